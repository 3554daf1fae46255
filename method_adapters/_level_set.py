"""The surface in a grid of signed distances, as a mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from method_adapters._crop import NoAnswerError
from pytest_cpas.adapting import Mesh


def level_set(
    values: NDArray[np.floating], level: float, *, half_width: float, closed: bool
) -> Mesh:
    """The surface where ``values`` (n, n, n) equal ``level``, by marching cubes (Lewiner 2003).

    The first and the last node of each axis (x, y, z) are at -``half_width`` and ``half_width``,
    metres. Triangles look towards larger values. ``closed`` adds a layer of nodes with the value
    1 around the grid, so that a surface that leaves the grid ends there. Raises
    :class:`NoAnswerError` if no value lies below, or none above, the level.
    """
    from skimage.measure import marching_cubes

    spacing = 2 * half_width / (len(values) - 1)
    first = -half_width
    if closed:
        values = np.pad(values, 1, constant_values=1.0)
        first -= spacing
    low, high = float(values.min()), float(values.max())
    if not low < level < high:  # NaN is neither
        raise NoAnswerError(
            f"no surface at {level:g} in signed distances from {low:.3g} to {high:.3g}"
        )
    vertices, triangles, _, _ = marching_cubes(
        np.ascontiguousarray(values, dtype=np.float32), level, spacing=(spacing,) * 3
    )
    return Mesh(vertices.astype(np.float64) + first, triangles)
