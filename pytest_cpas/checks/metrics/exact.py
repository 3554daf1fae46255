"""Independent truths: volumes in rational arithmetic, metrics straight from their definitions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Row = tuple[Sequence[Fraction], Fraction]


def shared_volume(a: Sequence[Sequence[Fraction]], b: Sequence[Sequence[Fraction]]) -> Fraction:
    """The volume that two boxes share, exactly.

    A box is (quaternion x y z w, centre, extents) in rational numbers; the quaternion need not be
    normalised. The volume of the polytope {normal . x <= bound} comes from the recursion over its
    faces by Lasserre (1983).
    """
    return _volume([*_half_spaces(a), *_half_spaces(b)], 3)


def rotation_of(quaternion: Sequence[Fraction | int]) -> list[list[Fraction]]:
    """The rotation matrix of a quaternion x y z w of any length, exactly."""
    x, y, z, w = map(Fraction, quaternion)
    n = x * x + y * y + z * z + w * w
    return [
        [1 - 2 * (y * y + z * z) / n, 2 * (x * y - z * w) / n, 2 * (x * z + y * w) / n],
        [2 * (x * y + z * w) / n, 1 - 2 * (x * x + z * z) / n, 2 * (y * z - x * w) / n],
        [2 * (x * z - y * w) / n, 2 * (y * z + x * w) / n, 1 - 2 * (x * x + y * y) / n],
    ]


def _half_spaces(box: Sequence[Sequence[Fraction]]) -> list[Row]:
    quaternion, centre, extents = box
    rotation = rotation_of(quaternion)
    rows: list[Row] = []
    for axis in range(3):
        for sign in (1, -1):
            normal = [sign * rotation[i][axis] for i in range(3)]
            at_centre = sum((n * c for n, c in zip(normal, centre, strict=True)), Fraction(0))
            rows.append((normal, at_centre + extents[axis] / 2))
    return rows


def _volume(rows: list[Row], dimension: int) -> Fraction:
    tightest: dict[tuple[Fraction, ...], Fraction] = {}
    for normal, bound in rows:
        lead = next((abs(n) for n in normal if n), None)
        if lead is None:
            if bound < 0:
                return Fraction(0)
            continue
        key = tuple(n / lead for n in normal)
        tightest[key] = min(tightest.get(key, bound / lead), bound / lead)
    if dimension == 1:
        upper, lower = tightest.get((Fraction(1),)), tightest.get((Fraction(-1),))
        if upper is None or lower is None:
            raise ValueError("the polytope is not bounded")
        return max(upper + lower, Fraction(0))
    total = Fraction(0)
    for face_normal, bound in tightest.items():
        if bound == 0:
            continue
        k = max(range(dimension), key=lambda i: abs(face_normal[i]))
        face: list[Row] = []
        for other, limit in tightest.items():
            if other != face_normal:
                factor = other[k] / face_normal[k]
                left = [other[i] - factor * face_normal[i] for i in range(dimension) if i != k]
                face.append((left, limit - factor * bound))
        total += bound / abs(face_normal[k]) * _volume(face, dimension - 1)
    return total / dimension


def rectangles_overlap(
    first: Sequence[float], second: Sequence[float], shift: Sequence[float], angle: float
) -> float:
    """The area that two rectangles share, by clipping.

    ``first`` and ``second``: their sides. The first has its centre at ``shift`` in the frame of the
    second, and is turned by ``angle``.
    """
    cosine, sine = math.cos(angle), math.sin(angle)
    ends = (first[0] / 2, first[1] / 2), (-first[0] / 2, -first[1] / 2)
    polygon = [
        (cosine * x - sine * y + shift[0], sine * x + cosine * y + shift[1])
        for x, y in (
            (ends[0][0], ends[0][1]), (ends[1][0], ends[0][1]),
            (ends[1][0], ends[1][1]), (ends[0][0], ends[1][1]),
        )
    ]  # fmt: skip
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        kept = []
        for p, q in zip(polygon, [*polygon[1:], *polygon[:1]], strict=True):
            room, next_room = (second[axis] / 2 - sign * point[axis] for point in (p, q))
            if room >= 0:
                kept.append(p)
            if (room >= 0) != (next_room >= 0):
                share = room / (room - next_room)
                kept.append((p[0] + share * (q[0] - p[0]), p[1] + share * (q[1] - p[1])))
        polygon = kept
    pairs = zip(polygon, [*polygon[1:], *polygon[:1]], strict=True)
    return abs(sum(p[0] * q[1] - p[1] * q[0] for p, q in pairs)) / 2


def nearest(source: Array, target: Array) -> Array:
    """The distance of each point of ``source`` to the nearest of ``target``, by brute force."""
    return np.asarray(
        [min(math.dist(p, q) for q in target.tolist()) for p in source.tolist()], dtype=float
    )


def largest_distance(points: Array) -> float:
    """The largest distance of two points, by brute force."""
    return max(math.dist(p, q) for p in points.tolist() for q in points.tolist())


def average_precision(
    scores: Sequence[float], correct: Sequence[bool], truths: int, interpolated: bool
) -> float:
    """The area under the precision-recall curve, for scores without ties."""
    order = sorted(range(len(scores)), key=lambda i: -scores[i])
    precisions, hits = [], 0
    for rank, i in enumerate(order, start=1):
        hits += correct[i]
        precisions.append(Fraction(hits, rank))
    area = Fraction(0)
    for rank, i in enumerate(order):
        if correct[i]:
            area += max(precisions[rank:]) if interpolated else precisions[rank]
    return float(area / truths)
