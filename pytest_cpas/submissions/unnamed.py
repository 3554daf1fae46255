"""Images that have no names: taken in the order of the data set, as far as the truth bears it out.

Orders that are tried are the data set's and the alphabetical one (0, 1, 10, 100, 2, ...), in which
folders are often listed. An image fits one of the data set's if each object of the data set stands
where the file's own truth has one of its class, within :data:`NEAR`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from pytest_cpas.submissions.frames import Image, Submission
from pytest_cpas.types import Array, DataError, Dataset, SampleRef

__all__ = ["places_of_unnamed"]

#: Truth of one object in a file and in a data set, metres. Neighbouring images are further apart,
#: where the camera moves.
NEAR = 0.001

_Known = Sequence[tuple[str, Array]]


def places_of_unnamed(
    submission: Submission, dataset: Dataset, wanted: Mapping[str, Sequence[SampleRef]]
) -> tuple[dict[str, int], list[str]]:
    """The number in the submission of each of the images of ``wanted``, and what to say of it.

    Raises :class:`DataError` where that cannot be told.
    """
    stored = submission.images
    head = f"{submission.path}: its {len(stored)} images have no names"
    names = list(wanted)
    if not any(image.truths is not None for image in stored):
        if len(stored) != len(names):
            raise DataError(
                f"{head}, and {dataset.name} has {len(names)} of them, so that which is which"
                " cannot be told; store the path of each as image_path"
            )
        note = f"images have no names: taken in the order of {dataset.name}, which nothing confirms"
        return {name: number for number, name in enumerate(names)}, [note]
    known = {name: _known(dataset, refs) for name, refs in wanted.items()}
    orders = {
        f"in the order of {dataset.name}": names,
        "in alphabetical order (0, 1, 10, 100, 2)": sorted(names, key=_unpadded),
    }
    seen = []
    for words, order in orders.items():
        numbers, misfit = _followed(submission, order, known)
        if misfit is None:
            note = f"images have no names: taken {words}, as the truth in the file bears out"
            lacking = len(names) - len(numbers)
            rest = f"{lacking} of {len(names)} images of {dataset.name} are not in the file, and"
            return numbers, [note, *([f"{rest} count as not correct"] if lacking else [])]
        seen.append(f"{words} the first {misfit}")
    raise DataError(
        f"{head}, and of these the truth in the file fits {', '.join(seen)}, so that which is which"
        " cannot be told; store the path of each as image_path"
    )


def _unpadded(name: str) -> str:
    return re.sub(r"\d+", lambda match: match[0].lstrip("0") or "0", name)


def _known(dataset: Dataset, refs: Sequence[SampleRef]) -> _Known:
    return [(ref.category, dataset.truth(ref).pose.translation) for ref in refs]


def _followed(
    submission: Submission, order: Sequence[str], known: Mapping[str, _Known]
) -> tuple[dict[str, int], int | None]:
    """The images of ``order`` that the submission's go along, skipping what those skip; and the
    first that goes along with none. An image without objects in it is no image of ours."""
    numbers: dict[str, int] = {}
    at = 0
    for number, image in enumerate(submission.images):
        if image.truths is None or not len(image.truths):
            continue
        while at < len(order) and not _fits(submission, image, known[order[at]]):
            at += 1
        if at == len(order):
            return numbers, number
        numbers[order[at]] = number
        at += 1
    return numbers, None


def _fits(submission: Submission, image: Image, known: _Known) -> bool:
    truths = image.truths
    if truths is None or len(truths) < len(known):
        return False
    names = np.array([submission.category(i) for i in truths.class_ids.tolist()])
    for category, position in known:
        near = np.abs(truths.poses[:, :3, 3] - position).max(axis=1) <= NEAR
        if not (near & (names == category)).any():
            return False
    return True
