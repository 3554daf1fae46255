"""Pickles with a dict of images, each with the dict of what was found in it.

CATRE's ``EXP_DATASET_preds.pkl``: ``iter0``, ``iter1``, ... for the steps of refinement, of which
the last is judged; in each, by ``scene_1/0000``, ``pred_class_ids`` (m,), ``pred_RTs`` (m, 4, 4)
without a scale, ``pred_scales`` (m, 3), metres, ``pred_scores`` (m,) and ``pred_bboxes`` (m, 4),
y1, x1, y2, x2. ``core/catre/engine/catre_custom_evaluator.py`` of THU-DA-6D-Pose-Group/CATRE (2022;
89b1b37) writes it. It has no truth. Of a dict without ``iter0`` the images are its keys.

PACE's pair of files: ``METHOD_pred.pkl``, by the image's path ``pred_class_ids``, ``pred_RTs``,
``pred_scales`` and ``pred_scores``, and beside it, in one folder, ``catpose_gts_SPLIT.pkl``, by the
same paths ``gt_class_ids`` (n,), ``gt_RTs`` (n, 4, 4), metres, and ``gt_scales`` (n, 3), metres, as
``eval/category/compute_ap.py`` of qq456cvb/PACE (2024; f9608cf) reads them. Class ids count the 55
names of ``category_names.txt`` there; a ``/`` in them is a ``-`` here. There are no 2-D boxes of
detections, so that answers are paired by class and position. Images without predictions count.

In both poses are rotation times scale and sizes are relative to it, which comes to the same where
one of them is 1 and the other in metres.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_cpas.reading.files import regular
from pytest_cpas.reading.paths import matching
from pytest_cpas.reading.pickles import load_pickle
from pytest_cpas.submissions import nocs
from pytest_cpas.submissions.frame_lists import name_of_path
from pytest_cpas.submissions.frames import Image, Submission
from pytest_cpas.types import CATEGORIES, DataError, Dataset, shown

__all__ = ["PACE", "TRUTH", "is_by_image", "read"]

#: What PACE's truth is called.
TRUTH = "catpose_gts_*.pkl"

#: PACE's classes, in the order of their ids.
PACE = (
    *("bottle", "bowl", "box-base_link", "box-link1", "box-link2", "box-link3", "brush", "can"),
    *("chip_can", "clip-link1", "clip-link2", "clock", "container", "cutter-base_link"),
    *("cutter-link1", "drinkbox", "dustpan", "hammer", "handbag", "hat", "helmet", "knife"),
    *("marker", "mug", "notebook", "pan", "pen", "pencil", "ping_pong_ball", "plate", "pot"),
    *("ramen_box", "ramen_package", "razor", "remote", "sausage", "scissor-link1"),
    *("scissor-link2", "slipper", "snack_box", "snack_package", "sneaker", "spanner", "spoon"),
    *("squeegee", "steel_tape", "tape", "tennis_ball", "thermos", "tissue", "toothbrush"),
    *("toy_car", "toys", "trash_bin", "wallet"),
)

#: What an image's dict has at least.
_NEEDED = {"pred_class_ids", "pred_RTs", "pred_scales"}

_NOTHING = {
    "pred_class_ids": np.zeros(0, int),
    "pred_RTs": np.zeros((0, 4, 4)),
    "pred_scales": np.zeros((0, 3)),
}


def is_by_image(value: Any) -> bool:
    """Whether what a pickle holds is of one of these forms."""
    if not isinstance(value, dict) or not value:
        return False
    first = next(iter(value.values()))
    if isinstance(first, dict) and _step(next(iter(value))) is not None:
        first = next(iter(first.values()), dict.fromkeys(_NEEDED))
    return isinstance(first, dict) and set(first) >= _NEEDED


def read(path: Path, value: Mapping[Any, Any], dataset: Dataset | None) -> Submission:
    """A pickle's content; :class:`DataError` naming the file and the image that is damaged."""
    steps = {key: step for key in value if (step := _step(key)) is not None}
    notes: list[str] = []
    where = f"{path}"
    if steps:
        last = max(steps, key=lambda key: steps[key])
        where += f", {last}"
        value = _dict(value[last], where)
        notes.append(f"of {len(steps)} steps of refinement the last, {last}, is judged")
    boxes = all("pred_bboxes" in each for each in value.values() if isinstance(each, dict))
    truths = None if boxes else _truths(path)
    if truths is None and dataset is None:
        asks = "" if boxes else f"; of PACE put {TRUTH.replace('*', 'SPLIT')} beside it"
        raise DataError(
            f"{path}: it has no truth; name the data set that it answers: --cpas-dataset=NAME"
            f" --cpas-data=DIR{asks}"
        )
    classes = dataset.class_names if dataset is not None else CATEGORIES if boxes else PACE
    form = "CATRE" if boxes else "PACE"
    images = _images(where, value, truths, classes, boxes)
    read = nocs.submission(path, form, images, classes)
    if dataset is None:
        notes.append("which objects are symmetric is told by their categories, not as PACE does")
    return replace(read, notes=notes)


def _step(key: object) -> int | None:
    match = re.fullmatch(r"iter([0-9]{1,4})", key) if isinstance(key, str) else None
    return int(match[1]) if match else None


def _dict(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise DataError(f"{where}: a {type(value).__name__}, expected a dict")
    return value


def _truths(path: Path) -> Mapping[Any, Any] | None:
    """PACE's truth beside a file; None where it is not there."""
    files = matching(path.parent, TRUTH)
    if len(files) > 1:
        raise DataError(
            f"{path}: {files[0].name} and {files[1].name} are beside it; leave the one that it"
            " answers"
        )
    return _dict(load_pickle(regular(files[0])), f"{files[0]}") if files else None


def _images(
    where: str,
    found: Mapping[Any, Any],
    truths: Mapping[Any, Any] | None,
    classes: Sequence[str],
    boxes: bool,
) -> Iterator[Image]:
    names = list(dict.fromkeys([*found, *(truths or ())]))
    if len(names) > nocs.MOST_IMAGES:
        raise DataError(
            f"{where}: {len(names)} images, at most {nocs.MOST_IMAGES} are read; split it by scenes"
        )
    for name in names:
        if not isinstance(name, str) or not name:
            raise DataError(f"{where}: image {shown(name)}, expected scene_1/0000 or a path")
        here = f"{where}, image {shown(name)}"
        values = dict(_dict(found.get(name, _NOTHING), here))
        if truths is not None:
            values |= _dict(truths.get(name, {}), f"{here}, its truth")
        yield nocs.image_of(name_of_path(name), values, here, classes, boxes=boxes)
