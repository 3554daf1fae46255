"""Masks for data sets that have none."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.datasets.rendering import hidden, render
from pytest_cpas.types import Camera, Mesh, Pose


def visible(
    mesh: Mesh, pose: Pose, depth: NDArray[np.float32], camera: Camera
) -> NDArray[np.bool_]:
    """Where (H, W) a posed mesh is seen and nothing was measured in front of it.

    ``depth`` (H, W): measured metres, 0 = missing. A pixel without a measurement counts as seen.
    """
    rendered = render([(mesh, pose)], camera).depth
    mask: NDArray[np.bool_] = (rendered > 0) & ~hidden(rendered, depth)
    return mask
