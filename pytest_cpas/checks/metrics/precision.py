"""Properties of what is counted: precision, and its mean over categories."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from pytest_cpas.checks.metrics.properties import close, expect, prop
from pytest_cpas.checks.metrics.subject import Subject

Array = NDArray[np.float64]

FINE = 1e-12
PRECISION = "precision"
MEAN = "mean_precision"

#: Limits of each error, the tightest first, and what is better.
LIMITS: dict[str, tuple[float, float, float]] = {
    "rotation_deg": (5.0, 10.0, 15.0),
    "position_m": (0.01, 0.02, 0.05),
    "iou": (0.75, 0.5, 0.25),
    "fscore": (0.8, 0.6, 0.4),
    "nad": (0.01, 0.05, 0.1),
}
LARGER_IS_BETTER = ("iou", "fscore")

NAMES = st.lists(st.sampled_from(sorted(LIMITS)), min_size=1, max_size=3, unique=True)


@st.composite
def tables(draw: st.DrawFn, on_limits: bool = True) -> dict[str, list[float]]:
    """Errors of some samples, near the limits; many of them, if wanted, at one."""
    count = draw(st.integers(1, 8))
    columns = {}
    for name, limits in LIMITS.items():
        near = [factor * x for factor in (0.9, 1.1) for x in limits]
        values = st.sampled_from([*limits, *near] if on_limits else near)
        columns[name] = draw(st.lists(values, min_size=count, max_size=count))
    return columns


TABLE = {"table": tables(), "names": NAMES, "which": st.integers(0, 2)}


def limits_of(names: list[str], which: int) -> dict[str, float]:
    """Limits on the errors of these names; 0 are the tightest."""
    return {name: LIMITS[name][which] for name in names}


def _errors(table: dict[str, list[float]]) -> dict[str, Array]:
    return {name: np.array(column, dtype=float) for name, column in table.items()}


def _meets(name: str, value: float, limit: float, strict: bool) -> bool:
    if name in LARGER_IS_BETTER:
        return value > limit or (value == limit and not strict)
    return value < limit or (value == limit and not strict)


def _counted(table: dict[str, list[float]], limits: dict[str, float], strict: bool) -> list[bool]:
    count = len(table["iou"])
    return [
        all(_meets(name, table[name][i], limit, strict) for name, limit in limits.items())
        for i in range(count)
    ]


@prop(PRECISION, reason="an independent count; one limit that is inverted or ignored shows",
      given=TABLE)  # fmt: skip
def counted_by_hand(
    subject: Subject, table: dict[str, list[float]], names: list[str], which: int
) -> None:
    """The precision is the share of samples that meet all limits."""
    strict = subject.defines(PRECISION, "boundary") == "strict"
    limits = limits_of(names, which)
    correct = _counted(table, limits, strict)
    close(subject(PRECISION, _errors(table), limits), sum(correct) / len(correct), FINE)


@prop(
    PRECISION,
    reason="a value that equals a threshold is common: 0, 1, and ratios of counts",
    given={"name": st.sampled_from(sorted(LIMITS)), "which": st.integers(0, 2)},
    weight=0.5,
)
def boundary(subject: Subject, name: str, which: int) -> None:
    """A value on its limit counts as the definition says."""
    limit = LIMITS[name][which]
    inclusive = subject.defines(PRECISION, "boundary") == "inclusive"
    value = subject(PRECISION, {name: np.array([limit])}, {name: limit})
    close(value, float(inclusive), FINE)


@prop(PRECISION, reason="what meets a tight limit meets a loose one",
      given={"table": tables(), "names": NAMES, "loosened": st.integers(0, 2)})  # fmt: skip
def monotone(
    subject: Subject, table: dict[str, list[float]], names: list[str], loosened: int
) -> None:
    """Loosening a limit never lowers the precision."""
    tight, loose = limits_of(names, 0), limits_of(names, 0)
    name = names[loosened % len(names)]
    loose[name] = LIMITS[name][1 + loosened % 2]
    one, other = (subject(PRECISION, _errors(table), limits) for limits in (tight, loose))
    expect(other >= one - FINE, f"{one!r} at {tight}, but {other!r} at {loose}")


@prop(PRECISION, reason="ground truth as prediction is perfect, at any limits",
      given={"count": st.integers(1, 5), "names": NAMES, "which": st.integers(0, 2)},
      weight=0.5)  # fmt: skip
def perfect(subject: Subject, count: int, names: list[str], which: int) -> None:
    """Samples without errors have precision 1."""
    columns = {name: np.full(count, float(name in LARGER_IS_BETTER)) for name in LIMITS}
    close(subject(PRECISION, columns, limits_of(names, which)), 1, FINE)


@prop(PRECISION, reason="counts add up; means of means do not, where parts differ in size",
      given=TABLE | {"cut": st.integers(1, 7)})  # fmt: skip
def additive(
    subject: Subject, table: dict[str, list[float]], names: list[str], which: int, cut: int
) -> None:
    """The numbers of correct samples of two parts add up to that of all."""
    count = len(table["iou"])
    cut = cut % count
    if cut == 0:
        return
    limits = limits_of(names, which)
    parts = [{k: v[:cut] for k, v in table.items()}, {k: v[cut:] for k, v in table.items()}]
    total = sum(subject(PRECISION, _errors(part), limits) * len(part["iou"]) for part in parts)
    close(subject(PRECISION, _errors(table), limits) * count, total, 1e-9, "all correct samples")


@prop(
    PRECISION,
    reason="a joint threshold is missed as soon as one of its limits is",
    given={"missed": st.sampled_from(sorted(LIMITS)), "which": st.integers(0, 2)},
)
def every_limit_decides(subject: Subject, missed: str, which: int) -> None:
    """A sample that is perfect but for one error is wrong where that error is limited."""
    perfect_but = {name: float(name in LARGER_IS_BETTER) for name in LIMITS}
    perfect_but[missed] = LIMITS[missed][which] * (0.9 if missed in LARGER_IS_BETTER else 1.1)
    errors = {name: np.array([value]) for name, value in perfect_but.items()}
    close(subject(PRECISION, errors, limits_of(sorted(LIMITS), which)), 0, FINE)


@st.composite
def categorised(draw: st.DrawFn) -> list[Any]:
    """[table, category of each sample, categories that are judged]."""
    table = draw(tables(on_limits=False))
    names = ["bottle", "bowl", "mug", "can"]
    count = len(table["iou"])
    of_sample = draw(st.lists(st.sampled_from(names[:3]), min_size=count, max_size=count))
    judged = draw(st.lists(st.sampled_from(names), min_size=1, max_size=4, unique=True))
    return [table, of_sample, judged]


@prop(MEAN, reason="a category without samples has no precision; as 0 it lowers the mean, and the "
      "mean over samples is another number",
      given={"data": categorised(), "names": NAMES, "which": st.integers(0, 2)})  # fmt: skip
def mean_of_the_present(subject: Subject, data: list[Any], names: list[str], which: int) -> None:
    """It is the mean over the categories that have samples, n/a if none has."""
    table, of_sample, judged = data
    limits = limits_of(names, which)
    correct = _counted(table, limits, strict=False)
    shares = []
    for category in judged:
        mine = [c for c, name in zip(correct, of_sample, strict=True) if name == category]
        if mine:
            shares.append(sum(mine) / len(mine))
    value = subject(MEAN, _errors(table), limits, list(of_sample), list(judged))
    if not shares:
        expect(value is None, f"the value is {value!r} without any samples, expected None (n/a)")
    else:
        expect(value is not None, "the value is None, but there are samples")
        close(value, sum(shares) / len(shares), FINE)


@prop(MEAN, reason="the same judgement in another order",
      given={"data": categorised(), "names": NAMES, "which": st.integers(0, 2)})  # fmt: skip
def independent_of_order(subject: Subject, data: list[Any], names: list[str], which: int) -> None:
    """The order of samples and of categories changes nothing."""
    table, of_sample, judged = data
    limits = limits_of(names, which)
    one = subject(MEAN, _errors(table), limits, list(of_sample), list(judged))
    backwards = {name: column[::-1] for name, column in table.items()}
    other = subject(MEAN, _errors(backwards), limits, of_sample[::-1], judged[::-1])
    if one is None or other is None:
        expect(one is other, f"{one!r}, but {other!r} in another order")
    else:
        close(other, one, FINE)
