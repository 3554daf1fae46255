"""A map of categories: known objects as instances of categories, so that categorical methods run.

::

    [ycbv]                           # a data set's name, or the folder of one in BOP format
    source = "where this is known from"

    [ycbv.objects.14]                # the object's number in BOP, or its category in the data set
    name = "025_mug"                 # optional, for people
    category = "mug"
    up = "+z"                        # the model's axis that is up; of several the one that fits
    front = "handle"                 # the model's axis that is its front, or what finds it
    symmetry = "none"                # in the category's frame, as in samples.csv: y is up
    unsure = "what is not established about it"      # optional, told in every summary

An object that the map does not name is left out. The category's frame is ShapeNet's: y up, and -z
the front, where a mug has its handle, a camera its lens and a laptop its open side. An object that
is symmetric about y needs no front. A map cannot prove itself right, but a wrong axis is often seen
by the shape: seen along its up axis a can or a bowl is as wide as deep, a bottle is tallest along
it, and a mug's handle is in front.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_cpas.datasets._symmetries import parse_symmetry
from pytest_cpas.datasets.bop import object_name
from pytest_cpas.reading.numbers import whole
from pytest_cpas.reading.structured import read_toml
from pytest_cpas.types import (
    CATEGORIES,
    Array,
    DataError,
    Dataset,
    Derived,
    GroundTruth,
    Mesh,
    Sample,
    SampleRef,
    WrappedDataset,
    raised_as,
    shown,
    some_of,
)
from pytest_cpas.types.frames import permute_extents
from pytest_cpas.types.geometry import Pose

__all__ = [
    "CategorisedDataset",
    "MappedObject",
    "categories_file",
    "read_categories",
    "shipped_categories",
]

_ENDING = ".categories.toml"

_KEYS = ("name", "category", "up", "front", "symmetry", "unsure")

#: What finds a front: a mug's handle.
_HANDLE = "handle"

#: Sides of what is round may differ by that share, and a handle is that share of the box off its
#: middle, and so many times more than across.
_ROUND, _OFF, _CLEARLY = 0.1, 0.02, 3.0


@dataclass(frozen=True, kw_only=True)
class MappedObject:
    """An object's entry. ``up``: the axes of the model that may be up; ``front``: its front's, or
    "handle", or empty. The rest is as in the file."""

    category: str
    up: tuple[str, ...]
    symmetry: str
    front: str = ""
    name: str = ""
    unsure: str = ""


def shipped_categories() -> dict[str, Path]:
    """The maps that ship, by name."""
    files = sorted(Path(__file__).parent.glob(f"*{_ENDING}"))
    return {file.name.removesuffix(_ENDING): file for file in files}


def categories_file(path: Path) -> Path:
    """The file that ``path`` names, or the shipped map of that name; :class:`DataError` else."""
    shipped = shipped_categories()
    if path.is_file():
        return path
    if path.name not in shipped:
        raise DataError(
            f"--cpas-categories {path}: no such file, and no map that ships, which are"
            f" {', '.join(shipped)}"
        )
    return shipped[path.name]


@raised_as(DataError)
def read_categories(path: Path) -> dict[str, dict[str, MappedObject]]:
    """The maps in a file: per data set, objects by their category there.

    Raises :class:`DataError` that says what is wrong with which entry.
    """
    maps = {}
    for key, table in read_toml(path).items():
        where = f"{path}: [{key}]"
        objects = table.get("objects") if isinstance(table, dict) else None
        if not isinstance(objects, dict) or not objects or set(table) - {"source", "objects"}:
            raise DataError(f"{where}: expected source, a text, and [{key}.objects.NUMBER]")
        if not isinstance(table.get("source"), str) or not table["source"]:
            raise DataError(f"{where}: no source, expected a text that says whence this is known")
        maps[key] = {
            object_name(number) if (number := whole(name)) is not None else name: _entry(
                entry, f"{path}: [{key}.objects.{name}]"
            )
            for name, entry in objects.items()
        }
        if len(maps[key]) < len(objects):
            raise DataError(f"{where}: an object is there twice")
    return maps


def _entry(entry: Any, where: str) -> MappedObject:
    if not isinstance(entry, dict) or set(entry) - set(_KEYS):
        raise DataError(f"{where}: {shown(entry)}, expected some of {', '.join(_KEYS)}")
    texts = {**entry, "up": ""}
    if wrong := [key for key, value in texts.items() if not isinstance(value, str)]:
        raise DataError(f"{where}: {wrong[0]} is {shown(entry[wrong[0]])}, expected a text")
    if lacks := [key for key in ("category", "up", "symmetry") if not entry.get(key)]:
        raise DataError(f"{where}: it lacks {', '.join(lacks)}")
    given = entry["up"]
    up = tuple(given) if isinstance(given, list) else (given,)
    front = entry.get("front", "")
    for axis in (*up, *([front] if front not in ("", _HANDLE) else [])):
        if not isinstance(axis, str) or not re.fullmatch(r"[+-][xyz]", axis):
            raise DataError(
                f"{where}: axis {shown(axis)}, expected +x, -x, +y, -y, +z or -z; front may be"
                f" {_HANDLE!r}, and up a list of axes"
            )
    try:
        symmetry = parse_symmetry(entry["symmetry"])
    except DataError as error:
        raise DataError(f"{where}: {error}") from None
    if not front and (symmetry.axis is None or symmetry.axis[1] == 0):
        raise DataError(
            f"{where}: no front, which an object needs that is not symmetric about y; write"
            f' front = "{_across(up)}" (or another axis of the model: where a mug has its handle, a'
            " camera its lens, a laptop its open side)"
        )
    # what a sample may be called, and what not
    SampleRef(id=where, category=entry["category"], scene="")
    return MappedObject(**{**entry, "up": up})


def _across(up: Sequence[str]) -> str:
    """An axis that may be the front of what has one of these axes up."""
    return "+" + next((axis for axis in "xyz" if all(each[1] != axis for each in up)), "x")


def _axis(name: str) -> Array:
    axis: Array = np.eye(3)["xyz".index(name[1])]
    return axis if name[0] == "+" else -axis


class CategorisedDataset(WrappedDataset):
    """A data set of known objects, whose objects are instances of categories.

    Its poses, extents and surfaces are in the categories' frames.
    """

    def __init__(self, dataset: Dataset, path: Path) -> None:
        """Read the map; :class:`DataError` for one that is wrong, or that is not of the data set's
        objects."""
        super().__init__(dataset)
        objects = _of(dataset, path)
        self._original = {ref.id: ref for ref in dataset.samples if ref.category in objects}
        counts = Counter(ref.category for ref in dataset.samples)
        if not self._original:
            raise DataError(
                f"{path}: none of its objects, such as {some_of([*objects])}, is in {dataset.name},"
                f" whose objects are {some_of(sorted(counts))}"
            )
        self._objects = objects
        self._axes: dict[str, Array] = {}
        self.damaged = list(dataset.damaged)
        for name, ref in {ref.category: ref for ref in self._original.values()}.items():
            try:
                truth = dataset.truth(ref)
            except DataError as error:
                self.damaged.append(f"{name}, which {path.name} gives a category: {error}")
                continue
            self._axes[name] = _find_axes(objects[name], truth, f"{path}: {name}")
        self.samples = [
            replace(ref, category=objects[ref.category].category)
            for ref in self._original.values()
            if ref.category in self._axes
        ]
        self.absent = frozenset(dataset.absent) & {ref.id for ref in self.samples}
        self.name = f"{dataset.name}+categories"
        known = {name: asdict(entry) for name, entry in sorted(objects.items())}
        text = f"{dataset.digest} {json.dumps(known, sort_keys=True)}"
        self.digest = hashlib.sha256(text.encode()).hexdigest()
        categories = {ref.category for ref in self.samples}
        self.class_names = CATEGORIES if categories <= {*CATEGORIES} else sorted(categories)
        self.published_axes, self.published_centres = None, {}
        left_out = sorted(counts.keys() - objects.keys())
        if left_out:
            self.missing = [
                *dataset.missing,
                f"{sum(counts[name] for name in left_out)} samples of {len(left_out)} objects,"
                f" first {left_out[0]}, that {path.name} gives no category: left out",
            ]
        unsure = {o.unsure: n for n, o in objects.items() if o.unsure and n in self._axes}
        told = "".join(f"; not established, such as for {n}: {text}" for text, n in unsure.items())
        declared = Derived(
            part="symmetry",
            made_of=frozenset({"map of categories"}),
            how=f"by {path.name}, as are categories and the objects' axes{told}",
        )
        self.derived = [each for each in dataset.derived if each.part != "symmetry"] + [declared]

    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about one sample, in its category's frame."""
        original = self._original[ref.id]
        return self._turned(original, self._dataset.truth(original))

    def load(self, ref: SampleRef) -> Sample:
        """Read one sample; a method is told the category."""
        original = self._original[ref.id]
        sample = self._dataset.load(original)
        seen = replace(sample.observation, category=ref.category)
        return Sample(ref, seen, self._turned(original, sample.truth))

    def _turned(self, original: SampleRef, truth: GroundTruth) -> GroundTruth:
        axes, surface = self._axes[original.category], truth.surface
        if isinstance(surface, Mesh):
            surface = Mesh(surface.vertices @ axes.T, surface.triangles)
        elif surface is not None:
            surface = surface @ axes.T
        return GroundTruth(
            pose=Pose(truth.pose.rotation @ axes.T, truth.pose.translation),
            extents=permute_extents(truth.extents, axes),
            symmetry=parse_symmetry(self._objects[original.category].symmetry),
            surface=surface,
        )

    def image_of(self, ref: SampleRef) -> str:
        """The image that a sample is in."""
        return self._dataset.image_of(self._original[ref.id])

    def fit_error(self, ref: SampleRef) -> float | None:
        """How well a fitted pose fits, metres."""
        return self._dataset.fit_error(self._original[ref.id])

    def unseen(self, ref: SampleRef) -> str | None:
        """Why a method is not asked about a sample."""
        return self._dataset.unseen(self._original[ref.id])

    def box_of(self, ref: SampleRef) -> Array | None:
        """The 2-D box of what is seen of an object."""
        return self._dataset.box_of(self._original[ref.id])


def _of(dataset: Dataset, path: Path) -> Mapping[str, MappedObject]:
    """The map of a data set in a file."""
    maps = read_categories(path)
    for key, objects in maps.items():
        # a data set in BOP format is called bop-FOLDER-SPLIT
        if dataset.name == key or re.fullmatch(rf"bop-{re.escape(key)}-[^-]+", dataset.name):
            return objects
    folder = re.sub(r"^bop-(.+)-[^-]+$", r"\1", dataset.name)
    there = f"it has those of {', '.join(maps)}. Call the data set's folder so, or" if maps else ""
    raise DataError(
        f"{path}: no map of {dataset.name}; {there or 'there is no map in it;'}"
        f" write [{folder}] with [{folder}.objects.NUMBER], or leave out --cpas-categories"
    )


def _find_axes(entry: MappedObject, truth: GroundTruth, where: str) -> Array:
    """The rotation from an object's model to its category's frame, checked by its shape."""
    where = f"{where} ({entry.name or entry.category})"
    fits = [up for up in entry.up if _stands(entry.category, truth.extents, up)]
    if len(fits) != 1:
        size = " x ".join(f"{1000 * side:.0f}" for side in truth.extents)
        seen = f"{' and '.join(fits)} fit" if fits else "it is not what the category would show"
        others = [
            f"+{axis}" for axis in "xyz" if _stands(entry.category, truth.extents, f"+{axis}")
        ]
        advice = (
            f"copy the map and write the axis that is up, such as"
            f' up = "{(fits or others)[0]}", then --cpas-categories FILE'
            if fits or others
            else "on none of its axes would this one be: is it of that category?"
        )
        raise DataError(
            f"{where}: up is {' or '.join(entry.up)}, and its box is {size} mm (x, y, z):"
            f" {seen}. Seen from above, a can or a bowl is as wide as deep, and a bottle is"
            f" tallest along its up axis; {advice}"
        )
    y, front = _axis(fits[0]), entry.front
    if front == _HANDLE:
        z = -_handle(truth, y, where)
    elif front:
        z = -_axis(front)
    else:
        z = np.roll(y, 1)
    if abs(y @ z) > 0:
        raise DataError(f"{where}: front is {front}, and up {fits[0]}, expected another axis")
    return np.stack([np.cross(y, z), y, z])


def _stands(category: str, extents: Array, up: str) -> bool:
    """Whether an object of this box (3,) can stand on that axis."""
    along = "xyz".index(up[1])
    across = np.delete(extents, along)
    if category in ("can", "bowl"):
        return bool(np.ptp(across) <= _ROUND * across.max())
    return category != "bottle" or bool(extents[along] > across.max())


def _handle(truth: GroundTruth, up: Array, where: str) -> Array:
    """The horizontal axis (3,) of a model on which its handle is: away from most of the surface."""
    beside = "+" + "xyz"[int(np.flatnonzero(up == 0)[0])]
    if not isinstance(truth.surface, Mesh):
        raise DataError(
            f"{where}: its handle is to be found, and there is no mesh of it; fetch the models, or"
            f' write front = "{beside}" or another axis'
        )
    corners = truth.surface.vertices[truth.surface.triangles]
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    mean = (areas[:, None] * corners.mean(axis=1)).sum(axis=0) / areas.sum()
    off = np.where(up == 0, mean / truth.extents, 0)
    axis = int(np.abs(off).argmax())
    across = np.abs(np.delete(off, axis)).max()
    if abs(off[axis]) < max(_OFF, _CLEARLY * across):
        raise DataError(
            f"{where}: no handle is found: the middle of its surface is {off.round(3).tolist()} of"
            f' its box from the middle of that; write front = "{beside}" or another axis'
        )
    return -_axis(("+" if off[axis] > 0 else "-") + "xyz"[axis])
