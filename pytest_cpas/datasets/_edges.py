"""Whether a surface is closed."""

from __future__ import annotations

import numpy as np

from pytest_cpas.types import Mesh

__all__ = ["open_edges"]


def open_edges(mesh: Mesh) -> int:
    """How many edges are of an odd number of triangles, after vertices in the same place were
    merged; 0 if the surface has no border."""
    _, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    triangles = same[mesh.triangles]
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, uses = np.unique(edges[edges[:, 0] != edges[:, 1]], axis=0, return_counts=True)
    return int(np.count_nonzero(uses % 2))
