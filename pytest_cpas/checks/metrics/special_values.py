"""Properties of precision where errors are special: none at all, infinite, or just beside a limit.

An error of a sample without an answer is infinite (minus infinite, where larger is better), one
that is n/a is None. An implementation may refuse either; what it must not do is judge otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pytest_cpas.checks.metrics.precision import FINE, LARGER_IS_BETTER, LIMITS, MEAN, PRECISION
from pytest_cpas.checks.metrics.properties import REFUSED, close, expect, prop, unless_refused
from pytest_cpas.checks.metrics.subject import Subject

#: Errors by name: numbers, None where n/a, "failed" without an answer.
Columns = Mapping[str, list[Any]]
Limits = Mapping[str, float]

_NAMES = sorted(LIMITS)
_NAME = st.sampled_from(_NAMES)


def _number(name: str, value: Any) -> Any:
    if value == "failed":
        return -math.inf if name in LARGER_IS_BETTER else math.inf
    return value


def _arrays(columns: Columns) -> dict[str, Any]:
    """Columns of floats, or of objects where something is n/a."""
    return {
        name: np.array(
            [_number(name, value) for value in column], dtype=object if None in column else float
        )
        for name, column in columns.items()
    }


def _correct(name: str, value: Any, limit: float, strict: bool) -> bool:
    number, bound = _number(name, value), limit
    if name in LARGER_IS_BETTER:
        number, bound = -number, -bound
    return bool(number < bound or (number == bound and not strict))


def _judged(columns: Columns, limits: Limits, strict: bool) -> list[bool | None]:
    """Whether each sample meets all limits; None where an error that is limited is n/a."""
    rows = zip(*(columns[name] for name in limits), strict=True)
    return [
        None
        if None in row
        else all(
            _correct(name, value, limits[name], strict)
            for name, value in zip(limits, row, strict=True)
        )
        for row in rows
    ]


def _share(judged: list[bool | None]) -> float | None:
    known = [correct for correct in judged if correct is not None]
    return sum(known) / len(known) if known else None


def _same(value: Any, expected: float | None) -> None:
    if expected is None:
        expect(value is None, f"the value is {value!r}, but there is nothing to judge: None (n/a)")
    else:
        close(value, expected, FINE)


def _by_hand(subject: Subject, columns: Columns, limits: Limits, may_refuse: bool) -> None:
    strict = subject.defines(PRECISION, "boundary") == "strict"
    args = (_arrays(columns), dict(limits))
    value = unless_refused(subject, PRECISION, *args) if may_refuse else subject(PRECISION, *args)
    if value is not REFUSED:
        _same(value, _share(_judged(columns, limits, strict)))


def _good(name: str) -> float:
    return 1.0 if name in LARGER_IS_BETTER else 0.0


def _failed() -> Iterator[dict[str, Any]]:
    for name in _NAMES:
        other = _NAMES[_NAMES.index(name) - 1]
        for limit in (LIMITS[name][1], 0.0):
            yield {"columns": {name: ["failed", _good(name), "failed"]}, "limits": {name: limit}}
            yield {"columns": {name: ["failed"]}, "limits": {name: limit}}
        columns = {
            name: ["failed", _good(name), _good(name)],
            other: [_good(other), "failed", _good(other)],
        }
        yield {"columns": columns, "limits": {name: LIMITS[name][1], other: LIMITS[other][1]}}


@prop(
    PRECISION,
    reason="a sample without an answer counts, as one that is wrong: left out, it flatters a method"
    " that gives up; a mean or a difference of infinities is NaN",
    given={
        "columns": st.lists(st.sampled_from(["failed", 0.5, 0.6]), min_size=1, max_size=6).map(
            lambda column: {"fscore": column}
        ),
        "limits": st.sampled_from([0.0, 0.55, 0.7]).map(lambda limit: {"fscore": limit}),
    },
    weight=0.25,
    corners=_failed,
)
def failed_samples(subject: Subject, columns: Columns, limits: Limits) -> None:
    """A sample with an infinite error is wrong at every limit, and counts."""
    _by_hand(subject, columns, limits, may_refuse=True)


def _zeros() -> Iterator[dict[str, Any]]:
    for name in _NAMES:
        columns = {name: [0.0, LIMITS[name][0], 1.0, 0.0]}
        yield {"columns": columns, "limits": {name: 0.0}}
        for other in ("rotation_deg", "iou"):
            if other != name:
                both = {**columns, other: [_good(other)] * 3 + [LIMITS[other][1] * 0.99 + 0.2]}
                yield {"columns": both, "limits": {name: 0.0, other: LIMITS[other][1]}}


@prop(
    PRECISION,
    reason="a limit of 0 is a limit: code that asks `if limit` takes it for none",
    given={
        "columns": st.lists(st.sampled_from([0.0, 0.3]), min_size=1, max_size=6).map(
            lambda column: {"position_m": column}
        ),
        "limits": st.just({"position_m": 0.0}),
    },
    weight=0.1,
    corners=_zeros,
)
def limit_of_zero(subject: Subject, columns: Columns, limits: Limits) -> None:
    """A limit of 0 is met by 0, or by nothing, as the definition says of a limit."""
    _by_hand(subject, columns, limits, may_refuse=False)


#: Four steps, so that a change of unit does not round a value onto its limit.
_STEPS = 4


def _beside(limit: float, relative: float) -> list[float]:
    if relative == 0:
        low = high = limit
        for _ in range(_STEPS):
            low, high = math.nextafter(low, -math.inf), math.nextafter(high, math.inf)
        return [low, high]
    return [limit * (1 - relative), limit * (1 + relative)]


def _near_limits() -> Iterator[dict[str, Any]]:
    for name in _NAMES:
        for limit in (*LIMITS[name], LIMITS[name][1] * 0.7):
            values = [v for r in (0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3) for v in _beside(limit, r)]
            yield {"columns": {name: values}, "limits": {name: limit}}
            for value in values:
                yield {"columns": {name: [value]}, "limits": {name: limit}}


@prop(
    PRECISION,
    reason="a tolerance, a rounding or a float32 moves a limit, and with it the samples near it",
    given={
        "columns": st.lists(
            st.sampled_from([v for r in (0, 1e-9, 1e-6) for v in _beside(7.3, r)]),
            min_size=1, max_size=6,
        ).map(lambda column: {"rotation_deg": column}),
        "limits": st.just({"rotation_deg": 7.3}),
    },
    weight=0.1,
    corners=_near_limits,
)  # fmt: skip
def beside_a_limit(subject: Subject, columns: Columns, limits: Limits) -> None:
    """A value a few steps of floating point beside its limit is on the side where it is."""
    _by_hand(subject, columns, limits, may_refuse=False)


def _unknown() -> Iterator[dict[str, Any]]:
    for name in _NAMES:
        limits = {name: LIMITS[name][1]}
        bad = "failed"
        yield {"columns": {name: []}, "limits": limits}
        yield {"columns": {name: [None, None]}, "limits": limits}
        yield {"columns": {name: [None, _good(name), bad, _good(name)]}, "limits": limits}
        other = _NAMES[_NAMES.index(name) - 1]
        both = {name: [None, _good(name), bad], other: [_good(other), None, _good(other)]}
        yield {"columns": both, "limits": {**limits, other: LIMITS[other][1]}}
        yield {"columns": both, "limits": limits}


@prop(
    PRECISION,
    reason="what is n/a is no number: as 0 it is perfect or hopeless, in the divisor it is wrong",
    given={
        "columns": st.lists(st.sampled_from([None, 0.005, 0.3]), max_size=6).map(
            lambda column: {"nad": column}
        ),
        "limits": st.just({"nad": 0.05}),
    },
    weight=0.25,
    corners=_unknown,
)
def nothing_to_judge(subject: Subject, columns: Columns, limits: Limits) -> None:
    """A sample whose error is None takes no part; without any there is no precision."""
    _by_hand(subject, columns, limits, may_refuse=True)


@prop(
    PRECISION,
    reason="what is not known of any sample can not be met, nor be left out of a joint limit",
    given={"name": _NAME, "other": _NAME},
    weight=0.25,
    corners=lambda: (
        {"name": name, "other": other} for name in _NAMES for other in _NAMES if name != other
    ),
)
def unknown_metric(subject: Subject, name: str, other: str) -> None:
    """A limit on errors that are not given has no value, whatever else is limited."""
    if name == other:
        return
    limits = {n: LIMITS[n][1] for n in (name, other)}
    value = unless_refused(subject, PRECISION, {other: np.full(3, _good(other))}, limits)
    if value is not REFUSED:
        _same(value, None)


@prop(
    PRECISION,
    reason="counters of 8 and 16 bits overflow, and parts of a data set get lost",
    given={"counts": st.lists(st.integers(0, 400), min_size=2, max_size=2).filter(any)},
    weight=0.1,
    corners=lambda: ({"counts": c} for c in ([128, 1], [255, 3], [256, 0], [70_000, 1])),
)
def many_samples(subject: Subject, counts: list[int]) -> None:
    """The precision of many samples is the share of those that are correct."""
    right, wrong = counts
    errors = {"iou": np.repeat([0.9, 0.1], [right, wrong])}
    close(subject(PRECISION, errors, {"iou": 0.5}), right / (right + wrong), FINE)


# -- over categories ---------------------------------------------------------------------------

#: Names that contain each other, or differ in case or length alone.
_ALIKE = ("can", "canister", "scan", "Can", "c", "ca", "a can")


def _mean(columns: Columns, limits: Limits, categories: list[str], names: list[str]) -> Any:
    judged = _judged(columns, limits, strict=False)
    shares = [
        _share([c for c, own in zip(judged, categories, strict=True) if own == name])
        for name in names
    ]
    present = [share for share in shares if share is not None]
    return sum(present) / len(present) if present else None


def _mean_by_hand(
    subject: Subject, columns: Columns, limits: Limits, categories: list[str], names: list[str],
    may_refuse: bool = False,
) -> None:  # fmt: skip
    args = (_arrays(columns), dict(limits), list(categories), list(names))
    value = unless_refused(subject, MEAN, *args) if may_refuse else subject(MEAN, *args)
    if value is not REFUSED:
        _same(value, _mean(columns, limits, categories, names))


def _alike() -> Iterator[dict[str, Any]]:
    for one in _ALIKE:
        for other in _ALIKE:
            if one != other:
                yield {"correct": [1, 0, 0], "categories": [one, other, other], "names": [one]}
                yield {"correct": [1, 0], "categories": [one, other], "names": [other, one, "b"]}


@prop(
    MEAN,
    reason="`in` finds a name in another one, and an array of names cuts the longer ones off",
    given={
        "correct": st.lists(st.integers(0, 1), min_size=4, max_size=4),
        "categories": st.lists(st.sampled_from(_ALIKE), min_size=4, max_size=4),
        "names": st.lists(st.sampled_from(_ALIKE), min_size=1, max_size=4, unique=True),
    },
    weight=0.5,
    corners=_alike,
)
def names_alike(
    subject: Subject, correct: list[int], categories: list[str], names: list[str]
) -> None:
    """Categories whose names contain each other are different ones."""
    columns = {"rotation_deg": [3.0 if c else 30.0 for c in correct]}
    _mean_by_hand(subject, columns, {"rotation_deg": 5.0}, categories, names)


def _special_of_categories() -> Iterator[dict[str, Any]]:
    three = ["mug", "can", "can"]
    for name in _NAMES:
        good = _good(name)
        for column in (
            ["failed", good, "failed"], [good, "failed", "failed"], [None, good, "failed"],
            [good, None, good], [good, None, None], [None, None, None],
        ):  # fmt: skip
            # no value on its limit: what a mean makes of that is not declared
            for limit in (LIMITS[name][1], 0.0)[: 1 + (name in LARGER_IS_BETTER)]:
                yield {"name": name, "column": column, "limit": limit, "categories": three}
    yield {"name": "iou", "column": [], "limit": 0.5, "categories": []}


@prop(
    MEAN,
    reason="a category in which nothing can be judged has no precision, one in which everything"
    " failed has 0",
    given={
        "name": st.just("position_m"),
        "column": st.lists(st.sampled_from([None, "failed", 0.01]), min_size=3, max_size=3),
        "limit": st.just(0.02),
        "categories": st.lists(st.sampled_from(["mug", "can"]), min_size=3, max_size=3),
    },
    weight=0.5,
    corners=_special_of_categories,
)
def special_errors(
    subject: Subject, name: str, column: list[Any], limit: float, categories: list[str]
) -> None:
    """Infinite errors are wrong, and None takes no part, in a mean over categories as well."""
    names = ["can", "mug", "bowl"]
    _mean_by_hand(subject, {name: column}, {name: limit}, categories, names, may_refuse=True)


@prop(
    MEAN,
    reason="a category is worth as much as another one, however many samples either has",
    given={
        "sizes": st.lists(st.integers(0, 40), min_size=2, max_size=6),
        "rights": st.lists(st.integers(0, 40), min_size=6, max_size=6),
    },
    weight=0.5,
    corners=lambda: (
        {"sizes": s, "rights": [1, 300, 0, 2, 0, 5]}
        for s in ([1, 300], [1, 300, 2], [0, 9, 0, 4], [3, 0, 0, 0, 0, 70])
    ),
)
def sizes_of_categories(subject: Subject, sizes: list[int], rights: list[int]) -> None:
    """The mean over many categories of very different sizes weighs them alike."""
    names = [f"category {i}" for i in range(len(sizes))]
    categories, correct = [], []
    for name, size, right in zip(names, sizes, rights, strict=False):
        categories += [name] * size
        correct += [1] * min(right, size) + [0] * (size - min(right, size))
    columns = {"iou": [0.8 if c else 0.2 for c in correct]}
    _mean_by_hand(subject, columns, {"iou": 0.5}, categories, names, may_refuse=not any(sizes))
