"""REAL275 (NOCS, Wang et al. 2019) in the layout in which it is published.

::

    real_test/scene_S/NNNN_color.png      8-bit colour
    real_test/scene_S/NNNN_depth.png      16-bit depth in millimetres, 0 = missing
    real_test/scene_S/NNNN_mask.png       8-bit instance id per pixel, 255 = background
    real_test/scene_S/NNNN_meta.txt       lines "mask_id class_id model"; class 0 = distractor
    gts/real_test/results_real_test_scene_S_NNNN.pkl      gt_RTs: (n, 4, 4), rotation times scale
    obj_models/real_test/MODEL.{obj,txt}  mesh in metres and its extents; bottoms are missing
    fixed_real_test_obj_models/MODEL.obj  closed meshes, released with the paper's toolbox

``Real/test`` may stand for ``real_test``, as in SPD (mentian/object-deformnet) and its followers.

``gt_RTs`` belong to the objects of whose id the mask has pixels, ascending, distractors left out:
in seven frames (scene_1/0198 to 0204) the meta file lists one that is hidden, and has no pose. So
there are 16118 objects, and 16125 lines of meta files. A frame of which it cannot be told whose the
poses are is refused: they are more or fewer than the objects, have the class or scale of others, or
are elsewhere than the pixels (docs/datasets.md). Object axes, and those of the meshes, are NOCS's;
both are turned into the ShapeNet frame here. A tree may be partial: what is there is listed, what
is missing is named once. Of a frame without images only the truth is known, by which stored
predictions are judged. Where it has no meta file either, its ground truth must have
``gt_class_ids`` and ``gt_scales`` (n, 3), relative to the scale; it may have ``gt_bboxes`` (n, 4),
y1, x1, y2, x2 in pixels.
"""

from __future__ import annotations

import functools
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.datasets._derived import BOX_OF_MESH, BY_CATEGORY, PROJECTED
from pytest_cpas.datasets._index import Scan
from pytest_cpas.datasets._nocs_meta import Listed, extents_path, read_meta, truth_path
from pytest_cpas.datasets._nocs_poses import (
    class_ids_in,
    contradiction,
    other_classes,
    poses_in,
    read_poses,
)
from pytest_cpas.datasets._tree import Tree, find_root
from pytest_cpas.reading.files import decoded, read_text
from pytest_cpas.reading.images import read_ids
from pytest_cpas.reading.meshes import read_mesh
from pytest_cpas.reading.numbers import numbers
from pytest_cpas.reading.paths import natural
from pytest_cpas.reading.pickles import load_numpy_pickle
from pytest_cpas.types import (
    Array,
    Camera,
    ContractError,
    DataError,
    Derived,
    GroundTruth,
    Mesh,
    Observation,
    Pose,
    Sample,
    SampleRef,
    Symmetry,
    raised_as,
)
from pytest_cpas.types._arrays import LARGEST_PIXEL, finite_array
from pytest_cpas.types.datasets import mask_box
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET, permute_extents

REAL_CAMERA = Camera(640, 480, 591.0125, 590.16775, 322.525, 244.11084)

#: Categories that the paper takes as symmetric about their up axis.
SYMMETRIC_CATEGORIES = frozenset({"bottle", "bowl", "can"})

_FRAME_FILE = re.compile(r"(\d+)_(?:color|depth|mask|coord|meta)\.")
_IMAGES = ("color", "depth", "mask", "coord")

_TRUTH_FILE = re.compile(r"results_real_test_(scene_\d+)_(\d+)\.pkl")


@functools.cache
def symmetry_of(category: str) -> Symmetry:
    """The symmetry that the paper grants a category: bottle, bowl and can about y, else none."""
    return Symmetry.about([0, 1, 0]) if category in SYMMETRIC_CATEGORIES else Symmetry.none()


class NocsTree(Tree):
    """The test split below ``root`` as a data set; see the module's docstring for the layout."""

    camera: Camera
    published_axes = NOCS_FROM_SHAPENET
    all_derived: Sequence[Derived] = (BY_CATEGORY,)

    #: What extents are where there is a mesh.
    box = BOX_OF_MESH

    #: The folder of its models, where its frames may be (as published, and as SPD and those who
    #: followed it have them), the lines of a meta file, and where a model's mesh may be.
    models = "real_test"
    layouts: tuple[str, ...] = ("real_test", "Real/test")
    meta = "mask_id class_id model"
    meshes: tuple[str, ...] = (
        "fixed_real_test_obj_models/{model}.obj",
        "obj_models/real_test/{model}.obj",
    )
    #: Whether a file beside a mesh has its extents.
    has_extents = True

    def __init__(self, name: str, root: Path, camera: Camera, frames: str = "") -> None:
        """Index the tree; ``frames``: which of :attr:`layouts` it has, the first by default."""
        # making the index needs them
        self.camera, self.frames, self.root = camera, frames or self.layouts[0], root
        self._mesh = functools.cache(self._read_mesh)
        super().__init__(name, root)
        self._poses = functools.lru_cache(maxsize=64)(read_poses)

    # -- index ------------------------------------------------------------------------------

    def scan(self, scan: Scan) -> None:
        """List the objects of every frame of which all files are there."""
        listed: list[tuple[str, list[Listed]]] = []
        absent = []
        for frame in self._frames(scan):
            lacks = [kind for kind, path in self._files(frame).items() if not scan.has(path)]
            if self._is_only_truth(scan, frame):
                absent.append(frame)
            elif lacks:
                for kind in lacks:
                    scan.lacks(f"frames without {kind}", frame)
                continue
            listed += self._scan_frame(scan, frame)
        if absent:
            scan.missing.append(
                f"images of {len(absent)} frames, first {absent[0]}: only their truth is there, by"
                " which stored predictions are judged, and no method"
            )
        listed = self._seen(scan, listed)
        models = Counter(o.model for _, os in listed for o in os if o.model)
        left_out = self._scan_models(scan, models)
        without_images = set(absent)
        with_mesh = {m for m in models if any(scan.has(f.format(model=m)) for f in self.meshes)}
        for frame, objects in listed:
            for item in objects:
                if item.model not in left_out:
                    place = item.mask_id if item.model else f"gt{item.pose_index}"
                    ref_id, scene = f"{frame}/{place}", frame.split("/")[0]
                    category, model = item.category, item.model
                    ref = SampleRef(id=ref_id, category=category, scene=scene, model=model)
                    scan.add(ref, item)
                    if model in with_mesh:
                        scan.derives(self.box, ref_id)
                    if frame in without_images:
                        scan.absent.append(ref_id)
                        scan.derives(PROJECTED, ref_id)

    def _frames(self, scan: Scan) -> list[str]:
        """The frames of which there is a file, in order."""
        frames = []
        for scene in sorted(scan.names(self.frames), key=natural):
            matches = map(_FRAME_FILE.match, scan.names(f"{self.frames}/{scene}"))
            frames += [f"{scene}/{number}" for number in sorted({m[1] for m in matches if m})]
        return frames

    def _is_only_truth(self, scan: Scan, frame: str) -> bool:
        """Whether the truth about a frame is there, and no image of it: here never."""
        return False

    def _files(self, frame: str) -> dict[str, str]:
        """What makes a frame: paths by kind, described for people."""
        stem = f"{self.frames}/{frame}"
        files = {
            f"{kind} ({self.frames}/scene_S/NNNN_{kind})": f"{stem}_{kind}"
            for kind in ("color.png", "depth.png", "mask.png", "meta.txt")
        }
        return {**files, "ground truth (gts/real_test/*.pkl)": truth_path(frame)}

    def _scan_frame(self, scan: Scan, frame: str) -> list[tuple[str, list[Listed]]]:
        try:
            meta = f"{self.frames}/{frame}_meta.txt"
            if not scan.has(meta):
                return [(frame, self._read_classes(scan, frame))]
            text = decoded(Path(meta), scan.read(meta), "replace")
            self._scan_truth(scan, frame)
            listed = read_meta(frame, text, self.meta, self.class_names)
            return [(frame, self._posed(scan, frame, listed))]
        except ContractError as error:
            scan.damaged.append(str(error))
            return []

    def _read_classes(self, scan: Scan, frame: str) -> list[Listed]:
        """The objects of a frame without a meta file, from its ground truth."""
        path = self.root / truth_path(frame)
        self._scan_truth(scan, frame)
        ids = class_ids_in(load_numpy_pickle(path), path, len(self.class_names))
        if ids is None:
            raise DataError(
                f"{path}: no gt_class_ids, and there is no {self.frames}/{frame}_meta.txt that says"
                " which objects are there"
            )
        categories = [self.class_names[i - 1] for i in ids]
        return [Listed(-1, name, "", i, len(ids)) for i, name in enumerate(categories)]

    def _scan_truth(self, scan: Scan, frame: str) -> None:
        """Add to the digest what the truth comes from."""
        scan.read(truth_path(frame))

    def _posed(self, scan: Scan, frame: str, listed: list[Listed]) -> list[Listed]:
        """Those of the listed objects that have a pose, and which it is.

        Raises :class:`DataError` where that cannot be told.
        """
        path = self.root / truth_path(frame)
        try:
            truth = load_numpy_pickle(path)
            poses = poses_in(truth, path)[0]
        except ContractError:
            return listed  # which every sample of the frame will say
        mask = f"{self.frames}/{frame}_mask.png"
        count = len(poses)
        seen = f"{path}: {count} poses, but the meta file lists {len(listed)} objects"
        if not scan.has(mask):
            if count == len(listed):
                return self._sound(frame, listed, listed, truth, poses, None)
            raise DataError(f"{seen}, and there is no mask that says which are seen")
        scan.see(mask)
        try:
            image = read_ids(self.root / mask, self.camera)
        except ContractError:
            return listed  # which every sample of the frame will say
        ids = np.flatnonzero(np.bincount(image.ravel())).tolist()
        posed = [item for item in listed if item.mask_id in ids]
        if count != len(posed):
            raise DataError(
                f"{seen}, of which {len(posed)} have pixels in the mask (its ids are"
                f" {', '.join(map(str, ids))}); which pose is whose cannot be told"
            )
        posed = [item._replace(pose_index=n, poses=count) for n, item in enumerate(posed)]
        return self._sound(frame, listed, posed, truth, poses, image)

    def _sound(
        self,
        frame: str,
        listed: list[Listed],
        posed: list[Listed],
        truth: Mapping[str, Any],
        poses: Array,
        ids: NDArray[np.uint8] | None,
    ) -> list[Listed]:
        """The objects that have a pose, with a doubt of all if one's cannot be its."""
        extents = {}
        for item in listed:
            with suppress(ContractError):  # which every sample of the model will say
                extents[item.model] = self._mesh(item.model)[1]
        meta = f"{self.frames}/{frame}_meta.txt"
        known = class_ids_in(truth, self.root / truth_path(frame), len(self.class_names))
        why = other_classes(known, posed, self.class_names, meta)
        why = why or contradiction(self.camera, poses, posed, extents, ids)
        return [item._replace(doubt=why) for item in posed] if why else posed

    def _seen(
        self, scan: Scan, listed: list[tuple[str, list[Listed]]]
    ) -> list[tuple[str, list[Listed]]]:
        """Those of the listed objects that are seen in their frame: here all of them."""
        return listed

    def _scan_models(self, scan: Scan, counts: Mapping[str, int]) -> set[str]:
        """Name models without mesh once; those without extents file too are to be left out."""
        original, left_out = [], set()
        for model, count in sorted(counts.items()):
            found = [p for p in (form.format(model=model) for form in self.meshes) if scan.has(p)]
            if found:
                scan.note(model)
                scan.hash(found[0])
            elif self.has_extents and scan.has(extents_path(self.models, model)):
                scan.hash(extents_path(self.models, model))
                scan.missing.append(f"mesh {model}.obj: shape metrics of {count} samples are n/a")
            else:
                lost = self.meshes[-1].format(model=model)
                extents = f" and {model}.txt" * self.has_extents
                scan.missing.append(f"mesh {lost}{extents}: {count} samples left out")
                left_out.add(model)
            if found and found[0] != self.meshes[0].format(model=model):
                original.append(model)
        if original:
            scan.missing.append(
                f"fixed_real_test_obj_models/ of {', '.join(original)}: using the original meshes,"
                " whose bottoms are missing, so F-scores differ from the published ones"
            )
        return left_out

    # -- samples ----------------------------------------------------------------------------

    @raised_as(DataError)
    def load(self, ref: SampleRef) -> Sample:
        """Read one sample; :class:`DataError` names the file that is damaged."""
        truth, frame = self.truth(ref), self.image_of(ref)
        mask = self._ids(frame) == Listed(*self._details[ref.id]).mask_id
        rgb = self._read_rgb(self.root / f"{self.frames}/{frame}_color.png", self.camera)
        observation = Observation(
            category=ref.category, rgb=rgb, depth=self._depth(frame), mask=mask, camera=self.camera
        )
        return Sample(ref, observation, truth)

    @raised_as(DataError)
    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about a sample, without its images."""
        item = Listed(*self._details[ref.id])
        frame = ref.id.rsplit("/", 1)[0]
        path = self.root / truth_path(frame)
        if item.doubt:
            raise DataError(
                f"{path}: {item.doubt}. Which pose is whose cannot be told: no object of"
                f" {frame} is read"
            )
        matrices, sizes = self._poses(path)
        if item.poses != len(matrices):
            raise DataError(
                f"{path}: {len(matrices)} poses, but the meta file lists {item.poses} objects;"
                " which is whose cannot be told"
            )
        scaled = matrices[item.pose_index]
        determinant = float(np.linalg.det(scaled[:3, :3]))
        if not determinant > 0:
            raise DataError(
                f"{path}: pose {item.pose_index} has determinant {determinant:g}, expected the"
                " cube of a positive scale"
            )
        rotation = scaled[:3, :3] / np.cbrt(determinant)
        mesh, extents = None, None if sizes is None else sizes[item.pose_index]
        if item.model:
            mesh, extents = self._mesh(item.model)
        if extents is None:
            raise DataError(f"{path}: no gt_scales, and no meta file that names the model")
        try:
            pose = Pose(rotation @ NOCS_FROM_SHAPENET, scaled[:3, 3])
            return GroundTruth(
                pose=pose, extents=extents, symmetry=self._symmetry(ref), surface=mesh
            )
        except ContractError as error:
            raise DataError(
                f"{path}, pose {item.pose_index}, and model {item.model}: {error}"
            ) from None

    def _symmetry(self, ref: SampleRef) -> Symmetry:
        return symmetry_of(ref.category)

    def _ids(self, frame: str) -> NDArray[np.uint8]:
        return self._read_ids(self.root / f"{self.frames}/{frame}_mask.png", self.camera)

    def _depth(self, frame: str) -> NDArray[np.float32]:
        return self._read_depth(self.root / f"{self.frames}/{frame}_depth.png", self.camera)

    def box_of(self, ref: SampleRef) -> Array | None:
        """The 2-D box of what is seen of an object: that of its mask, or of the ground truth."""
        item, frame = Listed(*self._details[ref.id]), self.image_of(ref)
        if ref.id not in self.absent:
            mask = self._ids(frame) == item.mask_id
            return mask_box(mask) if mask.any() else None
        path = self.root / truth_path(frame)
        boxes = load_numpy_pickle(path).get("gt_bboxes")
        if boxes is None:
            return None
        boxes = finite_array(boxes, f"{path}: gt_bboxes", LARGEST_PIXEL)
        if boxes.shape != (item.poses, 4):
            raise DataError(f"{path}: gt_bboxes has shape {boxes.shape}, expected (n, 4)")
        box: Array = boxes[item.pose_index]
        return box

    def _read_mesh(self, model: str) -> tuple[Mesh | None, Array]:
        """A model's mesh, if there is one, and its extents, metres."""
        for form in self.meshes:
            path = self.root / form.format(model=model)
            if os.path.lexists(path):  # also of a link to nothing, which reading will name
                mesh = read_mesh(path, NOCS_FROM_SHAPENET.T)
                low, high = mesh.bounds
                return mesh, high - low
        path = self.root / extents_path(self.models, model)
        extents = numbers(read_text(path).split(), (3,), f"{path}: extents in metres")
        return None, permute_extents(extents, NOCS_FROM_SHAPENET.T)


class Real275(NocsTree):
    """REAL275: the six test scenes, 2754 frames and 16118 objects when complete."""

    def __init__(self, data_dir: Path | None) -> None:
        """Find the tree in ``data_dir`` or ``data_dir/real275``; FileNotFoundError says how."""
        root = find_root("real275", data_dir, "gts/real_test")
        there = [frames for frames in self.layouts if (root / frames).exists()]
        super().__init__("real275", root, REAL_CAMERA, there[0] if there else "")

    def _frames(self, scan: Scan) -> list[str]:
        """Those of which there is an image or the truth."""
        truths = map(_TRUTH_FILE.fullmatch, scan.names("gts/real_test"))
        known = {f"{match[1]}/{match[2]}" for match in truths if match}
        return sorted({*super()._frames(scan), *known}, key=natural)

    def _is_only_truth(self, scan: Scan, frame: str) -> bool:
        """Whose the poses are is said by the meta file or by the ground truth itself."""
        truth = truth_path(frame)
        stem = f"{self.frames}/{frame}"
        if not scan.has(truth) or any(scan.has(f"{stem}_{kind}.png") for kind in _IMAGES):
            return False
        if scan.has(f"{stem}_meta.txt"):
            return True
        scan.see(truth)
        try:
            if "gt_class_ids" in load_numpy_pickle(self.root / truth):
                return True
        except ContractError:
            return True  # which listing it will tell
        scan.lacks("frames without meta.txt or gt_class_ids, which say what is there", frame)
        return False
