"""The meta files of NOCS's frames: which objects there are."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from pytest_cpas.types import DataError


class Listed(NamedTuple):
    """A line of a frame's meta file, which of the frame's poses is its, and how many there are.

    ``model`` is empty and ``mask_id`` -1 where there is no meta file. ``doubt``: why it cannot be
    told which pose is its.
    """

    mask_id: int
    category: str
    model: str
    pose_index: int
    poses: int
    doubt: str = ""


def read_meta(frame: str, text: str, columns: str, classes: Sequence[str]) -> list[Listed]:
    """The objects in the text of a frame's meta file, whose lines have these ``columns``, and whose
    class ids count ``classes`` from 1.

    Distractors are left out. Raises :class:`DataError`.
    """
    # a model's name becomes part of a path
    model = r" ((?!\.)[^\s/\\]+)" * (len(columns.split()) - 2)
    form = re.compile(r"([0-9]{1,9}) ([0-9]{1,9})" + model)
    if not text.strip():
        raise DataError(f"{frame}_meta.txt: it is empty, expected {columns!r} in each line")
    entries = []
    for line in filter(str.strip, text.split("\n")):
        match = form.fullmatch(" ".join(line.split()))
        if not match or int(match[2]) > len(classes) or int(match[1]) > 254:
            raise DataError(
                f"{frame}_meta.txt: line {line!r}, expected {columns!r} with a"
                f" mask id of 0 to 254 and a class id of 0 to {len(classes)}"
            )
        if int(match[2]) > 0:
            model = "/".join(match.groups()[2:])
            entries.append((int(match[1]), classes[int(match[2]) - 1], model))
    if len({mask_id for mask_id, _, _ in entries}) < len(entries):
        raise DataError(f"{frame}_meta.txt: a mask id occurs twice")
    count = len(entries)
    return [Listed(*entry, index, count) for index, entry in enumerate(sorted(entries))]


def truth_path(frame: str) -> str:
    """Where a frame's poses are."""
    return f"gts/real_test/results_real_test_{frame.replace('/', '_')}.pkl"


def extents_path(split: str, model: str) -> str:
    """Where a model's side lengths are."""
    return f"obj_models/{split}/{model}.txt"
