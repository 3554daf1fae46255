"""One pickled list with the dict of each image, in the keys of NOCS's form.

``pred_result.pkl`` of Lynne-Zheng-Linfang/HS-Pose (2023; 8bfc2ff), lolrudy/GPV_Pose (5828345) and
lolrudy/RBP_Pose (adf0741), also called ``pred_result_coord.pkl`` and ``pred_result_recon.pkl``
there, and of ziqin-h/GIVEPose (653fe1a), each written by ``evaluation/evaluate.py``. A dict is that
of the detections which the method was given, so that it has ``gt_class_ids`` and so on as well,
and ``image_path``, such as ``data/real/test/scene_1/0000``, where those had it; ``pred_RTs``
(m, 4, 4) and ``pred_scales`` (m, 3) are added. HS-Pose, GPV-Pose and RBP-Pose write poses without a
scale beside sizes in metres, GIVEPose a scale beside sizes relative to it: the product is the
extents in metres in both. Other keys, such as ``recon_model``, are not looked at.

Images that the method skipped are not in the list. Where no dict has ``image_path``, images are
taken in the data set's order, which is compared with the truth in the list.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pytest_cpas.submissions import nocs
from pytest_cpas.submissions.frames import Image, Submission
from pytest_cpas.types import DataError

__all__ = ["images", "name_of_path", "read"]

#: Keys under which a dict may name its image.
_NAMES = ("image_path", "img_path", "image_name", "file_name", "image_id")

#: Folders and ends of names that say of which kind an image is.
_KINDS = r"(?:rgb|colou?r|depth|image|images|label|mask)"


def read(path: Path, frames: Sequence[Any], classes: Sequence[str]) -> Submission:
    """The list of a pickle; :class:`DataError` naming the file and the frame that is damaged."""
    return nocs.submission(path, "list of frames", images(path, frames, classes), classes)


def images(path: Path, frames: Sequence[Any], classes: Sequence[str]) -> Iterator[Image]:
    """The images of a list; raises as :func:`read`."""
    if not frames:
        raise DataError(f"{path}: an empty list, expected the dict of each image")
    if len(frames) > nocs.MOST_IMAGES:
        raise DataError(
            f"{path}: {len(frames)} frames, at most {nocs.MOST_IMAGES} are read; split it by scenes"
        )
    for number, values in enumerate(frames):
        where = f"{path}, frame {number}"
        if not isinstance(values, dict):
            raise DataError(
                f"{where}: a {type(values).__name__}, expected a dict with pred_RTs and so on"
            )
        yield nocs.image_of(_name(values, where), values, where, classes)


def _name(values: Mapping[str, Any], where: str) -> str:
    """The image that a dict names; empty where it names none."""
    for key in _NAMES:
        given = values.get(key)
        if isinstance(given, list | tuple) and len(set(map(str, given))) == 1:
            given = given[0]  # once for each object
        if isinstance(given, str) and given:
            return name_of_path(given)
        if given is not None:
            raise DataError(
                f"{where}: {key} is a {type(given).__name__}, expected the image's path"
            )
    return ""


def name_of_path(path: str) -> str:
    """Scene and image, such as ``scene_1/0000``, out of the path of an image's file."""
    parts = [part for part in re.split(r"[/\\]+", path) if part]
    parts = [part for part in parts[:-1] if not re.fullmatch(_KINDS, part)] + parts[-1:]
    stem = re.sub(r"(\.[A-Za-z]+)?$", "", parts[-1]) if parts else ""
    stem = re.sub(rf"_{_KINDS}$", "", stem)
    return "/".join([*parts[-2:-1], stem])
