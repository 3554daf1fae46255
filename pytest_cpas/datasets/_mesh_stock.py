"""Meshes of one's own as objects of the rendered scenes: read, checked, their symmetries found."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pytest_cpas.datasets._edges import told_edges, uneven_edges
from pytest_cpas.datasets._mesh_folder import TABLE, UNITS, Faults, File, MeshFolder
from pytest_cpas.datasets._rings import finish
from pytest_cpas.datasets._scenes import Model
from pytest_cpas.datasets._symmetries import find_symmetry, mismatch
from pytest_cpas.datasets.nocs import SYMMETRIC_CATEGORIES
from pytest_cpas.reading.meshes import read_mesh
from pytest_cpas.types import CATEGORIES, ContractError, Mesh

__all__ = ["MeshStock", "SymmetryOf", "read_models"]

#: Diagonals of what stands on the table and is held, metres.
SMALLEST, LARGEST = 0.05, 0.6

#: A box that is this many of its diagonals away from the origin has lost digits there.
_FAR = 100

#: Thinnest side of a box, metres.
_FLAT = 0.0005

#: Surfaces nearer to each other than this share of the diagonal are the same.
_ALIKE = 1e-4

#: So many objects stand on the table at once.
_ON_TABLE = 5


@dataclass(frozen=True)
class SymmetryOf:
    """An object's symmetry in words, where it is from, and how far the surface is then off itself
    at most, as a share of the diagonal; ``near``: what comes nearest to being one more."""

    text: str
    source: str
    off: float
    near: tuple[str, float] | None = None


class MeshStock:
    """What the scenes show: meshes of all categories in turn."""

    def __init__(self, models: Sequence[Model]) -> None:
        self._models = models

    def on_table(self, number: int) -> list[Model]:
        """The next few of all."""
        count = min(_ON_TABLE, len(self._models))
        return [self._turn((number - 1) * count + place) for place in range(count)]

    def in_hand(self, number: int) -> Model:
        """One after the other."""
        return self._turn(number - 1)

    def _turn(self, index: int) -> Model:
        return self._models[index % len(self._models)]


def read_models(folder: MeshFolder) -> tuple[list[Model], dict[str, SymmetryOf]]:
    """The objects of a folder, categories in turn, and their symmetries by name.

    Class ids count the categories from 1, in alphabetical order. Raises
    :class:`pytest_cpas.types.DataError` that tells what is wrong with any of the meshes.
    """
    categories = sorted({file.category for file in folder.files})
    meshes: dict[str, Mesh] = {}
    faults = Faults(folder.root)
    for file in folder.files:
        try:
            # rotations of whole axes: nothing is mirrored, and nothing rounded
            mesh = read_mesh(folder.root / file.path, file.axes)
        except ContractError as error:
            faults.add("read", file.path, str(error).partition(": ")[2])
            continue
        _check_mesh(file, mesh, faults)
        if not faults.of(file.path):
            meshes[file.path] = finish(mesh.vertices * file.unit, mesh.triangles)
    for (one, first), (other, second) in itertools.combinations(meshes.items(), 2):
        if not faults.of(other) and _alike(first, second):
            faults.add("alike", other, f"the same surface as {one}; remove one of them")
    faults.tell()
    models, symmetries = [], {}
    for file in folder.files:
        mesh = meshes[file.path]
        pattern = file.category if file.category in CATEGORIES else "band"
        models.append(Model(mesh, file.name, categories.index(file.category) + 1, pattern))
        symmetries[file.name] = _symmetry(file, mesh)
    by_class = [[m for m in models if m.class_id == n + 1] for n in range(len(categories))]
    turns = itertools.zip_longest(*by_class)
    return [model for turn in turns for model in turn if model is not None], symmetries


def _check_mesh(file: File, mesh: Mesh, faults: Faults) -> None:
    """Tell what is wrong with a mesh, in the units and axes of its file."""
    low, high = mesh.bounds
    sides, centre = np.abs(file.axes.T) @ (high - low), (low + high) / 2
    diagonal, distance = float(np.linalg.norm(sides)), float(np.linalg.norm(centre))
    seen = f"its box is {' x '.join(f'{side:.3g}' for side in sides)}"
    if "unit" not in file.said:
        told = f"{seen}, and no unit is said of it; {_likely_unit(diagonal)}"
        faults.add("unit", file.path, told)
    elif not SMALLEST <= diagonal * file.unit <= LARGEST:
        told = (
            f"{seen} of {file.said['unit']}, {diagonal * file.unit:.3g} m across; expected"
            f" {SMALLEST} to {LARGEST} m, what can stand on a table and be held;"
            f" {_likely_unit(diagonal)}"
        )
        faults.add("size", file.path, told)
    elif sides.min() * file.unit < _FLAT:
        faults.add("flat", file.path, f"{seen} of {file.said['unit']}, flat; expected a solid")
    if distance > _FAR * diagonal:
        told = (
            f"{seen}, and its centre is {distance:.3g} from the origin, where digits are lost; move"
            " it there and export it again"
        )
        faults.add("far", file.path, told)
    elif not file.said.get("open", False) and any(edges := uneven_edges(_rounded(mesh, diagonal))):
        inside = "What is inside would be seen, and shape metrics miss a part; close it"
        if not edges[0]:
            inside = "What is inside cannot be told; take out what is there twice"
        told = (
            f"its surface is not closed: {told_edges(*edges)}. {inside}, or, if it is to be so,"
            f" say open = true in {TABLE}"
        )
        faults.add("open", file.path, told)


def _likely_unit(diagonal: float) -> str:
    """The advice for a mesh that is so large, in the units of its file."""
    for unit in ("mm", "m", "cm"):
        if SMALLEST <= diagonal * UNITS[unit] <= LARGEST:
            return f'probably it is in {unit}: unit = "{unit}" in {TABLE}'
    return f"say how many metres one unit is: unit = 0.12 in {TABLE}"


def _rounded(mesh: Mesh, diagonal: float) -> Mesh:
    """With corners that differ by the last digits of a text put together."""
    step = 1e-6 * diagonal
    return Mesh(np.round(mesh.vertices / step), mesh.triangles)


def _alike(first: Mesh, second: Mesh) -> bool:
    """Whether two surfaces are the same, in any file format."""
    sides = [np.ptp(mesh.bounds, axis=0) for mesh in (first, second)]
    near = _ALIKE * float(np.linalg.norm(sides[0]))
    if np.abs(sides[0] - sides[1]).max() > near:
        return False
    # vertices alone: what has the same of them in another order is the same
    return all(
        np.max(cKDTree(a.vertices).query(b.vertices)[0]) <= near
        for a, b in ((first, second), (second, first))
    )


def _symmetry(file: File, mesh: Mesh) -> SymmetryOf:
    """As the table says; else as the field takes the category; else found."""
    said = file.said.get("symmetry")
    if said is None and file.category in SYMMETRIC_CATEGORIES:
        return SymmetryOf("y", "as the field takes the category", mismatch(mesh, "y"))
    if said is None or said == "found":
        found = find_symmetry(mesh)
        return SymmetryOf(found.text, "found", found.off, found.next_best)
    return SymmetryOf(said, "declared", mismatch(mesh, said))
