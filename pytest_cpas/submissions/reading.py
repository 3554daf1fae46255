"""Which form a file of predictions has."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_cpas.reading.paths import matching
from pytest_cpas.submissions import bop_csv, by_image, jsonl_reading, matrices, nocs, pickled
from pytest_cpas.submissions.frames import Image, Objects, Submission
from pytest_cpas.types import CATEGORIES, Array, DataError, Dataset, some_of
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET

__all__ = ["read_submission"]

#: What files are called in forms that are no JSON lines.
_FORMS = {".pkl", ".npz", ".csv", ".txt"}


def read_submission(path: Path, dataset: Dataset | None = None) -> Submission:
    """Read a file of predictions, or a folder of them, in any form that is known.

    ``dataset``: the one that they are about, whose classes and object axes they have; without it
    those of NOCS. Raises :class:`DataError` naming the file that is damaged or in no form that is
    known.
    """
    # which says itself what its classes and axes are
    is_folder = os.path.isdir(path) and any(matching(path, "*.jsonl"))
    if is_folder and (others := [file for file in _files(path) if file.suffix in _FORMS]):
        raise DataError(
            f"{path}: it holds .jsonl files and {some_of(_names(path, others))}; name one of them,"
            " or a folder of one kind"
        )
    if is_folder or path.suffix == ".jsonl":
        return _by_place(jsonl_reading.read(path), dataset)
    read = _read(path, dataset)
    if dataset is None:
        return read
    if read.object_frame == "nocs" and dataset.published_axes is not NOCS_FROM_SHAPENET:
        images = [_in_our_axes(image, dataset.published_axes) for image in read.images]
        return replace(read, object_frame="shapenet", images=images)
    return read


def _by_place(submission: Submission, dataset: Dataset | None) -> Submission:
    """A submission without the names of its samples, if the data set has others for them all, or
    for their images: those of a tree with images are not those of its truth alone."""
    images = submission.images
    named = [sample for image in images for sample in image.answers.samples or () if sample]
    if dataset is None or not named or not dataset.samples:
        return submission
    known = {ref.id: dataset.image_of(ref) for ref in dataset.samples}
    same = not known.keys().isdisjoint(named)
    if same and not {image.name for image in images}.isdisjoint(known.values()):
        return submission
    unnamed = [replace(image, answers=replace(image.answers, samples=None)) for image in images]
    here = f"{named[0]} of {images[0].name}"
    there = " of ".join(next(iter(known.items())))
    note = (
        f"samples are called {here} here, and {there} in {dataset.name}: what an answer is about is"
        " told by its image, class and 2-D box"
    )
    return replace(submission, images=unnamed, notes=[*submission.notes, note])


def _read(path: Path, dataset: Dataset | None) -> Submission:
    """What is in the file, in the object axes that it has."""
    classes = CATEGORIES if dataset is None else dataset.class_names
    if os.path.isdir(path):  # which takes names that are too long
        files = list(_files(path))
        if any(matching(path, by_image.TRUTH)) and len(found := matching(path, "*_pred.pkl")) == 1:
            return pickled.read(found[0], dataset)
        if pickles := [file for file in files if file.suffix == ".pkl"]:
            return pickled.read_folder(path, pickles, classes)
        if texts := [file for file in files if file.suffix == ".txt"]:
            return matrices.read(path, texts, dataset)
        raise DataError(
            f"{path}: no .pkl, .jsonl or .txt files in this folder, which {_holds(path, files)}"
        )
    if path.suffix == ".csv":
        return bop_csv.read(path, dataset)
    if path.suffix == ".npz":
        return nocs.read(path, classes)
    if path.suffix == ".pkl":
        return pickled.read(path, dataset)
    if not os.path.exists(path):
        raise DataError(f"{path}: no such file or folder")
    raise DataError(f"{path}: expected a .pkl, an .npz, a .csv, a .jsonl, or a folder of files")


def _in_our_axes(image: Image, axes: Array | None) -> Image:
    """An image whose objects have the axes of a data set's published poses, in ours."""
    if axes is None:
        return image
    turn = np.eye(4)
    turn[:3, :3] = axes

    def turned(objects: Objects) -> dict[str, Any]:
        extents = objects.extents
        return {
            "poses": objects.poses @ turn,
            "extents": None if extents is None else extents @ np.abs(axes),
        }

    truths = image.truths
    return replace(
        image,
        answers=replace(image.answers, **turned(image.answers)),
        truths=None if truths is None else replace(truths, **turned(truths)),
    )


def _files(path: Path) -> Iterator[Path]:
    """The files in a folder and in folders of it, through no link to a folder."""
    for folder, _, names in os.walk(path):
        yield from (Path(folder, name) for name in names if not name.startswith("."))


def _holds(path: Path, files: Sequence[Path]) -> str:
    if not files:
        return "is empty"
    return f"holds {some_of(_names(path, files))}"


def _names(path: Path, files: Iterable[Path]) -> list[str]:
    """Files below a folder, as a message calls them."""
    return sorted(file.relative_to(path).as_posix() for file in files)
