"""Class ids that mean other classes than the form says: which ones, by where the answers are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np

from pytest_cpas.submissions.frames import Submission
from pytest_cpas.submissions.pairing import Pairing
from pytest_cpas.types import Array

__all__ = ["other_meaning"]

#: An answer is about the nearest object, of whatever class, if that is no further away, metres.
_THERE = 0.05

#: A class means another one if most of at least so many of its answers are about such objects.
_LEAST, _MOST = 5, 0.5


def other_meaning(
    submission: Submission, pairing: Pairing, positions: Iterable[tuple[int, Array]]
) -> Mapping[int, int]:
    """Class ids that seem to mean another one; ``positions`` (n, 3) of the objects, metres, by
    image."""
    ids = {category: number for number, category in enumerate(submission.classes, 1)}
    seen: dict[int, Counter[int]] = {}
    for number, true in positions:
        answers, refs = submission.images[number].answers, pairing.refs(number)
        if answers.samples is not None or not len(answers) or not refs:
            continue  # who names samples has no use for ids
        with np.errstate(all="ignore"):
            apart = np.linalg.norm(answers.poses[:, None, :3, 3] - true[None], axis=-1)
        apart = np.where(np.isfinite(apart), apart, np.inf)
        for class_id, place, distance in zip(
            answers.class_ids.tolist(),
            apart.argmin(axis=1).tolist(),
            apart.min(axis=1),
            strict=True,
        ):
            if class_id and distance <= _THERE and refs[place].category in ids:
                seen.setdefault(class_id, Counter())[ids[refs[place].category]] += 1
    meant = {}
    for class_id, counts in seen.items():
        [(other, most)] = counts.most_common(1)
        if other != class_id and most >= max(_LEAST, _MOST * counts.total()):
            meant[class_id] = other
    return meant
