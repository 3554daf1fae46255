"""The poses of a file of NOCS's ground truth, and whether they can be those of the objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.datasets._nocs_meta import Listed
from pytest_cpas.datasets._values import check_last_rows
from pytest_cpas.reading.pickles import load_numpy_pickle
from pytest_cpas.types import Array, Camera, DataError
from pytest_cpas.types._arrays import finite_array
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET

__all__ = ["class_ids_in", "contradiction", "other_classes", "poses_in", "read_poses"]

#: Corners of a box in units of its extents.
_CORNERS = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), axis=-1).reshape(8, 3)

#: At least this share of an object's pixels is within the 2-D box of its posed box, which is
#: enlarged on every side by this share of its size. Of all 16118 published objects all pixels are,
#: with half the margin.
_INSIDE, _MARGIN = 0.9, 0.2

#: A pose's scale is the box diagonal of its model, in all that is published to six digits: it is
#: another model's if it is as near to that, and not as near to its own (shares).
_SAME_SCALE, _OTHER_SCALE = 0.01, 0.02

#: Metres: as the check "poses" has it.
_FARTHEST = 10.0

_BACKGROUND = 255


def read_poses(path: Path) -> tuple[Array, Array | None]:
    """Poses (n, 4, 4), and extents (n, 3) in ShapeNet axes, metres, if they are there."""
    return poses_in(load_numpy_pickle(path), path)


def poses_in(truth: Mapping[str, Any], path: Path) -> tuple[Array, Array | None]:
    """As :func:`read_poses`, of what the file holds."""
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


def class_ids_in(truth: Mapping[str, Any], path: Path, classes: int) -> list[int] | None:
    """``gt_class_ids`` (n,), which count from 1 to ``classes``; None if there are none."""
    ids = truth.get("gt_class_ids")
    if ids is None:
        return None
    if (
        not isinstance(ids, np.ndarray)
        or ids.ndim != 1
        or ids.dtype.kind not in "iu"
        or (ids.size and not (ids.min() >= 1 and ids.max() <= classes))
    ):
        raise DataError(f"{path}: gt_class_ids are not class ids (n,) of 1 to {classes}")
    found: list[int] = ids.tolist()
    return found


def other_classes(
    known: Sequence[int] | None, objects: Sequence[Listed], names: Sequence[str], meta: str
) -> str:
    """What ``gt_class_ids`` say against the classes of a meta file; empty where nothing."""
    told = [names.index(item.category) + 1 for item in objects]
    if known is None or known == told:
        return ""
    return f"gt_class_ids are {known}, but the classes of these objects in {meta} are {told}"


def contradiction(
    camera: Camera,
    poses: Array,
    objects: Sequence[Listed],
    extents: Mapping[str, Array],
    ids: NDArray[np.uint8] | None,
) -> str:
    """What says that a frame's ``poses`` (n, 4, 4), rotation times scale, are not those of its
    ``objects`` (n) in this order; empty where nothing does.

    ``extents`` (3,), of the models that the frame lists, hidden ones too, in ShapeNet axes, metres,
    as far as they are known; ``ids`` (H, W): its mask, if there is one.
    """
    diagonals = {model: float(np.linalg.norm(sides)) for model, sides in extents.items()}
    scales = np.cbrt(np.linalg.det(poses[:, :3, :3]))
    for item, scale in zip(objects, scales, strict=True):
        own = diagonals.get(item.model)
        if own is None or abs(scale - own) <= _OTHER_SCALE * own:
            continue
        for model, diagonal in diagonals.items():
            if abs(scale - diagonal) <= _SAME_SCALE * diagonal:
                return (
                    f"{len(poses)} poses for {len(objects)} objects, but pose {item.pose_index} has"
                    f" the scale {scale:.4g} m, which is the box diagonal of {model}, and would be"
                    f" that of object {item.mask_id}, {item.model}, whose diagonal is {own:.4g} m"
                )
    there = (poses[:, 2, 3] > 0) & (poses[:, 2, 3] <= _FARTHEST)
    if ids is None or not there.any():  # such poses have another unit or convention, in all frames
        return ""
    rows, columns = np.nonzero(ids != _BACKGROUND)
    labels, pixels = ids[rows, columns], np.stack([columns, rows], axis=1)
    fit, misfit = [], []
    for item, pose, plausible in zip(objects, poses, there, strict=True):
        own_pixels = pixels[labels == item.mask_id]
        box = _box_of(camera, pose, extents.get(item.model))
        share = _share_inside(box, own_pixels) if plausible else 0.0
        if share >= _INSIDE:
            fit.append(str(item.mask_id))
        else:
            of = f"object {item.mask_id} ({item.category}, {len(own_pixels)} pixels)"
            misfit.append(f"that of pose {item.pose_index} {int(100 * share)} % of {of}")
    if not misfit:
        return ""
    return (
        f"{len(poses)} poses for the {len(objects)} objects of the mask, but as 2-D boxes, enlarged"
        f" by a fifth, they do not hold their objects' pixels: {' and '.join(misfit)}, expected"
        f" {100 * _INSIDE:g} % or more; {'objects ' + ', '.join(fit) if fit else 'none'} fit"
    )


def _box_of(camera: Camera, pose: Array, extents: Array | None) -> tuple[Array, Array] | None:
    """The enlarged 2-D box of a posed box: low and high corner, pixels; None if it reaches behind
    the camera. Its diagonal is the pose's scale; without extents it is a cube."""
    scale = np.cbrt(abs(np.linalg.det(pose[:3, :3])))
    rotation = pose[:3, :3] / max(scale, np.finfo(float).tiny)
    # the scale is the diagonal; extents in another unit are a matter of the checks
    sides = np.ones(3) if extents is None else extents
    extents = sides * scale / np.linalg.norm(sides)
    corners = _CORNERS * (extents @ np.abs(NOCS_FROM_SHAPENET).T) @ rotation.T + pose[:3, 3]
    if corners[:, 2].min() <= 0:
        return None
    corners = camera.project(corners)
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = _MARGIN * (high - low)
    return low - margin, high + margin


def _share_inside(box: tuple[Array, Array] | None, pixels: NDArray[np.int64]) -> float:
    """The share of an object's pixels (n, 2) that are in its box; 1 where nothing can be said."""
    if box is None or not len(pixels):
        return 1.0
    low, high = box
    return float(((pixels >= low) & (pixels <= high)).all(axis=1).mean())
