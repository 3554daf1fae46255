"""The mug: the one shape that is not a single stack of rings, since its handle is a loop."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.datasets._rings import SEGMENTS, finish, loft, revolve, side
from pytest_cpas.types import Array, Mesh


def mug(
    height: float,
    radius: float,
    foot: float,
    wall: float,
    handle_reach: float,
    handle_height: float,
    handle_thickness: float,
) -> Mesh:
    """A hollow body; the handle is a tube that grows out of two holes in its outer wall."""
    wide, tall, rows = 4, 2, 17  # a handle's end is wide x tall quads of the wall
    half = handle_height * height / 2
    # rows of the outer wall, so that two pairs of them enclose the handle's ends
    ends = [(rows // 2) + side * 5 for side in (-1, 1)]
    knots = [0, ends[0] - 1, ends[0] + 1, ends[1] - 1, ends[1] + 1, rows - 1]
    thick = handle_thickness / 2
    mid = height / 2
    levels = np.interp(
        np.arange(rows),
        knots,
        [
            0.004,
            mid - half - thick,
            mid - half + thick,
            mid + half - thick,
            mid + half + thick,
            height,
        ],
    )
    widening = foot + (1 - foot) * levels / height
    outer = np.stack([radius * widening, levels], axis=1)
    inner_levels = np.array([height, 0.66 * height, 0.33 * height, 2.5 * wall])
    inner = np.stack(
        [radius * (foot + (1 - foot) * inner_levels / height) - wall, inner_levels], axis=1
    )
    r_foot = foot * radius
    profile = np.concatenate(
        [
            [[0.85 * r_foot, 0.002], [0.9 * r_foot, 0.0], [r_foot - 0.002, 0.0]],
            outer,
            [[radius - wall / 2, height + wall / 4]],
            inner,
            [[r_foot - 3 * wall, 1.5 * wall]],
        ]
    )
    # columns are counted from half a handle's width before -z
    rings = np.roll(revolve(profile), wide // 2, axis=1)
    vertices, parts = loft(rings)
    first = 3  # the first row of the outer wall
    for row in ends:
        for ring in range(first + row - tall // 2, first + row + tall // 2):
            # part 0 closes the bottom, so the quads above ring i are part i + 1
            parts[ring + 1] = side(ring * SEGMENTS, (ring + 1) * SEGMENTS, SEGMENTS, skip=wide)
    loops = [_patch_boundary(first + row, wide, tall) for row in ends]
    tube, sides = _handle(vertices, loops, handle_reach, handle_thickness)
    return finish(np.concatenate([vertices, tube]), np.concatenate([*parts, *sides]))


def _patch_boundary(row: int, wide: int, tall: int) -> NDArray[np.int64]:
    """Vertices around the hole that is centred on ring ``row``: counter-clockwise from below."""
    low, high = row - tall // 2, row + tall // 2
    cells = (
        [(low, c) for c in range(wide)]
        + [(r, wide) for r in range(low, high)]
        + [(high, c) for c in range(wide, 0, -1)]
        + [(r, 0) for r in range(high, low, -1)]
    )
    return np.array([r * SEGMENTS + c for r, c in cells])


def _handle(
    vertices: Array, loops: list[NDArray[np.int64]], reach: float, thickness: float
) -> tuple[Array, list[NDArray[np.int64]]]:
    """Rings of a tube from the upper hole's boundary to the lower one's, and its triangles."""
    lower, upper = loops
    n = len(lower)
    boundary = vertices[upper]
    middle = {name: vertices[loop].mean(axis=0) for name, loop in (("low", lower), ("up", upper))}
    # elliptic cross-sections; their vertices keep the bearings that they have on the boundary
    bearing = np.arctan2(
        (boundary[:, 1] - middle["up"][1]) / np.ptp(boundary[:, 1]),
        (boundary[:, 0] - middle["up"][0]) / np.ptp(boundary[:, 0]),
    )
    across, along = np.cos(bearing) * 0.8 * thickness, np.sin(bearing) * 0.5 * thickness
    t = np.linspace(0, np.pi, 19)[1:-1]
    # half a superellipse: squarer than a circle, as handles are
    power = 0.75
    y = np.sign(np.cos(t)) * np.abs(np.cos(t)) ** power
    centre_y = middle["low"][1] + (middle["up"][1] - middle["low"][1]) * (1 + y) / 2
    base_z = middle["low"][2] + (middle["up"][2] - middle["low"][2]) * (1 + y) / 2
    path = np.stack([base_z - reach * np.sin(t) ** power, centre_y], axis=1)  # (z, y)
    ends = np.array([[middle[k][2], middle[k][1]] for k in ("up", "low")])
    tangent = np.diff(np.concatenate([ends[:1], path, ends[1:]]), axis=0)
    tangent = tangent[:-1] + tangent[1:]
    tangent /= np.sqrt(np.sum(tangent**2, axis=1))[:, None]
    # at the upper end the tangent is -z and "up" in the cross-section is +y
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)  # (z, y)
    rings = np.stack(
        [
            np.broadcast_to(across, (len(t), n)),
            path[:, 1, None] + normal[:, 1, None] * along,
            path[:, 0, None] + normal[:, 0, None] * along,
        ],
        axis=-1,
    )
    # walked outwards and back the section turns over: the lower boundary is met mirrored
    mirrored = np.array([int(np.argmin(np.abs(_wrap(bearing + b)))) for b in bearing])
    start = len(vertices)
    sequence = [upper, *(start + i * n + np.arange(n) for i in range(len(t))), lower[mirrored]]
    sides = []
    for a, b in itertools.pairwise(sequence):
        quad = np.stack([a, np.roll(a, -1), np.roll(b, -1), b], axis=1)
        sides += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return rings.reshape(-1, 3), sides


def _wrap(angle: Array) -> Array:
    wrapped: Array = (angle + np.pi) % (2 * np.pi) - np.pi
    return wrapped
