"""Properties under symmetry groups: each kind that can be declared is given, in every run."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.adapter import Box
from pytest_cpas.checks.metrics.boxes import COARSE
from pytest_cpas.checks.metrics.exact import rotation_of, shared_volume
from pytest_cpas.checks.metrics.properties import close, prop
from pytest_cpas.checks.metrics.rotations import SYMMETRIC as ERROR
from pytest_cpas.checks.metrics.strategies import Rows, as_symmetry, turned
from pytest_cpas.checks.metrics.subject import Subject
from pytest_cpas.checks.metrics.symmetric_boxes import SYMMETRIC as IOU
from pytest_cpas.types import Symmetry

Array = NDArray[np.float64]

_DISCRETE = some.supports_any(ERROR, "discrete")
_AXIS = some.supports_any(ERROR, "axis", "principal axis")
_FLIP = some.supports_any(ERROR, "axis with flip", "principal axis with flip")

_TURNS = [turned(axis, angle).tolist() for axis, angle in (
    ([1, 2, -4], 0.0), ([0, 1, 0], 0.4), ([0, 1, 0], 3.0), ([1, 0, 0], 2.0), ([1, 2, -4], 1.3),
    ([0, 0, 1], math.pi), ([3, -1, 2], 2.9),
)]  # fmt: skip


@prop(
    ERROR,
    reason="an object without symmetry has a group as well: the identity",
    given={"a": some.rotations, "b": some.rotations},
    weight=0.5,
    applies=_DISCRETE,
    corners=lambda: ({"a": a, "b": _TURNS[4]} for a in _TURNS),
    name="without_symmetry",
)
def error_without_symmetry(subject: Subject, a: Rows, b: Rows) -> None:
    """With the group of the identity alone the error is the plain angle."""
    expected = float(Rotation.from_matrix(np.array(b).T @ np.array(a)).magnitude())
    for symmetry in (Symmetry.none(), Symmetry.n_fold((0, 1, 0), 1)):
        close(subject(ERROR, np.array(a), np.array(b), symmetry), expected, COARSE)


#: Groups of several axes, by name.
_THREE = Symmetry.n_fold((0, 1, 0), 3).rotations
_LARGE = {
    "tetrahedron": [*Rotation.create_group("T").as_matrix()],
    "cube": [*Rotation.create_group("O").as_matrix()],
    "prism": [*_THREE, *(_THREE @ np.diag([1.0, -1.0, -1.0]))],
}


@prop(
    ERROR,
    reason="groups have more elements than those about one axis; each of them is tried",
    given={"a": some.rotations, "b": some.rotations, "kind": st.sampled_from(sorted(_LARGE))},
    weight=0.5,
    applies=_DISCRETE,
    corners=lambda: (
        {"a": (np.array(_TURNS[4]) @ element @ _TURNS[1]).tolist(), "b": _TURNS[4], "kind": kind}
        for kind, group in _LARGE.items()
        for element in group
    ),
)
def several_axes(subject: Subject, a: Rows, b: Rows, kind: str) -> None:
    """The error is the least over all elements of a group with several axes."""
    group = np.stack(_LARGE[kind])
    relative = np.swapaxes(np.array(b) @ group, -1, -2) @ np.array(a)
    expected = float(Rotation.from_matrix(relative).magnitude().min())
    close(subject(ERROR, np.array(a), np.array(b), Symmetry(group)), expected, COARSE)


_TILTS = (0.0, 1e-7, 0.3, 1.5, math.pi / 2, 1.7, 2.8, math.pi - 1e-7, math.pi)


def _flips() -> Iterator[dict[str, Any]]:
    for axis, tilt in itertools.product(([0, 1, 0], [1, 0, 0], [0, 0, 1], [1, 2, -4]), _TILTS):
        yield {"b": _TURNS[4], "axis": axis, "across": [5, -3, 2], "tilt": tilt, "spin": 1.0}


@prop(
    ERROR,
    reason="closed form: the smaller angle of the axis to either direction",
    given={
        "b": some.rotations, "axis": some.axes_of_objects, "across": some.axes,
        "tilt": some.angles, "spin": some.real(0, 6.28),
    },
    weight=0.5, applies=_FLIP, corners=_flips,
)  # fmt: skip
def tilted_axis_with_flip(
    subject: Subject, b: Rows, axis: list[int], across: list[int], tilt: float, spin: float
) -> None:
    """A tilt by x of an axis that may be flipped has error x or pi - x, whichever is less."""
    _tilt(subject, b, ["axis with flip", axis, 1], across, tilt, spin, min(tilt, math.pi - tilt))


@prop(
    ERROR,
    reason="closed form, for every axis, however far it is tilted",
    given={
        "b": some.rotations, "axis": some.axes_of_objects, "across": some.axes,
        "tilt": some.angles, "spin": some.real(0, 6.28),
    },
    weight=0.25, applies=_AXIS, corners=_flips,
)  # fmt: skip
def tilted_any_axis(
    subject: Subject, b: Rows, axis: list[int], across: list[int], tilt: float, spin: float
) -> None:
    """A tilt by x of the axis of rotation has error x, from 0 to half a turn."""
    _tilt(subject, b, ["axis", axis, 1], across, tilt, spin, tilt)


def _tilt(
    subject: Subject, b: Rows, group: list[Any], across: list[int], tilt: float, spin: float,
    expected: float,
) -> None:  # fmt: skip
    axis = group[1]
    normal = np.cross(axis, across)
    if not normal.any():
        normal = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    if some.supports(subject, ERROR, group):
        estimate = np.array(b) @ turned(normal, tilt) @ turned(axis, spin)
        close(subject(ERROR, estimate, np.array(b), as_symmetry(group)), expected, COARSE)


@prop(
    ERROR,
    reason="who checks the estimate alone scores against a mirrored truth",
    given={"a": some.rotations, "axis": st.integers(0, 2), "which": st.integers(0, 1)},
    weight=0.25,
    applies=lambda subject: subject.defines(ERROR, "rotation") == "matrix" and _AXIS(subject),
    corners=lambda: (
        {"a": _TURNS[4], "axis": axis, "which": which} for axis in range(3) for which in (0, 1)
    ),
    name="either_reflection_rejected",
)
def reflection_under_symmetry(subject: Subject, a: Rows, axis: int, which: int) -> None:
    """A reflection, of the estimate or of the truth, raises under a symmetry as well."""
    both = [np.array(a), np.array(a)]
    both[which][:, axis] *= -1
    subject.refuses(ERROR, *both, Symmetry.about((0, 1, 0)))


# -- IoU ---------------------------------------------------------------------------------------

_WHOLE = st.lists(st.integers(-9, 9), min_size=4, max_size=4).filter(any)
_SIDES = st.lists(st.integers(16, 100), min_size=3, max_size=3)
_SHIFT = st.lists(st.integers(-20, 20), min_size=3, max_size=3)

#: Boxes in rational numbers: quaternion of the estimate, of the truth, sides in 256ths of a metre.
_EXACT = {"turns": st.tuples(_WHOLE, _WHOLE).map(list), "first": _SIDES, "second": _SIDES,
          "shift": _SHIFT}  # fmt: skip


def _some_exact() -> Iterator[dict[str, Any]]:
    for turns in ([[1, 2, 3, 7], [0, 0, 0, 1]], [[0, 0, 1, 1], [0, 0, 0, 1]],
                  [[1, 0, 0, 2], [2, -1, 3, 5]]):  # fmt: skip
        yield {"turns": turns, "first": [40, 60, 90], "second": [80, 44, 62], "shift": [9, -5, 12]}
        yield {"turns": turns, "first": [90, 30, 50], "second": [88, 32, 49], "shift": [0, 0, 0]}


def _exact_iou(
    turns: list[Any], first: list[int], second: list[int], shift: list[int], then: Any = None
) -> float:
    """The IoU with the truth turned by a further quaternion ``then``, about its centre."""
    truth = _times(turns[1], then) if then else turns[1]
    sizes = [[Fraction(s, 256) for s in size] for size in (first, second)]
    centres = [[Fraction(s, 256) for s in shift], [Fraction(0)] * 3]
    quaternions = [[Fraction(v) for v in q] for q in (turns[0], truth)]
    shared = shared_volume(*zip(quaternions, centres, sizes, strict=True))
    volumes = [size[0] * size[1] * size[2] for size in sizes]
    return float(shared / (sum(volumes) - shared))


def _times(p: list[int], q: list[int]) -> list[int]:
    x, y, z, w = p
    a, b, c, d = q
    return [w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a,
            w * c + x * b - y * a + z * d, w * d - x * a - y * b - z * c]  # fmt: skip


def _boxes(
    turns: list[Any], first: list[int], second: list[int], shift: list[int]
) -> tuple[Box, Box]:
    centre = np.array(shift) / 256
    a, b = (np.array(rotation_of(q), dtype=float) for q in turns)
    return Box(a, centre, np.array(first) / 256), Box(b, np.zeros(3), np.array(second) / 256)


@prop(
    IOU,
    reason="an object without symmetry has a group as well: the identity",
    given=_EXACT,
    weight=0.1,
    applies=some.supports_any(IOU, "discrete"),
    corners=_some_exact,
    name="without_symmetry",
)
def iou_without_symmetry(
    subject: Subject, turns: list[Any], first: list[int], second: list[int], shift: list[int]
) -> None:
    """With the group of the identity alone the IoU is that of the boxes as they stand."""
    case = turns, first, second, shift
    close(subject(IOU, *_boxes(*case), Symmetry.none()), _exact_iou(*case), COARSE)


#: Groups whose elements are rational: quaternions.
_RATIONAL: dict[str, list[list[int]]] = {
    "n-fold 4": [[0, 0, 0, 1], [0, 1, 0, 1], [0, 1, 0, 0], [0, -1, 0, 1]],
    "n-fold 3": [[0, 0, 0, 1], [1, 1, 1, 1], [-1, -1, -1, 1]],
    "box": [[0, 0, 0, 1], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]],
}
_AS_GROUP = {
    "n-fold 4": lambda: Symmetry.n_fold((0, 1, 0), 4),
    "n-fold 3": lambda: Symmetry.n_fold((1, 1, 1), 3),
    "box": Symmetry.box,
}


@prop(
    IOU,
    reason="an independent truth for groups with a few elements",
    given=_EXACT | {"kind": st.sampled_from(sorted(_RATIONAL))},
    weight=0.1,
    applies=some.supports_any(IOU, "discrete"),
    corners=lambda: (
        {**case, "kind": kind} for case in list(_some_exact())[::2] for kind in sorted(_RATIONAL)
    ),
)
def exact_over_a_discrete_group(
    subject: Subject, turns: list[Any], first: list[int], second: list[int], shift: list[int],
    kind: str,
) -> None:  # fmt: skip
    """Over a discrete group the IoU is the largest that exact rational arithmetic gives."""
    case = turns, first, second, shift
    expected = max(_exact_iou(*case, then=element) for element in _RATIONAL[kind])
    close(subject(IOU, *_boxes(*case), _AS_GROUP[kind]()), expected, COARSE)


@prop(
    IOU,
    reason="a sphere may be turned in any way: what fits into the box then lies in it",
    given={
        "turn": some.rotations, "size": some.extents, "share": some.real(0.3, 1),
        "order": st.permutations(range(3)),
    },
    weight=0.1,
    applies=some.supports_any(IOU, "sphere"),
    corners=lambda: (
        {"turn": turn, "size": [0.1, 0.2, 0.35], "share": share, "order": order}
        for turn, share, order in (
            (_TURNS[4], 1.0, [0, 1, 2]), (_TURNS[6], 0.8, [2, 0, 1]), (_TURNS[3], 0.9, [1, 0, 2])
        )
    ),
)  # fmt: skip
def sphere(subject: Subject, turn: Rows, size: list[float], share: float, order: list[int]) -> None:
    """Under all rotations a smaller copy with the same centre has IoU share cubed."""
    centre = np.array([0.3, -0.2, 1.5])
    truth = Box(np.array(_TURNS[6]), centre, np.array(size))
    estimate = Box(np.array(turn), centre, share * np.array(size)[list(order)])
    close(subject(IOU, estimate, truth, Symmetry.full()), share**3, COARSE)


@prop(
    IOU,
    reason="the definition: a maximum over all rotations, about the centre of the true box",
    given={"turn": some.rotations, "direction": some.axes, "distance": some.real(0.1, 0.25)},
    weight=0.05,
    applies=some.supports_any(IOU, "sphere"),
    corners=lambda: (
        {"turn": _TURNS[4], "direction": direction, "distance": distance}
        for direction, distance in (([1, 2, -4], 0.25), ([1, 0, 0], 0.2))
    ),
)
def reached_by_some_rotation(
    subject: Subject, turn: Rows, direction: list[int], distance: float
) -> None:
    """Under all rotations a box that lies in the truth at some of them has the volumes' ratio."""
    centre = np.array([0.3, -0.2, 1.5])
    truth = Box(np.array(_TURNS[6]), centre, np.array([0.1, 0.6, 0.1]))
    away = distance * np.array(direction) / np.linalg.norm(direction)
    # its diagonal is shorter than the truth is wide, so that its own rotation does not matter
    estimate = Box(np.array(turn), centre + away, np.array([0.03, 0.05, 0.04]))
    value = subject(IOU, estimate, truth, Symmetry.full())
    close(value, float(estimate.extents.prod() / truth.extents.prod()), COARSE)
