"""One pickle, or a folder of them, each read as what its content is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pytest_cpas.reading.files import regular
from pytest_cpas.reading.paths import natural
from pytest_cpas.reading.pickles import load_pickle
from pytest_cpas.submissions import by_image, cutoop, frame_lists, nocs
from pytest_cpas.submissions.frames import Image, Submission
from pytest_cpas.types import CATEGORIES, DataError, Dataset, some_of

__all__ = ["read", "read_folder"]


def read(path: Path, dataset: Dataset | None) -> Submission:
    """A pickle; :class:`DataError` naming the file whose content is in no form that is known."""
    value = load_pickle(regular(path), cutoop.CLASSES)
    classes = CATEGORIES if dataset is None else dataset.class_names
    if cutoop.is_match(value):
        return cutoop.read(path, value, dataset)
    if by_image.is_by_image(value):
        return by_image.read(path, value, dataset)
    if isinstance(value, list):
        return frame_lists.read(path, value, classes)
    images = _images(path, nocs.image_name(path), value, classes)
    return nocs.submission(path, "NOCS", images, classes)


def read_folder(path: Path, files: Sequence[Path], classes: Sequence[str]) -> Submission:
    """Pickles of an image each, or of a list of them, that lie in a folder or in folders of it.

    Where some are called ``results_*.pkl``, those are read, and others are named.
    """

    def images() -> Iterator[Image]:
        for file in sorted(files, key=lambda file: natural(file.as_posix())):
            name = nocs.image_name(file)
            if file.parent != path and name == file.stem:  # named within its scene
                name = f"{file.parent.name}/{name}"
            yield from _images(file, name, load_pickle(regular(file)), classes)

    if len(files) > nocs.MOST_IMAGES:
        raise DataError(
            f"{path}: {len(files)} pickles, at most {nocs.MOST_IMAGES} are read; split it"
        )
    named = [file for file in files if file.name.startswith("results_")]
    others = [file.relative_to(path).as_posix() for file in files if file not in set(named)]
    files = named or files
    read = nocs.submission(path, "NOCS", images(), classes)
    if not named or not others:
        return read
    return replace(read, notes=[f"read are results_*.pkl; not read: {some_of(sorted(others))}"])


def _images(path: Path, name: str, value: Any, classes: Sequence[str]) -> Iterator[Image]:
    if isinstance(value, list):
        yield from frame_lists.images(path, value, classes)
    elif isinstance(value, dict):
        yield nocs.image_of(name, value, f"{path}", classes)
    else:
        raise DataError(
            f"{path}: holds a {type(value).__name__}, expected a dict of arrays, or a list of them"
        )
