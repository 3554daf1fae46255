"""A run beside another one on the same data: what was lost and gained, sample by sample."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.special import bdtr

from pytest_cpas.documents import (
    AgainstDocument,
    ChangeDocument,
    FlipDocument,
    PairDocument,
    RunConditions,
    RunDocument,
    SampleDocument,
)
from pytest_cpas.golden import describe, differences
from pytest_cpas.report.document import flip_document
from pytest_cpas.report.messages import run_title
from pytest_cpas.report.stored import StoredReportError
from pytest_cpas.report.tables import labels
from pytest_cpas.types.samples import ALL

#: Runs that are given as documents, or by no more than their conditions.
_New = TypeVar("_New", bound=RunConditions)
_Old = TypeVar("_Old", bound=RunConditions)
_Run = TypeVar("_Run", bound=RunConditions)


def pairs(new: Sequence[_New], old: Sequence[_Old]) -> tuple[list[tuple[_New, _Old]], list[str]]:
    """Which runs to compare, and a line for each that has no counterpart.

    A run is compared with that of the same method on the same data set; where a data set has one
    run left on either side, with that of the other method. Raises :class:`StoredReportError` if
    there is no pair, or if one was made on other data or with other definitions of the metrics.
    """
    matched = [(a, b) for a in new for b in old if run_title(a) == run_title(b)]
    left, right = _without(new, [a for a, _ in matched]), _without(old, [b for _, b in matched])
    for dataset in dict.fromkeys(run["dataset"] for run in left):
        ours = [run for run in left if run["dataset"] == dataset]
        theirs = [run for run in right if run["dataset"] == dataset]
        if len(ours) == len(theirs) == 1:
            matched.append((ours[0], theirs[0]))
    if not matched:
        raise StoredReportError(
            f"nothing to compare: the run is of {_names(new)}, the other one of {_names(old)};"
            " expected a data set that both have, with the same method or with one method each"
        )
    for a, b in matched:
        if other := differences(_same(b, a), _same(a, b)):
            raise StoredReportError(
                f"{run_title(a)} cannot be compared with {run_title(b)}: {'; '.join(other)}. Judge"
                " both on the same data with the same version"
            )
    here, there = _without(new, [a for a, _ in matched]), _without(old, [b for _, b in matched])
    unpaired = [f"{run_title(run)} (this run only)" for run in here]
    unpaired += [f"{run_title(run)} (the other run only)" for run in there]
    return matched, unpaired


def _same(run: RunConditions, other: RunConditions) -> dict[str, str]:
    """What a run must have in common with another one: the data, and what its facts mean."""
    shared = run["definitions"].keys() & other["definitions"].keys()
    data = {key: value for key, value in run["identity"].items() if key == "data"}
    return {**data, **{name: run["definitions"][name] for name in shared}}


def _names(runs: Sequence[RunConditions]) -> str:
    return ", ".join(map(run_title, runs)) or "no method on no data set"


def _without(runs: Sequence[_Run], taken: Sequence[_Run]) -> list[_Run]:
    return [run for run in runs if not any(run is other for other in taken)]


def against(new: Sequence[RunDocument], old: Sequence[RunDocument]) -> AgainstDocument:
    """The part of a document that compares its runs with those of another one.

    Raises :class:`StoredReportError` as :func:`pairs`.
    """
    matched, unpaired = pairs(new, old)
    return {"pairs": [_pair(now, before) for now, before in matched], "unpaired": unpaired}


def _pair(new: RunDocument, old: RunDocument) -> PairDocument:
    now, before = _judged(new), _judged(old)
    common = now.keys() & before.keys()
    columns = _columns(new, old)
    conditions = [{**run["identity"], **run["provenance"]} for run in (old, new)]
    return {
        "method": new["method"],
        "dataset": new["dataset"],
        "other": old["method"],
        "differences": differences(*conditions),
        "common": len(common),
        "only_here": len(now) - len(common),
        "only_there": len(before) - len(common),
        "precision": list(_precision(now, before, columns, guard=False)),
        "guards": list(_precision(now, before, columns, guard=True)),
        "flips": list(_flips(now, before, columns)),
    }


def _judged(run: RunDocument) -> dict[str, SampleDocument]:
    """The samples of a run's document that have a row."""
    return {sample["sample"]: sample for sample in run["samples"] if sample["outcome"] is not None}


def _flips(
    now: Mapping[str, SampleDocument],
    before: Mapping[str, SampleDocument],
    columns: Sequence[_Column],
) -> Iterator[FlipDocument]:
    for name in sorted(now.keys() & before.keys()):
        old, new = before[name], now[name]
        flip = flip_document(
            name,
            new["category"],
            [
                (c.label, (old["outcome"] or "")[c.old], (new["outcome"] or "")[c.new])
                for c in columns
            ],
            describe(old["facts"], old["failure"]),
            describe(new["facts"], new["failure"]),
        )
        if flip:
            yield flip


@dataclass(frozen=True)
class _Column:
    """A column that two runs have, and which character of an outcome is its own in each."""

    label: str
    old: int
    new: int
    guard: bool


def _columns(new: RunDocument, old: RunDocument) -> list[_Column]:
    """Those that both were judged in, under the same definitions."""
    now, before = ([*labels(run["precision"]), *labels(run["guards"])] for run in (new, old))
    guards = labels(new["guards"])
    return [
        _Column(label, before.index(label), index, label in guards)
        for index, label in enumerate(now)
        if label in before
    ]


def _precision(
    now: Mapping[str, SampleDocument],
    before: Mapping[str, SampleDocument],
    columns: Sequence[_Column],
    *,
    guard: bool,
) -> Iterator[ChangeDocument]:
    """One entry per category (and "all") and column, of the samples of both runs."""
    common = now.keys() & before.keys()
    categories = sorted({now[name]["category"] for name in common})
    for category in (*categories, *([ALL] if common else [])):
        members = [name for name in common if category in (ALL, now[name]["category"])]
        for column in columns:
            if column.guard is not guard:
                continue
            outcomes = [
                (before[name]["outcome"] or "")[column.old]
                + (now[name]["outcome"] or "")[column.new]
                for name in members
            ]
            known = [pair for pair in outcomes if "-" not in pair]
            old, new = (np.array([pair[side] == "1" for pair in known]) for side in (0, 1))
            yield {
                "category": category,
                "threshold": column.label,
                "before": {"correct": int(old.sum()), "total": len(known)} if known else None,
                "after": {"correct": int(new.sum()), "total": len(known)} if known else None,
                "lost": int((old & ~new).sum()) if known else 0,
                "gained": int((new & ~old).sum()) if known else 0,
                "p": _p_value(old, new) if known else None,
            }


def _p_value(old: np.ndarray, new: np.ndarray) -> float | None:
    """McNemar's exact test, two-sided; None without a flip."""
    lost, gained = int((old & ~new).sum()), int((new & ~old).sum())
    if not lost + gained:
        return None
    return min(1.0, 2 * float(bdtr(min(lost, gained), lost + gained, 0.5)))
