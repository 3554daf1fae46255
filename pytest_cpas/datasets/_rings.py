"""What all shapes are made from: closed surfaces through stacks of rings.

A stack is an array (M, N, 3): M rings of N vertices each, metres.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.types import Array, Mesh

#: Vertices of a ring about the y axis.
SEGMENTS = 48


def solid_of_revolution(profile: Array) -> Mesh:
    """The solid about the y axis through ``profile`` (M, 2): radius and height, metres.

    Both ends are closed by a disc. Like every shape it is centred on its bounding box.
    """
    return solid(revolve(profile))


def finish(vertices: Array, triangles: NDArray[np.int64]) -> Mesh:
    """Drop unused vertices, centre on the bounding box, round, orient the triangles outwards."""
    used, triangles = np.unique(triangles, return_inverse=True)
    vertices, triangles = vertices[used], triangles.reshape(-1, 3)
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    vertices = np.round(vertices, 7) + 0.0  # no -0.0
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    if np.sum(a * np.cross(b, c)) < 0:
        triangles = triangles[:, ::-1]
    return Mesh(vertices, triangles)


def side(first: int, second: int, count: int, skip: int = 0) -> NDArray[np.int64]:
    """Triangles between two rings of ``count`` vertices, less the first ``skip`` quads."""
    j = np.arange(skip, count)
    k = (j + 1) % count
    lower = np.stack([first + j, first + k, second + k], axis=1)
    upper = np.stack([first + j, second + k, second + j], axis=1)
    return np.concatenate([lower, upper])


def loft(rings: Array) -> tuple[Array, list[NDArray[np.int64]]]:
    """A closed surface through rings (M, N, 3), both ends closed at the middle of their ring."""
    m, n, _ = rings.shape
    vertices = np.concatenate(
        [rings.reshape(-1, 3), rings[0].mean(0)[None], rings[-1].mean(0)[None]]
    )
    j = np.arange(n)
    k = (j + 1) % n
    start = np.stack([np.full(n, m * n), k, j], axis=1)
    end = np.stack([np.full(n, m * n + 1), (m - 1) * n + j, (m - 1) * n + k], axis=1)
    sides = [side(i * n, (i + 1) * n, n) for i in range(m - 1)]
    return vertices, [start, *sides, end]


def revolve(profile: Array, columns: int = SEGMENTS) -> Array:
    """Rings (M, columns, 3) about the y axis through profile points (M, 2) of radius and height.

    The first column lies at -z, the following ones towards +x.
    """
    angles = 2 * np.pi * np.arange(columns) / columns
    radius, height = profile[:, 0, None], profile[:, 1, None]
    return np.stack(
        np.broadcast_arrays(radius * np.sin(angles), height, -radius * np.cos(angles)), axis=-1
    )


def refine(profile: Array, step: float) -> Array:
    """Points on the straight lines between profile points, at most ``step`` apart."""
    pieces = [profile[:1]]
    for a, b in itertools.pairwise(profile):
        count = max(1, int(np.ceil(np.sqrt(np.sum((b - a) ** 2)) / step)))
        pieces.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(pieces)


def solid(rings: Array) -> Mesh:
    """The shape whose surface is lofted through ``rings`` (M, N, 3)."""
    vertices, triangles = loft(rings)
    return finish(vertices, np.concatenate(triangles))
