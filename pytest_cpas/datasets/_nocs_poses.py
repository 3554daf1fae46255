"""The poses of a file of NOCS's ground truth, and whether one is where an object is seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.datasets._values import check_last_rows
from pytest_cpas.reading.pickles import load_numpy_pickle
from pytest_cpas.types import Array, Camera, DataError, GroundTruth
from pytest_cpas.types._arrays import finite_array
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET

__all__ = ["read_poses", "seen_instead"]

#: Corners of a box in units of its extents.
_CORNERS = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), axis=-1).reshape(8, 3)

#: At least this share of an object's pixels is within the 2-D box of its posed box, which is
#: enlarged on every side by this share of its size.
_INSIDE, _MARGIN = 0.5, 0.2


def read_poses(path: Path) -> tuple[Array, Array | None]:
    """Poses (n, 4, 4), and extents (n, 3) in ShapeNet axes, metres, if they are there."""
    truth = load_numpy_pickle(path)
    poses, sizes = truth.get("gt_RTs"), truth.get("gt_scales")
    if (
        not isinstance(poses, np.ndarray)
        or poses.shape[1:] != (4, 4)
        or poses.dtype.kind != "f"
        or not np.isfinite(poses).all()
    ):
        raise DataError(f"{path}: gt_RTs is not an array (n, 4, 4) of finite numbers")
    check_last_rows(poses, f"{path}: gt_RTs")
    poses = poses.astype(np.float64)
    if sizes is None:
        return poses, None
    sizes = finite_array(sizes, f"{path}: gt_scales")
    if sizes.shape != (len(poses), 3):
        raise DataError(f"{path}: gt_scales has shape {sizes.shape}, expected (n, 3)")
    scales = np.cbrt(np.abs(np.linalg.det(poses[:, :3, :3])))
    return poses, scales[:, None] * sizes @ np.abs(NOCS_FROM_SHAPENET)


def seen_instead(
    camera: Camera, truth: GroundTruth, poses: Array, own: int, mask: NDArray[np.bool_]
) -> int | None:
    """Which other one of an image's ``poses`` (n, 4, 4) is where the pixels (H, W) of an object
    are, if its ``own`` is not; None otherwise."""
    if _share_inside(camera, truth.pose.matrix, truth.extents, mask) >= _INSIDE:
        return None
    for index, matrix in enumerate(poses):
        # of the others an upright box will do
        if index != own and _share_inside(camera, matrix, None, mask) >= _INSIDE:
            return index
    return None


def _share_inside(
    camera: Camera, matrix: Array, extents: Array | None, mask: NDArray[np.bool_]
) -> float:
    """The share of a mask's pixels that are in the 2-D box of a posed box; of a matrix with a
    scale, which is the diagonal, without ``extents``. 1 where nothing can be said."""
    corners = _CORNERS * (1 / np.sqrt(3) if extents is None else extents)
    corners = corners @ matrix[:3, :3].T + matrix[:3, 3]
    if not mask.any() or corners[:, 2].min() <= 0:
        return 1.0 if extents is not None else 0.0  # what is none says so itself
    corners = camera.project(corners)
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = _MARGIN * (high - low)
    pixels = np.argwhere(mask)[:, ::-1]
    return float(((pixels >= low - margin) & (pixels <= high + margin)).all(axis=1).mean())
