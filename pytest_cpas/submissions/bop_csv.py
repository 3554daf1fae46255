"""The table of the BOP Challenge, with a line for each estimate.

``scene_id,im_id,obj_id,score,R,t,time``: rotation R (9 numbers, row by row) and translation t (3
numbers, millimetres), blanks between them, from the object's model to the camera (OpenCV axes);
time in seconds for the image, which is not looked at. The first line names the columns and may be
left out. As ``bop_toolkit_lib/inout.py`` of thodan/bop_toolkit (2018; cea62d6) writes and reads it:
``METHOD_DATASET-test.csv``. Its axes and origin are those of the models, so that it is read with
``--cpas-dataset bop:DIR``. There are no extents, and no 2-D boxes: which object of an image an
estimate is about is said by obj_id, and by the position where several have it.

Some published tables hold what is nearly a rotation, the ground truth of LM-O as well; the nearest
rotation is judged, with a note.
"""

from __future__ import annotations

import io
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pytest_cpas.datasets.bop import object_name
from pytest_cpas.reading.files import lines_of, read_text
from pytest_cpas.reading.numbers import whole
from pytest_cpas.reading.tables import csv_lines
from pytest_cpas.reading.words import decimal
from pytest_cpas.submissions.frames import Answers, Image, Submission
from pytest_cpas.submissions.nocs import MOST_IMAGES, MOST_IN_IMAGE
from pytest_cpas.types import Array, DataError, Dataset, Hypothesis, shown

__all__ = ["HEADER", "line", "read"]

HEADER = "scene_id,im_id,obj_id,score,R,t,time"

#: Largest entry of ``R @ R.T - I`` of what is a rotation, and of what is nearly one. That of LM-O's
#: own truth goes up to 4e-4.
_EXACT, _NEARLY = 1e-4, 4e-3

#: Objects that a camera sees are further from it, metres.
_NEAREST = 0.02


class _Estimate(NamedTuple):
    """``class_id`` counts the data set's classes from 1; ``pose`` (16,) is in metres; ``distance``:
    of the model's origin from the camera, metres."""

    class_id: int
    score: float
    pose: list[float]
    distance: float


def read(path: Path, dataset: Dataset | None) -> Submission:
    """The table; :class:`DataError` naming the line that is damaged, or what else is needed."""
    if dataset is None or not dataset.published_centres:
        raise DataError(
            f"{path}: a table of BOP has no truth, and its poses are those of BOP's models; name"
            " the data set that it answers: --cpas-dataset bop:DIR"
        )
    found: dict[str, list[_Estimate]] = defaultdict(list)
    lines = lines_of(io.StringIO(read_text(path), newline=""), f"{path}")
    for number, fields in csv_lines(f"{path}", lines):
        if (number, ",".join(fields)) == (1, HEADER) or not fields:
            continue
        where = f"{path}, line {number}"
        image, estimate = _estimate(fields, where, dataset.class_names, dataset.published_centres)
        if len(found) == MOST_IMAGES and image not in found:
            raise DataError(f"{where}: more than {MOST_IMAGES} images; split it by scenes")
        if len(found[image]) == MOST_IN_IMAGE:
            raise DataError(
                f"{where}: more than {MOST_IN_IMAGE} estimates of image {image}; leave out those"
                " with the lowest scores"
            )
        found[image].append(estimate)
    if not found:
        raise DataError(f"{path}: no estimates, expected a line with {HEADER} for each")
    images, far, distances = [], 0, []
    for name, estimates in found.items():
        class_ids, scores, poses, far_off = (
            np.array(values) for values in zip(*estimates, strict=True)
        )
        poses = poses.reshape(-1, 4, 4)
        far += _take_nearest_rotations(poses)
        distances += far_off.tolist()
        answers = Answers(class_ids=class_ids.astype(np.int64), scores=scores, poses=poses)
        images.append(Image(name=name, answers=answers))
    notes = []
    if far:
        notes.append(f"{far} rotations are none, by little: the nearest ones are judged")
    if np.median(distances) < _NEAREST:
        notes.append(
            f"half of the objects are nearer to the camera than {1000 * _NEAREST:g} mm: are the"
            " translations in metres? In this form they are in millimetres"
        )
    return Submission(
        path=path,
        form="BOP",
        images=images,
        classes=dataset.class_names,
        object_frame="shapenet",
        gives=frozenset({"score"}),
        notes=notes,
    )


def line(place: tuple[int, int, int], estimate: Hypothesis, centre: Array) -> str:
    """The line of an estimate in the standard frames, without its end.

    ``place``: scene, image and model; ``centre`` (3,): of the model, metres, in BOP's axes. The
    time was not measured, and the score is 1 where there is none.
    """
    origin = 1000 * (estimate.translation - estimate.rotation @ centre)
    values = estimate.rotation.ravel(), origin
    score = 1 if estimate.score is None else estimate.score
    r, t = (" ".join(f"{value:.9g}" for value in each) for each in values)
    return f"{','.join(map(str, place))},{score!r},{r},{t},-1"


def _take_nearest_rotations(poses: Array) -> int:
    """Replace what is nearly a rotation in poses (n, 4, 4); returns how many are."""
    turns = poses[:, :3, :3]
    with np.errstate(all="ignore"):
        off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    rows = np.flatnonzero((off > _EXACT) & (off <= _NEARLY))
    u, _, vt = np.linalg.svd(turns[rows])
    turns[rows] = u @ vt
    return len(rows)


def _estimate(
    fields: Sequence[str], where: str, classes: Sequence[str], centres: Mapping[str, Array]
) -> tuple[str, _Estimate]:
    """The image of a line, and its estimate in our object frame."""
    if len(fields) != 7:
        raise DataError(f"{where}: {len(fields)} values with commas between, expected {HEADER}")
    places = [whole(field.strip()) for field in fields[:3]]
    for key, place, field in zip(HEADER.split(","), places, fields, strict=False):
        if place is None:
            raise DataError(
                f"{where}: {key} is {shown(field)}, expected a number of up to 9 digits"
            )
    scene, image, number = (place or 0 for place in places)
    name = object_name(number)
    if name not in centres or name not in classes:
        raise DataError(f"{where}: obj_id {number} is none of the data set's {len(classes)} models")
    score = decimal(fields[3].strip())
    if score is None:
        raise DataError(f"{where}: score is {shown(fields[3])}, expected a finite number")
    rotation = np.reshape(_numbers(fields[4], 9, f"{where}: R"), (3, 3))
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = np.array(_numbers(fields[5], 3, f"{where}: t")) / 1000
    distance = float(np.linalg.norm(pose[:3, 3]))
    pose[:3, 3] += rotation @ centres[name]
    estimate = _Estimate(classes.index(name) + 1, score, pose.ravel().tolist(), distance)
    return f"{scene:06d}/{image:06d}", estimate


def _numbers(text: str, count: int, what: str) -> list[float]:
    """Numbers with blanks between them; of a failed estimate they may be NaN or infinite."""
    words = text.split()
    numbers = [decimal(word) for word in words]
    for place, word in enumerate(words):
        if numbers[place] is None and word.lower().lstrip("+-") in ("nan", "inf"):
            numbers[place] = float(word)
    given = [number for number in numbers if number is not None]
    if len(given) != count or len(words) != count:
        raise DataError(f"{what} is {shown(text)}, expected {count} numbers with blanks between")
    return given
