"""From what a file has to poses, truths and hypotheses, each checked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from pytest_cpas.submissions.frames import Answers, Image, Objects, Submission
from pytest_cpas.types import AnswerError, Array, ContractError, DataError, Hypothesis, Mesh
from pytest_cpas.types._arrays import frozen_array

__all__ = [
    "box_at",
    "counted_otherwise",
    "failures",
    "hypothesis",
    "in_half_precision",
    "names",
    "order",
    "rigid",
    "score_at",
]

#: Largest entry of ``R @ R.T - I`` of a rotation whose entries were rounded to half precision: of
#: relative errors of 2 ** -11 each, of the sums of three squares and of the scale.
_HALF_TOLERANCE = 4e-3

#: The same of a rotation without a scale, whose entries are as they were computed.
_ROUNDING = 1e-12


_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])


def in_half_precision(images: Iterable[Image]) -> bool:
    """Whether all poses that were answered are numbers of half precision (float16), whatever they
    are stored as. Poses of ones and zeros show nothing."""
    tells = False
    for image in images:
        poses = image.answers.poses
        with np.errstate(all="ignore"):
            halves = poses.astype(np.float16)
        if not np.array_equal(halves, poses, equal_nan=True):
            return False
        tells = tells or bool((poses != np.rint(poses)).any())
    return tells


def order(answers: Answers) -> list[int]:
    """The rows of an image's answers in an order that is none of the file: those of the best rank
    first, then the surest, those that are equally sure by their other numbers."""
    count = len(answers)
    columns = [answers.class_ids, *answers.poses.reshape(count, 16).T]
    for values in (answers.boxes, answers.extents):
        columns += [] if values is None else [*values.T]
    if answers.scores is not None:
        columns.insert(0, -answers.scores)
    if answers.ranks is not None:
        columns.insert(0, answers.ranks)
    rows: list[int] = np.lexsort(columns[::-1]).tolist()
    return rows


def names(submission: Submission, image: str, answers: Answers) -> Iterator[tuple[int, str]]:
    """The rows of an image's answers in :func:`order`, and what each is called: by the image, its
    category and its 2-D box in whole pixels; those that share all of it are numbered. What has no
    score among others that have is no answer."""
    called: Counter[str] = Counter()
    for row in order(answers):
        if answers.scores is not None and np.isnan(answers.scores[row]):
            continue  # no detection, but a line that says that there is none
        own = f"{image}/{submission.category(int(answers.class_ids[row]))}"
        if answers.boxes is not None:
            own += "/" + "_".join(f"{pixel:.0f}" for pixel in answers.boxes[row].tolist())
        called[own] += 1
        yield row, own if called[own] == 1 else f"{own}+{called[own]}"


def box_at(answers: Answers, row: int) -> Array | None:
    """The 2-D box (4,) of an answer, None where it has none."""
    boxes = answers.boxes
    return None if boxes is None or np.isnan(boxes[row]).any() else boxes[row]


def score_at(answers: Answers, row: int) -> float | None:
    """How sure an answer is, None where that is not said."""
    scores = answers.scores
    return None if scores is None or np.isnan(scores[row]) else float(scores[row])


def counted_otherwise(step: int, classes: int, answers: Answers) -> Answers:
    """Answers whose class ids are ``step`` more, where there is such a class."""
    ids = answers.class_ids + step
    fits = (ids >= 1) & (ids <= classes)
    return replace(answers, class_ids=np.where(fits, ids, answers.class_ids))


def failures(answers: Answers) -> list[str | None]:
    """Per answer why it is none, and None where it is one: what the file says, a pose or a box of
    zeros, one that is not finite."""
    count = len(answers)
    poses = answers.poses.reshape(count, 16)
    extents = np.ones((count, 3)) if answers.extents is None else answers.extents
    reasons: list[str | None] = list(answers.reasons or [None] * count)
    with np.errstate(all="ignore"):
        # boxes of a pose without a scale have no size, which is the pose's fault
        scaled = np.linalg.det(answers.poses[:, :3, :3]) != 0
    for words, found in (
        ("the stored pose is not finite", ~np.isfinite(poses).all(axis=1)),
        ("the stored pose is zero", (answers.poses[:, :3, :3] == 0).all(axis=(1, 2))),
        ("the stored box is not finite", scaled & ~np.isfinite(extents).all(axis=1)),
        ("the stored box is zero", scaled & (extents == 0).all(axis=1)),
    ):
        for index in np.flatnonzero(found).tolist():
            reasons[index] = reasons[index] or words
    return reasons


def rigid(objects: Objects, index: int, *, half: bool = False) -> tuple[Array, Array]:
    """Rotation (3, 3) and translation (3,), metres, of an object, without its scale.

    ``half``: it was stored in half precision, so that the nearest rotation is taken from further
    away. Raises :class:`pytest_cpas.types.ContractError` for what is no pose.
    """
    pose = frozen_array(objects.poses[index], (4, 4), "the pose")
    if np.abs(pose[3] - _LAST_ROW).max() > 1e-6:
        raise DataError(
            f"the pose's last row is {pose[3].tolist()}, expected 0, 0, 0, 1; is it transposed?"
        )
    determinant = float(np.linalg.det(pose[:3, :3]))
    if not determinant > 0:
        raise DataError(
            f"the pose has determinant {determinant:g}, expected the cube of a positive scale"
        )
    rotation = pose[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROUNDING:
        rotation = rotation / np.cbrt(determinant)
    if half and np.abs(rotation @ rotation.T - np.eye(3)).max() <= _HALF_TOLERANCE:
        u, _, vt = np.linalg.svd(rotation)
        rotation = u @ vt
    return rotation, pose[:3, 3]


def hypothesis(
    answers: Answers, index: int, where: str, *, half: bool = False, shaped: bool = True
) -> Hypothesis:
    """An answer, in the frames of its submission; without its shape unless ``shaped``.

    Raises :class:`AnswerError` that begins with ``where`` for what is none.
    """
    try:
        shape = answers.shapes[index] if shaped and answers.shapes is not None else None
        rotation, translation = rigid(answers, index, half=half)
        return Hypothesis(
            rotation=rotation,
            translation=translation,
            extents=None if answers.extents is None else answers.extents[index],
            score=score_at(answers, index),
            mesh=shape if isinstance(shape, Mesh) else None,
            points=None if isinstance(shape, Mesh) else shape,
        )
    except ContractError as error:
        raise AnswerError(f"{where}: {error}") from None
