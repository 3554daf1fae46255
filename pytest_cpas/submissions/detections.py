"""What a detector found, in the place of the masks of the ground truth.

A folder of pickles, one per image, ``results_*_scene_S_NNNN.pkl``, as NOCS's code and what descends
from it exchange the results of Mask R-CNN: ``rois`` (n, 4), y1, x1, y2, x2 in pixels; ``class_ids``
(n,); ``scores`` (n,); ``masks`` (H, W, n) of truth values. Which object of an image is whose is
told by class and 2-D box, as for stored predictions: the surest one counts.
"""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.reading.files import regular
from pytest_cpas.reading.paths import matching
from pytest_cpas.reading.pickles import load_numpy_pickle
from pytest_cpas.submissions.answers import counted_otherwise, names
from pytest_cpas.submissions.frames import Answers, Image, Submission
from pytest_cpas.submissions.nocs import check_boxes, check_class_ids
from pytest_cpas.submissions.pairing import DETECTION_IOU, Pairing, box_ious
from pytest_cpas.types import Array, DataError, Dataset, Observation, Sample, SampleRef
from pytest_cpas.types.datasets import WrappedDataset, mask_box
from pytest_cpas.types.names import checked_name
from pytest_cpas.types.samples import evenly

__all__ = ["DetectedDataset", "Found", "without_detections"]

#: The arrays of an image, and their dimensions.
_ARRAYS = {"rois": 2, "class_ids": 1, "scores": 1, "masks": 3}

#: Images whose classes are looked at, evenly spaced; and what is told: so many detections or
#: objects, or such a share of the boxes.
_IMAGES, _LEAST, _SHARE = 200, 5, 0.1

#: Images of a folder, and detections in one.
_MOST_IMAGES, _MOST_IN_IMAGE = 100_000, 300

#: What a data set is called that is seen through a detector, beyond its name.
_SEEN = "+detections"


def without_detections(name: str) -> str:
    """What a data set is called when it is not seen through a detector."""
    return name.removesuffix(_SEEN)


class Found(NamedTuple):
    """A detection: what it is called among all, its image and category, how sure the detector is,
    its 2-D box (4,): y1, x1, y2, x2; the number of the image's file, and the row in it."""

    name: str
    image: str
    category: str
    score: float
    box: Array
    number: int
    row: int


class DetectedDataset(WrappedDataset):
    """A data set whose objects are seen through the masks of a detector."""

    def __init__(self, dataset: Dataset, folder: Path) -> None:
        """Read the boxes of all images; :class:`DataError` naming the file that is damaged."""
        super().__init__(dataset)
        self._files = _files(folder)
        self._detections, masks = _submission(folder, self._files, dataset.class_names)
        self._pairing = Pairing(self._detections, dataset)
        self._read = functools.lru_cache(maxsize=2)(_read)
        digest = hashlib.sha256(f"{dataset.digest} {masks}".encode())
        for image in self._detections.images:
            for values in (image.answers.class_ids, image.answers.boxes, image.answers.scores):
                digest.update(np.ascontiguousarray(values).tobytes())
        self.digest = digest.hexdigest()
        self.name = checked_name("data set", f"{dataset.name}{_SEEN}")
        self.missing = [*dataset.missing, *self._pairing.notes]
        # whose mask a method does not see
        told = "its box tells which detection is of an object, and a method sees the detector's"
        self.derived = [
            replace(each, how=f"{each.how}; {told}") if each.part == "mask" else each
            for each in dataset.derived
        ]

    @functools.cached_property
    def notes(self) -> Sequence[str]:
        """What is noticed about the detections beside what the data set says; nothing about sound
        ones."""
        notes = [*self._dataset.notes]
        numbers = evenly(sorted(self._pairing.images), _IMAGES)
        where = "" if len(numbers) == len(self._pairing.images) else f" of {len(numbers)} images"
        read = (self._read(self._files[number], self.class_names) for number in numbers)
        wrong, swapped, total = sum(map(_contradictions, read), np.zeros(3, np.int64))
        if wrong >= max(_LEAST, _SHARE * total):
            notes.append(
                f"audit: the 2-D boxes of {wrong} of {total} detections{where} are not those of"
                f" their masks, of which {swapped} would be if they were x1, y1, x2, y2; which"
                " object is whose is told by the boxes, and a method sees the masks"
            )

        def matched(step: int) -> int:
            images, classes = self._detections.images, len(self.class_names)
            answers = {n: counted_otherwise(step, classes, images[n].answers) for n in numbers}
            return sum(bool(rows) for n in numbers for rows in self._pairing.rows(n, answers[n]))

        given = matched(0)
        for step, words in ((1, "one more"), (-1, "one less")):
            if (found := matched(step)) >= max(_LEAST, 2 * given):
                notes.append(
                    f"audit: to read class ids as {words} would find {found} instead of {given}"
                    f" objects in {len(numbers)} images; if that is it, number classes from 1:"
                    f" {', '.join(self.class_names)}"
                )
        return notes

    def unseen(self, ref: SampleRef) -> str | None:
        """Why no detection is of a sample; None if one is."""
        number = self._pairing.number(ref)
        if number is None:
            return "whose image is not among the detections"
        rows = self._pairing.found(number).answers[ref.id]
        if not rows:
            return "not detected"
        return None if self._mask(number, rows[0]).any() else "the mask of its detection is empty"

    def ranked_with(self, ref: SampleRef) -> list[Found]:
        """The detections that are ranked with a sample, the one that it is seen by first: all that
        are assigned to it and, with the first sample of an image, those of no object."""
        number = self._pairing.number(ref)
        if number is None:
            return []
        assigned = self._pairing.found(number).answers
        taken = {row for rows in assigned.values() for row in rows}
        wanted = set(assigned[ref.id])
        answers = self._detections.images[number].answers
        scores: Any = answers.scores  # which every detection has, and a box
        boxes: Any = answers.boxes
        if ref == self._pairing.refs(number)[0]:
            wanted |= set(range(len(answers))) - taken
        image = self._pairing.images[number]
        found = [
            Found(
                name=name,
                image=image,
                category=self._detections.category(int(answers.class_ids[row])),
                score=float(scores[row]),
                box=boxes[row],
                number=number,
                row=row,
            )
            for row, name in names(self._detections, image, answers)
            if row in wanted
        ]
        return sorted(found, key=lambda each: each.row != next(iter(assigned[ref.id]), None))

    def observe(self, ref: SampleRef, found: Found) -> Observation | None:
        """What a method sees of a detection in the image of a sample; None of a mask without a
        pixel. Raises :class:`DataError` naming the file that is damaged."""
        mask = self._mask(found.number, found.row)
        if not mask.any():
            return None
        seen = self._dataset.load(ref).observation
        if mask.shape != seen.mask.shape:
            raise DataError(
                f"{self._files[found.number]}: masks of {mask.shape[1]} x {mask.shape[0]}, but the"
                f" image is {seen.mask.shape[1]} x {seen.mask.shape[0]}"
            )
        return Observation(
            category=found.category, rgb=seen.rgb, depth=seen.depth, mask=mask, camera=seen.camera
        )

    def _mask(self, number: int, row: int) -> NDArray[np.bool_]:
        """The mask (H, W) of a detection."""
        masks = self._read(self._files[number], self.class_names)["masks"]
        return np.ascontiguousarray(masks[:, :, row] != 0)

    def load(self, ref: SampleRef) -> Sample:
        """Read one sample; its mask is the detector's. Raises :class:`DataError` without one."""
        reason = self.unseen(ref)
        observation = None if reason else self.observe(ref, self.ranked_with(ref)[0])
        if observation is None:
            raise DataError(f"{ref.id}: {reason}")
        return Sample(ref, observation, self._dataset.truth(ref))


def _submission(
    folder: Path, files: Sequence[Path], classes: Sequence[str]
) -> tuple[Submission, str]:
    """The boxes of all images, as answers without poses, and a digest of the masks."""
    images = []
    digest = hashlib.sha256()
    for file in files:
        found = _read(file, classes)
        digest.update(np.packbits(found["masks"] != 0).tobytes())
        answers = Answers(
            class_ids=found["class_ids"],
            poses=np.full((len(found["class_ids"]), 4, 4), np.nan),
            boxes=found["rois"].astype(np.float64),
            scores=found["scores"].astype(np.float64),
        )
        images.append(Image(name=file.stem, answers=answers))
    submission = Submission(
        path=folder,
        form="detections",
        images=images,
        classes=classes,
        object_frame="nocs",
        gives=frozenset(),
    )
    return submission, digest.hexdigest()


def _contradictions(found: Mapping[str, NDArray[Any]]) -> NDArray[np.int64]:
    """How many 2-D boxes of an image are not those of their masks, how many of those would be with
    x and y exchanged, and how many there are."""
    boxes, masks = found["rois"].astype(np.float64), found["masks"] != 0
    seen = [row for row in range(len(boxes)) if masks[:, :, row].any()]
    if not seen:
        return np.array([0, 0, len(boxes)])
    true = np.array([mask_box(masks[:, :, row]) for row in seen])
    given, swapped = (
        np.diagonal(box_ious(boxes[seen][:, order], true)) >= DETECTION_IOU
        for order in ([0, 1, 2, 3], [1, 0, 3, 2])
    )
    return np.array([(~given).sum(), (~given & swapped).sum(), len(boxes)])


def _files(folder: Path) -> list[Path]:
    if not os.path.isdir(folder):  # which takes names that are too long
        raise DataError(f"{folder}: not a folder, expected one with a detector's pickle per image")
    files = matching(folder, "*.pkl")
    if not 0 < len(files) <= _MOST_IMAGES:
        raise DataError(
            f"{folder}: {len(files)} .pkl files, expected 1 to {_MOST_IMAGES}: the results of a"
            " detector, one per image"
        )
    return files


def _read(file: Path, classes: Sequence[str]) -> dict[str, NDArray[Any]]:
    content = load_numpy_pickle(regular(file))
    count = -1
    for name, dimensions in _ARRAYS.items():
        array = content.get(name)
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
            raise DataError(f"{file}: {name} is missing or not an array of numbers")
        if len(array) == 0 and name != "masks":
            content[name] = array = array.reshape((0,) + (4,) * (dimensions - 1))
        rows = array.shape[-1] if name == "masks" and array.ndim == 3 else len(array)
        count = rows if count < 0 else count
        if array.ndim != dimensions or rows != count or count > _MOST_IN_IMAGE:
            raise DataError(
                f"{file}: {name} has shape {array.shape}, expected rois (n, 4), class_ids (n,),"
                f" scores (n,) and masks (H, W, n) of one n up to {_MOST_IN_IMAGE}"
            )
    if content["rois"].shape[1:] != (4,) or not np.isfinite(content["scores"].astype(float)).all():
        raise DataError(f"{file}: rois are no boxes (n, 4), or scores are not finite")
    check_boxes(content["rois"].astype(float), f"{file}: rois", ordered=False)
    content["class_ids"] = check_class_ids(content["class_ids"], f"{file}: class_ids", classes)
    return content
