"""The frames of stored predictions: what is read, checked, and which detection is whose.

Arrays have the field's keys; boxes are y1, x1, y2, x2 in pixels, poses 4 x 4.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.reading.arrays import Wanted, read_npz
from pytest_cpas.reading.files import regular
from pytest_cpas.reading.pickles import load_numpy_pickle
from pytest_cpas.types import CATEGORIES, DataError

__all__ = ["REQUIRED", "Frame", "assign_detections", "detection_order", "read_frames"]

#: A detection belongs to a ground truth if their 2-D boxes overlap at least this much.
DETECTION_IOU = 0.5

#: The arrays that a frame must have, and the shape of a row of each.
REQUIRED: dict[str, tuple[int, ...]] = {
    "gt_class_ids": (),
    "gt_bboxes": (4,),
    "gt_RTs": (4, 4),
    "gt_scales": (3,),
    "pred_class_ids": (),
    "pred_bboxes": (4,),
    "pred_RTs": (4, 4),
    "pred_scales": (3,),
}

#: Those that it may have: how sure a detection is, and whether a mug's handle can be seen.
_OPTIONAL: dict[str, tuple[int, ...]] = {"pred_scores": (), "gt_handle_visibility": ()}

_SHAPES = REQUIRED | _OPTIONAL

#: What the arrays of an ``.npz`` are; rows are checked frame by frame.
_ARRAYS = {
    "frame": Wanted("U", (None,)),
    "gt_offset": Wanted("iu", (None,)),
    "pred_offset": Wanted("iu", (None,)),
    **{key: Wanted("iuf") for key in REQUIRED},
    **{key: Wanted("biuf", optional=True) for key in _OPTIONAL},
}

#: Frames of a file, objects or detections in one, and pairs in all frames of an object and a
#: detection of its class, each of which is measured. REAL275 has 2754, 10 and 20193.
MOST_FRAMES = 100_000
MOST_IN_FRAME = 300
MOST_PAIRS = 1_000_000

#: Coordinates of a 2-D box, pixels, are no larger.
_LARGEST_PIXEL = 1e9

Frame = Mapping[str, NDArray[Any]]


def read_frames(path: Path) -> Iterator[tuple[str, Frame]]:
    """Yield (name, arrays) per frame, e.g. ``scene_1_0000``.

    Raises :class:`DataError` naming the file that is damaged, that is neither form, or that holds
    more than is read.
    """
    pairs = 0
    for name, frame in _all_frames(path):
        counts = (
            np.bincount(frame[f"{side}_class_ids"].astype(np.int64), minlength=len(CATEGORIES) + 1)
            for side in ("gt", "pred")
        )
        pairs += int(np.dot(*counts))
        if pairs > MOST_PAIRS:
            raise DataError(
                f"{path}: up to frame {name} there are {pairs} pairs of an object and a detection"
                f" of its class, at most {MOST_PAIRS} are read; split it by scenes"
            )
        yield name, frame


def _all_frames(path: Path) -> Iterator[tuple[str, Frame]]:
    if os.path.isdir(path):  # which takes names that are too long
        files = sorted(path.glob("*.pkl"))
        if not files:
            raise DataError(f"{path}: no .pkl files in this folder")
        for file in files:
            yield from _all_frames(file)
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
    if len(names) > MOST_FRAMES:
        raise DataError(f"{path}: {len(names)} frames, at most {MOST_FRAMES} are read; split it")
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
    present = [key for key in _SHAPES if key in arrays]
    for key in present:
        count = offsets[key.split("_")[0]][-1]
        if len(arrays[key]) != count:
            raise DataError(f"{path}: {key} has {len(arrays[key])} rows, expected {count}")
    for index, name in enumerate(names):
        rows = {side: slice(*offset[index : index + 2]) for side, offset in offsets.items()}
        frame = {key: arrays[key][rows[key.split("_")[0]]] for key in present}
        yield name, _checked(frame, f"{path}, frame {name}")


def _checked(frame: Mapping[str, Any], where: str) -> Frame:
    checked: dict[str, NDArray[Any]] = {}
    for key, shape in _SHAPES.items():
        side = key.split("_")[0]
        array = frame.get(key)
        if array is None and key in _OPTIONAL:
            continue
        kinds = "biuf" if key in _OPTIONAL else "iuf"
        if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds:
            raise DataError(f"{where}: {key} is missing or not an array of numbers")
        if array.ndim and len(array) == 0:
            array = array.reshape(0, *shape)  # an empty list is stored as shape (0,)
        count = len(checked.get(f"{side}_class_ids", array)) if array.ndim else 0
        if array.shape != (count, *shape):
            raise DataError(f"{where}: {key} has shape {array.shape}, expected {(count, *shape)}")
        if count > MOST_IN_FRAME:
            raise DataError(
                f"{where}: {key} has {count} rows, at most {MOST_IN_FRAME} of a frame are read;"
                " leave out the detections with the lowest scores"
            )
        if array.dtype.kind == "f" and array.dtype.itemsize not in (4, 8):
            with np.errstate(over="ignore"):  # what is too large is infinite, and found below
                array = array.astype(np.float64)
        if key.endswith("class_ids"):
            array = _class_ids(array, f"{where}: {key}")
        elif key.endswith("bboxes"):
            _check_boxes(array.astype(float), f"{where}: {key}")
        elif key in _OPTIONAL and not np.isfinite(array.astype(float)).all():
            raise DataError(f"{where}: {key} holds NaN or infinite numbers")
        checked[key] = array
    return checked


def _check_boxes(boxes: NDArray[np.float64], where: str) -> None:
    if not (np.abs(boxes) <= _LARGEST_PIXEL).all():
        raise DataError(f"{where} holds NaN or numbers above {_LARGEST_PIXEL:g}, expected pixels")
    inverted = np.flatnonzero((boxes[:, 2:] < boxes[:, :2]).any(axis=1))
    if len(inverted):
        raise DataError(
            f"{where}: row {inverted[0]} is {boxes[inverted[0]].tolist()}, expected y1, x1, y2, x2"
            " with y1 <= y2 and x1 <= x2"
        )


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


def detection_order(frame: Frame) -> NDArray[np.int64]:
    """The rows of a frame's detections, (n,), in an order that is none of the file: the surest
    first, those that are equally sure by their other numbers."""
    count = len(frame["pred_class_ids"])
    keys = ("pred_scores", "pred_class_ids", "pred_bboxes", "pred_RTs", "pred_scales")
    columns = [
        frame[key].reshape(count, math.prod(_SHAPES[key])).astype(float)
        for key in keys
        if key in frame
    ]
    if "pred_scores" in frame:
        columns[0] = -columns[0]
    return np.lexsort(np.concatenate(columns, axis=1).T[::-1])


def assign_detections(frame: Frame) -> NDArray[np.int64]:
    """Which detection each ground truth gets, (n,), -1 for none.

    Per class, one to one, by descending 2-D box IoU (boxes are y1, x1, y2, x2 in pixels), at
    least ``DETECTION_IOU``; ties go to the first ground truth, and in the order of
    :func:`detection_order`.
    """
    order = detection_order(frame)
    assigned = np.full(len(frame["gt_class_ids"]), -1)
    if not len(assigned) or not len(frame["pred_class_ids"]):
        return assigned
    truth = frame["gt_bboxes"][:, None].astype(float)
    found = frame["pred_bboxes"][order][None].astype(float)
    overlap = np.minimum(truth[..., 2:], found[..., 2:]) - np.maximum(
        truth[..., :2], found[..., :2]
    )
    common = overlap.clip(min=0).prod(axis=-1)
    areas = [(boxes[..., 2:] - boxes[..., :2]).prod(axis=-1) for boxes in (truth, found)]
    union = areas[0] + areas[1] - common
    iou = np.divide(common, union, out=np.zeros_like(common), where=union > 0)
    iou[frame["gt_class_ids"][:, None] != frame["pred_class_ids"][order][None]] = 0
    taken = np.zeros(iou.shape[1], dtype=bool)
    near = np.flatnonzero(iou >= DETECTION_IOU)
    for flat in near[np.argsort(-iou.ravel()[near], kind="stable")].tolist():
        row, column = divmod(flat, iou.shape[1])
        if assigned[row] < 0 and not taken[column]:
            assigned[row] = order[column]
            taken[column] = True
    return assigned
