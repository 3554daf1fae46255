"""A folder of text files, each with the pose of one object in one image.

``ob_in_cam/IMAGE.txt``: 4 x 4 numbers, row by row, object to camera (OpenCV axes), metres, as
``run_demo.py`` of NVlabs/FoundationPose (2024; bf25183) writes them with ``numpy.savetxt``. The
file is called by its image. The folders that it is in name the scene, and the object's category,
if there is one: ``scene_1/ob_in_cam/0000.txt``, ``obj_000005/000048/000001.txt``. Without a
category it is about the only object of its image. The object's axes and origin are those of the
models that the data set publishes. There are no extents and no scores.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pytest_cpas.reading.files import read_text
from pytest_cpas.reading.paths import natural
from pytest_cpas.reading.words import decimal
from pytest_cpas.submissions.frames import Answers, Image, Submission
from pytest_cpas.submissions.nocs import MOST_IMAGES, MOST_IN_IMAGE
from pytest_cpas.types import CATEGORIES, Array, DataError, Dataset, shown

__all__ = ["read"]

#: Bytes of a file.
_LARGEST = 2**16

#: A folder that names nothing.
_PLAIN = "ob_in_cam"


def read(path: Path, files: Sequence[Path], dataset: Dataset | None) -> Submission:
    """The files of a folder; :class:`DataError` naming the one that is damaged."""
    if len(files) > MOST_IMAGES:
        raise DataError(f"{path}: {len(files)} files, at most {MOST_IMAGES} are read; split it")
    classes = CATEGORIES if dataset is None else dataset.class_names
    centres = {} if dataset is None else dataset.published_centres
    above = [part for part in path.resolve().parts[1:] if part != _PLAIN][-1:]
    found: dict[str, list[tuple[int, Array]]] = defaultdict(list)
    for file in sorted(files, key=lambda file: natural(file.as_posix())):
        folders = [*above, *file.relative_to(path).parts[:-1]]
        named = [folder for folder in folders if folder in classes]
        scene = [folder for folder in folders if folder not in (*named, _PLAIN)]
        class_id = classes.index(named[-1]) + 1 if named else 0
        pose = _pose(file)
        if centres:
            if len(classes) == 1:
                class_id = 1
            if not class_id:
                raise DataError(
                    f"{file}: which model it is about is not said; put the files about each object"
                    f" into a folder of its category's name, such as {classes[0]}/"
                )
            pose[:3, 3] += pose[:3, :3] @ centres[classes[class_id - 1]]
        image = found["/".join([*scene[-1:], file.stem])]
        if len(image) == MOST_IN_IMAGE:
            raise DataError(f"{file}: more than {MOST_IN_IMAGE} objects of an image")
        image.append((class_id, pose))
    images = []
    for name, objects in found.items():
        class_ids, poses = zip(*objects, strict=True)
        answers = Answers(class_ids=np.array(class_ids, dtype=np.int64), poses=np.stack(poses))
        images.append(Image(name=name, answers=answers))
    return Submission(
        path=path,
        form="folder of matrices",
        images=images,
        classes=classes,
        object_frame="nocs",
        gives=frozenset(),
    )


def _pose(file: Path) -> Array:
    """The pose (4, 4) in a file; that of a failed object may be of NaN or infinities."""
    words = read_text(file, _LARGEST).split()
    numbers = [float(w) if w.lower().lstrip("+-") in ("nan", "inf") else decimal(w) for w in words]
    given = [number for number in numbers if number is not None]
    if len(given) != len(numbers):
        word = words[numbers.index(None)]
        raise DataError(f"{file}: {shown(word)} is no number, expected 4 x 4 numbers")
    if len(given) != 16:
        raise DataError(f"{file}: {len(given)} numbers, expected 4 x 4 with blanks between")
    return np.reshape(given, (4, 4))
