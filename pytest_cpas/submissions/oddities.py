"""Answers that are no sample's, or none of their own: counted, whatever is true."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from pytest_cpas.submissions.frames import Submission
from pytest_cpas.submissions.pairing import Pairing

__all__ = ["oddities"]

#: An answer that so many samples share, and that is so large a part of them, is told.
_REPEATED, _SHARE = 5, 0.1


def oddities(
    submission: Submission, pairing: Pairing, numbers: Sequence[int], where: str
) -> Iterator[str]:
    """A line for each kind. ``numbers``: the images in which answers are counted that are no
    sample's, ``where``: which those are, in words."""
    yield from _left_over(submission, pairing, numbers, where)
    yield from _copied(submission, pairing)
    yield from _repeated(submission, pairing)


def _left_over(
    submission: Submission, pairing: Pairing, numbers: Sequence[int], where: str
) -> Iterator[str]:
    """Answers that are no sample's best, and samples of which none is."""
    further = foreign = tied = total = 0
    for number in numbers:
        answers, found = submission.images[number].answers, pairing.found(number).answers
        if answers.samples is not None:
            continue  # which say what they are about
        total += len(answers)
        foreign += len(answers) - sum(map(len, found.values()))
        for rows in found.values():
            further += max(0, len(rows) - 1)
            scores = answers.scores
            tied += len(rows) > 1 and (scores is None or bool(scores[rows[0]] == scores[rows[1]]))
    if further or foreign:
        yield (
            f"of {total} answers{where} {further} are about samples that have a better one, and"
            f" {foreign} are about no sample: they count in rankings alone"
        )
    if tied:
        yield (
            f"{tied} samples{where} have several best answers with one score, or none: that whose"
            " numbers come first in ascending order is taken; write scores"
        )


def _copied(submission: Submission, pairing: Pairing) -> Iterator[str]:
    """Answers that are the file's own truth, bit for bit."""
    equal = total = 0
    for number in pairing.images:
        image = submission.images[number]
        if image.truths is None:
            continue
        true = {pose.tobytes() for pose in image.truths.poses}
        equal += sum(pose.tobytes() in true for pose in image.answers.poses)
        total += len(image.answers)
    if equal >= _REPEATED:
        yield (
            f"audit: {equal} of {total} answers are the file's own ground truth to the last bit;"
            " was one stored in the place of the other?"
        )


def _repeated(submission: Submission, pairing: Pairing) -> Iterator[str]:
    """One pose that many answers have, or the answers of an image."""
    counts: Counter[bytes] = Counter()
    shared = 0
    for number in pairing.images:
        answers = submission.images[number].answers
        posed = np.isfinite(answers.poses).all(axis=(1, 2))
        posed &= answers.poses[:, :3, :3].any(axis=(1, 2))
        poses = [pose.tobytes() for pose in answers.poses[posed]]
        counts.update(poses)
        # of what is one object there are several answers
        classes = dict(zip(poses, answers.class_ids[posed].tolist(), strict=True))
        told = zip(poses, answers.class_ids[posed].tolist(), strict=True)
        shared += sum(classes[pose] != class_id for pose, class_id in told)
    if not counts:
        return
    [(_, most)] = counts.most_common(1)
    if most >= max(_REPEATED, _SHARE * counts.total()):
        yield f"audit: {most} of {counts.total()} answers have one and the same pose"
    elif shared >= max(_REPEATED, _SHARE * counts.total()):
        yield (
            f"audit: {shared} of {counts.total()} answers have the pose of an answer of another"
            " class in their image"
        )
