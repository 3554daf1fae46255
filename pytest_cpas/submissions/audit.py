"""What explains a file better than what it says: boxes, rows, frames or classes that are mixed up.

Each usual mistake is undone in turn, and the samples are counted whose answer is near the truth
then. Only what makes significantly more of them near is told: with the counts, and what to write.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pytest_cpas.submissions.answers import counted_otherwise
from pytest_cpas.submissions.class_ids import other_meaning
from pytest_cpas.submissions.frames import Answers, Submission
from pytest_cpas.submissions.oddities import oddities
from pytest_cpas.submissions.pairing import NEAR, Pairing
from pytest_cpas.submissions.truth import OwnTruth, truth_of
from pytest_cpas.types import Array, Dataset, GroundTruth, Symmetry
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET
from pytest_cpas.types.samples import evenly

__all__ = ["audit"]

#: What counts as near the truth: metres, and degrees (of the up axis where an object is symmetric).
_NEAR_M, _NEAR_DEG = 0.02, 10.0

#: How far from its own frame an answer is looked for, frames.
_STEPS = 10

#: Images that are looked at, evenly spaced, each with its neighbours.
_IMAGES = 200

#: A mistake is told if undoing it brings so many samples more near the truth than away from it, and
#: as many standard deviations of a coin that is thrown for each; or so many more of them closer to
#: it, and none in all away from it.
_LEAST, _DEVIATIONS, _FAR = 5, 4.0, 5.0

#: What boxes are is not guessed if answers fit so many times more samples without them.
_MUCH_MORE = 1.5

#: The file's own truth is the data set's up to such differences: metres, degrees.
_SAME_M, _SAME_DEG = 1e-4, 0.1


class _Truth(NamedTuple):
    """Objects of an image: positions (n, 3), rotations (n, 3, 3), which are symmetric (n,)."""

    positions: Array
    rotations: Array
    symmetric: NDArray[np.bool_]


class _Errors(NamedTuple):
    """Of samples (n,): whether they are near the truth, and the distance from it, metres, infinite
    without an answer."""

    near: NDArray[np.bool_]
    metres: Array


class _Mistake(NamedTuple):
    """A usual mistake: what it is, what to write instead, and the answers without it."""

    told: str
    write: str
    undone: Callable[[int], Answers | None]


class _Found(NamedTuple):
    """A mistake, how many samples are near the truth without it, and how many closer to it."""

    mistake: _Mistake
    near: int
    closer: int


def audit(submission: Submission, pairing: Pairing, dataset: Dataset) -> list[str]:
    """What is noticed about the answers of a file, a line each; nothing about a sound one.

    Raises :class:`pytest_cpas.types.DataError` for a truth that cannot be read.
    """
    numbers = evenly(sorted(pairing.images), _IMAGES)
    truths = {number: _truth(pairing, dataset, number) for number in numbers}

    def errors(undone: Callable[[int], Answers | None]) -> _Errors:
        of = [_errors(submission, pairing, n, undone(n), truths[n]) for n in numbers]
        return _Errors(*map(np.concatenate, zip(*of, strict=True)))

    if not numbers:
        return []
    lines = []
    given = errors(lambda number: submission.images[number].answers)
    where = "" if len(numbers) == len(pairing.images) else f" of {len(numbers)} images"
    places = ((number, truth.positions) for number, truth in truths.items())
    usual = [*_mistakes(submission, pairing), *_exchanged(submission, pairing, places)]
    found = _best(given, ((m, errors(m.undone)) for m in usual))
    other = _boxes_of_nothing(submission)
    # an object that was not detected may stand closer to something else
    without = _best(given, [(other, errors(other.undone))], closer=False)
    if without is not None and (found is None or without.near > _MUCH_MORE * found.near):
        found = without
    if found is not None:
        lines.append(
            f"audit: {found.mistake.told} would bring {found.near} instead of {given.near.sum()} of"
            f" {len(given.near)} samples{where} near the truth ({_NEAR_M * 100:g} cm,"
            f" {_NEAR_DEG:g} deg), and {found.closer} closer than they are; if that is it,"
            f" {found.mistake.write}"
        )
    if not isinstance(dataset, OwnTruth):
        lines += _differing(submission, pairing, dataset)
    return [*lines, *oddities(submission, pairing, numbers, where)]


def _best(
    given: _Errors, undone: Iterable[tuple[_Mistake, _Errors]], *, closer: bool = True
) -> _Found | None:
    """What explains the most, if anything does: with how many samples are near the truth then, and
    how many are closer to it, which explains something too if ``closer``."""
    best: _Found | None = None
    for mistake, found in undone:
        nearer = closer and _tell(given.metres > found.metres, found.metres > given.metres, _FAR)
        if nearer and found.near.sum() >= given.near.sum():
            clear = True
        else:
            clear = _tell(found.near & ~given.near, given.near & ~found.near, _DEVIATIONS)
        new = _Found(mistake, int(found.near.sum()), int((given.metres > found.metres).sum()))
        if clear and (best is None or new[1:] > best[1:]):
            best = new
    return best


# -- what is near ---------------------------------------------------------------------------


def _truth(pairing: Pairing, dataset: Dataset, number: int) -> _Truth:
    truths = [dataset.truth(ref) for ref in pairing.refs(number)]
    return _Truth(
        np.array([truth.pose.translation for truth in truths]).reshape(-1, 3),
        np.array([truth.pose.rotation for truth in truths]).reshape(-1, 3, 3),
        np.array([_is_symmetric(truth.symmetry) for truth in truths], dtype=bool),
    )


def _is_symmetric(symmetry: Symmetry) -> bool:
    return symmetry.sphere or symmetry.axis is not None or len(symmetry.rotations) > 1


def _tell(better: NDArray[np.bool_], worse: NDArray[np.bool_], deviations: float) -> bool:
    """Whether more samples are better than worse than a fair coin explains."""
    gained, lost = int(better.sum()), int(worse.sum())
    return gained - lost >= float(max(_LEAST, deviations * np.sqrt(gained + lost)))


def _errors(
    submission: Submission,
    pairing: Pairing,
    number: int,
    answers: Answers | None,
    truth: _Truth,
) -> _Errors:
    """Those of the best answers about the samples of an image."""
    count = len(truth.positions)
    near, metres = np.zeros(count, bool), np.full(count, np.inf)
    if answers is None or not len(answers):
        return _Errors(near, metres)
    firsts = [rows[0] if rows else -1 for rows in pairing.rows(number, answers)]
    places = [place for place, row in enumerate(firsts) if row >= 0]
    poses = answers.poses[[firsts[place] for place in places]]
    with np.errstate(all="ignore"):
        scales = np.cbrt(np.linalg.det(poses[:, :3, :3]))
        rotations = poses[:, :3, :3] / scales[:, None, None]
        if submission.object_frame == "nocs":
            rotations = rotations @ NOCS_FROM_SHAPENET
        true = truth.rotations[places]
        traces = np.einsum("nij,nij->n", rotations, true)
        ups = np.einsum("ni,ni->n", rotations[:, :, 1], true[:, :, 1])
        cosines = np.where(truth.symmetric[places], ups, (traces - 1) / 2)
        apart = np.linalg.norm(poses[:, :3, 3] - truth.positions[places], axis=1)
        # what is not finite is near nothing
        near[places] = (apart <= _NEAR_M) & (cosines >= np.cos(np.radians(_NEAR_DEG)))
        metres[places] = np.where(np.isfinite(apart), apart, np.inf)
    return _Errors(near, metres)


# -- usual mistakes -------------------------------------------------------------------------


def _mistakes(submission: Submission, pairing: Pairing) -> Iterator[_Mistake]:
    images = submission.images

    def within(change: Callable[[Answers], Answers | None]) -> Callable[[int], Answers | None]:
        return lambda number: change(images[number].answers)

    for told, write, make in _BOX_ORDERS:
        undone = within(partial(_boxed, make))
        yield _Mistake(f"to read 2-D boxes as {told}", f"write {write}", undone)
    for step in (1, -1):
        for parts, told in _ROLLED:
            yield _Mistake(
                f"to take the {told} of each answer from the row"
                f" {'above' if step > 0 else 'below'}",
                f"write {told} in the order of the rest of their frame",
                within(partial(_rolled, step, parts)),
            )
        yield _Mistake(
            f"to read class ids as {'one more' if step > 0 else 'one less'}",
            f"number classes from 1: {', '.join(submission.classes)}",
            within(partial(counted_otherwise, step, len(submission.classes))),
        )
    yield from _misplaced(submission, pairing)


def _exchanged(
    submission: Submission, pairing: Pairing, places: Iterable[tuple[int, Array]]
) -> Iterator[_Mistake]:
    meant = other_meaning(submission, pairing, places)
    if len({other - class_id for class_id, other in meant.items()}) < 2:
        return  # nothing, or all are one more or one less, which is told so
    ids = np.arange(len(submission.classes) + 1)
    ids[list(meant)] = list(meant.values())
    told = ", ".join(f"{a} as {submission.category(b)}" for a, b in sorted(meant.items()))
    yield _Mistake(
        f"to read the class ids {told}",
        f"number classes from 1: {', '.join(submission.classes)}",
        lambda number: _renumbered(submission.images[number].answers, ids),
    )


def _renumbered(answers: Answers, ids: NDArray[np.int64]) -> Answers:
    return replace(answers, class_ids=ids[answers.class_ids])


def _boxes_of_nothing(submission: Submission) -> _Mistake:
    """What is left to say where boxes are none of the orders that are known."""
    return _Mistake(
        "to find answers by class and position, not by their 2-D boxes,",
        "write 2-D boxes as y1, x1, y2, x2 in pixels of the image",
        lambda number: replace(submission.images[number].answers, boxes=None),
    )


def _boxed(make: Callable[[Array], Array], answers: Answers) -> Answers | None:
    return None if answers.boxes is None else replace(answers, boxes=make(answers.boxes))


def _rolled(step: int, parts: Sequence[str], answers: Answers) -> Answers | None:
    values = {part: getattr(answers, part) for part in parts}
    moved = {k: np.roll(v, step, axis=0) for k, v in values.items() if v is not None}
    return replace(answers, **moved) if len(answers) > 1 else None


#: How boxes are meant that are no y1, x1, y2, x2; how to write them so; and what they become.
_BOX_ORDERS: tuple[tuple[str, str, Callable[[Array], Array]], ...] = (
    ("x1, y1, x2, y2", "boxes[:, [1, 0, 3, 2]]", lambda b: b[:, [1, 0, 3, 2]]),
    (
        "x, y, width, height",
        "y, x, y + height, x + width",
        lambda b: np.column_stack([b[:, 1], b[:, 0], b[:, 1] + b[:, 3], b[:, 0] + b[:, 2]]),
    ),
    (
        "y, x, height, width",
        "y, x, y + height, x + width",
        lambda b: np.column_stack([b[:, :2], b[:, :2] + b[:, 2:]]),
    ),
    (
        "centre x, centre y, width, height",
        "corners y1, x1, y2, x2",
        lambda b: np.column_stack([b[:, 1::-1] - b[:, :1:-1] / 2, b[:, 1::-1] + b[:, :1:-1] / 2]),
    ),
)

#: Parts of answers that are rolled against the rest of their frame.
_ROLLED = (
    (("poses", "extents", "scores"), "poses"),
    (("class_ids",), "classes"),
    (("boxes",), "2-D boxes"),
)


def _misplaced(submission: Submission, pairing: Pairing) -> Iterator[_Mistake]:
    """Answers about an image that stand with another one."""
    images = submission.images
    placed = list(pairing.images)  # in the order of the data set

    def whole(others: Mapping[int, int]) -> Callable[[int], Answers | None]:
        return lambda number: images[others[number]].answers

    def poses(others: Mapping[int, int]) -> Callable[[int], Answers | None]:
        return lambda number: _posed(images[number].answers, images[others[number]].answers)

    write = "store what was answered with the image that it was answered for"
    for step in (*range(1, _STEPS + 1), *range(-1, -_STEPS - 1, -1)):
        others = dict(zip(placed, [*placed[step:], *placed[:step]], strict=True))
        near = "next frame" if step > 0 else "previous frame"
        far = f"frame that is {abs(step)} {'after' if step > 0 else 'before'}"
        told = near if abs(step) == 1 else far
        yield _Mistake(f"to take the answers of the {told}", write, whole(others))
        if abs(step) == 1:
            yield _Mistake(f"to take the poses of the {told}", write, poses(others))
    listed = sorted(placed, key=lambda number: _listed(pairing.images[number]))
    if listed != placed:
        there = dict(zip(listed, placed, strict=True))
        back = dict(zip(placed, listed, strict=True))
        for told, others in (
            ("to take the frames as sorted alphabetically (0, 1, 10, 100)", there),
            ("to take the frames in their own order, not alphabetically (0, 1, 10, 100)", back),
        ):
            yield _Mistake(told, "sort the frames by their numbers", whole(others))


def _posed(answers: Answers, other: Answers) -> Answers | None:
    if len(answers) != len(other):
        return None
    return replace(answers, poses=other.poses, extents=other.extents)


def _listed(name: str) -> tuple[str, str]:
    """What puts images into the order of a folder whose files have numbers without zeros."""
    digits = name[len(name.rstrip("0123456789")) :]
    return name.rpartition("/")[0], str(int(digits)) if digits else ""


# -- the file's own truth -------------------------------------------------------------------


def _differing(submission: Submission, pairing: Pairing, dataset: Dataset) -> Iterator[str]:
    """Where the file's own truth is not the data set's."""
    strange = total = lacking = 0
    apart: list[tuple[float, float, float]] = []
    for number in pairing.images:
        truths = submission.images[number].truths
        if truths is None:
            continue
        own = pairing.found(number).own
        total += len(truths)
        strange += len(truths) - len(own)
        lacking += len(pairing.refs(number)) - len(own)
        apart += [
            _apart(dataset.truth(ref), truth_of(submission, truths, own[ref.id]))
            for ref in pairing.refs(number)
            if ref.id in own
        ]
    if strange:
        yield (
            f"{strange} of {total} objects of the file's own ground truth are not within"
            f" {NEAR * 100:g} cm of one of {dataset.name}'s of their class and image, and do not"
            " count"
        )
    if lacking:
        yield f"{lacking} objects of {dataset.name} are not in the file's own ground truth"
    parts = np.array(apart).reshape(-1, 3)
    differing = parts[(parts > (_SAME_M, _SAME_M, _SAME_DEG)).any(axis=1)]
    if len(differing):
        centres, sides, degrees = differing.max(axis=0)
        yield (
            f"the file's own ground truth differs from {dataset.name}'s for {len(differing)} of"
            f" {len(apart)} objects that are in both, by up to {centres * 1000:.1f} mm (centres),"
            f" {sides * 1000:.1f} mm (sides) and {degrees:.1f} deg; that of {dataset.name} counts"
        )


def _apart(one: GroundTruth, other: GroundTruth) -> tuple[float, float, float]:
    """How far two truths about an object are apart: centres and sides, metres, and degrees."""
    centres = float(np.linalg.norm(one.pose.translation - other.pose.translation))
    sides = float(np.abs(one.extents - other.extents).max())
    turn = one.pose.rotation.T @ other.pose.rotation
    if _is_symmetric(one.symmetry):  # the up axis alone says something of all of those
        degrees = np.degrees(np.arctan2(np.hypot(turn[0, 1], turn[2, 1]), turn[1, 1]))
        return centres, sides, float(degrees)
    return centres, sides, float(np.degrees(Rotation.from_matrix(turn).magnitude()))
