"""Meshes of one's own, rendered as ``synthetic-tabletop`` and ``synthetic-handheld`` are.

::

    DIR/CATEGORY/NAME.{obj,off,ply,stl}
    DIR/meshes.toml      units, up axes, fronts, symmetries

``synthetic:DIR`` is both data sets, ``synthetic-tabletop:DIR`` and ``synthetic-handheld:DIR``; in
tables they are called ``synthetic-tabletop-NAME`` and ``synthetic-handheld-NAME``, with the name in
the table, or that of the folder. On the table stand up to five objects at a time, in at least 6
scenes of 5 frames, every one in at least two of them; held is every one in 7 frames or, of less
than 18, in several times 7, so that there are about 126 images at least.

They are made on first use, and again when the bytes of a mesh, the table or the code that renders
have changed. The digest is that of what was made, so that what changes no pixel, pose, mesh or
symmetry makes no other data set.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from pytest_cpas._files import write_file
from pytest_cpas.datasets import _edges, _mesh_folder, _mesh_stock, _symmetries
from pytest_cpas.datasets._mesh_folder import MeshFolder
from pytest_cpas.datasets._mesh_stock import MeshStock, SymmetryOf, read_models
from pytest_cpas.datasets._symmetries import TOLERANCE, parse_symmetry
from pytest_cpas.datasets.nocs import NocsTree
from pytest_cpas.datasets.synthetic import HANDHELD, TABLETOP, Split, cached, generate, recipe
from pytest_cpas.reading.files import read_text
from pytest_cpas.reading.structured import read_json
from pytest_cpas.types import DataError, SampleRef, Symmetry

__all__ = ["OwnHandheld", "OwnMeshes", "OwnTabletop"]

#: What is known of the objects, beside the frames.
_MODELS = "models.json"

#: So many objects are named in a line.
_NAMED = 10


class OwnTree(NocsTree):
    """One split of a folder of meshes, in the cache; see the module's docstring."""

    split: ClassVar[Split]
    all_derived = ()

    def __init__(self, data_dir: Path) -> None:
        """Read the folder, and render what is not in the cache.

        Raises :class:`FileNotFoundError` and :class:`DataError` that tell what is wrong with it.
        """
        folder = MeshFolder(data_dir)
        split = dataclasses.replace(
            self.split, name=f"{self.split.name}-{folder.name}", scenes=self._scenes(folder)
        )

        def make(place: Path) -> None:
            models, symmetries = read_models(folder)
            generate(dataclasses.replace(split, stock=MeshStock(models)), place)
            folder.check_unchanged()
            described = {name: dataclasses.asdict(found) for name, found in symmetries.items()}
            write_file(place / _MODELS, json.dumps(described))

        code = (_edges, _mesh_folder, _mesh_stock, _symmetries)
        root = cached(split.name, f"{folder.key}-{recipe(*code)}", make)
        self._symmetries = {
            name: SymmetryOf(**values) for name, values in read_json(root / _MODELS).items()
        }
        self.class_names = sorted({file.category for file in folder.files})
        self._categories = {file.name: file.category for file in folder.files}
        super().__init__(split.name, root, split.camera)
        told = [f"{name} {found.text}" for name, found in sorted(self._symmetries.items())]
        content = read_text(root / "digest.txt")
        text = "\n".join([content, *self.class_names, *told])
        self.digest = hashlib.sha256(text.encode()).hexdigest()

    @classmethod
    def _scenes(cls, folder: MeshFolder) -> int:
        """How many scenes show every mesh often enough."""
        raise NotImplementedError

    @property
    def known_as(self) -> str:
        """Whose known faults are also this one's: those of the split, whatever the meshes are."""
        return self.split.name

    @property
    def notes(self) -> Sequence[str]:
        """The symmetries of the objects, and which of them no frame shows well."""
        groups: dict[tuple[str, str, str], list[str]] = defaultdict(list)
        for name, found in self._symmetries.items():
            groups[self._categories[name], found.text, found.source].append(_told(name, found))
        lines = [
            "symmetries, and by how much of the box's diagonal each brings a surface off itself at"
            f" most; where they are looked for, {_percent(TOLERANCE)} counts"
        ]
        for (category, text, source), members in sorted(groups.items()):
            more = f", and {len(members) - _NAMED} more" if len(members) > _NAMED else ""
            lines.append(f"{category}: {text}, {source}: {', '.join(members[:_NAMED])}{more}")
        if unseen := sorted(self._symmetries.keys() - {ref.model for ref in self.samples}):
            lines.append(f"no frame shows these well, so they are not judged: {', '.join(unseen)}")
        return lines

    def _symmetry(self, ref: SampleRef) -> Symmetry:
        return parse_symmetry(self._symmetries[ref.model].text)


def _told(name: str, found: SymmetryOf) -> str:
    if found.near is None:
        return f"{name} {_percent(found.off)}"
    text, off = found.near
    return f"{name} {_percent(found.off)} (next {text}, {_percent(off)})"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


class OwnTabletop(OwnTree):
    """Upright objects on a table."""

    split = TABLETOP

    @classmethod
    def _scenes(cls, folder: MeshFolder) -> int:
        return max(cls.split.scenes, math.ceil(2 * len(folder.files) / 5))


class OwnHandheld(OwnTree):
    """One freely turned object in a hand."""

    split = HANDHELD

    @classmethod
    def _scenes(cls, folder: MeshFolder) -> int:
        count = len(folder.files)
        return count * math.ceil(cls.split.scenes / count)


class OwnMeshes:
    """Both of them, where several data sets can be named."""

    #: The data sets that ``synthetic:DIR`` stands for.
    splits = (TABLETOP.name, HANDHELD.name)

    def __init__(self, data_dir: Path | None) -> None:
        """Raises :class:`FileNotFoundError` without a folder, and :class:`DataError` that says how
        each of the two is named."""
        if data_dir is None:
            raise FileNotFoundError(
                "synthetic is made of meshes of your own; name their folder: synthetic:DIR"
                " (docs/own-meshes.md)"
            )
        one, other = (f"{split}:{data_dir}" for split in self.splits)
        raise DataError(
            f"synthetic:{data_dir} is two data sets, and one is wanted here; name {one} or {other}"
            " (docs/own-meshes.md)"
        )
