"""Stored predictions as input: what somebody else's run of a method gave.

Three forms are read, all with the field's keys (``gt_class_ids``, ``gt_bboxes``, ``gt_RTs``,
``gt_scales``, ``pred_class_ids``, ``pred_bboxes``, ``pred_scores``, ``pred_RTs``, ``pred_scales``;
poses are 4 x 4, rotation times scale, in NOCS object axes):

* a pickle ``results_*_scene_S_NNNN.pkl`` of one frame, or a folder of them;
* an ``.npz`` with the rows of all frames one after the other, ``frame`` (their names) and
  ``gt_offset`` / ``pred_offset`` (where each frame's rows begin).

The detections of a frame are assigned to its ground truth per class, one to one, by descending
2-D box IoU, at least 0.5. A ground truth without a detection counts as not correct.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.datasets.nocs import symmetry_of
from pytest_cpas.evaluation.measuring import measure
from pytest_cpas.evaluation.rows import Row
from pytest_cpas.evaluation.runs import Run, SampleError, Selection
from pytest_cpas.reading.arrays import Wanted, read_npz
from pytest_cpas.reading.files import regular
from pytest_cpas.reading.pickles import load_numpy_pickle
from pytest_cpas.types import (
    CATEGORIES,
    AnswerError,
    Array,
    ContractError,
    DataError,
    GroundTruth,
    Hypothesis,
    MethodInfo,
    Pose,
    Prediction,
    SampleRef,
)
from pytest_cpas.types._arrays import frozen_array
from pytest_cpas.types.datasets import STORED
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET, permute_extents

#: A detection belongs to a ground truth if their 2-D boxes overlap at least this much.
DETECTION_IOU = 0.5

_SHAPES: dict[str, tuple[int, ...]] = {
    "gt_class_ids": (),
    "gt_bboxes": (4,),
    "gt_RTs": (4, 4),
    "gt_scales": (3,),
    "pred_class_ids": (),
    "pred_bboxes": (4,),
    "pred_RTs": (4, 4),
    "pred_scales": (3,),
}

#: What the arrays of an ``.npz`` are; rows are checked frame by frame.
_ARRAYS = {
    "frame": Wanted("U", (None,)),
    "gt_offset": Wanted("iu", (None,)),
    "pred_offset": Wanted("iu", (None,)),
    **{key: Wanted("iuf") for key in _SHAPES},
}

#: Coordinates of a 2-D box, pixels, are no larger.
_LARGEST_PIXEL = 1e9

Frame = Mapping[str, NDArray[Any]]


def read_frames(path: Path) -> Iterator[tuple[str, Frame]]:
    """Yield (name, arrays) per frame, e.g. ``scene_1_0000``.

    Raises :class:`DataError` naming the file that is damaged, or that is neither form.
    """
    if os.path.isdir(path):  # which takes names that are too long
        files = sorted(path.glob("*.pkl"))
        if not files:
            raise DataError(f"{path}: no .pkl files in this folder")
        for file in files:
            yield from read_frames(file)
    elif path.suffix == ".npz":
        yield from _read_npz(path)
    elif path.suffix == ".pkl":
        match = re.search(r"(scene_\d+_\d+)$|_([^_]+_[^_]+)$", path.stem)
        name = match.group(0).lstrip("_") if match else path.stem
        yield name, _checked(load_numpy_pickle(regular(path)), f"{path}")
    else:
        raise DataError(f"{path}: expected a .pkl, a folder of them, or an .npz")


def _read_npz(path: Path) -> Iterator[tuple[str, Frame]]:
    arrays = read_npz(path, _ARRAYS)
    names: list[str] = arrays["frame"].tolist()
    offsets = {}
    for side in ("gt", "pred"):
        counts, offset = arrays[f"{side}_class_ids"], arrays[f"{side}_offset"].tolist()
        count = len(counts) if counts.ndim else 0
        if len(offset) != len(names) + 1 or (offset[0], offset[-1]) != (0, count):
            seen = f"{len(offset)} entries" + (f" up to {offset[-1]}" if offset else "")
            raise DataError(
                f"{path}: {side}_offset has {seen}, expected {len(names) + 1} from 0 to {count}"
            )
        for index, (low, high) in enumerate(pairwise(offset)):
            if low > high:
                raise DataError(
                    f"{path}: {side}_offset goes down from {low} to {high} at frame"
                    f" {names[index]!r}, so that rows would be counted twice"
                )
        offsets[side] = offset
    for key in _SHAPES:
        count = offsets[key.split("_")[0]][-1]
        if len(arrays[key]) != count:
            raise DataError(f"{path}: {key} has {len(arrays[key])} rows, expected {count}")
    for index, name in enumerate(names):
        rows = {side: slice(*offset[index : index + 2]) for side, offset in offsets.items()}
        frame = {key: arrays[key][rows[key.split("_")[0]]] for key in _SHAPES}
        yield name, _checked(frame, f"{path}, frame {name}")


def _checked(frame: Mapping[str, Any], where: str) -> Frame:
    checked: dict[str, NDArray[Any]] = {}
    for key, shape in _SHAPES.items():
        side = key.split("_")[0]
        array = frame.get(key)
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf":
            raise DataError(f"{where}: {key} is missing or not an array of numbers")
        if array.ndim and len(array) == 0:
            array = array.reshape(0, *shape)  # an empty list is stored as shape (0,)
        count = len(checked.get(f"{side}_class_ids", array)) if array.ndim else 0
        if array.shape != (count, *shape):
            raise DataError(f"{where}: {key} has shape {array.shape}, expected {(count, *shape)}")
        if array.dtype.kind == "f" and array.dtype.itemsize not in (4, 8):
            with np.errstate(over="ignore"):  # what is too large is infinite, and found below
                array = array.astype(np.float64)
        if key.endswith("class_ids"):
            array = _class_ids(array, f"{where}: {key}")
        elif key.endswith("bboxes") and not (np.abs(array.astype(float)) <= _LARGEST_PIXEL).all():
            raise DataError(
                f"{where}: {key} holds NaN or numbers above {_LARGEST_PIXEL:g}, expected pixels"
            )
        checked[key] = array
    return checked


def _class_ids(ids: NDArray[Any], where: str) -> NDArray[Any]:
    """Class ids as integers, also where they are stored as real numbers."""
    if len(ids) and not (ids.min() >= 1 and ids.max() <= len(CATEGORIES)):
        raise DataError(
            f"{where}: class ids run from {ids.min()} to {ids.max()}, expected 1 to"
            f" {len(CATEGORIES)} ({', '.join(CATEGORIES)})"
        )
    if ids.dtype.kind != "f":
        return ids
    if (ids != np.floor(ids)).any():
        raise DataError(f"{where}: class ids such as {ids[ids != np.floor(ids)][0]}, not integers")
    return ids.astype(np.int64)


def assign_detections(frame: Frame) -> NDArray[np.int64]:
    """Which detection each ground truth gets, (n,), -1 for none.

    Per class, one to one, by descending 2-D box IoU (boxes are y1, x1, y2, x2 in pixels), at
    least ``DETECTION_IOU``; ties go to the first.
    """
    assigned = np.full(len(frame["gt_class_ids"]), -1)
    if not len(assigned) or not len(frame["pred_class_ids"]):
        return assigned
    truth = frame["gt_bboxes"][:, None].astype(float)
    found = frame["pred_bboxes"][None].astype(float)
    overlap = np.minimum(truth[..., 2:], found[..., 2:]) - np.maximum(
        truth[..., :2], found[..., :2]
    )
    common = overlap.clip(min=0).prod(axis=-1)
    areas = [(boxes[..., 2:] - boxes[..., :2]).prod(axis=-1) for boxes in (truth, found)]
    union = areas[0] + areas[1] - common
    iou = np.divide(common, union, out=np.zeros_like(common), where=union > 0)
    iou[frame["gt_class_ids"][:, None] != frame["pred_class_ids"][None]] = 0
    for flat in np.argsort(-iou, axis=None, kind="stable"):
        row, column = divmod(int(flat), iou.shape[1])
        if iou[row, column] < DETECTION_IOU:
            break
        if assigned[row] < 0 and column not in assigned:
            assigned[row] = column
    return assigned


def _posed_box(scaled: NDArray[Any], relative: NDArray[Any]) -> tuple[Pose, Array]:
    """Pose and extents (3,), metres, of a (4, 4) similarity and a box relative to its scale."""
    scaled = frozen_array(scaled, (4, 4), "the pose")
    determinant = float(np.linalg.det(scaled[:3, :3]))
    if not determinant > 0:
        raise DataError(
            f"the pose has determinant {determinant:g}, expected the cube of a positive scale"
        )
    scale = np.cbrt(determinant)
    extents = frozen_array(relative, (3,), "the scales") * scale
    return Pose(scaled[:3, :3] / scale, scaled[:3, 3]), extents


class StoredRun(Run):
    """Stored predictions, judged like the run of a method."""

    def __init__(self, path: Path, *, selection: Selection | None = None) -> None:
        """Read the file or folder; nothing is judged yet."""
        self._frames: dict[str, Frame] = {}
        self._places: dict[str, tuple[str, int]] = {}
        digest = hashlib.sha256()
        samples = []
        for name, frame in read_frames(path):
            scene, _, number = name.rpartition("_")
            if name in self._frames:
                raise DataError(f"{path}: frame {name} occurs twice")
            self._frames[name] = frame
            for key in _SHAPES:
                if key.startswith("gt"):
                    digest.update(np.ascontiguousarray(frame[key]).tobytes())
            for index, class_id in enumerate(frame["gt_class_ids"].tolist()):
                ref_id = f"{scene}/{number}/gt{index}" if scene else f"{number}/gt{index}"
                try:
                    category = CATEGORIES[class_id - 1]
                    ref = SampleRef(id=ref_id, category=category, scene=scene or number)
                except ContractError as error:
                    raise DataError(f"{path}, frame {name!r}: {error}") from None
                if ref_id in self._places:
                    other = self._places[ref_id][0]
                    raise DataError(f"{path}: frames {other} and {name} give one id, {ref_id}")
                self._places[ref_id] = name, index
                samples.append(ref)
        super().__init__(
            re.sub(r"[^A-Za-z0-9._-]", "-", path.stem if path.is_file() else path.name),
            STORED,
            samples,
            selection=selection,
            identity={"data": digest.hexdigest()},
        )
        self.info: MethodInfo = MethodInfo(
            name=self.method,
            categories=CATEGORIES,
            needs=frozenset(),
            gives=frozenset({"extents"}),
            licence="unknown",
            object_frame="nocs",
        )

    def judge(self, ref: SampleRef) -> Row:
        """The row of one ground truth; raises :class:`SampleError` for a broken pose."""
        row = self._rows[ref.id]
        if isinstance(row, ContractError):
            raise SampleError(f"{self.method}, sample {ref.id} ({ref.category}): {row}")
        return row

    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about one sample."""
        return self._pair(ref)[0]

    @functools.cached_property
    def _rows(self) -> dict[str, Row | ContractError]:
        """All at once: measuring in bulk is what makes large files quick."""
        rows: dict[str, Row | ContractError] = {}
        pairs: dict[SampleRef, tuple[GroundTruth, Prediction]] = {}
        for ref in self.samples:
            try:
                pairs[ref] = self._pair(ref)
            except ContractError as error:
                rows[ref.id] = error
        truths = [truth for truth, _ in pairs.values()]
        predictions = [prediction for _, prediction in pairs.values()]
        for row in measure(list(pairs), truths, predictions, self.info):
            rows[row.sample] = row
        return rows

    def _pair(self, ref: SampleRef) -> tuple[GroundTruth, Prediction]:
        name, index = self._places[ref.id]
        frame = self._frames[name]
        try:
            pose, extents = _posed_box(frame["gt_RTs"][index], frame["gt_scales"][index])
            truth = GroundTruth(
                pose=Pose(pose.rotation @ NOCS_FROM_SHAPENET, pose.translation),
                extents=permute_extents(extents, NOCS_FROM_SHAPENET.T),
                symmetry=symmetry_of(ref.category),
            )
        except ContractError as error:
            raise DataError(f"ground truth: {error}") from None
        detection = int(self._assigned(name)[index])
        if detection < 0:
            return truth, Prediction.failed("not detected")
        try:
            pose, extents = _posed_box(
                frame["pred_RTs"][detection], frame["pred_scales"][detection]
            )
            return truth, Prediction(
                (Hypothesis(rotation=pose.rotation, translation=pose.translation, extents=extents),)
            )
        except ContractError as error:
            raise AnswerError(f"prediction {detection} of {name}: {error}") from None

    @functools.cache  # noqa: B019 - lives as long as the run
    def _assigned(self, name: str) -> NDArray[np.int64]:
        return assign_detections(self._frames[name])
