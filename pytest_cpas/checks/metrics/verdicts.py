"""Properties of the verdict on one posed object."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.adapter import Sample
from pytest_cpas.checks.metrics.exact import largest_distance, nearest, rotation_of, shared_volume
from pytest_cpas.checks.metrics.precision import LARGER_IS_BETTER, LIMITS, NAMES, limits_of
from pytest_cpas.checks.metrics.properties import expect, prop
from pytest_cpas.checks.metrics.strategies import Rows, posed, turned
from pytest_cpas.checks.metrics.subject import Subject

VERDICT = "pose_correct"

_AXIS = st.sampled_from([None, 0, 1, 2])
_SIZES = st.lists(some.real(0.08, 0.3), min_size=3, max_size=3)
_POSE = {"rotation": some.rotations, "position": some.positions, "size": _SIZES}


def _truth(rotation: Rows, position: list[float], size: list[float]) -> Sample:
    return posed(rotation, position, size)


@prop(VERDICT, reason="ground truth as prediction is perfect, at any limits",
      given=_POSE | {"axis": _AXIS, "names": NAMES})  # fmt: skip
def truth_is_correct(
    subject: Subject, rotation: Rows, position: list[float], size: list[float],
    axis: int | None, names: list[str],
) -> None:  # fmt: skip
    """The true pose, box and surface are correct at any limits."""
    truth = _truth(rotation, position, size)
    limits = limits_of(names, 0)
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
    limits = limits_of(names, which)
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


# -- each error, computed once more, just within its limit and just beyond it --------------------

#: By how much a limit is looser, or tighter, than the error.
_ROOM = 0.02

#: Distance of the F-score, metres.
_NEAR = 0.01


def _pair(
    rotation: Rows, position: list[float], size: list[int], other: list[int],
    turn: list[int], shift: list[int], seed: int, with_iou: bool,
) -> tuple[Sample, Sample, dict[str, tuple[float, float]]]:  # fmt: skip
    """Estimate, truth, and between what each error lies, whatever a diameter is that of.

    Sides and shift in 512ths of a metre; ``turn``: a quaternion; both in the true object's frame.
    """
    r, relative = np.array(rotation), np.array(rotation_of(turn), dtype=float)
    truth = posed(r, position, np.array(size) / 512)
    rng = np.random.default_rng(seed)
    lattice = posed(np.eye(3), np.zeros(3), np.array(other) / 512).points
    # some points move by less than the distance of the F-score, some by more
    moves = rng.normal(size=lattice.shape)
    far = rng.choice([0.2, 0.8, 1.3, 2.0], len(lattice)) * _NEAR
    lattice = lattice + moves * (far / np.linalg.norm(moves, axis=1))[:, None]
    # of fewer points, or with some that are far from all, so that recall and precision differ
    if seed % 2:
        lattice = lattice[rng.permutation(len(lattice))[:14]]
    else:
        lattice = np.concatenate([lattice, lattice[:14] * 1.5 + 0.03])
    turned_by, moved_by = r @ relative, truth.translation + r @ (np.array(shift) / 512)
    estimate = Sample(turned_by, moved_by, np.array(other) / 512, lattice @ turned_by.T + moved_by)
    iou = _exact_iou(size, other, turn, shift) if with_iou else math.nan
    forth, back = nearest(truth.points, estimate.points), nearest(estimate.points, truth.points)
    recall, precision = (float((d < _NEAR).mean()) for d in (forth, back))
    fscore = 2 * recall * precision / (recall + precision) if recall * precision else 0.0
    own, other_diameter = largest_distance(truth.points), largest_distance(estimate.points)
    nads = [max(forth.mean() / own, back.mean() / d) for d in (own, other_diameter)]
    angle = 2 * math.degrees(math.atan2(math.hypot(*turn[:3]), abs(turn[3])))
    distance = math.hypot(*shift) / 512
    errors = {
        "rotation_deg": (angle, angle), "position_m": (distance, distance), "iou": (iou, iou),
        "fscore": (fscore, fscore), "nad": (float(min(nads)), float(max(nads))),
    }  # fmt: skip
    return estimate, truth, errors


def _exact_iou(size: list[int], other: list[int], turn: list[int], shift: list[int]) -> float:
    sizes = [[Fraction(s, 512) for s in sides] for sides in (other, size)]
    shared = shared_volume(
        ([Fraction(v) for v in turn], [Fraction(s, 512) for s in shift], sizes[0]),
        ([Fraction(0)] * 3 + [Fraction(1)], [Fraction(0)] * 3, sizes[1]),
    )
    return float(shared / (math.prod(sizes[0]) + math.prod(sizes[1]) - shared))


def _limit(name: str, error: tuple[float, float], met: bool) -> float:
    low, high = error
    if (name in LARGER_IS_BETTER) == met:
        return low * (1 - _ROOM)
    return high * (1 + _ROOM)


_POSES: tuple[dict[str, Any], ...] = (
    {"rotation": np.eye(3).tolist(), "position": [0.0, 0.0, 0.0], "size": [60, 90, 120],
     "other": [64, 84, 118], "turn": [0, 0, 0, 1], "shift": [3, 2, -2]},
    {"rotation": turned([1, 2, -4], 1.1).tolist(), "position": [0.2, -0.1, 0.9],
     "size": [60, 90, 120], "other": [66, 80, 130], "turn": [1, -2, 1, 30], "shift": [3, 3, 3]},
    {"rotation": turned([0, 1, 3], 2.6).tolist(), "position": [-0.4, 0.3, 1.7],
     "size": [44, 44, 51], "other": [40, 47, 49], "turn": [0, 3, 0, 20], "shift": [0, 0, 4]},
    {"rotation": turned([2, -1, 1], 0.5).tolist(), "position": [0.0, 0.0, 1.0],
     "size": [140, 100, 60], "other": [130, 104, 66], "turn": [4, 1, 0, 22], "shift": [-6, 0, 5]},
)  # fmt: skip


def _near_limits() -> Iterator[dict[str, Any]]:
    names = sorted(LIMITS)
    for i, pose in enumerate(_POSES):
        for name in names:
            for missed in (None, name):
                yield {**pose, "seed": i, "names": [name], "missed": missed}
        for pair in itertools.combinations(names, 2):
            yield {**pose, "seed": i, "names": list(pair), "missed": pair[i % 2]}
        for missed in (*names, None):
            yield {**pose, "seed": i, "names": names, "missed": missed}


_SMALL = st.integers(-6, 6)


@prop(VERDICT, reason="an error that is computed in another frame, along one axis, with other "
      "points or at another distance is close to the right one: its limit tells them apart",
      given={
          "rotation": some.rotations, "position": some.positions,
          "size": st.lists(st.integers(40, 150), min_size=3, max_size=3),
          "other": st.lists(st.integers(40, 150), min_size=3, max_size=3),
          "turn": st.tuples(_SMALL, _SMALL, _SMALL, st.integers(15, 60)).map(list),
          "shift": st.lists(_SMALL, min_size=3, max_size=3), "seed": some.seeds,
          "names": NAMES, "missed": st.sampled_from([None, *sorted(LIMITS)]),
      }, weight=0.5, corners=_near_limits)  # fmt: skip
def just_within_and_beyond(
    subject: Subject, rotation: Rows, position: list[float], size: list[int], other: list[int],
    turn: list[int], shift: list[int], seed: int, names: list[str], missed: str | None,
) -> None:  # fmt: skip
    """Limits 2 % beside the errors of any pose and shape are met or missed as they must be."""
    estimate, truth, errors = _pair(
        rotation, position, size, other, turn, shift, seed, "iou" in names
    )  # fmt: skip
    if any(errors[name][0] < 1e-3 for name in names):
        return
    limits = {name: _limit(name, errors[name], name != missed) for name in names}
    value = subject(VERDICT, estimate, truth, limits, None)
    told = {name: errors[name][0] for name in names}
    expect(value == (missed not in names), f"{told} is judged {value} at {limits}")


@prop(VERDICT, reason="the angle between two axes, whatever the spin and the pose are",
      given={
          "rotation": some.rotations, "axis": st.integers(0, 2), "across": some.axes,
          "tilt": some.real(0.5, 170), "spin": some.real(0, 6.28),
          "shift": st.lists(some.real(-0.02, 0.02), min_size=3, max_size=3),
      }, weight=0.5, corners=lambda: (
          {"rotation": pose["rotation"], "axis": axis, "across": [3, 1, 2], "tilt": tilt,
           "spin": 2.0, "shift": [0.006, -0.004, 0.007]}
          for pose in _POSES for axis in range(3) for tilt in (4.0, 60.0, 100.0, 165.0)
      ))  # fmt: skip
def just_within_and_beyond_when_round(
    subject: Subject, rotation: Rows, axis: int, across: list[int], tilt: float, spin: float,
    shift: list[float],
) -> None:  # fmt: skip
    """Of a round object limits 2 % beside tilt and distance are met or missed as they must be."""
    r, unit = np.array(rotation), np.eye(3)[axis]
    normal = np.cross(unit, across)
    if not normal.any():
        return
    position = np.array([0.1, 0.2, 1.0])
    truth = posed(r, position, [0.1, 0.2, 0.3])
    estimate = posed(
        r @ turned(normal, math.radians(tilt)) @ turned(unit, spin), position + shift,
        [0.1, 0.2, 0.3],
    )  # fmt: skip
    distance = math.hypot(*shift)
    for missed in ("rotation_deg", "position_m", None):
        errors = {"rotation_deg": tilt, "position_m": distance}
        limits = {name: _limit(name, (e, e), name != missed) for name, e in errors.items()}
        if distance > 1e-3:
            value = subject(VERDICT, estimate, truth, limits, axis)
            expect(value == (missed is None), f"{errors} is judged {value} at {limits}")
