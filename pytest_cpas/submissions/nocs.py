"""The form of NOCS's evaluation code: the truth and the detections of an image under fixed keys.

``gt_class_ids`` (n,), ``gt_bboxes`` (n, 4), ``gt_RTs`` (n, 4, 4), ``gt_scales`` (n, 3) and
``pred_class_ids`` (m,), ``pred_bboxes`` (m, 4), ``pred_RTs`` (m, 4, 4), ``pred_scales`` (m, 3);
``pred_scores`` (m,) and ``gt_handle_visibility`` (n,) need not be there, or are None, nor the truth
as a whole, nor ``gt_bboxes`` beside a data set. Boxes are y1, x1, y2, x2 in pixels; poses are
rotation times scale, metres; sizes are relative to that scale. The object axes are those of the
poses that the data set publishes; without one they are NOCS's. Class ids count the data set's
classes from 1. Read are

* a pickle of one image, such as ``results_test_scene_S_NNNN.pkl`` of REAL275 and
  ``results_val_SSSSS_NNNN.pkl`` of CAMERA25;
* a folder of them, or a folder per scene, whose pickles are called by the image alone
  (HouseCat6D: ``test_scene1/000012.pkl``);
* an ``.npz`` with the rows of all images one after the other, ``frame`` (their names) and
  ``gt_offset`` / ``pred_offset`` (where each image's rows begin).

As ``utils/solver.py`` and ``utils/solver_housecat6d.py`` of Leeiieeo/AG-Pose (2024; 09daeee) write
it, and many before them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.reading.arrays import Wanted, read_npz
from pytest_cpas.submissions.frames import Answers, Image, Submission, Truths, relative_extents
from pytest_cpas.types import DataError
from pytest_cpas.types._arrays import LARGEST_PIXEL

__all__ = ["image_name", "image_of", "read", "submission"]

#: The arrays that an image must have, and the shape of a row of each.
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

_SIDES = ("gt", "pred")

#: What the arrays of an ``.npz`` are; rows are checked image by image.
_ARRAYS = {
    "frame": Wanted("U", (None,)),
    **{f"{side}_offset": Wanted("iu", (None,), optional=side == "gt") for side in _SIDES},
    **{key: Wanted("iuf", optional=key.startswith("gt")) for key in REQUIRED},
    **{key: Wanted("biuf", optional=True) for key in _OPTIONAL},
}

#: Images of a file, objects or detections in one, and pairs in all images of an object and a
#: detection of its class, each of which is measured. REAL275 has 2754, 10 and 20193.
MOST_IMAGES = 100_000
MOST_IN_IMAGE = 300
MOST_PAIRS = 1_000_000


def read(path: Path, classes: Sequence[str]) -> Submission:
    """An ``.npz``.

    Raises :class:`DataError` naming the file that is damaged, or that holds more than is read.
    """
    return submission(path, "NOCS", _read_npz(path, classes), classes)


def submission(
    path: Path, form: str, images: Iterable[Image], classes: Sequence[str]
) -> Submission:
    """What was read of a form that has NOCS's keys; :class:`DataError` for more than is read."""
    pairs = 0
    read = []
    for image in images:
        if image.truths is not None:
            counts = (
                np.bincount(objects.class_ids, minlength=len(classes) + 1)
                for objects in (image.truths, image.answers)
            )
            pairs += int(np.dot(*counts))
        if pairs > MOST_PAIRS:
            raise DataError(
                f"{path}: up to frame {image.name} there are {pairs} pairs of an object and a"
                f" detection of its class, at most {MOST_PAIRS} are read; split it by scenes"
            )
        read.append(image)
    scored = all(image.answers.scores is not None for image in read)
    return Submission(
        path=path,
        form=form,
        images=read,
        classes=classes,
        object_frame="nocs",
        gives=frozenset({"extents", "score"} if scored else {"extents"}),
    )


def image_name(path: Path) -> str:
    """The image that a pickle is about, by the pickle's name."""
    match = re.search(r"(scene_\d+_\d+)$|_([^_]+_[^_]+)$", path.stem)
    return match.group(0).lstrip("_") if match else path.stem


def _read_npz(path: Path, classes: Sequence[str]) -> Iterator[Image]:
    arrays = read_npz(path, _ARRAYS)
    names: list[str] = arrays["frame"].tolist()
    if len(names) > MOST_IMAGES:
        raise DataError(f"{path}: {len(names)} frames, at most {MOST_IMAGES} are read; split it")
    if not all(names):
        raise DataError(f"{path}: a frame has no name")
    offsets = {}
    sides = _sides(arrays, f"{path}")
    for side in sides:
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
    present = [key for key in _SHAPES if key in arrays and key.split("_")[0] in sides]
    for key in present:
        count = offsets[key.split("_")[0]][-1]
        if len(arrays[key]) != count:
            raise DataError(f"{path}: {key} has {len(arrays[key])} rows, expected {count}")
    for index, name in enumerate(names):
        rows = {side: slice(*offset[index : index + 2]) for side, offset in offsets.items()}
        frame = {key: arrays[key][rows[key.split("_")[0]]] for key in present}
        yield image_of(name, frame, f"{path}, frame {name}", classes)


def _sides(values: Mapping[str, Any], where: str) -> Sequence[str]:
    """Whether there is truth beside the detections; :class:`DataError` for a part of it. Its 2-D
    boxes may be those of the data set."""
    keys = {key for key in REQUIRED if key.startswith("gt")}
    if not keys & set(values):
        return _SIDES[1:]
    if lacks := sorted(keys - {"gt_bboxes"} - set(values)):
        raise DataError(f"{where}: lacks {', '.join(lacks)}, which belong to its ground truth")
    return _SIDES


def image_of(
    name: str,
    values: Mapping[str, Any],
    where: str,
    classes: Sequence[str],
    *,
    boxes: bool = True,
) -> Image:
    """An image of a dict that has the keys; :class:`DataError` that begins with ``where``.

    ``boxes``: whether it has 2-D boxes that can be compared.
    """
    skipped = set() if boxes else {"gt_bboxes", "pred_bboxes"}
    if "gt_bboxes" not in values:
        skipped.add("gt_bboxes")
    sides = _sides(values, where)
    keys = [key for key in _SHAPES if key.split("_")[0] in sides and key not in skipped]
    arrays = _checked({key: values.get(key) for key in keys}, where)
    objects: dict[str, Any] = {}
    for side in sides:
        poses, sizes = (arrays[f"{side}_{key}"].astype(np.float64) for key in ("RTs", "scales"))
        seen = arrays.get(f"{side}_bboxes")
        ids = check_class_ids(arrays[f"{side}_class_ids"], f"{where}: {side}_class_ids", classes)
        objects[side] = {
            "class_ids": ids,
            "poses": poses,
            "extents": relative_extents(poses, sizes),
            "boxes": None if seen is None else seen.astype(np.float64),
        }
    scores, handles = arrays.get("pred_scores"), arrays.get("gt_handle_visibility")
    return Image(
        name=name,
        answers=Answers(
            **objects["pred"], scores=None if scores is None else scores.astype(np.float64)
        ),
        truths=Truths(**objects["gt"], visible_handles=None if handles is None else handles != 0)
        if "gt" in sides
        else None,
    )


def _checked(values: Mapping[str, Any], where: str) -> dict[str, NDArray[Any]]:
    checked: dict[str, NDArray[Any]] = {}
    for key, array in values.items():
        side, shape = key.split("_")[0], _SHAPES[key]
        if array is None and key in _OPTIONAL:
            continue
        array = _array(array)
        kinds = "biuf" if key in _OPTIONAL else "iuf"
        if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds:
            raise DataError(f"{where}: {key} is missing or not an array of numbers")
        if array.ndim and len(array) == 0:
            array = array.reshape(0, *shape)  # an empty list is stored as shape (0,)
        count = len(checked.get(f"{side}_class_ids", array)) if array.ndim else 0
        if array.shape != (count, *shape):
            raise DataError(f"{where}: {key} has shape {array.shape}, expected {(count, *shape)}")
        if count > MOST_IN_IMAGE:
            raise DataError(
                f"{where}: {key} has {count} rows, at most {MOST_IN_IMAGE} of a frame are read;"
                " leave out the detections with the lowest scores"
            )
        if array.dtype.kind == "f" and array.dtype.itemsize not in (4, 8):
            with np.errstate(over="ignore"):  # what is too large is infinite, and found below
                array = array.astype(np.float64)
        if key.endswith("bboxes"):
            check_boxes(array.astype(float), f"{where}: {key}", ordered=side == "gt")
        elif key in _OPTIONAL and not np.isfinite(array.astype(float)).all():
            raise DataError(f"{where}: {key} holds NaN or infinite numbers")
        checked[key] = array
    return checked


def _array(values: Any) -> Any:
    """Lists of rows as an array, which is what their writers mean; the rest as it is."""
    if isinstance(values, list | tuple):
        try:
            values = np.array(values) if len(values) else np.zeros(0)
        except ValueError:  # rows of several lengths
            values = np.array([None, *values], dtype=object)[1:]
    if isinstance(values, np.ndarray) and values.dtype == object and values.ndim:
        return _filled(values)
    return values


def _filled(rows: NDArray[Any]) -> Any:
    """Rows of which some are None, which is how some say that an instance failed: of NaN."""
    given = [np.asarray(row) for row in rows.tolist() if row is not None]
    shapes = {row.shape for row in given if row.dtype.kind in "iuf"}
    if len(given) == len(rows) or len(shapes) != 1:
        return None
    [shape] = shapes
    filled = np.full((len(rows), *shape), np.nan)
    filled[[place for place, row in enumerate(rows.tolist()) if row is not None]] = given
    return filled


def check_boxes(boxes: NDArray[np.float64], where: str, *, ordered: bool) -> None:
    """That 2-D boxes (n, 4) are pixels, and ``ordered`` ones y1, x1, y2, x2."""
    if not (np.abs(boxes) <= LARGEST_PIXEL).all():
        raise DataError(f"{where} holds NaN or numbers above {LARGEST_PIXEL:g}, expected pixels")
    inverted = np.flatnonzero((boxes[:, 2:] < boxes[:, :2]).any(axis=1))
    if ordered and len(inverted):
        raise DataError(
            f"{where}: row {inverted[0]} is {boxes[inverted[0]].tolist()}, expected y1, x1, y2, x2"
            " with y1 <= y2 and x1 <= x2"
        )


def check_class_ids(ids: NDArray[Any], where: str, classes: Sequence[str]) -> NDArray[np.int64]:
    """Class ids as integers, also where they are stored as real numbers."""
    if len(ids) and not (ids.min() >= 1 and ids.max() <= len(classes)):
        raise DataError(
            f"{where}: class ids run from {ids.min()} to {ids.max()}, expected 1 to"
            f" {len(classes)} ({', '.join(classes)}); are they counted from another number, or is"
            " the file of a data set with other classes (--cpas-dataset NAME)?"
        )
    if ids.dtype.kind == "f" and (ids != np.floor(ids)).any():
        raise DataError(f"{where}: class ids such as {ids[ids != np.floor(ids)][0]}, not integers")
    return ids.astype(np.int64)
