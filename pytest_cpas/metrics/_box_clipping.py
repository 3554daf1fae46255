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

import functools
import importlib.util
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = ["expect", "overlap_and_torque"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Kernel = Callable[[Array, Array, Array, Array, Array], tuple[Array, Array]]

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
#: The same as indices of (-1, 1).
_FACE_SIDES = (_FACE_CORNERS > 0).astype(int)


def overlap_and_torque(
    rotation: Array, offset: Array, half_a: Array, half_b: Array
) -> tuple[Array, Array]:
    """The volumes (N,) that boxes A and B share, and the torques (N, 3) on A.

    ``rotation`` (N, 3, 3) and ``offset`` (N, 3) take A's frame to B's; ``half_a``, ``half_b``
    (N, 3) are half the extents. The torque is the integral of ``p x n`` over the part of A's
    surface that lies in B, p from B's centre: turning A about B's centre at the rate omega changes
    the volume at the rate ``omega . torque``, turning B at ``-omega . torque``.
    """
    kernel = _kernel(len(offset))
    if kernel is not None:
        return kernel(rotation, offset, half_a, half_b, _FACE_CORNERS)
    volume, torque = np.empty(len(offset)), np.empty((len(offset), 3))
    for start in range(0, len(offset), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        volume[chunk], torque[chunk] = _clip_chunk(
            rotation[chunk], offset[chunk], half_a[chunk], half_b[chunk]
        )
    return volume, torque


def _clip_chunk(
    rotation: Array, offset: Array, half_a: Array, half_b: Array
) -> tuple[Array, Array]:
    # the corners of A, as sums of what each side adds: (coordinate, corner, face, pair)
    sides = np.moveaxis(rotation * half_a[:, None, :], 0, -1)
    ends = np.stack([-sides, sides])
    corners = ends[_FACE_SIDES[..., 0], :, 0] + ends[_FACE_SIDES[..., 1], :, 1]
    corners += ends[_FACE_SIDES[..., 2], :, 2]
    corners += offset.T
    polygons = np.moveaxis(corners, 2, 0).reshape(3, 4, -1)
    bounds = np.tile(half_b.T, 6)
    for axis in (0, 1):
        polygons = _clip(polygons, axis, 1.0, bounds[axis])
        polygons = _clip(polygons, axis, -1.0, bounds[axis])
    column_area = _projected_area(polygons)
    polygons = _clip(polygons, 2, 1.0, bounds[2])
    below_area = _projected_area(polygons)
    polygons = _clip(polygons, 2, -1.0, bounds[2])
    first = polygons[:, :1]
    spokes = polygons[:, 1:] - first
    area = 0.5 * _cross(spokes[:, :-1], spokes[:, 1:])
    centroid = first + (spokes[:, :-1] + spokes[:, 1:]) / 3
    flux = (centroid[2] * area[2]).sum(axis=0)
    flux += bounds[2] * (column_area - 2 * below_area + area[2].sum(axis=0))
    torque = _cross(centroid, area).sum(axis=1)
    return (
        np.maximum(flux.reshape(6, -1).sum(axis=0), 0),
        torque.reshape(3, 6, -1).sum(axis=1).T,
    )


def _cross(u: Array, v: Array) -> Array:
    """The cross products of vectors (3, ...); that of numpy copies them."""
    return np.stack([u[i - 2] * v[i - 1] - u[i - 1] * v[i - 2] for i in range(3)])


def _clip(polygons: Array, axis: int, sign: float, bound: Array) -> Array:
    """Clip polygons (3, K, M) to ``sign * coordinate <= bound``; returns (3, K + 1, M).

    A convex polygon has one run of vertices outside. It is taken around the outermost vertex, so
    that vertices which rounding puts a hair outside elsewhere just stay where they are. The run
    becomes the two points where the boundary crosses the plane, repeated to fill its places.
    """
    count, total = polygons.shape[1:]
    result = np.concatenate([polygons, polygons[:, :1]], axis=1)
    height = sign * polygons[axis] - bound
    cut = np.flatnonzero(height.max(axis=0) > 0)
    if len(cut) == 0:
        return result
    # start each polygon at its outermost vertex; flat indices are several times as fast
    order = height.argmax(axis=0)[cut] + np.arange(count)[:, None]
    order[order >= count] -= count
    places = order * total + cut
    height = height.ravel().take(places)
    points = polygons.reshape(3, -1).take(places, axis=1)
    outside = height > 0
    leading = np.logical_and.accumulate(outside, axis=0)
    trailing = np.logical_and.accumulate(outside[::-1], axis=0)[::-1]
    lead, trail = leading.sum(axis=0), trailing.sum(axis=0)
    entry = _crossing(points, height, lead - 1, lead % count)
    leave = _crossing(points, height, -trail % count, (-trail - 1) % count)
    entry[axis] = leave[axis] = sign * bound[cut]
    np.copyto(points, leave[:, None], where=trailing)
    np.copyto(points, entry[:, None], where=leading)
    result[:, :-1, cut] = points
    result[:, -1, cut] = np.where(lead == count, entry, leave)
    return result


def _crossing(points: Array, height: Array, outer: Index, inner: Index) -> Array:
    """Where the edges from vertices ``outer`` to ``inner`` cross height 0, (3, M)."""
    column = np.arange(len(outer))
    outer, inner = outer * len(column) + column, inner * len(column) + column
    points, height = points.reshape(3, -1), height.ravel()
    high, low = height.take(outer), height.take(inner)
    # a polygon that is outside as a whole has no crossing: it shrinks to a point
    drop = high - low
    share = np.divide(high, drop, out=np.zeros_like(high), where=(low <= 0) & (drop > 0))
    start = points.take(outer, axis=1)
    return np.asarray(start + share * (points.take(inner, axis=1) - start))


def _projected_area(polygons: Array) -> Array:
    """Signed areas (M,) of polygons (3, K, M) projected along z."""
    x, y = polygons[:2, 1:] - polygons[:2, :1]
    return np.asarray(0.5 * (x[:-1] * y[1:] - x[1:] * y[:-1]).sum(axis=0))


#: Pairs that numpy has clipped so far; a call costs about as much as this many pairs.
_CALL = 40
_clipped_by_numpy = 0

#: From here on the compiled kernel is used, if numba is installed.
_WARM = 200_000


def expect(pairs: int) -> None:
    """Take the compiled kernel from the beginning if so many pairs will make it pay."""
    global _clipped_by_numpy
    if pairs >= _WARM:
        _clipped_by_numpy = _WARM


@functools.cache
def _compiled() -> Kernel | None:
    if importlib.util.find_spec("numba") is None:
        return None
    from pytest_cpas.metrics import _box_kernel

    kernel: Kernel = _box_kernel.clip_pairs
    return kernel


def _kernel(pairs: int) -> Kernel | None:
    """The compiled kernel if it pays.

    It is 15 times faster, but importing numba takes 0.3 s and the first compilation on a machine
    2 s (numba caches it on disk). So it is only loaded once numpy has worked for that long: a
    user's first small test never waits for a compiler.
    """
    global _clipped_by_numpy
    if _clipped_by_numpy < _WARM:
        _clipped_by_numpy += pairs + _CALL
    return _compiled() if _clipped_by_numpy >= _WARM else None
