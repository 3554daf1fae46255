"""Properties of the IoU of oriented boxes where they meet in few points, planes, or far away."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.adapter import Box
from pytest_cpas.checks.metrics.boxes import COARSE, IOU, agrees_with_exact
from pytest_cpas.checks.metrics.exact import rotation_of
from pytest_cpas.checks.metrics.properties import close, prop
from pytest_cpas.checks.metrics.strategies import Rows, turned
from pytest_cpas.checks.metrics.subject import Subject

#: What of an interval from -8 to 8 another one may cover, in 64ths of a metre.
_INTERVALS = (
    (-8, 8), (-4, 4), (-12, 12), (-8, 0), (2, 8), (-8, -7), (2, 14), (-12, 8), (-3, 11),
    (8, 14), (9, 12),
)  # fmt: skip

_GENERAL = turned([1, 2, -4], 1.1).tolist()
_PLAIN = np.eye(3).tolist()
_PLACES = ([0.0, 0.0, 0.0], [3.0, -2.0, 8.0], [-40.0, 25.0, 90.0])


def _planes() -> Iterator[dict[str, Any]]:
    numbers = range(len(_INTERVALS))
    chosen = [c for c in itertools.combinations_with_replacement(numbers, 3) if max(c) < 9]
    chosen += [(a, b, c) for a in (0, 3, 6) for b in (1, 8) for c in (9, 10)]
    for i, relations in enumerate(chosen):
        yield {
            "relations": list(np.roll(relations, i).tolist()),
            "camera": (_PLAIN, _GENERAL)[i % 2],
            "place": _PLACES[i % 3],
            "swapped": i % 5 < 2,
        }


@prop(
    IOU,
    reason="boxes of one table, or of one annotator, share planes: what is clipped twice there, or"
    " not at all, is a face",
    given={
        "relations": st.lists(st.integers(0, len(_INTERVALS) - 1), min_size=3, max_size=3),
        "camera": some.rotations,
        "place": some.positions,
        "swapped": st.booleans(),
    },
    weight=0.5,
    corners=_planes,
)
def shared_planes(
    subject: Subject, relations: list[int], camera: Rows, place: list[float], swapped: bool
) -> None:
    """Boxes with parallel sides, of which some lie in one plane, overlap as their sides do."""
    low, high = (np.array([_INTERVALS[i][end] for i in relations]) / 64 for end in (0, 1))
    turn, half = np.array(camera), 8 / 64
    shared = float(np.maximum(np.minimum(high, half) - np.maximum(low, -half), 0).prod())
    volumes = (2 * half) ** 3 + float((high - low).prod())
    boxes = [
        Box(turn, np.array(place), np.full(3, 2 * half)),
        Box(turn, np.array(place) + turn @ (low + high) / 2, high - low),
    ]
    value = subject(IOU, *(reversed(boxes) if swapped else boxes))
    close(value, shared / (volumes - shared), COARSE)


#: Of two boxes: quaternions, sides in 256ths of a metre, a direction from the one to the other.
_MEETINGS: tuple[tuple[list[list[int]], list[int], list[int], list[int]], ...] = (
    # corners, edges and faces of cubes
    ([[0, 0, 0, 1], [0, 0, 2, 5]], [64] * 3, [64] * 3, [1, 0, 0]),
    ([[0, 0, 2, 5], [0, 0, 2, 5]], [64] * 3, [64] * 3, [1, 0, 0]),
    ([[1, 2, 3, 7], [1, 2, 3, 7]], [64] * 3, [64] * 3, [1, 1, 1]),
    ([[0, 0, 0, 1], [0, 0, 0, 1]], [64] * 3, [64] * 3, [1, 1, 1]),
    ([[3, -1, 2, 8], [0, 0, 0, 1]], [64] * 3, [64] * 3, [2, 3, -1]),
    # plates and rods
    ([[0, 0, 0, 1], [0, 0, 2, 5]], [128, 128, 2], [2, 128, 128], [1, 2, 0]),
    ([[0, 0, 0, 1], [1, 1, 0, 9]], [128, 2, 128], [120, 2, 100], [1, 1, 2]),
    ([[0, 0, 0, 1], [1, -2, 3, 4]], [128, 4, 4], [4, 128, 6], [1, 0, 1]),
    ([[2, 0, 1, 5], [0, 3, 0, 8]], [128, 20, 20], [16, 128, 12], [1, 4, 2]),
    # of very different sizes
    ([[1, 2, 3, 7], [0, 0, 0, 1]], [8, 9, 10], [128, 110, 90], [1, 2, 1]),
    ([[0, 0, 0, 1], [2, -1, 0, 6]], [128, 128, 128], [5, 40, 12], [-1, 1, 3]),
)
_DEPTHS = (0.0, 0.2, 0.55, 0.8, 0.95)


def _meetings() -> Iterator[dict[str, Any]]:
    for i, (quaternions, first, second, direction) in enumerate(_MEETINGS):
        for depth in _DEPTHS:
            case = {"quaternions": quaternions, "first": first, "second": second}
            yield {**case, "direction": direction, "depth": depth}
            if i % 2:
                yield {
                    "quaternions": quaternions[::-1], "first": second, "second": first,
                    "direction": [-c for c in direction], "depth": depth,
                }  # fmt: skip


_QUATERNIONS = st.lists(st.integers(-9, 9), min_size=4, max_size=4).filter(any)
_SIZES = st.lists(st.integers(2, 128), min_size=3, max_size=3)


@prop(
    IOU,
    reason="boxes overlap in a corner or an edge from farther away than their longest side: who"
    " compares the distance of the centres with that gives 0",
    given={
        "quaternions": st.tuples(_QUATERNIONS, _QUATERNIONS).map(list),
        "first": _SIZES,
        "second": _SIZES,
        "direction": some.axes,
        "depth": some.real(0.3, 0.97),
    },
    weight=0.5,
    corners=_meetings,
)
def overlap_in_part(
    subject: Subject,
    quaternions: list[list[int]],
    first: list[int],
    second: list[int],
    direction: list[int],
    depth: float,
) -> None:
    """From one centre to the last touch, the IoU agrees with exact rational arithmetic."""
    normal = np.array(direction) / np.linalg.norm(direction)
    reach = sum(
        float(np.abs(normal @ np.array(rotation_of(q), dtype=float)) @ size) / 2
        for q, size in zip(quaternions, (first, second), strict=True)
    )
    offset = np.rint(depth * reach * normal).astype(int).tolist()
    agrees_with_exact(subject, quaternions, first, second, [Fraction(o, 256) for o in offset])


def _nestings() -> Iterator[dict[str, Any]]:
    outer = [0.3, 0.2, 0.5]
    for inner in ([0.06, 0.05, 0.07], [0.1, 0.02, 0.15], [0.001, 0.1, 0.1]):
        for turn in (_PLAIN, _GENERAL):
            for swapped in (False, True):
                yield {"outer": outer, "inner": inner, "turn": turn, "swapped": swapped}


@prop(
    IOU,
    reason="no corner of the larger box lies in the smaller one: an intersection made of the"
    " corners of the first box alone depends on the order",
    given={
        "outer": some.extents,
        "inner": st.lists(some.real(0.001, 0.02), min_size=3, max_size=3),
        "turn": some.rotations,
        "swapped": st.booleans(),
    },
    weight=0.25,
    corners=_nestings,
)
def nested_either_way(
    subject: Subject, outer: list[float], inner: list[float], turn: Rows, swapped: bool
) -> None:
    """A box inside another one, first or second, has the ratio of the volumes as IoU."""
    boxes = [
        Box(np.array(_GENERAL), np.array([0.1, 0.2, 1.0]), np.array(outer)),
        Box(np.array(turn), np.array([0.1, 0.2, 1.0]), np.array(inner)),
    ]
    value = subject(IOU, *(reversed(boxes) if swapped else boxes))
    close(value, float(np.prod(inner) / np.prod(outer)), COARSE)


_PAIR = [[_PLAIN, [0.0, 0.0, 0.0], [0.1, 0.05, 0.2]],
         [_GENERAL, [0.02, 0.01, -0.03], [0.12, 0.06, 0.15]]]  # fmt: skip


@prop(
    IOU,
    reason="single precision is good to a tenth of a millimetre only, a hundred metres away",
    given={
        "pair": some.near_boxes(),
        "place": st.lists(some.real(-90, 90), min_size=3, max_size=3),
    },
    weight=0.25,
    corners=lambda: (
        {"pair": _PAIR, "place": place}
        for place in ([0.0, 0.0, 99.0], [77.7, -33.3, 88.8], [-99.9, 0.1, 0.2])
    ),
)
def far_away(subject: Subject, pair: list[Any], place: list[float]) -> None:
    """Boxes that are up to 150 m away overlap as near ones do."""
    near, far = (
        subject(
            IOU,
            *(
                Box(np.array(r), np.array(p) - pair[0][1] + where, np.array(size))
                for r, p, size in pair
            ),
        )
        for where in (np.zeros(3), np.array(place))
    )
    close(far, near, COARSE)


@prop(
    IOU,
    reason="who checks the estimate alone scores against a mirrored truth",
    given={"pair": some.near_boxes(), "axis": st.integers(0, 2), "which": st.booleans()},
    weight=0.25,
    corners=lambda: (
        {"pair": _PAIR, "axis": axis, "which": which}
        for axis in range(3)
        for which in (False, True)
    ),
    applies=lambda subject: (
        subject.defines(IOU, "rotation") == "matrix" and subject.defines(IOU, "box") != ("corners",)
    ),
)
def either_reflection_rejected(subject: Subject, pair: list[Any], axis: int, which: bool) -> None:
    """A reflection of either box raises."""
    boxes = [some.as_box(plain) for plain in pair]
    boxes[which].rotation[:, axis] *= -1
    subject.refuses(IOU, *boxes)
