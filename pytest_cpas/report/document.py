"""What a session found, as one plain, versioned document: the only source of every renderer.

A document is a dict of JSON values, as of :mod:`pytest_cpas.documents`. It holds no path,
and a time only below ``speed``, where --cpas-benchmark asked for it: the same rows give the same
document, wherever and in how many parts they were judged.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Final

from pytest_cpas.checks.contract import ContractResult
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.diagnosis import Explanation
from pytest_cpas.documents import (
    CategoryDocument,
    ContractDocument,
    ContractStatus,
    CountDocument,
    CurveName,
    CurvesDocument,
    Document,
    FlipDocument,
    ItemOutcome,
    PointDocument,
    PrecisionDocument,
    RunDocument,
    SampleDocument,
    SpeedDocument,
    VerdictDocument,
)
from pytest_cpas.evaluation import THRESHOLDS, Run, Table
from pytest_cpas.golden import RunTable, TableSample, differences
from pytest_cpas.golden.published import (
    PublishedCell,
    count_problems,
    published_cells,
    published_datasets,
    published_name,
)
from pytest_cpas.metrics.precision import Count, curve
from pytest_cpas.report.published import points, published_count, published_document
from pytest_cpas.types import Required, Verdict
from pytest_cpas.types.samples import ALL

FORMAT: Final = 1

#: The thresholds of the paper's curves: metric, and the limits (metres, degrees, F-score).
CURVES: Mapping[CurveName, Sequence[float]] = {
    "position_m": [i / 200 for i in range(11)],
    "rotation_deg": list(range(21)),
    "fscore_1cm": [i / 20 for i in range(21)],
}

#: Outcomes, the worst first. "skipped": a verdict could not be given, and none was required.
SEVERITY: Sequence[ItemOutcome] = ("failed", "skipped", "passed")


def document(runs: Sequence[RunDocument], failed_items: int) -> Document:
    """The document of a session: its runs, as of :func:`run_document`, failing ones first.

    ``failed_items`` counts the test items that failed, whatever they tested. If a run is on a data
    set of the paper, the published tables stand beside.
    """
    return {
        "format": FORMAT,
        "outcome": "failed" if failed_items else worst(run["outcome"] for run in runs),
        "failed_items": failed_items,
        "thresholds": [threshold.label for threshold in THRESHOLDS],
        "runs": sorted(runs, key=lambda run: SEVERITY.index(run["outcome"])),
        "published": {name: published_document(name) for name in published_datasets()}
        if any(run["published_as"] for run in runs)
        else {},
    }


def run_document(
    run: Run,
    new: RunTable,
    *,
    errors: Mapping[str, str] = MappingProxyType({}),
    verdicts: Sequence[Verdict] = (),
    require_golden: Required = False,
    contract: Iterable[ContractResult] = (),
    findings: Sequence[Explanation] = (),
    golden: RunTable | None = None,
    speed: SpeedDocument | None = None,
    samples: bool = True,
) -> RunDocument:
    """The document of one run.

    ``new``: its table; ``errors``: why samples have no row; ``golden``: the recorded table, shown
    beside it if it was made under the same conditions; ``speed``: what :mod:`pytest_cpas.timing`
    measured; ``samples``: whether they are listed.
    """
    if golden is not None and differences(golden.identity, new.identity):
        golden = None
    old = golden.samples if golden else {}
    published = published_name(run.dataset, run.listed)
    problems = [
        *run.damaged,
        *count_problems(run.dataset, run.listed, partial=bool(run.missing)).values(),
    ]
    verdict_documents: list[VerdictDocument] = [
        {
            "word": verdict.word.value,
            "category": verdict.category,
            "details": verdict.details,
            "outcome": verdict.outcome(require_golden),
        }
        for verdict in verdicts
    ]
    # workers send them in any order
    checks = [_contract(result) for result in sorted(contract, key=lambda result: result.check)]
    broken = problems or errors or any(c["status"] in ("violated", "gone") for c in checks)
    slower = speed is not None and speed["verdict"]["outcome"] == "failed"
    return {
        "method": run.method,
        "dataset": run.dataset,
        "published_as": published,
        "outcome": "failed" if broken or slower else worst(v["outcome"] for v in verdict_documents),
        "judged": len(new.samples),
        "listed": sum(run.listed.values()),
        "unanswered": sum(bool(sample.failure) for sample in new.samples.values()),
        "categories": _categories(run, new),
        "seeds": run.seeds,
        "missing": list(run.missing),
        "problems": problems,
        "verdicts": verdict_documents,
        "findings": [
            {"category": finding.category, "name": finding.name, "lines": finding.lines()}
            for finding in findings
        ],
        "contract": checks,
        "precision": _precision(
            new.table,
            golden.table if golden else {},
            published_cells(published, run.method) if published else [],
        ),
        "curves": _curves(new),
        "flips": [
            flip
            for name in sorted(old.keys() & new.samples.keys())
            if (flip := flip_document(name, old[name], new.samples[name]))
        ],
        "samples": _samples(run, new, old, errors) if samples else [],
        "speed": speed,
        "up_axes": None,  # :mod:`pytest_cpas.report.up_axes`, for a report only
        "identity": dict(run.identity),
        "provenance": dict(run.provenance),
    }


def worst(outcomes: Iterable[ItemOutcome]) -> ItemOutcome:
    """The worst of some outcomes; of none, "skipped"."""
    return min(outcomes, key=SEVERITY.index, default="skipped")


def _contract(result: ContractResult) -> ContractDocument:
    status: ContractStatus
    if result.outcome is Outcome.NOT_OFFERED:
        status = "n/a"
    elif result.known:
        status = "known" if result.violated else "gone"
    elif result.wrong:
        status = "violated"
    else:
        status = "information" if result.violated else "passed"
    return {"check": result.check, "status": status, "message": result.message}


def _categories(run: Run, new: RunTable) -> dict[str, CategoryDocument]:
    judged = Counter(sample.category for sample in new.samples.values())
    return {
        name: {"judged": judged[name], "listed": count}
        for name, count in sorted(run.listed.items())
    }


def _precision(
    table: Table, golden: Table, published: Sequence[PublishedCell]
) -> list[PrecisionDocument]:
    """One entry per category (and "all") and joint threshold; what is n/a is None."""
    paper = {(cell.category, cell.label): cell for cell in published}
    return [
        {
            "category": category,
            "threshold": threshold.label,
            "measured": _count(table.get(category, {}).get(threshold.label)),
            "golden": _count(golden.get(category, {}).get(threshold.label)),
            "published": published_count(cell)
            if (cell := paper.get((category, threshold.label)))
            else None,
        }
        for category in (*sorted({*table, *golden} - {ALL}), *([ALL] if table else []))
        for threshold in THRESHOLDS
    ]


def _count(count: Count | None) -> CountDocument | None:
    return None if count is None else {"correct": count.correct, "total": count.total}


def _curves(table: RunTable) -> CurvesDocument:
    """Per metric the counts at :data:`CURVES`; None where the metric is n/a."""
    errors = table.errors

    def counts(name: CurveName) -> list[PointDocument] | None:
        limits = CURVES[name]
        counted = curve(errors, name.removesuffix("_1cm"), limits) if table.samples else None
        return None if counted is None else points(zip(limits, counted, strict=True))

    return {
        "position_m": counts("position_m"),
        "rotation_deg": counts("rotation_deg"),
        "fscore_1cm": counts("fscore_1cm"),
    }


def flip_document(name: str, old: TableSample, new: TableSample) -> FlipDocument | None:
    """At which thresholds a sample is judged otherwise than before; None if at none."""
    if old.outcome == new.outcome:
        return None
    flip: FlipDocument = {
        "sample": name,
        "category": new.category,
        "lost": [],
        "gained": [],
        "changed": [],
        "before": old.describe(),
        "after": new.describe(),
    }
    for threshold, before, after in zip(THRESHOLDS, old.outcome, new.outcome, strict=True):
        if (before, after) == ("1", "0"):
            flip["lost"].append(threshold.label)
        elif (before, after) == ("0", "1"):
            flip["gained"].append(threshold.label)
        elif before != after:
            flip["changed"].append(threshold.label)
    return flip


def _samples(
    run: Run, new: RunTable, old: Mapping[str, TableSample], errors: Mapping[str, str]
) -> list[SampleDocument]:
    """The samples that have a row or an error, by name."""
    category = {ref.id: ref.category for ref in run.samples}
    samples: list[SampleDocument] = []
    for name in sorted({*new.samples, *errors}):
        judged = new.samples.get(name)
        values = judged.errors if judged else (None,) * 4
        # as golden tables keep them: the last bits are those of a process, not of a run
        position, rotation, iou, fscore = (
            None if value is None or not math.isfinite(value) else float(f"{value:.6g}")
            for value in values
        )
        samples.append(
            {
                "sample": name,
                "category": judged.category if judged else category[name],
                "outcome": judged.outcome if judged else None,
                "golden": old[name].outcome if name in old else None,
                "position_m": position,
                "rotation_deg": rotation,
                "iou": iou,
                "fscore_1cm": fscore,
                "failure": judged.failure or None if judged else None,
                "error": None if judged else errors[name],
            }
        )
    return samples
