"""A run beside another one on the same data: what was lost and gained, sample by sample."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from pytest_cpas.evaluation import DEFINITIONS, THRESHOLDS
from pytest_cpas.golden import TableSample, differences
from pytest_cpas.golden.spread import fewer, more
from pytest_cpas.report.document import Document, flip_document
from pytest_cpas.report.stored import StoredReportError
from pytest_cpas.report.words import run_name

#: What two runs must have in common to be compared.
_SAME = frozenset({"data", *DEFINITIONS})


def pairs(
    new: Sequence[Document], old: Sequence[Document]
) -> tuple[list[tuple[Document, Document]], list[str]]:
    """Which runs to compare, and in words those that have no counterpart.

    A run is compared with that of the same method on the same data set; where a data set has one
    run left on either side, with that of the other method. Of a run its method, data set and
    identity are looked at. Raises :class:`StoredReportError` if there is no pair, or if one was
    made on other data or with other definitions of the metrics.
    """
    found = [(a, b) for a in new for b in old if run_name(a) == run_name(b)]
    left, right = _without(new, [a for a, _ in found]), _without(old, [b for _, b in found])
    for dataset in dict.fromkeys(run["dataset"] for run in left):
        ours, theirs = ([r for r in runs if r["dataset"] == dataset] for runs in (left, right))
        if len(ours) == len(theirs) == 1:
            found.append((ours[0], theirs[0]))
    if not found:
        raise StoredReportError(
            f"nothing to compare: the run is of {_names(new)}, the other one of {_names(old)};"
            " expected a data set that both have, with the same method or with one method each"
        )
    for a, b in found:
        before, now = (
            {key: value for key, value in run["identity"].items() if key in _SAME} for run in (b, a)
        )
        if other := differences(before, now):
            raise StoredReportError(
                f"{run_name(a)} cannot be compared with {run_name(b)}: {'; '.join(other)}. Judge"
                " both on the same data with the same version"
            )
    alone = [
        f"{run_name(run)} ({which} only)"
        for which, runs, taken in (
            ("this run", new, [a for a, _ in found]),
            ("the other run", old, [b for _, b in found]),
        )
        for run in _without(runs, taken)
    ]
    return found, alone


def _names(runs: Sequence[Document]) -> str:
    return ", ".join(map(run_name, runs)) or "no method on no data set"


def _without(runs: Sequence[Document], taken: Sequence[Document]) -> list[Document]:
    return [run for run in runs if not any(run is other for other in taken)]


def against(new: Sequence[Document], old: Sequence[Document]) -> Document:
    """The part of a document that compares its runs with those of another one.

    Raises :class:`StoredReportError` as :func:`pairs`.
    """
    found, alone = pairs(new, old)
    return {"pairs": [_pair(now, before) for now, before in found], "unpaired": alone}


def _pair(new: Document, old: Document) -> Document:
    now, before = _judged(new), _judged(old)
    common = sorted(now.keys() & before.keys())
    conditions = [{**run["identity"], **run["provenance"]} for run in (old, new)]
    return {
        "method": new["method"],
        "dataset": new["dataset"],
        "other": old["method"],
        "differences": differences(*conditions),
        "common": len(common),
        "only_here": len(now) - len(common),
        "only_there": len(before) - len(common),
        "precision": list(_precision(now, before, common)),
        "flips": [
            flip for name in common if (flip := flip_document(name, before[name], now[name]))
        ],
    }


def _judged(run: Document) -> dict[str, TableSample]:
    """The samples of a run's document that have a row."""
    judged = {}
    for sample in run["samples"]:
        if sample["outcome"] is not None:
            # what is not finite is not in a document
            position, rotation = (
                math.inf if sample[key] is None else sample[key]
                for key in ("position_m", "rotation_deg")
            )
            judged[sample["sample"]] = TableSample(
                category=sample["category"],
                outcome=sample["outcome"],
                repeats=(),
                errors=(position, rotation, sample["iou"], sample["fscore_1cm"]),
                failure=sample["failure"] or "",
            )
    return judged


def _precision(
    now: Mapping[str, TableSample], before: Mapping[str, TableSample], common: Sequence[str]
) -> Iterator[Document]:
    """One entry per category (and "all") and joint threshold, of the samples of both runs."""
    categories = sorted({now[name].category for name in common})
    for category in (*categories, *(["all"] if common else [])):
        members = [name for name in common if category in ("all", now[name].category)]
        for index, threshold in enumerate(THRESHOLDS):
            outcomes = [before[name].outcome[index] + now[name].outcome[index] for name in members]
            known = [pair for pair in outcomes if "-" not in pair]
            entry: Document = {"category": category, "threshold": threshold.label}
            if not known:
                yield {**entry, "before": None, "after": None, "lost": 0, "gained": 0, "p": None}
                continue
            old, new = (np.array([pair[side] == "1" for pair in known]) for side in (0, 1))
            yield {
                **entry,
                "before": {"correct": int(old.sum()), "total": len(known)},
                "after": {"correct": int(new.sum()), "total": len(known)},
                "lost": int((old & ~new).sum()),
                "gained": int((new & ~old).sum()),
                "p": _p_value(old, new),
            }


def _p_value(old: np.ndarray, new: np.ndarray) -> float | None:
    """McNemar's exact test, two-sided; None without a flip."""
    if (old == new).all():
        return None
    return min(1.0, 2 * min(fewer(old[:, None], new), more(old[:, None], new)))
