"""REAL275 (NOCS, Wang et al. 2019) in the layout in which it is published.

::

    real_test/scene_S/NNNN_color.png      8-bit colour
    real_test/scene_S/NNNN_depth.png      16-bit depth in millimetres, 0 = missing
    real_test/scene_S/NNNN_mask.png       8-bit instance id per pixel, 255 = background
    real_test/scene_S/NNNN_meta.txt       lines "mask_id class_id model"; class 0 = distractor
    gts/real_test/results_real_test_scene_S_NNNN.pkl      gt_RTs: (n, 4, 4), rotation times scale
    obj_models/real_test/MODEL.{obj,txt}  mesh in metres and its extents; bottoms are missing
    fixed_real_test_obj_models/MODEL.obj  closed meshes, released with the paper's toolbox

``gt_RTs`` belong to the objects in ascending mask id, distractors left out. Its object axes, and
those of the meshes, are NOCS's; both are turned into the ShapeNet frame here. A tree may be
partial: what is there is listed, what is missing is named once.
"""

from __future__ import annotations

import functools
import hashlib
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_cpas._safe_pickle import load_numpy_pickle
from pytest_cpas.datasets._files import names, natural
from pytest_cpas.datasets._images import read_depth, read_ids, read_rgb
from pytest_cpas.datasets._meshes import read_mesh
from pytest_cpas.frames import NOCS_FROM_SHAPENET, permute_extents
from pytest_cpas.types import (
    CATEGORIES,
    Array,
    Camera,
    ContractError,
    GroundTruth,
    Mesh,
    Observation,
    Pose,
    Sample,
    SampleRef,
    Symmetry,
)

REAL_CAMERA = Camera(640, 480, 591.0125, 590.16775, 322.525, 244.11084)

#: Categories that the paper takes as symmetric about their up axis.
SYMMETRIC_CATEGORIES = frozenset({"bottle", "bowl", "can"})

_DOWNLOAD = """\
REAL275 is published for non-commercial use, citation required ("Normalized Object Coordinate \
Space", Wang et al. 2019). Fetch and unpack into one folder:
  http://download.cs.stanford.edu/orion/nocs/real_test.zip    -> real_test/      (about 3.5 GB)
  http://download.cs.stanford.edu/orion/nocs/gts.zip          -> gts/real_test/  (about 10 MB)
  http://download.cs.stanford.edu/orion/nocs/obj_models.zip   -> obj_models/     (about 2 GB)
  https://github.com/roym899/pose_and_shape_evaluation/releases/download/v1.0.0/\
fixed_real_test_obj_models.zip -> fixed_real_test_obj_models/  (about 20 MB)
and pass that folder, or its parent if it is called real275, with --cpas-data DIR or CPAS_DATA."""


@functools.cache
def symmetry_of(category: str) -> Symmetry:
    """The symmetry that the paper grants a category: bottle, bowl and can about y, else none."""
    return Symmetry.about([0, 1, 0]) if category in SYMMETRIC_CATEGORIES else Symmetry.none()


@dataclass(frozen=True)
class _Object:
    """A line of a frame's meta file, and which of the frame's poses is its."""

    mask_id: int
    model: str
    pose_index: int


class NocsTree:
    """The test split below ``root`` as a data set; see the module's docstring for the layout."""

    def __init__(self, name: str, root: Path, camera: Camera) -> None:
        """Index the tree. No image is opened."""
        self.name = name
        self.root = root
        self.camera = camera
        self.missing: list[str] = []
        self.damaged: list[str] = []
        self._objects: dict[str, _Object] = {}
        self._poses = functools.lru_cache(maxsize=64)(self._read_poses)
        self._images = functools.lru_cache(maxsize=2)(self._read_images)
        self._mesh = functools.cache(self._read_mesh)
        self.samples: Sequence[SampleRef] = self._index()

    # -- index ------------------------------------------------------------------------------

    def _index(self) -> list[SampleRef]:
        digest = hashlib.sha256()
        samples: list[SampleRef] = []
        absent: dict[str, list[str]] = defaultdict(list)
        folder = self.root / "real_test"
        truths = names(self.root / "gts" / "real_test")
        for scene in sorted(names(folder), key=natural):
            files = names(folder / scene)
            frames = sorted({name.split("_")[0] for name in files if "_" in name})
            for number in frames:
                frame = f"{scene}/{number}"
                wanted = {
                    f"{kind} (real_test/scene_S/NNNN_{kind})": f"{number}_{kind}" in files
                    for kind in ("color.png", "depth.png", "mask.png", "meta.txt")
                }
                truth = self._truth_path(frame)
                wanted["ground truth (gts/real_test/*.pkl)"] = truth.name in truths
                lacks = [kind for kind, there in wanted.items() if not there]
                for kind in lacks:
                    absent[kind].append(frame)
                if lacks:
                    continue
                meta = (folder / scene / f"{number}_meta.txt").read_bytes()
                digest.update(meta)
                digest.update(truth.read_bytes())
                try:
                    samples.extend(self._read_meta(frame, meta.decode("utf-8", "replace")))
                except ContractError as error:
                    self.damaged.append(str(error))
        for kind, where in sorted(absent.items()):
            self.missing.append(f"{len(where)} frames without {kind}, first {where[0]}: left out")
        samples = self._leave_out_unsized(samples)
        for model in sorted({self._objects[s.id].model for s in samples}):
            path = self._mesh_path(model)
            digest.update(model.encode() + (path.read_bytes() if path else b""))
        self.digest = digest.hexdigest()
        return samples

    def _read_meta(self, frame: str, text: str) -> list[SampleRef]:
        entries = []
        for line in text.splitlines():
            match = re.fullmatch(r"\s*(\d+)\s+(\d+)\s+(\S+)\s*", line)
            if not match or int(match[2]) > len(CATEGORIES) or int(match[1]) > 254:
                raise ContractError(
                    f"{frame}_meta.txt: line {line!r}, expected 'mask_id class_id model' with a"
                    f" mask id of 0 to 254 and a class id of 0 to {len(CATEGORIES)}"
                )
            if int(match[2]) > 0:
                entries.append((int(match[1]), CATEGORIES[int(match[2]) - 1], match[3]))
        if len({mask_id for mask_id, _, _ in entries}) < len(entries):
            raise ContractError(f"{frame}_meta.txt: a mask id occurs twice")
        samples = []
        for index, (mask_id, category, model) in enumerate(sorted(entries)):
            ref = SampleRef(f"{frame}/{mask_id}", category, frame.split("/")[0], model)
            self._objects[ref.id] = _Object(mask_id, model, index)
            samples.append(ref)
        return samples

    def _leave_out_unsized(self, samples: list[SampleRef]) -> list[SampleRef]:
        """Name models without mesh once; without an extents file too, their samples go."""
        affected: dict[str, int] = defaultdict(int)
        for sample in samples:
            affected[self._objects[sample.id].model] += 1
        original, unsized = [], set()
        for model, count in sorted(affected.items()):
            path = self._mesh_path(model)
            if path is None and self._extents_path(model).is_file():
                self.missing.append(f"mesh {model}.obj: shape metrics of {count} samples are n/a")
            elif path is None:
                self.missing.append(f"mesh {model}.obj and .txt: {count} samples left out")
                unsized.add(model)
            elif path.parent.name == "real_test":
                original.append(model)
        if original:
            self.missing.append(
                f"fixed_real_test_obj_models/ of {', '.join(original)}: using the original meshes,"
                " whose bottoms are missing, so F-scores differ from the published ones"
            )
        return [s for s in samples if self._objects[s.id].model not in unsized]

    def _truth_path(self, frame: str) -> Path:
        name = f"results_real_test_{frame.replace('/', '_')}.pkl"
        return self.root / "gts" / "real_test" / name

    def _extents_path(self, model: str) -> Path:
        return self.root / "obj_models" / "real_test" / f"{model}.txt"

    def _mesh_path(self, model: str) -> Path | None:
        for folder in ("fixed_real_test_obj_models", "obj_models/real_test"):
            path = self.root / folder / f"{model}.obj"
            if path.is_file():
                return path
        return None

    # -- samples ----------------------------------------------------------------------------

    def load(self, ref: SampleRef) -> Sample:
        """Read one sample; :class:`ContractError` names the file that is damaged."""
        item = self._objects[ref.id]
        frame = ref.id.rsplit("/", 1)[0]
        matrices = self._poses(frame)
        if item.pose_index >= len(matrices):
            raise ContractError(
                f"{self._truth_path(frame)}: {len(matrices)} poses, but the meta file lists"
                " more objects"
            )
        scaled = matrices[item.pose_index]
        determinant = float(np.linalg.det(scaled[:3, :3]))
        if not determinant > 0:
            raise ContractError(
                f"{self._truth_path(frame)}: pose {item.pose_index} has determinant"
                f" {determinant:g}, expected the cube of a positive scale"
            )
        rotation = scaled[:3, :3] / np.cbrt(determinant)
        pose = Pose(rotation @ NOCS_FROM_SHAPENET, scaled[:3, 3])
        rgb, depth, ids = self._images(frame)
        observation = Observation(ref.category, rgb, depth, ids == item.mask_id, self.camera)
        mesh, extents = self._mesh(item.model)
        truth = GroundTruth(pose, extents, symmetry_of(ref.category), mesh)
        return Sample(ref, observation, truth)

    def _read_poses(self, frame: str) -> Array:
        path = self._truth_path(frame)
        poses = load_numpy_pickle(path).get("gt_RTs")
        if (
            not isinstance(poses, np.ndarray)
            or poses.shape[1:] != (4, 4)
            or poses.dtype.kind != "f"
            or not np.isfinite(poses).all()
        ):
            raise ContractError(f"{path}: gt_RTs is not an array (n, 4, 4) of finite numbers")
        return poses.astype(np.float64)

    def _read_images(
        self, frame: str
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
        stem = self.root / "real_test" / frame
        return (
            read_rgb(stem.with_name(f"{stem.name}_color.png"), self.camera),
            read_depth(stem.with_name(f"{stem.name}_depth.png"), self.camera),
            read_ids(stem.with_name(f"{stem.name}_mask.png"), self.camera),
        )

    def _read_mesh(self, model: str) -> tuple[Mesh | None, Array]:
        path = self._mesh_path(model)
        if path is None:
            try:
                extents = np.array(self._extents_path(model).read_text().split(), dtype=float)
                return None, permute_extents(extents, NOCS_FROM_SHAPENET.T)
            except ValueError as error:
                raise ContractError(
                    f"{self._extents_path(model)}: expected three extents in metres ({error})"
                ) from error
        mesh = read_mesh(path, NOCS_FROM_SHAPENET.T)
        low, high = mesh.bounds
        return mesh, high - low


class Real275(NocsTree):
    """REAL275: the six test scenes, 2754 frames and 16118 objects when complete."""

    def __init__(self, data_dir: Path | None) -> None:
        """Find the tree in ``data_dir`` or ``data_dir/real275``; FileNotFoundError says how."""
        if data_dir is None:
            raise FileNotFoundError(f"real275 needs a folder (--cpas-data).\n{_DOWNLOAD}")
        for root in (data_dir, data_dir / "real275"):
            if (root / "real_test").is_dir():
                super().__init__("real275", root, REAL_CAMERA)
                return
        raise FileNotFoundError(f"no real_test folder in {data_dir}.\n{_DOWNLOAD}")
