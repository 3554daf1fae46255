"""The computation of ``_box_clipping`` as compiled loops. Needs numba (the ``fast`` extra)."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["clip_pairs"]

Array = NDArray[np.float64]

_compiled = numba.njit(cache=True, error_model="numpy")


@_compiled
def _clip(buffer: Array, source: int, count: int, axis: int, sign: float, bound: float) -> int:
    """Sutherland-Hodgman: clip ``buffer[source]`` into ``buffer[1 - source]``; the new count."""
    target = 1 - source
    kept = 0
    last = count - 1
    before = sign * buffer[source, last, axis] - bound
    for i in range(count):
        here = sign * buffer[source, i, axis] - bound
        if (here > 0) != (before > 0):
            share = before / (before - here)
            for k in range(3):
                start = buffer[source, last, k]
                buffer[target, kept, k] = start + share * (buffer[source, i, k] - start)
            buffer[target, kept, axis] = sign * bound
            kept += 1
        if here <= 0:
            for k in range(3):
                buffer[target, kept, k] = buffer[source, i, k]
            kept += 1
        last = i
        before = here
    return kept


@_compiled
def _projected_area(buffer: Array, source: int, count: int) -> float:
    area = 0.0
    x0, y0 = buffer[source, 0, 0], buffer[source, 0, 1]
    for i in range(1, count - 1):
        area += (buffer[source, i, 0] - x0) * (buffer[source, i + 1, 1] - y0) - (
            buffer[source, i, 1] - y0
        ) * (buffer[source, i + 1, 0] - x0)
    return 0.5 * area


@_compiled
def clip_pairs(
    rotation: Array, offset: Array, half_a: Array, half_b: Array, face_corners: Array
) -> tuple[Array, Array]:
    """Volumes (N,) and torques (N, 3); see :func:`_box_clipping.overlap_and_torque`."""
    volume = np.zeros(len(offset))
    torque = np.zeros((len(offset), 3))
    # a convex polygon gains at most one vertex per plane; rounding may add a few more
    buffer = np.empty((2, 64, 3))
    edges = np.empty((3, 3))
    high = np.empty(3)
    low = np.empty(3)
    for n in range(len(offset)):
        apart = False
        for i in range(3):
            reach = half_b[n, i]
            for j in range(3):
                edges[i, j] = rotation[n, i, j] * half_a[n, j]
                reach += abs(edges[i, j])
            apart |= abs(offset[n, i]) >= reach
        if apart:
            continue
        total = 0.0
        for face in range(6):
            # the face's highest and lowest coordinates beyond B's planes
            normal = face // 2
            side = 1.0 - 2.0 * (face % 2)
            u = (normal + 1) % 3
            v = (normal + 2) % 3
            for i in range(3):
                middle = offset[n, i] + side * edges[i, normal]
                reach = abs(edges[i, u]) + abs(edges[i, v])
                high[i] = middle + reach - half_b[n, i]
                low[i] = -half_b[n, i] - middle + reach
            if min(high[0], low[0]) < -2 * half_b[n, 0] or min(high[1], low[1]) < -2 * half_b[n, 1]:
                continue  # beside B: nothing of it is above, below or inside
            for k in range(4):
                s, t = face_corners[k, face, u], face_corners[k, face, v]
                for i in range(3):
                    buffer[0, k, i] = (
                        offset[n, i] + side * edges[i, normal] + s * edges[i, u] + t * edges[i, v]
                    )
            source = 0
            count = 4
            for axis in range(2):
                if high[axis] > 0 and count > 0:
                    count = _clip(buffer, source, count, axis, 1.0, half_b[n, axis])
                    source = 1 - source
                if low[axis] > 0 and count > 0:
                    count = _clip(buffer, source, count, axis, -1.0, half_b[n, axis])
                    source = 1 - source
            if count == 0:
                continue
            column_area = _projected_area(buffer, source, count)
            below_area = column_area
            if high[2] > 0:
                count = _clip(buffer, source, count, 2, 1.0, half_b[n, 2])
                source = 1 - source
                below_area = _projected_area(buffer, source, count)
            if low[2] > 0 and count > 0:
                count = _clip(buffer, source, count, 2, -1.0, half_b[n, 2])
                source = 1 - source
            inside_area = 0.0
            x0, y0, z0 = buffer[source, 0]
            for i in range(1, count - 1):
                ux = buffer[source, i, 0] - x0
                uy = buffer[source, i, 1] - y0
                uz = buffer[source, i, 2] - z0
                vx = buffer[source, i + 1, 0] - x0
                vy = buffer[source, i + 1, 1] - y0
                vz = buffer[source, i + 1, 2] - z0
                ax = 0.5 * (uy * vz - uz * vy)
                ay = 0.5 * (uz * vx - ux * vz)
                az = 0.5 * (ux * vy - uy * vx)
                x = x0 + (ux + vx) / 3
                y = y0 + (uy + vy) / 3
                z = z0 + (uz + vz) / 3
                inside_area += az
                total += z * az
                torque[n, 0] += y * az - z * ay
                torque[n, 1] += z * ax - x * az
                torque[n, 2] += x * ay - y * ax
            total += half_b[n, 2] * (column_area - 2 * below_area + inside_area)
        volume[n] = max(total, 0.0)
    return volume, torque
