"""Which triangle each pixel sees, in numpy alone: a z-buffer over spans of pixels.

What :func:`pytest_cpas.datasets.rendering.render` takes in place of Open3D's ray caster. For a
triangle with corners a, b, c in the camera frame and a pixel's ray r = (x, y, 1), the ray meets it
where r . (b x c), r . (c x a) and r . (a x b) all have the sign of a . (b x c), at the depth
a . (b x c) over their sum: homogeneous coordinates, so that a triangle may reach behind the camera
and nothing is clipped (M. Olano, T. Greer, "Triangle scan conversion using 2D homogeneous
coordinates", Graphics Hardware 1997).

Two triangles that share an edge evaluate it to values that differ in sign alone, so no ray slips
between them. All of it is elementwise IEEE arithmetic in double precision, the same on every
processor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.datasets.rendering import cross
from pytest_cpas.types import Array, Camera

__all__ = ["rasterise"]

#: Triangles thinner than that, seen from the camera, are lines: nothing of them is seen.
_FLAT = 1e-18

#: A corner nearer than that to the plane of the camera counts as behind it, metres.
_NEAR = 1e-6

#: So many pixels are looked at together; more would not stay in the processor's cache.
_AT_ONCE = 1 << 18


def rasterise(corners: Array, camera: Camera) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Flat indices of the pixels whose ray meets a triangle, and these triangles.

    ``corners`` (F, 3, 3) metres, camera frame; both sides are seen. Where two triangles are equally
    near, the first is taken.
    """
    x = (np.arange(camera.width, dtype=np.float64) - camera.cx) / camera.fx
    y = (np.arange(camera.height, dtype=np.float64) - camera.cy) / camera.fy
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    edges = np.stack([cross(b, c), cross(c, a), cross(a, b)], axis=1)  # (F, 3 edges, 3)
    volume = a[:, 0] * edges[:, 0, 0] + a[:, 1] * edges[:, 0, 1] + a[:, 2] * edges[:, 0, 2]
    edges *= np.where(volume < 0, -1.0, 1.0)[:, None, None]
    volume = np.abs(volume)

    triangle, row, first, last = _spans(corners, edges, volume, x, y)
    depth = np.full(camera.height * camera.width, np.inf)
    nearest = np.full(depth.size, -1)
    lengths = last - first + 1
    ends = np.cumsum(lengths)
    start = 0
    while start < len(lengths):
        done = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, done + _AT_ONCE, side="right")))
        part = slice(start, stop)
        count = lengths[part]
        of_span = np.repeat(np.arange(start, stop), count)
        column = np.arange(len(of_span)) - np.repeat(np.cumsum(count) - count, count)
        column += first[of_span]
        which, line = triangle[of_span], row[of_span]
        values = [_value(edges, which, edge, x[column], y[line]) for edge in range(3)]
        inside = (values[0] >= 0) & (values[1] >= 0) & (values[2] >= 0)
        total = values[0] + values[1] + values[2]
        inside &= total > 0
        which, pixel = which[inside], (line * camera.width + column)[inside]
        z = volume[which] / total[inside]
        before = depth.copy() if start else depth
        np.minimum.at(depth, pixel, z)
        won = (z == depth[pixel]) & ((z < before[pixel]) if start else True)
        # of equals the last that is written stays, so the first triangle is written last
        nearest[pixel[won][::-1]] = which[won][::-1]
        start = stop
    hit = np.flatnonzero(nearest >= 0)
    return hit, nearest[hit]


def _value(edges: Array, which: NDArray[np.int64], edge: int, x: Array, y: Array) -> Array:
    """How far rays (x, y, 1) are on the inner side of an edge, in the same order of operations for
    the two triangles that share it."""
    value: Array = edges[which, edge, 0] * x + edges[which, edge, 1] * y + edges[which, edge, 2]
    return value


def _spans(
    corners: Array, edges: Array, volume: Array, x: Array, y: Array
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Triangle, row, first and last column (each (S,)) of what may be covered: a pixel too much at
    either end, never one too few."""
    z = corners[:, :, 2]
    in_front = (z > _NEAR).all(axis=1)  # else its rows are not those of its corners
    high = corners[:, :, 1] / np.maximum(z, _NEAR)
    top = np.where(in_front, np.searchsorted(y, high.min(axis=1)) - 1, 0)
    bottom = np.where(in_front, np.searchsorted(y, high.max(axis=1)), len(y) - 1)
    top, bottom = np.maximum(top, 0), np.minimum(bottom, len(y) - 1)
    usable = (z > 0).any(axis=1) & (volume > _FLAT) & (top <= bottom)
    some = np.flatnonzero(usable)
    rows = (bottom - top + 1)[some]
    triangle = np.repeat(some, rows)
    row = np.arange(len(triangle)) - np.repeat(np.cumsum(rows) - rows, rows) + top[triangle]

    low = np.full(len(triangle), -np.inf)
    far = np.full(len(triangle), np.inf)
    for edge in range(3):
        slope = edges[triangle, edge, 0]
        rest = edges[triangle, edge, 1] * y[row] + edges[triangle, edge, 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            crossing = -rest / slope
        low = np.where(slope > 0, np.maximum(low, crossing), low)
        far = np.where(slope < 0, np.minimum(far, crossing), far)
    step = x[1] - x[0]
    limit = np.array([-2.0, len(x) + 1.0])
    first = np.floor(np.clip((low - x[0]) / step, *limit)).astype(np.int64)
    last = np.ceil(np.clip((far - x[0]) / step, *limit)).astype(np.int64)
    first, last = np.maximum(first, 0), np.minimum(last, len(x) - 1)
    kept = first <= last
    return triangle[kept], row[kept], first[kept], last[kept]
