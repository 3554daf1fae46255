"""The pickled ``DetectMatch`` of Omni6DPose's evaluation: answers row by row beside their truth.

``detect_match.pkl`` as ``runners/evaluation_single.py`` of Omni6DPose/GenPose2 (GenPose++, 2024;
1a1a907) writes it, of the class in ``common/eval_utils.py`` of Omni6DPose/Omni6DPoseAPI (package
cutoop, 2024; c1ed906), or a dict of its fields: ``gt_affine`` and ``pred_affine`` (n, 4, 4), object
to camera (OpenCV axes), metres; ``gt_size`` and ``pred_size`` (n, 3), side lengths, metres;
``gt_class_labels`` (n,); ``gt_sym_labels`` (n,), each with ``any`` and ``x``, ``y``, ``z``;
``image_path`` (n,), without which each row is an image; ``detect_scores`` (n,) or None. Classes are
imported from nowhere: what is read are the fields.

Row k answers the truth of row k. Without a data set, categories are called ``class_K`` by their
labels, and symmetries are those of the file; labels count the classes of a data set from 1.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pytest_cpas.submissions.frame_lists import name_of_path
from pytest_cpas.submissions.frames import Answers, Image, Submission, Truths
from pytest_cpas.submissions.nocs import MOST_IMAGES, MOST_IN_IMAGE
from pytest_cpas.types import Array, DataError, Dataset, Symmetry, shown

__all__ = ["CLASSES", "is_match", "read"]

#: The classes of which a file may hold objects.
CLASSES = frozenset(
    f"cutoop.{name}"
    for name in ("eval_utils.DetectMatch", "rotation.SymLabel", "data_types.CameraIntrinsicsBase")
) | {"cutoop.data_types.CameraIntrinsics"}

_TAGS = ("none", "any", "half", "quarter")


def is_match(value: Any) -> bool:
    """Whether what a pickle holds is of this form."""
    return isinstance(value, dict) and {"gt_affine", "pred_affine"} <= set(value)


def read(path: Path, value: Mapping[str, Any], dataset: Dataset | None) -> Submission:
    """A pickle's content; :class:`DataError` naming the file and the field that is damaged."""
    labels = _array(value, "gt_class_labels", (None,), f"{path}", kinds="iu").tolist()
    count = len(labels)
    sides = {
        side: {
            "poses": _array(value, f"{side}_affine", (count, 4, 4), f"{path}"),
            "extents": _array(value, f"{side}_size", (count, 3), f"{path}"),
        }
        for side in ("gt", "pred")
    }
    scores = None
    if value.get("detect_scores") is not None:
        scores = _array(value, "detect_scores", (count,), f"{path}")
        if not np.isfinite(scores).all():
            raise DataError(f"{path}: detect_scores holds NaN or infinite numbers")
    symmetries = None
    if dataset is None:
        tags = value.get("gt_sym_labels")
        symmetries = _symmetries(tags, count, f"{path}: gt_sym_labels")
    classes, class_ids = _classes(labels, dataset, path)
    rows: dict[str, list[int]] = defaultdict(list)
    for row, name in enumerate(_names(value.get("image_path"), count, f"{path}: image_path")):
        rows[name].append(row)
        if len(rows[name]) > MOST_IN_IMAGE or len(rows) > MOST_IMAGES:
            raise DataError(
                f"{path}: row {row} is one of more than {MOST_IN_IMAGE} of image {name}, or of more"
                f" than {MOST_IMAGES} images; split the file by scenes"
            )
    images = [
        Image(
            name=name,
            answers=Answers(
                class_ids=class_ids[chosen],
                truths=np.arange(len(chosen)),
                scores=None if scores is None else scores[chosen],
                **{key: values[chosen] for key, values in sides["pred"].items()},
            ),
            truths=Truths(
                class_ids=class_ids[chosen],
                symmetries=None if symmetries is None else [symmetries[row] for row in chosen],
                **{key: values[chosen] for key, values in sides["gt"].items()},
            ),
        )
        for name, chosen in rows.items()
    ]
    return Submission(
        path=path,
        form="cutoop",
        images=images,
        classes=classes,
        object_frame="shapenet" if dataset is None else "nocs",
        gives=frozenset({"extents"} if scores is None else {"extents", "score"}),
        notes=_undetected(value.get("gt_n_objects"), count) if dataset is None else (),
    )


def _undetected(annotated: Any, count: int) -> Sequence[str]:
    """What to say of objects that are counted by ``gt_n_objects``, and have no row."""
    numbers = annotated.values() if isinstance(annotated, dict) else ()
    objects = sum(number for number in numbers if type(number) is int)
    if objects <= count:
        return ()
    return [
        f"{objects} objects were annotated, and the file has {count}: the others are not judged"
        " without a data set, and classes are called class_K by their labels"
    ]


def _array(
    value: Mapping[str, Any], key: str, shape: tuple[int | None, ...], where: str, kinds: str = "f"
) -> Any:
    array = value.get(key)
    if isinstance(array, list):
        try:
            array = np.array(array)
        except ValueError:  # rows of several lengths
            array = None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds:
        words = "integers" if kinds == "iu" else "numbers"
        raise DataError(f"{where}: {key} is missing or not an array of {words}")
    wanted = tuple(have if n is None else n for n, have in zip(shape, array.shape, strict=False))
    if array.shape != wanted or array.ndim != len(shape):
        words = ", ".join("n" if n is None else str(n) for n in shape)
        raise DataError(f"{where}: {key} has shape {array.shape}, expected ({words})")
    return array.astype(np.int64 if kinds == "iu" else np.float64)


def _classes(
    labels: Sequence[int], dataset: Dataset | None, path: Path
) -> tuple[Sequence[str], Any]:
    """The names of all classes, and the class id of each row."""
    known = sorted(set(labels))
    if dataset is None:
        if known and not 0 <= known[0] <= known[-1] <= 10**6:
            raise DataError(
                f"{path}: gt_class_labels run from {known[0]} to {known[-1]}, expected 0 to a"
                " million"
            )
        places = {label: place for place, label in enumerate(known, start=1)}
        ids = np.array([places[label] for label in labels], dtype=np.int64)
        return tuple(f"class_{label}" for label in known), ids
    if known and not 1 <= known[0] <= known[-1] <= len(dataset.class_names):
        raise DataError(
            f"{path}: gt_class_labels run from {known[0]} to {known[-1]}, and {dataset.name} has"
            f" the classes 1 to {len(dataset.class_names)} ({', '.join(dataset.class_names)})"
        )
    return dataset.class_names, np.array(labels, dtype=np.int64)


def _names(given: Any, count: int, where: str) -> Sequence[str]:
    """The image of each row."""
    if given is None:
        return [f"{row:06d}" for row in range(count)]
    if isinstance(given, str):
        return [name_of_path(given)] * count
    names = given.tolist() if isinstance(given, np.ndarray) else given
    if not isinstance(names, list | tuple) or len(names) != count:
        raise DataError(f"{where} is no list of {count} texts")
    for row, name in enumerate(names):
        if not isinstance(name, str) or not name:
            raise DataError(f"{where}: row {row} is {shown(name)}, expected the image's path")
    return [name_of_path(name) for name in names]


def _symmetries(given: Any, count: int, where: str) -> Sequence[Symmetry]:
    tags = given.tolist() if isinstance(given, np.ndarray) else given
    if not isinstance(tags, list) or len(tags) != count:
        raise DataError(f"{where} is no list of {count} symmetries")
    made: dict[tuple[Any, ...], Symmetry] = {}
    found = []
    for row, tag in enumerate(tags):
        key = _tag(tag)
        if key is None:
            raise DataError(
                f"{where}: row {row} is {shown(tag)}, expected any, and x, y and z, each"
                f" {', '.join(_TAGS)}"
            )
        made[key] = made.get(key) or _symmetry(*key)
        found.append(made[key])
    return found


def _tag(tag: Any) -> tuple[bool, tuple[str, ...]] | None:
    if not isinstance(tag, dict) or not isinstance(tag.get("any"), bool | np.bool_):
        return None
    axes = tuple(tag.get(axis) for axis in "xyz")
    if not all(isinstance(axis, str) and axis in _TAGS for axis in axes):
        return None
    return bool(tag["any"]), tuple(str(axis) for axis in axes)


def _symmetry(free: bool, axes: Sequence[str]) -> Symmetry:
    """The group that turns about x, y and z generate: any turn, half ones, quarter ones."""
    if free or axes.count("any") > 1 or {"any", "quarter"} <= set(axes):
        return Symmetry.full()
    folds = {"half": 2, "quarter": 4}
    rotations: list[Array] = [np.eye(3)]
    turns = [
        Symmetry.n_fold(np.eye(3)[place], folds[tag]).rotations[1].round()
        for place, tag in enumerate(axes)
        if tag in folds
    ]
    for rotation in rotations:  # which grows until no turn gives another one
        for turn in turns:
            made = turn @ rotation
            if not any(np.array_equal(made, known) for known in rotations):
                rotations.append(made)
    spun = [np.eye(3)[place] for place, tag in enumerate(axes) if tag == "any"]
    return Symmetry(np.stack(rotations), *itertools.islice(spun, 1))
