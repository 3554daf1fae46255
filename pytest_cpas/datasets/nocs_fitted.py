"""CAMERA25 and the training split of REAL (NOCS, Wang et al. 2019), as published.

::

    val/SSSSS/NNNN_{color,mask,coord}.png, NNNN_meta.txt       CAMERA25
    camera_full_depths/val/SSSSS/NNNN_composed.png             its depth, millimetres
    obj_models/val/SYNSET/ID/model.obj                         its meshes
    real_train/scene_S/NNNN_{color,depth,mask,coord}.png, NNNN_meta.txt
    obj_models/real_train/MODEL.{obj,txt}

``CAMERA/val`` and ``Real/train`` may stand for ``val`` and ``real_train``, as in SPD and its
followers.

No poses are published for real_train, and some of those published for CAMERA25 are wrong
(``nocs_dataset.py`` of the paper's toolbox). As there, a pose is the similarity transform from the
NOCS map, in ``coord.png``, to the measured points: red, green and blue are x, y and 1 - z, in 0..1
of a unit that is the box diagonal. An object with fewer than 30 pixels of depth, or with a depth of
over 32 m, which is a faulty rendering, is left out. To know that, making the index opens the masks
and depth images; afterwards it is kept.

The meshes of real_train are metric. Those of CAMERA25 have the unit of the NOCS map, and their z is
mirrored against it (``preprocess/shape_data.py`` of mentian/object-deformnet, cd43bb8, 2020).
"""

from __future__ import annotations

import functools
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.datasets._index import Scan
from pytest_cpas.datasets._nocs_meta import Listed
from pytest_cpas.datasets._tree import find_marked
from pytest_cpas.datasets.nocs import REAL_CAMERA, NocsTree, symmetry_of
from pytest_cpas.reading.images import read_depth, read_ids, read_rgb
from pytest_cpas.reading.meshes import read_mesh
from pytest_cpas.similarity import NoSimilarityError, Similarity, robust_umeyama
from pytest_cpas.types import (
    Camera,
    ContractError,
    DataError,
    Derived,
    GroundTruth,
    Mesh,
    Pose,
    SampleRef,
    raised_as,
)
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET

CAMERA_CAMERA = Camera(640, 480, 577.5, 577.5, 319.5, 239.5)

_LEAST_PIXELS = 30
_LARGEST_DEPTH = 32.0  # metres

#: Correspondences that a pose is fitted to; more only cost time.
_FITTED = 2048


_FITTED_POSE = Derived(
    part="pose",
    made_of=frozenset({"NOCS map", "mask", "depth"}),
    how="fitted to the NOCS map and the measured depth",
)

_SCALED_BOX = Derived(
    part="extents",
    made_of=frozenset({"mesh"}),
    how="the side lengths of the mesh's box, in the scale that is fitted with the pose",
)


class FittedTree(NocsTree):
    """A split without published poses; see the module's docstring."""

    #: A pose is fitted to images.
    quick_truth = False

    all_derived = (*NocsTree.all_derived, _FITTED_POSE)

    #: Where a frame's depth is.
    depth = "{frames}/{frame}_depth.png"

    def __init__(self, name: str, data_dir: Path | None, camera: Camera) -> None:
        """Find the tree in ``data_dir``, or ``name`` or ``real275`` in it, and index it."""
        root, frames = find_marked(name, data_dir, self.layouts, "real275")
        super().__init__(name, root, camera, frames)
        self._read_coord = functools.lru_cache(maxsize=2)(read_rgb)
        self._last_fit = functools.lru_cache(maxsize=1)(self._fit_to_map)

    def _files(self, frame: str) -> dict[str, str]:
        stem = f"{self.frames}/{frame}"
        files = {
            f"{kind} ({self.frames}/SCENE/NNNN_{kind})": f"{stem}_{kind}"
            for kind in ("color.png", "mask.png", "coord.png", "meta.txt")
        }
        depth = self.depth.format(frames=self.frames, frame="SCENE/NNNN")
        return {**files, f"depth ({depth})": self._depth_path(frame)}

    def _depth_path(self, frame: str) -> str:
        return self.depth.format(frames=self.frames, frame=frame)

    def _scan_truth(self, scan: Scan, frame: str) -> None:
        published = self.layouts[0]
        for kind in ("mask", "coord"):
            end = f"{frame}_{kind}.png"
            scan.weigh(f"{self.frames}/{end}", f"{published}/{end}")
        depth = self.depth.format(frames=published, frame=frame)
        scan.weigh(self._depth_path(frame), depth)

    def _posed(self, scan: Scan, frame: str, listed: list[Listed]) -> list[Listed]:
        """All of them: poses are fitted."""
        return listed

    def _seen(
        self, scan: Scan, listed: list[tuple[str, list[Listed]]]
    ) -> list[tuple[str, list[Listed]]]:
        """Leave out what cannot be fitted: the meta files list what is hidden, too."""
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            depths = list(pool.map(lambda entry: self._depths(*entry), listed))
        seen = []
        for (frame, objects), found in zip(listed, depths, strict=True):
            if isinstance(found, ContractError):
                scan.damaged.append(str(found))
                continue
            fitted = []
            for item, (count, farthest) in zip(objects, found, strict=True):
                if count < _LEAST_PIXELS:
                    kind = f"objects with fewer than {_LEAST_PIXELS} pixels of depth"
                elif farthest > _LARGEST_DEPTH:
                    kind = f"objects with a depth of over {_LARGEST_DEPTH:g} m"
                else:
                    fitted.append(item)
                    continue
                scan.lacks(kind, f"{frame}/{item.mask_id}")
            seen.append((frame, fitted))
        return seen

    def _depths(self, frame: str, objects: list[Listed]) -> list[tuple[int, float]] | ContractError:
        """Of each object how many pixels have a depth, and the largest, metres."""
        try:
            ids = read_ids(self.root / f"{self.frames}/{frame}_mask.png", self.camera)
            depth = read_depth(self.root / self._depth_path(frame), self.camera)
        except ContractError as error:
            return error
        found = [depth[ids == item.mask_id] for item in objects]
        return [(int(np.count_nonzero(v)), float(v.max(initial=0))) for v in found]

    @raised_as(DataError)
    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about a sample, fitted to its NOCS map."""
        item = Listed(*self._details[ref.id])
        fitted = self._fit(ref, item)
        mesh, extents = self._mesh(item.model)
        pose = Pose(fitted.rotation, fitted.translation)
        return GroundTruth(
            pose=pose, extents=extents, symmetry=symmetry_of(ref.category), surface=mesh
        )

    @raised_as(DataError)
    def fit_error(self, ref: SampleRef) -> float | None:
        """The median distance of the measured points from where the map has them, metres."""
        return self._last_fit(ref, Listed(*self._details[ref.id]))[1]

    def _fit(self, ref: SampleRef, item: Listed) -> Similarity:
        return self._last_fit(ref, item)[0]

    def _fit_to_map(self, ref: SampleRef, item: Listed) -> tuple[Similarity, float]:
        """From the NOCS map, in ShapeNet axes and centred, to the camera; and how well it fits."""
        frame = ref.id.rsplit("/", 1)[0]
        path = self.root / f"{self.frames}/{frame}_coord.png"
        depth = self._depth(frame)
        mask = (self._ids(frame) == item.mask_id) & (depth > 0)
        nocs = self._read_coord(path, self.camera)[mask].astype(float)
        nocs[:, 2] = 1 - nocs[:, 2]
        points = self.camera.back_project(depth, mask)
        step = -(-len(points) // _FITTED)
        try:
            mapped, points = ((nocs - 0.5) @ NOCS_FROM_SHAPENET)[::step], points[::step]
            fitted = robust_umeyama(mapped, points, np.random.default_rng(0))
        except NoSimilarityError as error:
            raise DataError(f"{path}, object {item.mask_id}: {error}") from None
        return fitted, float(np.median(fitted.residuals(mapped, points)))

    def _depth(self, frame: str) -> NDArray[np.float32]:
        return self._read_depth(self.root / self._depth_path(frame), self.camera)


class RealTrain(FittedTree):
    """The seven training scenes of REAL."""

    models = "real_train"
    layouts = ("real_train", "Real/train")
    meshes = ("obj_models/real_train/{model}.obj",)

    def __init__(self, data_dir: Path | None) -> None:
        """Find the tree in ``data_dir``, or ``real_train`` or ``real275`` in it."""
        super().__init__("real_train", data_dir, REAL_CAMERA)


class Camera25(FittedTree):
    """CAMERA25: the validation split of CAMERA, 25000 images when complete."""

    models = "val"
    layouts = ("val", "CAMERA/val")
    meta = "mask_id class_id synset model"
    box = _SCALED_BOX
    meshes = ("obj_models/val/{model}/model.obj",)
    depth = "camera_full_depths/val/{frame}_composed.png"
    has_extents = False

    def __init__(self, data_dir: Path | None) -> None:
        """Find the tree in ``data_dir``, or ``camera25`` or ``real275`` in it."""
        super().__init__("camera25", data_dir, CAMERA_CAMERA)
        self._unit_mesh = functools.cache(self._read_unit_mesh)

    @raised_as(DataError)
    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about a sample; extents and mesh have the fitted scale."""
        item = Listed(*self._details[ref.id])
        fitted = self._fit(ref, item)
        mesh = self._unit_mesh(item.model)
        low, high = fitted.scale * mesh.bounds
        centre = (low + high) / 2
        metric = Mesh(fitted.scale * mesh.vertices - centre, mesh.triangles)
        pose = Pose(fitted.rotation, fitted.translation + fitted.rotation @ centre)
        return GroundTruth(
            pose=pose, extents=high - low, symmetry=symmetry_of(ref.category), surface=metric
        )

    def _read_unit_mesh(self, model: str) -> Mesh:
        path = self.root / self.meshes[0].format(model=model)
        return read_mesh(path, NOCS_FROM_SHAPENET.T @ np.diag([1.0, 1.0, -1.0]))
