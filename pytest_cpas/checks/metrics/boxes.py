"""Properties of the IoU of oriented boxes."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.adapter import Box
from pytest_cpas.checks.metrics.exact import rotation_of, shared_volume
from pytest_cpas.checks.metrics.properties import close, expect, prop
from pytest_cpas.checks.metrics.strategies import Rows, as_box
from pytest_cpas.checks.metrics.subject import Subject

IOU = "box_iou"

#: Far above rounding, far below any mistake.
COARSE = 1e-6
FINE = 1e-9

PAIR = {"pair": some.near_boxes()}


def _moved(box: Box, rotation: Any, shift: Any) -> Box:
    turn = np.array(rotation)
    return Box(turn @ box.rotation, turn @ box.translation + np.array(shift), box.extents)


@prop(IOU, reason="a perfect prediction must be perfect", given={"box": some.boxes})
def identity(subject: Subject, box: list[Any]) -> None:
    """A box has IoU 1 with itself."""
    close(subject(IOU, as_box(box), as_box(box)), 1, COARSE)


@prop(IOU, reason="intersection and union know no first and second", given=PAIR)
def symmetry_of_arguments(subject: Subject, pair: list[Any]) -> None:
    """The two boxes can be swapped."""
    a, b = map(as_box, pair)
    close(subject(IOU, b, a), subject(IOU, a, b), COARSE)


@prop(IOU, reason="the intersection is a part of the union", given=PAIR)
def in_range(subject: Subject, pair: list[Any]) -> None:
    """The IoU is in [0, 1]."""
    value = subject(IOU, *map(as_box, pair))
    expect(-FINE <= value <= 1 + FINE, f"the IoU is {value!r}, expected 0 to 1")


@prop(
    IOU,
    reason="the IoU of oriented boxes has no frame; NOCS' published one changes",
    given={"pair": some.near_boxes(), "camera": some.rotations, "shift": some.positions},
)
def moved_camera(subject: Subject, pair: list[Any], camera: Rows, shift: list[float]) -> None:
    """Moving both boxes together changes nothing."""
    a, b = map(as_box, pair)
    moved = subject(IOU, _moved(a, camera, shift), _moved(b, camera, shift))
    close(moved, subject(IOU, a, b), COARSE)


@prop(
    IOU,
    reason="millimetres or metres, it is a ratio; fixed tolerances break small boxes",
    given={"pair": some.near_boxes(), "scale": st.sampled_from([0.01, 0.1, 1000.0])},
)
def unit(subject: Subject, pair: list[Any], scale: float) -> None:
    """A change of unit changes nothing."""
    a, b = map(as_box, pair)
    scaled = [Box(x.rotation, scale * x.translation, scale * x.extents) for x in (a, b)]
    close(subject(IOU, *scaled), subject(IOU, a, b), COARSE)


@prop(
    IOU,
    reason="the same box can be written in 24 ways",
    given={"pair": some.near_boxes(), "turn": some.quarter_turns},
)
def relabelled_axes(subject: Subject, pair: list[Any], turn: Rows) -> None:
    """Naming the axes of a box otherwise changes nothing."""
    a, b = map(as_box, pair)
    q = np.array(turn)
    same = Box(a.rotation @ q, a.translation, np.abs(q.T) @ a.extents)
    close(subject(IOU, same, b), subject(IOU, a, b), COARSE)


@prop(
    IOU,
    reason="closed form, for any rotation of the inner box",
    given={
        "box": some.boxes,
        "turn": some.rotations,
        "shares": st.lists(some.real(0.05, 0.99), min_size=3, max_size=3),
        "where": st.lists(some.real(-1, 1), min_size=3, max_size=3),
    },
)
def nested(
    subject: Subject, box: list[Any], turn: Rows, shares: list[float], where: list[float]
) -> None:
    """A box inside another one: the IoU is the ratio of the volumes."""
    outer = as_box(box)
    # the inner box may turn freely: it is scaled to stay inside
    inner = outer.extents * np.array(shares)
    reach = np.abs(np.array(turn)) @ inner / 2
    inner = inner * min(1, 0.99 * (outer.extents / 2 / reach).min())
    room = outer.extents / 2 - np.abs(np.array(turn)) @ inner / 2
    centre = outer.translation + outer.rotation @ (room * 0.99 * np.array(where))
    value = subject(IOU, Box(outer.rotation @ np.array(turn), centre, inner), outer)
    close(value, float(inner.prod() / outer.extents.prod()), COARSE)


@prop(
    IOU,
    reason="without shared volume there is no overlap, however near the boxes are",
    given={
        "pair": st.tuples(some.boxes, some.boxes).map(list),
        "axis": st.integers(0, 2),
        "gap": some.log_real(1e-4, 1.0),
    },
)
def disjoint(subject: Subject, pair: list[Any], axis: int, gap: float) -> None:
    """Boxes on two sides of a plane have IoU 0."""
    a, b = map(as_box, pair)
    normal = a.rotation[:, axis]
    reach = a.extents[axis] / 2 + np.abs(normal @ b.rotation) @ b.extents / 2
    apart = Box(b.rotation, a.translation + (reach + gap) * normal, b.extents)
    close(subject(IOU, a, apart), 0, FINE)


@prop(
    IOU,
    reason="a shared face, edge or corner has no volume; half-space codes crash on it",
    given={
        "turns": st.tuples(some.quarter_turns, some.quarter_turns).map(list),
        "first": st.lists(st.integers(1, 64), min_size=3, max_size=3),
        "second": st.lists(st.integers(1, 64), min_size=3, max_size=3),
        "sides": st.lists(st.sampled_from([0, 1, -1]), min_size=3, max_size=3).filter(any),
    },
)
def touching(
    subject: Subject, turns: list[Rows], first: list[int], second: list[int], sides: list[int]
) -> None:
    """Boxes that only touch have IoU 0."""
    # whole multiples of 1/64 m: they touch exactly, in floating point as well
    a, b = (
        Box(np.array(turn), np.zeros(3), np.array(size) / 64)
        for turn, size in zip(turns, (first, second), strict=True)
    )
    reach = (np.abs(a.rotation) @ a.extents + np.abs(b.rotation) @ b.extents) / 2
    close(subject(IOU, a, Box(b.rotation, np.array(sides) * reach, b.extents)), 0, FINE)


@prop(
    IOU,
    reason="what is farther away overlaps less: convex bodies of one centre, moved apart",
    given={
        "box": some.boxes,
        "turn": some.rotations,
        "direction": some.axes,
        "steps": st.lists(some.real(0, 0.6), min_size=2, max_size=2),
    },
)
def monotone_as_boxes_part(
    subject: Subject, box: list[Any], turn: Rows, direction: list[int], steps: list[float]
) -> None:
    """The IoU falls as one box is moved away from the other one's centre."""
    a = as_box(box)
    away = np.array(direction) / np.linalg.norm(direction) * a.extents.max()
    near, far = (
        subject(IOU, a, Box(np.array(turn) @ a.rotation, a.translation + s * away, a.extents))
        for s in sorted(steps)
    )
    expect(far <= near + COARSE, f"the IoU grew from {near!r} to {far!r} as the boxes parted")


@prop(
    IOU,
    reason="closed form, for boxes with parallel sides",
    given={
        "box": some.boxes,
        "other": some.any_extents,
        "where": st.lists(some.real(-1, 1), min_size=3, max_size=3),
    },
)
def parallel_sides(
    subject: Subject, box: list[Any], other: list[float], where: list[float]
) -> None:
    """Boxes with parallel sides share the product of their sides' overlaps."""
    a = as_box(box)
    size = np.array(other)
    offset = np.array(where) * (a.extents + size) / 2
    b = Box(a.rotation, a.translation + a.rotation @ offset, size)
    overlap = np.minimum(a.extents / 2, offset + size / 2) - np.maximum(
        -a.extents / 2, offset - size / 2
    )
    shared = float(np.maximum(overlap, 0).prod())
    expected = shared / float(a.extents.prod() + size.prod() - shared)
    close(subject(IOU, a, b), expected, COARSE)


_QUATERNIONS = st.lists(st.integers(-9, 9), min_size=4, max_size=4).filter(any)
_SIZES = st.lists(st.integers(1, 128), min_size=3, max_size=3)


@prop(
    IOU,
    reason="an independent truth for boxes in general position",
    given={
        "quaternions": st.tuples(_QUATERNIONS, _QUATERNIONS).map(list),
        "first": _SIZES,
        "second": _SIZES,
        "offset": st.lists(st.integers(-40, 40), min_size=3, max_size=3),
    },
    weight=0.75,
)
def exact_volume(
    subject: Subject,
    quaternions: list[list[int]],
    first: list[int],
    second: list[int],
    offset: list[int],
) -> None:
    """The IoU agrees with exact rational arithmetic."""
    agrees_with_exact(subject, quaternions, first, second, [Fraction(o, 256) for o in offset])


@prop(
    IOU,
    reason="good predictions nearly coincide: faces intersect at tiny angles, or are coplanar",
    given={
        "quaternion": _QUATERNIONS,
        "size": _SIZES,
        "axis": some.axes,
        "exponent": st.integers(2, 16),
        "offset": st.sampled_from([0, 0, 1]),
    },
    weight=0.5,
)
def nearly_coincident(
    subject: Subject,
    quaternion: list[int],
    size: list[int],
    axis: list[int],
    exponent: int,
    offset: int,
) -> None:
    """Boxes that differ by an angle of 1e-16 to 1e-2 agree with exact rational arithmetic."""
    x, y, z, w = quaternion
    p, q, r = axis
    s = 10**exponent
    other = [
        w * p + x * s + y * r - z * q,
        w * q - x * r + y * s + z * p,
        w * r + x * q - y * p + z * s,
        w * s - x * p - y * q - z * r,
    ]
    shift = [Fraction(offset, s), Fraction(0), Fraction(0)]
    agrees_with_exact(subject, [quaternion, other], size, size, shift)


def agrees_with_exact(
    subject: Subject,
    quaternions: list[list[int]],
    first: list[int],
    second: list[int],
    offset: list[Fraction],
) -> None:
    """Expect the IoU of boxes with sides in 256ths of a metre to be that of exact arithmetic."""
    sizes = [[Fraction(s, 256) for s in size] for size in (first, second)]
    centres = [[Fraction(0)] * 3, offset]
    exact = [
        ([Fraction(v) for v in quaternion], centre, size)
        for quaternion, centre, size in zip(quaternions, centres, sizes, strict=True)
    ]
    shared = shared_volume(*exact)
    union = math.prod(sizes[0]) + math.prod(sizes[1]) - shared
    boxes = [
        Box(*(np.array(part, dtype=float) for part in (rotation_of(quaternion), centre, size)))
        for quaternion, centre, size in exact
    ]
    close(subject(IOU, *boxes), float(shared / union), FINE)


@prop(
    IOU,
    reason="a negative side is a mirrored axis, a zero side no box; both give volumes",
    given={
        "pair": some.near_boxes(),
        "axis": st.integers(0, 2),
        "side": st.sampled_from([0.0, -0.1]),
        "which": st.booleans(),
    },
    applies=lambda subject: subject.defines(IOU, "box") != ("corners",),
)
def extents_rejected(
    subject: Subject, pair: list[Any], axis: int, side: float, which: bool
) -> None:
    """Extents that are not positive raise."""
    boxes = list(map(as_box, pair))
    boxes[which].extents[axis] = side
    subject.refuses(IOU, *boxes)


@prop(
    IOU,
    reason="a mirrored box is the same set of points, so the IoU hides the mirrored frame",
    given={"pair": some.near_boxes(), "axis": st.integers(0, 2)},
    applies=lambda subject: (
        subject.defines(IOU, "rotation") == "matrix" and subject.defines(IOU, "box") != ("corners",)
    ),
)
def reflection_rejected(subject: Subject, pair: list[Any], axis: int) -> None:
    """A reflection raises."""
    a, b = map(as_box, pair)
    a.rotation[:, axis] *= -1
    subject.refuses(IOU, a, b)
