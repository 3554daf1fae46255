"""Which answers of a file are about which sample of a data set.

Images are known by name. An answer is about the sample that it names; or about that of the file's
own truth that it stands beside; or else it is a detection, which is assigned by class and 2-D box:
one to one, by descending box IoU, at least ``DETECTION_IOU``; what is left over then, such as
further hypotheses of one detection, goes to the object that its box overlaps most, by as much.
Where a form has no 2-D boxes either, it is assigned by class and position: one to one, the nearest
first, however far; what is left over to the nearest. The best-scored answer of a sample is its
answer.
"""

from __future__ import annotations

import functools
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.submissions.answers import order
from pytest_cpas.submissions.frames import Answers, Submission
from pytest_cpas.submissions.truth import OwnTruth
from pytest_cpas.submissions.unnamed import places_of_unnamed
from pytest_cpas.types import Array, Camera, DataError, Dataset, GroundTruth, SampleRef, some_of

__all__ = ["DETECTION_IOU", "NEAR", "Pairing", "assign", "assign_by_position", "box_ious"]

#: A detection belongs to an object if their 2-D boxes overlap at least this much.
DETECTION_IOU = 0.5

#: A 2-D box of the file's own truth is believed where its position is the data set's, metres.
_SAME = 0.01

#: The file's own truth is that of a sample if their positions are no further apart, metres.
NEAR = 0.1

#: Metres; an answer without a position is taken to be as far away.
_FARTHEST = 1e300

#: Words in an image's name that are no part of it.
_KINDS = {"color", "colour", "rgb", "depth", "image", "png", "jpg", "pkl"}


class Found(NamedTuple):
    """What was found about the samples of an image, by their ids: ``answers``, rows of the image's
    answers, best first; ``own``, the row of the file's own truth about it, where it has one."""

    answers: Mapping[str, Sequence[int]]
    own: Mapping[str, int]


class _Objects(NamedTuple):
    """What answers about an image are assigned by: its samples, which of them a row of the file's
    own truth is about, and the 2-D boxes (n, 4), None where no answer has one."""

    refs: Sequence[SampleRef]
    linked: Mapping[int, int]
    boxes: Array | None


class Pairing:
    """A submission beside a data set. Each image is looked at when it is first asked for."""

    def __init__(self, submission: Submission, dataset: Dataset) -> None:
        """Find the images; :class:`DataError` where which is which cannot be told."""
        self._submission, self._dataset = submission, dataset
        self._refs: dict[str, list[SampleRef]] = defaultdict(list)
        for ref in dataset.samples:
            self._refs[dataset.image_of(ref)].append(ref)
        if isinstance(dataset, OwnTruth):
            self._numbers = dict(dataset.numbers)
            self.notes = ["the truth is the file's own; --cpas-dataset NAME takes a data set's"]
        elif not any(image.name for image in submission.images):
            self._numbers, self.notes = places_of_unnamed(submission, dataset, self._refs)
        else:
            self._numbers, self.notes = _images(submission, dataset.name, list(self._refs))
            self.notes += _strangers(submission, dataset, self._numbers)
        self.notes += _other_classes(submission, dataset)
        #: The data set's names of images by number in the submission, in the data set's order.
        self.images = {
            self._numbers[image]: image for image in self._refs if image in self._numbers
        }
        for number in self.images:
            self._check_classes(number)
        self._found: dict[int, Found] = {}
        self._objects = functools.cache(self._look)

    def number(self, ref: SampleRef) -> int | None:
        """The number, in the submission, of the image that a sample is in; None if it lacks it."""
        return self._numbers.get(self._dataset.image_of(ref))

    def found(self, number: int) -> Found:
        """What was found about the samples of an image of the submission.

        Raises :class:`DataError` where that cannot be told.
        """
        if number not in self._found:
            self._found[number] = self._find(number)
        return self._found[number]

    def refs(self, number: int) -> Sequence[SampleRef]:
        """The samples of an image of the submission."""
        return self._refs[self.images[number]]

    def rows(self, number: int, answers: Answers) -> list[list[int]]:
        """Per sample of an image the rows of its answers, the best first, if these were those that
        the submission has of it. Raises as :meth:`found`."""
        refs, linked, boxes = self._objects(number)
        rows = order(answers)
        found: list[list[int]] = [[] for _ in refs]
        if answers.samples is not None:
            places = {ref.id: place for place, ref in enumerate(refs)}
            same = self._same(refs, answers, rows)
            for column, row in enumerate(rows):
                place = places.get(answers.samples[row])
                if place is not None and same[place, column]:
                    found[place].append(row)
        elif answers.truths is not None:
            for row in rows:
                if answers.truths[row] in linked:
                    found[linked[int(answers.truths[row])]].append(row)
        elif answers.boxes is not None and boxes is not None:
            same = self._same(refs, answers, rows)
            assigned = assign(boxes, answers.boxes[rows], same)
            found = [[rows[place] for place in places] for places in assigned]
        else:
            true = [self._dataset.truth(ref).pose.translation for ref in refs]
            same = self._same(refs, answers, rows)
            assigned = assign_by_position(
                np.array(true).reshape(-1, 3), answers.poses[rows, :3, 3], same
            )
            found = [[rows[place] for place in places] for places in assigned]
        if answers.scores is not None and answers.ranks is None:
            scores = np.nan_to_num(answers.scores, nan=-np.inf).tolist()
            for each in found:
                each.sort(key=lambda row: -scores[row])
        return found

    def _check_classes(self, number: int) -> None:
        """Raise :class:`DataError` for answers without a class in an image of several objects."""
        refs = self.refs(number)
        if len(refs) > 1 and 0 in self._submission.images[number].answers.class_ids:
            raise DataError(
                f"{self._submission.path}: its answers have no class, and there are {len(refs)}"
                f" objects in image {self.images[number]}; put those about each object into a"
                f" folder of its category's name, such as {refs[0].category}/"
            )

    def _same(
        self, refs: Sequence[SampleRef], answers: Answers, rows: Sequence[int]
    ) -> NDArray[np.bool_]:
        """Whether samples and answers (n, m) are of one class, or the answer has none."""
        ids = answers.class_ids[rows].tolist()
        same = [
            [number == 0 or ref.category == self._submission.category(number) for number in ids]
            for ref in refs
        ]
        return np.array(same, dtype=bool).reshape(len(refs), len(rows))

    def _find(self, number: int) -> Found:
        refs, linked, _ = self._objects(number)
        rows = self.rows(number, self._submission.images[number].answers)
        return Found(
            {ref.id: found for ref, found in zip(refs, rows, strict=True)},
            {refs[place].id: row for row, place in linked.items()},
        )

    def _look(self, number: int) -> _Objects:
        refs, answers = self.refs(number), self._submission.images[number].answers
        linked = _linked(self._submission, number, self._dataset, refs)
        by_box = answers.samples is None and answers.truths is None and answers.boxes is not None
        boxes = _boxes(self._submission, number, self._dataset, refs, linked) if by_box else None
        return _Objects(refs, linked, boxes)


# -- images ---------------------------------------------------------------------------------


def _images(
    submission: Submission, dataset: str, wanted: Sequence[str]
) -> tuple[dict[str, int], list[str]]:
    """The number of each of the data set's images in the submission, and what is amiss."""
    stored = submission.images
    known: dict[tuple[str, ...], str] = {}
    # a form that names samples names images as the data set does
    exact = all(image.answers.samples is not None for image in stored)
    for name in wanted:
        if (key := (name,) if exact else _key(name)) in known:
            raise DataError(f"{dataset}: files cannot tell image {known[key]!r} from {name!r}")
        known[key] = name
    numbers: dict[str, int] = {}
    foreign, twice = [], []
    for number, image in enumerate(stored):
        key = (image.name,) if exact else _key(image.name)
        found = next((known[key[i:]] for i in range(len(key)) if key[i:] in known), None)
        if found is None:
            foreign.append(image.name)
        elif found in numbers:
            twice.append(f"{stored[numbers[found]].name} and {image.name}")
        else:
            numbers[found] = number
    if twice:
        raise DataError(
            f"{submission.path}: {len(twice)} images are there twice: {some_of(twice)}; leave one"
            " of each out"
        )
    lacking = [image for image in wanted if image not in numbers]
    notes = []
    if lacking:
        notes.append(
            f"{len(lacking)} of {len(wanted)} images of {dataset} are not in the file, and count as"
            f" not correct: {some_of(lacking)}"
        )
    if foreign:
        notes.append(
            f"{len(foreign)} of {len(stored)} images of the file are not among those of {dataset}"
            f" that are here, and do not count: {some_of(foreign)}"
        )
    if not numbers:
        raise DataError(
            f"{submission.path}: none of its {len(stored)} images, such as {some_of(foreign)}, is"
            f" one of {dataset}'s, such as {some_of(wanted)}"
        )
    return numbers, notes


def _strangers(
    submission: Submission, dataset: Dataset, numbers: Mapping[str, int]
) -> Sequence[str]:
    """What is amiss with the samples that answers name."""
    images = {ref.id: dataset.image_of(ref) for ref in dataset.samples}
    named = [
        (image.name, sample)
        for image in submission.images
        for sample in dict.fromkeys(image.answers.samples or ())
        if sample
    ]
    if not named:
        return []
    notes = []
    if strangers := [sample for image, sample in named if images.get(sample) != image]:
        notes.append(
            f"{len(strangers)} samples of the file are not in {dataset.name}, or not in the image"
            f" that it says, and do not count: {some_of(strangers)}"
        )
    if others := list(_otherwise_named(submission, dataset)):
        notes.append(
            f"{len(others)} answers name another category than that of their sample, and do not"
            f" count: {some_of(others)}"
        )
    there = {sample for _, sample in named}
    if lacking := [s for s, image in images.items() if s not in there and image in numbers]:
        notes.append(
            f"{len(lacking)} samples of images that are in the file are not in it, and count as not"
            f" correct: {some_of(lacking)}"
        )
    return notes


def _otherwise_named(submission: Submission, dataset: Dataset) -> Iterable[str]:
    true = {ref.id: ref.category for ref in dataset.samples}
    for image in submission.images:
        ids = image.answers.class_ids.tolist()
        for sample, class_id in zip(image.answers.samples or (), ids, strict=False):
            if class_id and sample in true and submission.category(class_id) != true[sample]:
                yield f"{sample} ({true[sample]}) as {submission.category(class_id)}"


def _other_classes(submission: Submission, dataset: Dataset) -> Sequence[str]:
    """What is amiss with the categories of the answers."""
    counts = Counter(
        submission.category(class_id)
        for image in submission.images
        for class_id in image.answers.class_ids.tolist()
    )
    known = {ref.category for ref in dataset.samples} | {""}
    others = {category: count for category, count in counts.items() if category not in known}
    if not others:
        return []
    seen = (
        f"{sum(others.values())} of {counts.total()} answers are of categories of which no sample"
        f" of {dataset.name} is here: {some_of(list(others))}"
    )
    if not {*counts} & {*dataset.class_names, *known}:
        raise DataError(
            f"{submission.path}: {seen}; expected some of {', '.join(sorted(known - {''}))} (what"
            " was converted without --dataset NAME has made its categories up)"
        )
    return [f"{seen}; no sample is found by them"]


def _key(name: str) -> tuple[str, ...]:
    """Words and numbers of an image's name, which its kind, extension and zeros do not change."""
    parts = [part for part in re.findall(r"[a-z]+|\d+", name.lower()) if part not in _KINDS]
    return tuple(part.lstrip("0") or "0" if part.isdigit() else part for part in parts)


# -- objects of an image --------------------------------------------------------------------


def _linked(
    submission: Submission, number: int, dataset: Dataset, refs: Sequence[SampleRef]
) -> dict[int, int]:
    """Which of ``refs`` each row of the file's own truth is about: by class, nearest first."""
    truths = submission.images[number].truths
    if truths is None:
        return {}
    if isinstance(dataset, OwnTruth):
        return {row: row for row in range(len(truths))}
    distances = np.full((len(truths), len(refs)), np.inf)
    true = np.array([dataset.truth(ref).pose.translation for ref in refs]).reshape(-1, 3)
    for row, class_id in enumerate(truths.class_ids.tolist()):
        same = [ref.category == submission.category(class_id) for ref in refs]
        distances[row, same] = np.linalg.norm(true[same] - truths.poses[row, :3, 3], axis=1)
    return dict(_one_to_one(-distances, -NEAR))


def _one_to_one(fits: Array, least: float) -> Iterable[tuple[int, int]]:
    """Pairs (row, column) by descending fit, each row and column once; ties go to the first."""
    rows, columns = set(), set()
    near = np.flatnonzero(fits.ravel() >= least)
    for flat in near[np.argsort(-fits.ravel()[near], kind="stable")].tolist():
        row, column = divmod(flat, fits.shape[1])
        if row not in rows and column not in columns:
            rows.add(row)
            columns.add(column)
            yield row, column


def _boxes(
    submission: Submission,
    number: int,
    dataset: Dataset,
    refs: Sequence[SampleRef],
    linked: Mapping[int, int],
) -> Array:
    """The 2-D boxes (n, 4) of samples: the data set's, else those that the file has itself, else
    those of the projected objects."""
    truths = submission.images[number].truths
    boxes = np.full((len(refs), 4), np.nan)
    rows = {place: row for row, place in linked.items()}
    for place, ref in enumerate(refs):
        box = dataset.box_of(ref)
        if box is None and truths is not None and truths.boxes is not None and place in rows:
            true = dataset.truth(ref).pose.translation
            if np.linalg.norm(truths.poses[rows[place], :3, 3] - true) <= _SAME:
                box = truths.boxes[rows[place]]
        if box is None and dataset.camera is not None:
            box = _projected(dataset.truth(ref), dataset.camera)
        if box is None:
            raise DataError(
                f"{submission.path}: which detection is about {ref.id} cannot be told, since"
                f" neither {dataset.name} nor the file has its 2-D box; a copy with masks has it"
            )
        boxes[place] = box
    return boxes


def _projected(truth: GroundTruth, camera: Camera) -> Array | None:
    """The 2-D box (4,) of a projected box; None of one that is not in front of the camera."""
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = truth.pose.apply(signs * truth.extents / 2)
    if corners[:, 2].min() <= 0:
        return None
    pixels = camera.project(corners)[:, ::-1]
    box: Array = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    return box


def box_ious(boxes: Array, others: Array) -> Array:
    """IoU (n, m) of 2-D boxes (n, 4) and (m, 4), y1, x1, y2, x2; 0 of what has no area."""
    one, two = boxes[:, None], others[None]
    overlap = np.minimum(one[..., 2:], two[..., 2:]) - np.maximum(one[..., :2], two[..., :2])
    common = overlap.clip(min=0).prod(axis=-1)
    areas = [(each[..., 2:] - each[..., :2]).clip(min=0).prod(axis=-1) for each in (one, two)]
    union = areas[0] + areas[1] - common
    ious: Array = np.divide(common, union, out=np.zeros_like(common), where=union > 0)
    return ious


def assign_by_position(positions: Array, found: Array, same: NDArray[np.bool_]) -> list[list[int]]:
    """The answers about each object, by their positions ``found`` (m, 3), metres.

    ``positions`` (n, 3) of objects, ``same`` (n, m): of one class.
    """
    with np.errstate(all="ignore"):
        distances = np.linalg.norm(positions[:, None] - found[None], axis=-1)
    # a failed answer has no position, and is about what no other answer is about
    fits = np.where(same, -np.nan_to_num(distances, nan=_FARTHEST, posinf=_FARTHEST), -np.inf)
    assigned: list[list[int]] = [[] for _ in positions]
    pairs = dict(_one_to_one(fits, -_FARTHEST))
    for place, row in pairs.items():
        assigned[place].append(row)
    for row in {*range(len(found))} - {*pairs.values()}:
        if same[:, row].any():
            assigned[int(fits[:, row].argmax())].append(row)
    return assigned


def assign(boxes: Array, found: Array, same: NDArray[np.bool_]) -> list[list[int]]:
    """The detections of each object, those that overlap it most first.

    ``boxes`` (n, 4) of objects, ``found`` (m, 4) of detections, ``same`` (n, m): of one class.
    """
    ious = np.where(same, box_ious(boxes, found), 0)
    assigned: list[list[int]] = [[] for _ in boxes]
    pairs = dict(_one_to_one(ious, DETECTION_IOU))
    for place, row in pairs.items():
        assigned[place].append(row)
    taken = set(pairs.values())
    for row in range(len(found)):
        place = int(ious[:, row].argmax()) if len(boxes) else -1
        if row not in taken and place >= 0 and ious[place, row] >= DETECTION_IOU:
            assigned[place].append(row)
    return assigned
