"""What a session found, as one plain, versioned document: the only source of every renderer.

A document is a dict of JSON values, as of :mod:`pytest_cpas.documents`. It holds a time
only below ``speed``, where --cpas-benchmark asked for it, and a path only where a verdict names the
folder of a golden table: the same rows give the same document otherwise, wherever and in how many
parts they were judged.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
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
    ParityDocument,
    PointDocument,
    PrecisionDocument,
    RunDocument,
    SampleDocument,
    ScoreDocument,
    SpeedDocument,
    VerdictDocument,
)
from pytest_cpas.evaluation import Run
from pytest_cpas.golden import RunTable, TableSample, other_conditions, shared_columns
from pytest_cpas.golden.published import (
    count_problems,
    published_cells,
    published_datasets,
    published_name,
    published_sample_counts,
)
from pytest_cpas.metrics.precision import Count, Errors, curve
from pytest_cpas.protocols import (
    PAPER,
    Column,
    CountColumn,
    IntervalTable,
    Protocol,
    RankingColumn,
    ScoreColumn,
    count_columns,
    score_columns,
)
from pytest_cpas.report.intervals import interval_table, intervals_document, scenes_of
from pytest_cpas.report.lacking import lacking
from pytest_cpas.report.literature import literature_documents
from pytest_cpas.report.published import points, published_count, published_document
from pytest_cpas.types import Required, Verdict
from pytest_cpas.types.samples import ALL

FORMAT: Final = 2

#: The thresholds of the paper's curves: metric, and the limits (metres, degrees, F-score).
CURVES: Mapping[CurveName, Sequence[float]] = {
    "position_m": [i / 200 for i in range(11)],
    "rotation_deg": list(range(21)),
    "fscore_1cm": [i / 20 for i in range(21)],
}

#: Reasons without an answer that are told of a run.
_MOST_FAILURES = 20

#: Outcomes, the worst first. "skipped": a verdict could not be given, and none was required.
SEVERITY: Sequence[ItemOutcome] = ("failed", "skipped", "passed")


def document(
    runs: Sequence[RunDocument], failed_items: int, protocols: Sequence[Protocol]
) -> Document:
    """The document of a session: its runs, as of :func:`run_document`, failing ones first.

    ``protocols``: what they are judged under; ``failed_items`` counts the test items that failed,
    whatever they tested. If a run is on a data set of the paper, the published tables stand beside;
    under nocs-legacy, what the literature prints does.
    """
    content: Document = {
        "format": FORMAT,
        "outcome": "failed" if failed_items else worst(run["outcome"] for run in runs),
        "failed_items": failed_items,
        "thresholds": [label(column) for column in shown_columns(protocols, guard=False)],
        "guards": [label(column) for column in shown_columns(protocols, guard=True)],
        "runs": sorted(runs, key=lambda run: SEVERITY.index(run["outcome"])),
        "published": {name: published_document(name) for name in published_datasets()}
        if any(run["published_as"] for run in runs)
        else {},
    }
    if beside := literature_documents(runs, protocols):
        content["literature"] = beside
    return content


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
    parity: ParityDocument | None = None,
    samples: bool = True,
) -> RunDocument:
    """The document of one run.

    ``new``: its table; ``errors``: why samples have no row; ``golden``: the recorded table, shown
    beside it if it was made under the same conditions; ``speed``: what :mod:`pytest_cpas.timing`
    measured; ``parity``: what :mod:`pytest_cpas.traces` found; ``samples``: whether they are
    listed.
    """
    if golden is not None and other_conditions(golden, new):
        golden = None
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
    scenes, intervals = scenes_of(new), interval_table(new)
    # workers send them in any order
    checks = [_contract(result) for result in sorted(contract, key=lambda result: result.check)]
    content: RunDocument = {
        "method": run.method,
        "dataset": run.dataset,
        "published_as": published,
        "outcome": run_outcome(problems or errors, checks, speed, verdict_documents, parity),
        "judged": len(new.samples),
        "listed": sum(run.listed.values()),
        "unanswered": sum(bool(sample.failure) for sample in new.samples.values()),
        "scenes": None if scenes is None else len(set(scenes)),
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
        "precision": _precision(new, golden, intervals, published, guard=False),
        "guards": _precision(new, golden, intervals, published, guard=True),
        "scores": _scores(new, golden, intervals),
        "lacking": lacking(new),
        "curves": _curves(new),
        "flips": _flips(new, golden),
        "samples": _samples(run, new, golden, errors) if samples else [],
        "speed": speed,
        "up_axes": None,  # :mod:`pytest_cpas.report.up_axes`, for a report only
        "identity": dict(run.identity),
        "definitions": dict(run.definitions),
        "provenance": dict(run.provenance),
    }
    if parity is not None:
        content["parity"] = parity
    if failures := Counter(s.failure for s in new.samples.values() if s.failure):
        content["failures"] = dict(failures.most_common(_MOST_FAILURES))
    notes = [*filter(None, [run.derived]), *run.notes]
    listed, published_count = content["listed"], sum(published_sample_counts(run.dataset).values())
    if listed < published_count:
        told = f"{listed} of the {published_count} samples that were published are at hand"
        notes += [told] if told not in notes else []  # where a report is judged anew
    if notes:
        content["notes"] = notes
    return content


def run_outcome(
    broken: Collection[object],
    contract: Iterable[ContractDocument],
    speed: SpeedDocument | None,
    verdicts: Iterable[VerdictDocument],
    parity: ParityDocument | None = None,
) -> ItemOutcome:
    """The outcome of a run; ``broken``: what is wrong with its data and its samples."""
    violated = any(check["status"] in ("violated", "gone") for check in contract)
    slower = speed is not None and speed["verdict"]["outcome"] == "failed"
    parts = parity is not None and parity["outcome"] == "failed"
    if broken or violated or slower or parts:
        return "failed"
    return worst(verdict["outcome"] for verdict in verdicts)


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


def shown_columns(protocols: Sequence[Protocol], *, guard: bool) -> list[CountColumn]:
    """The columns that count samples and are to be read, or those that are there to be guarded."""
    return [column for column in count_columns(protocols) if column.guard is guard]


def label(column: Column) -> str:
    """What a column is called in a document: with its protocol, unless that is the paper's."""
    return column.label if column.protocol == PAPER else f"{column.protocol}: {column.label}"


def _precision(
    new: RunTable,
    golden: RunTable | None,
    intervals: IntervalTable,
    published: str | None,
    *,
    guard: bool,
) -> list[PrecisionDocument]:
    """One entry per category (and "all") and column; what is n/a is None."""
    cells = published_cells(published, new.method) if published else []
    paper = {(cell.category, cell.column): cell for cell in cells}
    old = golden.table if golden else {}
    return [
        {
            "category": category,
            "threshold": label(column),
            "measured": _count(new.table.get(category, {}).get(column.key)),
            "intervals": intervals_document(intervals.get(category, {}).get(column.key)),
            "golden": _count(old.get(category, {}).get(column.key)),
            "published": published_count(cell)
            if (cell := paper.get((category, column.key)))
            else None,
        }
        for category in _in_order({*new.table, *old})
        for column in shown_columns(new.protocols, guard=guard)
    ]


def _scores(
    new: RunTable, golden: RunTable | None, intervals: IntervalTable
) -> list[ScoreDocument]:
    old = golden.scores if golden else {}
    scores: list[ScoreDocument] = []
    columns: list[ScoreColumn | RankingColumn] = [
        *score_columns(new.protocols),
        *new.ranking_columns,
    ]
    for category in _in_order(new.scores.keys()):
        for column in columns:
            score = new.scores[category].get(column.key)
            before = old.get(category, {}).get(column.key)
            scores.append(
                {
                    "category": category,
                    "score": label(column),
                    "guard": column.guard,
                    "measured": short(score.value) if score else None,
                    "intervals": intervals_document(intervals.get(category, {}).get(column.key)),
                    "golden": short(before.value) if before else None,
                    "samples": score.samples if score else 0,
                    "better": column.better,
                    "share": not (isinstance(column, ScoreColumn) and column.median),
                }
            )
    return scores


def _in_order(categories: Collection[str]) -> list[str]:
    """By name, and "all" last."""
    return sorted(categories, key=lambda name: (name == ALL, name))


def short(value: float) -> float | None:
    """A number as a document has it for people; None if it is infinite."""
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _count(count: Count | None) -> CountDocument | None:
    return None if count is None else {"correct": count.correct, "total": count.total}


def _curves(table: RunTable) -> CurvesDocument:
    """Per metric the counts at :data:`CURVES`; None where the metric is n/a."""
    samples = table.samples.values()
    errors = Errors(
        {
            name.removesuffix("_1cm"): [sample.facts.get(name) for sample in samples]
            for name in CURVES
        }
    )

    def counts(name: CurveName) -> list[PointDocument] | None:
        limits = CURVES[name]
        counted = curve(errors, name.removesuffix("_1cm"), limits) if table.samples else None
        return None if counted is None else points(zip(limits, counted, strict=True))

    return {
        "position_m": counts("position_m"),
        "rotation_deg": counts("rotation_deg"),
        "fscore_1cm": counts("fscore_1cm"),
    }


def flip_document(
    name: str, category: str, outcomes: Iterable[tuple[str, str, str]], before: str, after: str
) -> FlipDocument | None:
    """In which columns a sample is judged otherwise than before; None if in none.

    ``outcomes``: the label of each column, and the characters then and now; ``before`` and
    ``after``: the answers in words.
    """
    flip: FlipDocument = {
        "sample": name,
        "category": category,
        "lost": [],
        "gained": [],
        "changed": [],
        "before": before,
        "after": after,
    }
    for column, old, new in outcomes:
        if (old, new) == ("1", "0"):
            flip["lost"].append(column)
        elif (old, new) == ("0", "1"):
            flip["gained"].append(column)
        elif old != new:
            flip["changed"].append(column)
    return flip if flip["lost"] or flip["gained"] or flip["changed"] else None


def _flips(new: RunTable, golden: RunTable | None) -> list[FlipDocument]:
    if golden is None:
        return []
    shared = shared_columns(golden, new)
    flips = []
    for name in sorted(golden.samples.keys() & new.samples.keys()):
        old, now = golden.samples[name], new.samples[name]
        pairs = [(label(c.column), old.outcome[c.old], now.outcome[c.new]) for c in shared]
        if any(before != after for _, before, after in pairs):
            words = old.describe(), now.describe()
            flips.append(flip_document(name, now.category, pairs, *words))
    return [flip for flip in flips if flip]


def _samples(
    run: Run, new: RunTable, golden: RunTable | None, errors: Mapping[str, str]
) -> list[SampleDocument]:
    """The samples that have a row or an error, by name."""
    category = {ref.id: ref.category for ref in run.samples}
    old = golden.samples if golden else {}
    samples: list[SampleDocument] = []
    for name in sorted({*new.samples, *errors}):
        judged = new.samples.get(name)
        facts = {
            name: value
            for name, value in (judged.facts if judged else {}).items()
            if value is None or math.isfinite(value)
        }
        shown = {name: None if value is None else short(value) for name, value in facts.items()}
        samples.append(
            {
                "sample": name,
                "category": judged.category if judged else category[name],
                "scene": new.scenes.get(name, ""),
                "outcome": _outcome(judged, new, new) if judged else None,
                "golden": _outcome(old[name], golden, new) if golden and name in old else None,
                "position_m": shown.get("position_m"),
                "rotation_deg": shown.get("rotation_deg"),
                "iou": shown.get("iou"),
                "fscore_1cm": shown.get("fscore_1cm"),
                "facts": facts,
                "failure": judged.failure if judged else None,
                "error": None if judged else errors[name],
            }
        )
    return samples


def _outcome(sample: TableSample, table: RunTable, shown: RunTable) -> str:
    """The outcome of a sample of ``table`` as the document has it, in the columns of ``shown``."""
    letters = {column.new: sample.outcome[column.old] for column in shared_columns(table, shown)}
    order = sorted(range(len(shown.columns)), key=lambda index: shown.columns[index].guard)
    return "".join(letters.get(index, "-") for index in order)
