"""When a run is diagnosed, and on which samples."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from pytest_cpas.diagnosis.evidence import BOX_IOU, Evidence
from pytest_cpas.diagnosis.search import Explanation, diagnose
from pytest_cpas.evaluation import THRESHOLDS, Row, Run
from pytest_cpas.evaluation.estimates import decode_estimates
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

#: Samples whose truth is read anew where that means reading images too.
MOST_TRUTHS = 500

#: Golden precision by category and threshold.
Expected = Mapping[tuple[str, str], float]


def expected_precision(golden: RunTable | None, run: Run) -> Expected:
    """What the golden table of a run, else the paper's, leads to expect; empty without one."""
    if golden is None:
        cells = published_cells(run.dataset, run.method)
        return {(cell.category, cell.label): cell.low / cell.total for cell in cells}
    return {
        (category, label): count.precision
        for category, counts in golden.table.items()
        for label, count in counts.items()
        if count is not None
    }


def is_far_below(table: RunTable, expected: Expected) -> bool:
    """Whether a run is so much worse than expected that it is worth asking why."""
    coarse = THRESHOLDS[0]
    for category, counts in table.table.items():
        for label, count in counts.items():
            least = FAR_BELOW * expected.get((category, label), 0.0)
            if not expected and label == coarse.label:
                least = FLOOR
            if count is not None and count.precision < least:
                return True
    ious = [
        iou
        for sample in table.samples.values()
        if (iou := sample.errors[2]) is not None and sample.outcome[0] == "1"
    ]
    return sum(iou >= BOX_IOU for iou in ious) < BOX_FLOOR * len(ious)


def diagnose_run(
    run: Run, rows: Sequence[Row], table: RunTable, expected: Expected
) -> list[Explanation]:
    """What explains that a run is far below what is expected of it; empty if it is not.

    ``table`` is that of ``rows``.
    """
    info = run.info
    if info is None or not is_far_below(table, expected):
        return []
    if not run.quick_truth:
        rows = evenly(rows, MOST_TRUTHS)
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
    return diagnose(
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
