"""When a run is diagnosed, and on which samples."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

from pytest_cpas.diagnosis.evidence import BOX_IOU, Evidence
from pytest_cpas.diagnosis.search import Explanation, diagnose
from pytest_cpas.evaluation import Row, Run, StoredRun
from pytest_cpas.evaluation.estimates import decode_estimates
from pytest_cpas.facts import Facts
from pytest_cpas.golden import RunTable
from pytest_cpas.golden.published import published_cells
from pytest_cpas.types import ContractError, GroundTruth, SampleRef
from pytest_cpas.types.samples import evenly

#: A run is diagnosed if a precision is below this share of the golden one, ...
FAR_BELOW = 0.5

#: ... or, without a golden table, if the coarser pose precision of a category is below this, ...
FLOOR = 0.25

#: ... or if among the samples with a correct pose the boxes are correct in less than this share.
BOX_FLOOR = 0.75

#: The coarser threshold of the paper: metres and degrees.
COARSE_POSITION, COARSE_ROTATION = 0.02, 10.0

#: Samples that are looked at, evenly spaced; and where each truth means reading images.
MOST_SAMPLES, MOST_TRUTHS = 10_000, 500

#: Golden precision by category and key of a column.
Expected = Mapping[tuple[str, str], float]


def expected_precision(golden: RunTable | None, run: Run) -> Expected:
    """What the golden table of a run, else the paper's, leads to expect; empty without one."""
    if golden is None:
        cells = published_cells(run.dataset, run.method)
        return {(cell.category, cell.column): cell.low / cell.total for cell in cells}
    return {
        (category, column): count.precision
        for category, counts in golden.table.items()
        for column, count in counts.items()
        if count is not None
    }


def is_far_below(table: RunTable, expected: Expected) -> bool:
    """Whether a run is so much worse than expected that it is worth asking why."""
    for category, counts in table.table.items():
        for column, count in counts.items():
            least = FAR_BELOW * expected.get((category, column), 0.0)
            if count is not None and count.precision < least:
                return True
    coarse: dict[str, list[bool]] = {}
    ious = []
    for sample in table.samples.values():
        right = _is_coarsely_right(sample.facts)
        coarse.setdefault(sample.category, []).append(right)
        if right and (iou := sample.facts.get("iou")) is not None:
            ious.append(iou)
    if not expected and any(sum(right) < FLOOR * len(right) for right in coarse.values()):
        return True
    return sum(iou >= BOX_IOU for iou in ious) < BOX_FLOOR * len(ious)


def _is_coarsely_right(facts: Facts) -> bool:
    position, rotation = facts["position_m"], facts["rotation_deg"]
    if position is None or rotation is None:
        return False
    return position <= COARSE_POSITION and rotation <= COARSE_ROTATION


def diagnose_run(
    run: Run, rows: Sequence[Row], table: RunTable, expected: Expected
) -> list[Explanation]:
    """What explains that a run is far below what is expected of it; empty if it is not.

    ``table`` is that of ``rows``.
    """
    info = run.info
    if info is None or not is_far_below(table, expected):
        return []
    rows = evenly(rows, MOST_SAMPLES if run.quick_truth else MOST_TRUTHS)
    refs = {ref.id: ref for ref in run.samples}
    unanswered: Counter[str] = Counter()
    answered: list[tuple[SampleRef, str, GroundTruth]] = []
    for row in rows:
        if row.estimate is None:
            unanswered[row.category] += 1
            continue
        ref = refs[row.sample]
        try:
            truth = run.truth(ref)
        except ContractError:  # judged when it was not yet damaged
            continue
        if truth is not None:
            answered.append((ref, row.estimate, truth))
    found = diagnose(
        Evidence.of(
            [ref.category for ref, _, _ in answered],
            decode_estimates([estimate for _, estimate, _ in answered]),
            [truth for _, _, truth in answered],
            info,
            unanswered=unanswered,
            focal=run.focal,
            scenes=[ref.scene for ref, _, _ in answered],
        )
    )
    return [replace(each, of_file=isinstance(run, StoredRun)) for each in found]
