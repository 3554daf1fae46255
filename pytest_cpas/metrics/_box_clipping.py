"""The volume that two boxes share, for many pairs at once.

Box B is [-b, b] in its own frame. Box A's surface is moved into B by clamping each coordinate to
[-b_i, b_i]. Clamping leaves the inside of B alone and moves nothing into it from outside, so the
clamped surface encloses exactly the part of A that lies in B, and the volume is the flux of
(0, 0, z) through it::

    V = sum over A's faces of the integral of clamp(z, -b_z, b_z) dx dy
        over the part of the face's projection that lies in |x| <= b_x, |y| <= b_y

Only A's faces occur, no face of B and no choice between coplanar faces, and every term is a
continuous function of the input. Rounding that moves a vertex across a plane therefore changes the
volume by a rounding error, not by a face: that is what makes identical, nearly identical and
touching boxes no special case. A face is a polygon that is clipped against six planes in turn.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["overlap"]

Array = NDArray[np.float64]

#: Pairs that are clipped together: their polygons stay in the processor's cache.
_CHUNK = 256


def _face_corners() -> Array:
    """Signs (4, 6, 3) of the corners of a box's six faces, counter-clockwise from outside."""
    faces = np.empty((4, 6, 3))
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    for axis in range(3):
        for side, sign in enumerate((1, -1)):
            faces[:, 2 * axis + side, axis] = sign
            faces[:, 2 * axis + side, (axis + 1) % 3] = square[::sign, 0]
            faces[:, 2 * axis + side, (axis + 2) % 3] = square[::sign, 1]
    return faces


_FACE_CORNERS = _face_corners()


def overlap(rotation: Array, offset: Array, half_a: Array, half_b: Array) -> Array:
    """Volumes (N,) shared by boxes A and B.

    ``rotation`` (N, 3, 3) and ``offset`` (N, 3) take A's frame to B's; ``half_a``, ``half_b``
    (N, 3) are half the extents.
    """
    volume = np.empty(len(offset))
    for start in range(0, len(offset), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        volume[chunk], _ = _clipped(rotation[chunk], offset[chunk], half_a[chunk], half_b[chunk])
    return volume


def _clipped(rotation: Array, offset: Array, half_a: Array, half_b: Array) -> tuple[Array, Array]:
    """Volumes (N,), and A's faces inside B as polygons (3, K, 6 N), face-major."""
    corners = np.einsum("nij,kfj,nj->ikfn", rotation, _FACE_CORNERS, half_a)
    corners += offset.T[:, None, None, :]
    polygons = corners.reshape(3, 4, -1)
    bounds = np.tile(half_b.T, 6)
    for axis in (0, 1):
        polygons = _clip(polygons, axis, bounds[axis])
    column = _area(polygons)
    below = _clip_side(polygons, 2, 1.0, bounds[2])
    below_area = _area(below)
    inside = _clip_side(below, 2, -1.0, bounds[2])
    fan = _fan(inside)
    inside_area = fan.sum(axis=0)
    z = inside[2]
    flux = (fan * (z[0] + z[1:-1] + z[2:])).sum(axis=0) / 3
    flux += bounds[2] * (column - 2 * below_area + inside_area)
    return np.maximum(flux.reshape(6, -1).sum(axis=0), 0), inside


def _clip(polygons: Array, axis: int, bound: Array) -> Array:
    return _clip_side(_clip_side(polygons, axis, 1.0, bound), axis, -1.0, bound)


def _clip_side(polygons: Array, axis: int, sign: float, bound: Array) -> Array:
    """Clip polygons (3, K, M) to ``sign * coordinate <= bound``; returns (3, K + 1, M).

    A convex polygon has one run of vertices outside. It is taken around the outermost vertex, so
    that vertices which rounding puts a hair outside elsewhere just stay where they are. The run
    becomes the two points where the boundary crosses the plane, repeated to fill its places.
    """
    count = polygons.shape[1]
    result = np.concatenate([polygons, polygons[:, :1]], axis=1)
    height = sign * polygons[axis] - bound
    cut = np.flatnonzero(height.max(axis=0) > 0)
    if len(cut) == 0:
        return result
    height = height[:, cut]
    # start each polygon at its outermost vertex
    order = (height.argmax(axis=0) + np.arange(count)[:, None]) % count
    height = np.take_along_axis(height, order, axis=0)
    points = polygons[:, order, cut]
    outside = height > 0
    leading = np.logical_and.accumulate(outside, axis=0)
    trailing = np.logical_and.accumulate(outside[::-1], axis=0)[::-1]
    lead, trail = leading.sum(axis=0), trailing.sum(axis=0)
    entry = _crossing(points, height, lead - 1, lead % count)
    leave = _crossing(points, height, -trail % count, (-trail - 1) % count)
    entry[axis] = leave[axis] = sign * bound[cut]
    points = np.where(leading, entry[:, None], np.where(trailing, leave[:, None], points))
    result[:, :-1, cut] = points
    result[:, -1, cut] = np.where(lead == count, entry, leave)
    return result


def _crossing(points: Array, height: Array, outer: Array, inner: Array) -> Array:
    """Where the edges from vertices ``outer`` to ``inner`` cross height 0, (3, M)."""
    column = np.arange(points.shape[2])
    high, low = height[outer, column], height[inner, column]
    start = points[:, outer, column]
    # a polygon that is outside as a whole has no crossing: it shrinks to a point
    drop = high - low
    share = np.divide(high, drop, out=np.zeros_like(high), where=(low <= 0) & (drop > 0))
    return start + share * (points[:, inner, column] - start)


def _fan(polygons: Array) -> Array:
    """Signed areas (K - 2, M), projected along z, of the triangles that a polygon splits into."""
    x = polygons[0, 1:] - polygons[0, 0]
    y = polygons[1, 1:] - polygons[1, 0]
    return 0.5 * (x[:-1] * y[1:] - x[1:] * y[:-1])


def _area(polygons: Array) -> Array:
    return _fan(polygons).sum(axis=0)
