"""A run beside another one on the same data: what was lost and gained, sample by sample."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeVar

import numpy as np
from scipy.special import bdtr

from pytest_cpas.documents import (
    AgainstDocument,
    ChangeDocument,
    PairDocument,
    RunConditions,
    RunDocument,
)
from pytest_cpas.evaluation import DEFINITIONS, THRESHOLDS
from pytest_cpas.golden import TableSample, differences
from pytest_cpas.report.document import flip_document
from pytest_cpas.report.messages import run_title
from pytest_cpas.report.stored import StoredReportError
from pytest_cpas.types.samples import ALL

#: What two runs must have in common to be compared.
_SAME = frozenset({"data", *DEFINITIONS})


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
        if other := differences(_same(b), _same(a)):
            raise StoredReportError(
                f"{run_title(a)} cannot be compared with {run_title(b)}: {'; '.join(other)}. Judge"
                " both on the same data with the same version"
            )
    here, there = _without(new, [a for a, _ in matched]), _without(old, [b for _, b in matched])
    unpaired = [f"{run_title(run)} (this run only)" for run in here]
    unpaired += [f"{run_title(run)} (the other run only)" for run in there]
    return matched, unpaired


def _same(run: RunConditions) -> dict[str, str]:
    """The part of a run's identity that another one must have as well."""
    return {key: value for key, value in run["identity"].items() if key in _SAME}


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


def _judged(run: RunDocument) -> dict[str, TableSample]:
    """The samples of a run's document that have a row."""
    judged = {}
    for sample in run["samples"]:
        if sample["outcome"] is not None:
            # what is not finite is not in a document
            position, rotation = (
                math.inf if error is None else error
                for error in (sample["position_m"], sample["rotation_deg"])
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
) -> Iterator[ChangeDocument]:
    """One entry per category (and "all") and joint threshold, of the samples of both runs."""
    categories = sorted({now[name].category for name in common})
    for category in (*categories, *([ALL] if common else [])):
        members = [name for name in common if category in (ALL, now[name].category)]
        for index, threshold in enumerate(THRESHOLDS):
            outcomes = [before[name].outcome[index] + now[name].outcome[index] for name in members]
            known = [pair for pair in outcomes if "-" not in pair]
            if not known:
                yield {
                    "category": category,
                    "threshold": threshold.label,
                    "before": None,
                    "after": None,
                    "lost": 0,
                    "gained": 0,
                    "p": None,
                }
                continue
            old, new = (np.array([pair[side] == "1" for pair in known]) for side in (0, 1))
            yield {
                "category": category,
                "threshold": threshold.label,
                "before": {"correct": int(old.sum()), "total": len(known)},
                "after": {"correct": int(new.sum()), "total": len(known)},
                "lost": int((old & ~new).sum()),
                "gained": int((new & ~old).sum()),
                "p": _p_value(old, new),
            }


def _p_value(old: np.ndarray, new: np.ndarray) -> float | None:
    """McNemar's exact test, two-sided; None without a flip."""
    lost, gained = int((old & ~new).sum()), int((new & ~old).sum())
    if not lost + gained:
        return None
    return min(1.0, 2 * float(bdtr(min(lost, gained), lost + gained, 0.5)))
