"""Observations of shapes at known poses, made without a renderer."""

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.metrics.surfaces import sample_surface
from pytest_cpas.types import Camera, Mesh, Observation, Pose

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)


def splat(points: NDArray[np.float64], camera: Camera) -> NDArray[np.float32]:
    """Depth of a densely sampled closed surface: the nearest sample of every pixel."""
    u, v = np.rint(camera.project(points)).astype(int).T
    depth = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(depth, (v, u), points[:, 2])
    return np.where(np.isinf(depth), 0, depth).astype(np.float32)


def observe(mesh: Mesh, pose: Pose, category: str, background: float = 2.0) -> Observation:
    depth = splat(pose.apply(sample_surface(mesh, 400_000, seed=5)), CAMERA)
    mask = depth > 0
    depth[~mask] = background
    depth = np.round(depth, 3)  # whole millimetres, as a sensor gives them
    rgb = np.zeros((*depth.shape, 3), np.float32)
    return Observation(category=category, rgb=rgb, depth=depth, mask=mask, camera=CAMERA)
