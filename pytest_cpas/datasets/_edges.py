"""Whether a surface is closed."""

from __future__ import annotations

import numpy as np

from pytest_cpas.types import Mesh

__all__ = ["told_edges", "uneven_edges"]


def uneven_edges(mesh: Mesh) -> tuple[int, int]:
    """How many edges are of one triangle, and of three or more, an odd number, after vertices in
    the same place were merged; none if the surface has no border."""
    _, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    triangles = same[mesh.triangles]
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, uses = np.unique(edges[edges[:, 0] != edges[:, 1]], axis=0, return_counts=True)
    return int(np.count_nonzero(uses == 1)), int(np.count_nonzero((uses > 1) & (uses % 2 == 1)))


def told_edges(single: int, crowded: int) -> str:
    """What is wrong with such edges, of which there are some."""
    told = [f"{single} edges are open"] * bool(single)
    if crowded:
        told.append(
            f"{crowded} edges are of three triangles or more, an odd number (is a triangle there"
            " twice?)"
        )
    return " and ".join(told)
