"""The parts of NOCS's data sets, wherever somebody has them: found by what is in them, and linked
to where they are published."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pytest_cpas.reading.paths import names
from pytest_cpas.types import DataError

__all__ = ["LINKABLE", "link"]

#: Folders below the one that is named, deep.
_DEEP = 6

#: Names of a folder that are looked at, to see what it is.
_LOOKED_AT = 200


@dataclass(frozen=True)
class _Part:
    """A folder of a data set: where it is published, how it is known, and whether nothing can be
    done without it.

    ``word``: one that its path has, ``but``: one that it has not; ``holds``: whether a folder with
    these names is one.
    """

    published: str
    word: str
    holds: Callable[[Path, Sequence[str]], bool]
    needed: bool = True
    but: str = "-"

    def is_at(self, folder: Path, within: Path, there: Sequence[str]) -> bool:
        path = "/".join([within.name, *folder.relative_to(within).parts])
        words = re.split(r"[^a-z]+", path.lower())
        return self.word in words and self.but not in words and self.holds(folder, there)


def _frames(scene: str, kind: str) -> Callable[[Path, Sequence[str]], bool]:
    def holds(folder: Path, there: Sequence[str]) -> bool:
        scenes = (name for name in there if re.fullmatch(scene, name))
        first = next(scenes, None)
        return first is not None and any(
            re.fullmatch(rf"\d+_{kind}", name) for name in names(folder / first)
        )

    return holds


def _files(pattern: str) -> Callable[[Path, Sequence[str]], bool]:
    return lambda _, there: any(re.fullmatch(pattern, name) for name in there)


def _synsets(folder: Path, there: Sequence[str]) -> bool:
    for synset in (name for name in there if re.fullmatch(r"\d{8}", name)):
        models = sorted(names(folder / synset))
        return any("model.obj" in names(folder / synset / model) for model in models[:5])
    return False


_REAL_FRAMES = _frames(r"scene_\d+", r"meta\.txt")
#: Those of CAMERA have a folder each, in which they are called model.obj.
_REAL_MODELS = _files(r"(?!model\.obj).*\.obj")

#: The parts of each data set that can be linked.
LINKABLE: Mapping[str, Sequence[_Part]] = {
    "real275": (
        _Part("real_test", "test", _REAL_FRAMES),
        _Part("gts/real_test", "test", _files(r"results_real_test_.*\.pkl")),
        _Part("obj_models/real_test", "test", _REAL_MODELS, but="fixed"),
        _Part("fixed_real_test_obj_models", "fixed", _REAL_MODELS, needed=False),
    ),
    "real_train": (
        _Part("real_train", "train", _REAL_FRAMES),
        _Part("obj_models/real_train", "train", _REAL_MODELS),
    ),
    "camera25": (
        _Part("val", "val", _frames(r"\d{5}", r"meta\.txt")),
        _Part("camera_full_depths/val", "val", _frames(r"\d{5}", r"composed\.png")),
        _Part("obj_models/val", "val", _synsets),
    ),
}


def link(folder: Path, name: str, to: Path) -> list[str]:
    """Find the parts of the data set ``name`` below ``folder``, and link them in ``to`` where they
    are published; a line for each.

    Raises :class:`DataError`, and then nothing is made, for a data set that is none of
    :data:`LINKABLE`, for parts that are not there or twice, and where something else is in the way;
    :class:`OSError` for what cannot be written.
    """
    if name not in LINKABLE:
        raise DataError(
            f"{name}: expected one of {', '.join(LINKABLE)}; other data sets are read as they are"
            " published"
        )
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder")
    parts = LINKABLE[name]
    found: dict[str, list[Path]] = {part.published: [] for part in parts}
    for place, there in _folders(folder.resolve()):
        for part in parts:
            if part.is_at(place, folder.resolve(), there):
                found[part.published].append(place)
    told = []
    for part in parts:
        places = found[part.published]
        if len(places) > 1:
            raise DataError(
                f"{part.published} of {name} may be {' or '.join(map(str, places))}; name a folder"
                " that holds one of them"
            )
        if not places and part.needed:
            raise DataError(
                f"{folder}: nothing below it, {_DEEP} folders deep, is {part.published} of {name}"
                f" (a folder with {part.word!r} in its path)"
            )
        if not places:
            told.append(f"{part.published}: not there; the data set can do without it")
    made = {to / published: places[0] for published, places in found.items() if places}
    for path, place in made.items():
        if os.path.lexists(path) and path.resolve() != place:
            raise DataError(f"{path}: something else is there; name another folder with --to")
    for path in made:
        first = next(each for each in path.parents if os.path.lexists(each))
        if not first.is_dir():
            raise DataError(f"{first}: it is no folder; name another one with --to")
    for path, place in made.items():
        if not os.path.lexists(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.symlink_to(place, target_is_directory=True)
        told.append(f"{path} -> {place}")
    return told


def _folders(root: Path) -> Iterator[tuple[Path, Sequence[str]]]:
    """All folders, and what some of them have; links are not followed."""
    level = [root]
    for _ in range(_DEEP):
        below = []
        for folder in level:
            there = sorted(names(folder))
            yield folder, there
            if len(there) <= _LOOKED_AT or folder == root:
                paths = (folder / name for name in there)
                below += [path for path in paths if path.is_dir() and not path.is_symlink()]
        level = below
