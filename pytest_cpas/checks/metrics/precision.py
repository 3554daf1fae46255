"""Properties of what is counted: precision, its means and areas, and single verdicts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.adapter import Sample
from pytest_cpas.checks.metrics.properties import close, expect, prop
from pytest_cpas.checks.metrics.strategies import Rows, posed, turned
from pytest_cpas.checks.metrics.subject import Subject

Array = NDArray[np.float64]

FINE = 1e-12
PRECISION = "precision"
MEAN = "mean_precision"
AUC = "iou_auc"
VUS = "pose_vus"
VERDICT = "pose_correct"

#: Limits of each error, the tightest first, and what is better.
LIMITS: dict[str, tuple[float, float, float]] = {
    "rotation_deg": (5.0, 10.0, 15.0),
    "position_m": (0.01, 0.02, 0.05),
    "iou": (0.75, 0.5, 0.25),
    "fscore": (0.8, 0.6, 0.4),
    "nad": (0.01, 0.05, 0.1),
}
LARGER_IS_BETTER = ("iou", "fscore")

_NAMES = st.lists(st.sampled_from(sorted(LIMITS)), min_size=1, max_size=3, unique=True)


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


TABLE = {"table": tables(), "names": _NAMES, "which": st.integers(0, 2)}


def _limits(names: list[str], which: int) -> dict[str, float]:
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
    limits = _limits(names, which)
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
      given={"table": tables(), "names": _NAMES, "loosened": st.integers(0, 2)})  # fmt: skip
def monotone(
    subject: Subject, table: dict[str, list[float]], names: list[str], loosened: int
) -> None:
    """Loosening a limit never lowers the precision."""
    tight, loose = _limits(names, 0), _limits(names, 0)
    name = names[loosened % len(names)]
    loose[name] = LIMITS[name][1 + loosened % 2]
    one, other = (subject(PRECISION, _errors(table), limits) for limits in (tight, loose))
    expect(other >= one - FINE, f"{one!r} at {tight}, but {other!r} at {loose}")


@prop(PRECISION, reason="ground truth as prediction is perfect, at any limits",
      given={"count": st.integers(1, 5), "names": _NAMES, "which": st.integers(0, 2)},
      weight=0.5)  # fmt: skip
def perfect(subject: Subject, count: int, names: list[str], which: int) -> None:
    """Samples without errors have precision 1."""
    columns = {name: np.full(count, float(name in LARGER_IS_BETTER)) for name in LIMITS}
    close(subject(PRECISION, columns, _limits(names, which)), 1, FINE)


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
    limits = _limits(names, which)
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
    close(subject(PRECISION, errors, _limits(sorted(LIMITS), which)), 0, FINE)


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
      given={"data": categorised(), "names": _NAMES, "which": st.integers(0, 2)})  # fmt: skip
def mean_of_the_present(subject: Subject, data: list[Any], names: list[str], which: int) -> None:
    """It is the mean over the categories that have samples, n/a if none has."""
    table, of_sample, judged = data
    limits = _limits(names, which)
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
      given={"data": categorised(), "names": _NAMES, "which": st.integers(0, 2)})  # fmt: skip
def independent_of_order(subject: Subject, data: list[Any], names: list[str], which: int) -> None:
    """The order of samples and of categories changes nothing."""
    table, of_sample, judged = data
    limits = _limits(names, which)
    one = subject(MEAN, _errors(table), limits, list(of_sample), list(judged))
    backwards = {name: column[::-1] for name, column in table.items()}
    other = subject(MEAN, _errors(backwards), limits, of_sample[::-1], judged[::-1])
    if one is None or other is None:
        expect(one is other, f"{one!r}, but {other!r} in another order")
    else:
        close(other, one, FINE)


# -- areas under precision ---------------------------------------------------------------------

_IOUS = st.lists(
    st.one_of(some.real(0, 1), st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0])),
    min_size=1, max_size=6,
)  # fmt: skip
_POSES = st.lists(
    st.tuples(
        st.one_of(some.real(0, 12), st.sampled_from([0.0, 5.0, 10.0, 180.0])),
        st.one_of(some.real(0, 0.06), st.sampled_from([0.0, 0.02, 0.05, 1.0])),
    ).map(list),
    min_size=1, max_size=6,
)  # fmt: skip
_RANGES = st.sampled_from([[5.0, 0.02], [5.0, 0.05], [10.0, 0.02], [10.0, 0.05]])
_LOWER = st.sampled_from([0.25, 0.5, 0.75])


def _clip(value: float) -> float:
    return min(max(value, 0.0), 1.0)


def _bin_error(subject: Subject, metric: str, dimensions: int) -> float:
    """How far a midpoint sum may be from the integral, for each sample and so for the mean."""
    bins = subject.defines(metric, "bins")
    return FINE if bins is None else dimensions * 0.5 / bins + FINE


@prop(AUC, reason="closed form of the area: a sample adds its clipped, normalised IoU",
      given={"ious": _IOUS, "lower": _LOWER})  # fmt: skip
def closed_form(subject: Subject, ious: list[float], lower: float) -> None:
    """The area is the mean of (IoU - lower) / (1 - lower), clipped to [0, 1]."""
    expected = sum(_clip((iou - lower) / (1 - lower)) for iou in ious) / len(ious)
    close(subject(AUC, np.array(ious), lower), expected, _bin_error(subject, AUC, 1))


@prop(AUC, reason="the ends of the scale", given={"lower": _LOWER}, weight=0.25,
      name="perfect_and_hopeless")  # fmt: skip
def auc_ends(subject: Subject, lower: float) -> None:
    """IoU 1 has area 1, IoU at the lower threshold area 0."""
    close(subject(AUC, np.ones(3), lower), 1, FINE)
    close(subject(AUC, np.full(3, lower), lower), 0, FINE)


@prop(VUS, reason="closed form of the volume: a sample adds the product of its two margins",
      given={"poses": _POSES, "ranges": _RANGES}, name="closed_form")  # fmt: skip
def vus_closed_form(subject: Subject, poses: Rows, ranges: list[float]) -> None:
    """The volume is the mean of (1 - angle / largest) (1 - distance / largest), each clipped."""
    expected = sum(_clip(1 - r / ranges[0]) * _clip(1 - t / ranges[1]) for r, t in poses)
    angles, shifts = np.array(poses).T.copy()
    value = subject(VUS, angles, shifts, *ranges)
    close(value, expected / len(poses), _bin_error(subject, VUS, 2))


@prop(VUS, reason="the ends of the scale", given={"ranges": _RANGES}, weight=0.25,
      name="perfect_and_hopeless")  # fmt: skip
def vus_ends(subject: Subject, ranges: list[float]) -> None:
    """No error has volume 1; an error of the largest angle or distance alone has volume 0."""
    close(subject(VUS, np.zeros(3), np.zeros(3), *ranges), 1, FINE)
    close(subject(VUS, np.full(3, ranges[0]), np.zeros(3), *ranges), 0, FINE)
    close(subject(VUS, np.zeros(3), np.full(3, ranges[1]), *ranges), 0, FINE)


# -- the verdict on one posed object -----------------------------------------------------------

_AXIS = st.sampled_from([None, 0, 1, 2])
_SIZES = st.lists(some.real(0.08, 0.3), min_size=3, max_size=3)
_POSE = {"rotation": some.rotations, "position": some.positions, "size": _SIZES}


def _truth(rotation: Rows, position: list[float], size: list[float]) -> Sample:
    return posed(rotation, position, size)


@prop(VERDICT, reason="ground truth as prediction is perfect, at any limits",
      given=_POSE | {"axis": _AXIS, "names": _NAMES})  # fmt: skip
def truth_is_correct(
    subject: Subject, rotation: Rows, position: list[float], size: list[float],
    axis: int | None, names: list[str],
) -> None:  # fmt: skip
    """The true pose, box and surface are correct at any limits."""
    truth = _truth(rotation, position, size)
    limits = _limits(names, 0)
    value = subject(VERDICT, truth, _truth(rotation, position, size), limits, axis)
    expect(value, f"the truth is judged wrong at {limits}")


@prop(VERDICT, reason="NaN is not above any threshold: an arccos of -1.0000000000000002 is correct "
      "at every one", given=_POSE | {"axis": st.integers(0, 2), "spin": some.real(0, 6.28)},
      weight=2)  # fmt: skip
def upside_down_is_wrong(
    subject: Subject, rotation: Rows, position: list[float], size: list[float],
    axis: int, spin: float,
) -> None:  # fmt: skip
    """An object that is round about an axis, but stands on its head, is wrong at 10 degrees."""
    r = np.array(rotation)
    over = r @ turned(np.eye(3)[(axis + 1) % 3], math.pi) @ turned(np.eye(3)[axis], spin)
    estimate = posed(over, position, size)
    value = subject(VERDICT, estimate, posed(r, position, size), {"rotation_deg": 10.0}, axis)
    expect(not value, "upside down is judged correct at 10 degrees")


@prop(VERDICT, reason="a spin about the axis of a round object is no error",
      given=_POSE | {"axis": st.integers(0, 2), "spin": some.real(0, 6.28)},
      weight=0.5)  # fmt: skip
def spun_is_correct(
    subject: Subject, rotation: Rows, position: list[float], size: list[float],
    axis: int, spin: float,
) -> None:  # fmt: skip
    """An object that is round about an axis is correct at any spin, by angle and by IoU."""
    r = np.array(rotation)
    estimate = posed(r @ turned(np.eye(3)[axis], spin), position, size)
    limits = {"rotation_deg": 0.5, "iou": 0.999}
    value = subject(VERDICT, estimate, posed(r, position, size), limits, axis)
    expect(value, f"an object that was spun by {spin!r} about its axis is judged wrong at {limits}")


@prop(VERDICT, reason="a limit that is met decides nothing, one that is missed everything",
      given=_POSE | {
          "axis": st.integers(0, 2), "angle": some.real(0.5, 20), "shift": some.real(0.001, 0.05),
          "names": st.sampled_from(
              [["rotation_deg"], ["position_m"], ["rotation_deg", "position_m"]]
          ),
          "which": st.integers(0, 2),
      })  # fmt: skip
def pose_limits(
    subject: Subject, rotation: Rows, position: list[float], size: list[float],
    axis: int, angle: float, shift: float, names: list[str], which: int,
) -> None:  # fmt: skip
    """A known angle and shift is correct if, and only if, both are within their limits."""
    r = np.array(rotation)
    moved = np.array(position) + shift * np.eye(3)[axis]
    estimate = posed(r @ turned(np.eye(3)[axis], math.radians(angle)), moved, size)
    limits = _limits(names, which)
    errors = {"rotation_deg": angle, "position_m": shift}
    if any(abs(errors[name] - limit) < 1e-6 for name, limit in limits.items()):
        return
    expected = all(errors[name] < limit for name, limit in limits.items())
    value = subject(VERDICT, estimate, posed(r, position, size), limits, None)
    expect(value == expected, f"{errors} is judged {value} at {limits}")


@prop(VERDICT, reason="a distance is better when it is smaller, an IoU or F-score when it is "
      "larger; an inverted limit rewards the worst",
      given={
          "size": _SIZES, "name": st.sampled_from(["nad", "fscore", "iou"]), "far": st.booleans(),
      })  # fmt: skip
def shape_limits(subject: Subject, size: list[float], name: str, far: bool) -> None:
    """What coincides to 0.1 mm is correct at any shape limit, what is half its size away wrong."""
    truth = posed(np.eye(3), np.zeros(3), size)
    # the lattice points of the sample are half a side apart: half of that is far from all
    shift = np.array(size) / 4 if far else np.full(3, 5e-5)
    estimate = posed(np.eye(3), shift, size)
    limits = {name: LIMITS[name][1]}
    value = subject(VERDICT, estimate, truth, limits, None)
    expect(value != far, f"{'far' if far else 'near'} is judged {value} at {limits}")


@prop(VERDICT, reason="predictions that miss by a box width must be wrong, not crash",
      given={
          "first": st.lists(st.integers(4, 32), min_size=3, max_size=3),
          "sides": st.lists(st.sampled_from([0, 1]), min_size=3, max_size=3).filter(any),
      }, weight=0.5)  # fmt: skip
def touching_is_wrong(subject: Subject, first: list[int], sides: list[int]) -> None:
    """A box that only touches the true one is wrong at IoU 0.25."""
    size = np.array(first) / 64
    truth = posed(np.eye(3), np.zeros(3), size)
    estimate = posed(np.eye(3), np.array(sides) * size, size)
    value = subject(VERDICT, estimate, truth, {"iou": 0.25}, None)
    expect(not value, "a box that only touches is judged correct at IoU 0.25")
