"""A folder of meshes of one's own, with the table that says in which units and axes they are.

``docs/own-meshes.md`` describes both, with an example. What is wrong is told of all meshes at once.
"""

from __future__ import annotations

import difflib
import hashlib
import os
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pytest_cpas.datasets._symmetries import EXPECTED, parse_symmetry
from pytest_cpas.reading.files import read_bytes
from pytest_cpas.reading.paths import names, natural
from pytest_cpas.reading.structured import read_toml
from pytest_cpas.types import Array, ContractError, DataError, SampleRef, shown
from pytest_cpas.types.names import checked_name

__all__ = ["TABLE", "Faults", "File", "MeshFolder"]

TABLE = "meshes.toml"

#: Metres.
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254}

_FORMATS = (".obj", ".off", ".ply", ".stl")

#: Formats of CAD and graphics that are not read.
_OTHERS: tuple[str, ...] = (
    ".3ds",
    ".3mf",
    ".blend",
    ".dae",
    ".fbx",
    ".glb",
    ".gltf",
    ".iges",
    ".igs",
    ".step",
)
_OTHERS += (".stp", ".usd", ".usdz", ".wrl", ".x3d", ".x_t")


_KEYS = ("unit", "up", "front", "symmetry", "open")

#: Where an object that has no other front looks, by its up axis: what ShapeNet and Blender mean.
_FRONTS = {"y": "-z", "z": "-y", "x": "-z"}

#: Categories whose front is told by something: which way the methods of the field expect it.
FRONT_IS = {
    "camera": "the lens points to",
    "laptop": "the keyboard opens to",
    "mug": "the handle points to",
}

#: Largest file, bytes: as much as :func:`pytest_cpas.reading.meshes.read_mesh` reads.
_LARGEST = 2**28

#: So many meshes are named.
_NAMED = 3


@dataclass(frozen=True)
class File:
    """A mesh of the folder: its path below it, its category, what it is called, and what the table
    says of it by key."""

    path: str
    category: str
    name: str
    said: Mapping[str, Any]

    @property
    def unit(self) -> float:
        """Metres of one unit."""
        unit = self.said["unit"]
        return float(UNITS[unit] if isinstance(unit, str) else unit)

    @property
    def axes(self) -> Array:
        """The rotation (3, 3) from the file's axes to ours: y up, the front towards -z."""
        up = _axis(self.said["up"])
        front = _axis(self.said.get("front", _FRONTS[self.said["up"][-1]]))
        return np.stack([np.cross(up, -front), up, -front])


class Faults:
    """What is wrong, of each kind with all meshes that it is said of."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._of_kind: dict[str, list[tuple[str, str]]] = defaultdict(list)

    def add(self, kind: str, where: str, text: str) -> None:
        """``where``: the path below the folder."""
        self._of_kind[kind].append((where, text))

    def of(self, where: str) -> bool:
        """Whether something is wrong with a mesh."""
        return any(where == at for found in self._of_kind.values() for at, _ in found)

    def tell(self) -> None:
        """Raise :class:`DataError` if there is any."""
        if not self._of_kind:
            return
        lines = []
        for found in self._of_kind.values():
            for where, text in found[:_NAMED]:
                lines.append(f"{self._root / where}: {text}")
            if len(found) > _NAMED:
                lines.append(f"and {len(found) - _NAMED} more like these")
        raise DataError("\n".join(lines))


class MeshFolder:
    """The meshes of a folder: ``name`` for its data sets, ``files``, and a digest ``key`` of the
    bytes of meshes and table."""

    def __init__(self, root: Path) -> None:
        """List the meshes; none is parsed.

        Raises :class:`FileNotFoundError` where there is no folder, :class:`DataError` for one that
        has no meshes, for a table that is wrong, and for what is in the wrong place.
        """
        if not root.is_dir():
            raise FileNotFoundError(
                f"{root}: no such folder; expected one with a folder per category, such as"
                f" {root.name}/mug/a.obj, and a table {root.name}/{TABLE} (docs/own-meshes.md)"
            )
        self.root = root
        faults = Faults(root)
        found = self._listed(faults)
        faults.tell()
        if not found:
            raise DataError(
                f"{root}: no meshes; expected a folder per category with files of"
                f" {', '.join(_FORMATS)}, such as {root.name}/mug/a.obj"
            )
        table = self._table([path for path, _ in found])
        self.name = _data_set_name(root, table)
        self.files = [
            File(path, category, name, _said(table, path, category))
            for path, category, name in _named(found, faults)
        ]
        for file in self.files:
            _check_said(file, faults)
        faults.tell()
        self.key = self._key()

    def check_unchanged(self) -> None:
        """Raise :class:`DataError` if meshes or table have changed since they were listed."""
        if self._key() != self.key:
            raise DataError(f"{self.root}: its files changed while they were read; run it again")

    def _key(self) -> str:
        digest = hashlib.sha256(self.name.encode())
        listed = [file.path for file in self.files]
        for path in [TABLE, *listed] if TABLE in names(self.root) else listed:
            content = read_bytes(self.root / path, _LARGEST)
            digest.update(os.fsencode(f"{path}\0{len(content)}\0") + content)
        return digest.hexdigest()[:12]

    def _listed(self, faults: Faults) -> list[tuple[str, str]]:
        """Paths and categories of the meshes, in order."""
        found = []
        for category in sorted(names(self.root), key=natural):
            place = self.root / category
            if category.startswith("."):
                continue
            if not place.is_dir():
                if _kind(category) in (*_FORMATS, *_OTHERS):
                    faults.add(
                        "place", category, "it is in no category; move it to a folder that is"
                        f" called as its category: {self.root.name}/mug/{category}"
                    )  # fmt: skip
                continue
            if self._leads_out(place, faults, category):
                continue
            meshes = []
            for name in sorted(names(place), key=natural):
                path = f"{category}/{name}"
                if name.startswith("."):
                    continue
                if _kind(name) in _OTHERS:
                    faults.add(
                        "format", path, f"{_kind(name)} is not read; export it as"
                        f" {', '.join(_FORMATS)}"
                    )  # fmt: skip
                elif _kind(name) in _FORMATS:
                    if not self._leads_out(place / name, faults, path):
                        meshes.append((path, category))
                elif (inner := _mesh_below(place / name)) is not None:
                    faults.add(
                        "place", f"{path}/{inner}", f"meshes lie directly in the folder of their"
                        f" category; move it to {self.root.name}/{category}/{Path(inner).name}"
                    )  # fmt: skip
            found += meshes
            if meshes:
                try:
                    SampleRef(id="any", category=category, scene="")
                except ContractError as error:
                    faults.add("category", category, str(error).partition(": ")[2])
        return found

    def _leads_out(self, place: Path, faults: Faults, path: str) -> bool:
        """Whether a link leads out of the folder, which is then told."""
        target = Path(os.path.realpath(place))  # of a link to itself, itself
        if target.is_relative_to(os.path.realpath(self.root)):
            return False
        faults.add("link", path, f"it leads to {target}, out of {self.root}; copy it there")
        return True

    def _table(self, paths: Sequence[str]) -> Mapping[str, Any]:
        """The table, of which every part is about something that is there."""
        if TABLE not in names(self.root):
            return {}
        path, faults = self.root / TABLE, Faults(self.root)
        self._leads_out(path, faults, TABLE)
        faults.tell()
        table = read_toml(path)
        known = ("name", *_KEYS, "category", "mesh")
        categories = sorted({each.split("/")[0] for each in paths})
        _check_keys(f"{path}", table, known)
        for part, there in (("category", categories), ("mesh", sorted(paths))):
            if not isinstance(table.get(part, {}), dict):
                raise DataError(
                    f'{path}: {part} is {shown(table[part])}, expected a table: [{part}."NAME"]'
                )
            for name, values in table.get(part, {}).items():
                where = f"{path}: [{part}.{name}]"
                if name not in there:
                    raise DataError(
                        f"{where}: there is no such {part}.{_meant(name, there)} There are"
                        f" {', '.join(there[:10])}{' and more' if len(there) > 10 else ''}"
                    )
                if not isinstance(values, dict):
                    raise DataError(f"{where}: {shown(values)}, expected a table of {_KEYS}")
                _check_keys(where, values, _KEYS)
        return table


def _kind(name: str) -> str:
    return os.path.splitext(name)[1].lower()


def _mesh_below(folder: Path) -> str | None:
    """The first mesh anywhere below a folder."""
    for place, _, files in os.walk(folder):
        for name in sorted(files):
            if not name.startswith(".") and _kind(name) in _FORMATS:
                return (Path(place) / name).relative_to(folder).as_posix()
    return None


def _check_keys(where: str, table: Mapping[str, Any], known: Sequence[str]) -> None:
    for key in table:
        if key not in known:
            raise DataError(
                f"{where}: {shown(key)} is not known.{_meant(key, known)} Known are"
                f" {', '.join(known)}"
            )


def _meant(name: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(name.lower(), known, n=1)
    return f" Did you mean {close[0]!r}?" if close else ""


def _data_set_name(root: Path, table: Mapping[str, Any]) -> str:
    """What the data sets of a folder are called behind their kind: letters, digits, ., _ and -."""
    if "name" not in table:
        name = re.sub(r"[^A-Za-z0-9._-]", "-", root.resolve().name)
    elif isinstance(table["name"], str):
        name = table["name"]
    else:
        raise DataError(f"{root / TABLE}: name is {shown(table['name'])}, expected a text")
    try:
        checked_name("data set", name)
    except ContractError as error:
        raise DataError(
            f'{error}; give the folder\'s data sets a name in {root / TABLE}: name = "parts"'
        ) from None
    if "+" in name:  # by which perturbed data sets are told
        raise DataError(f"{root / TABLE}: name is {shown(name)}, expected one without '+'")
    return name


def _named(found: Sequence[tuple[str, str]], faults: Faults) -> list[tuple[str, str, str]]:
    """Paths, categories, and names of which no two are the same, also where case does not count."""
    named = []
    seen: dict[str, str] = {}
    for path, category in found:
        stem = Path(path).stem
        name = re.sub(r"[^A-Za-z0-9._-]", "-", f"{category}_{stem}")
        earlier = seen.setdefault(name.lower(), path)
        if earlier != path:
            faults.add(
                "name", path, f"it would be called {name}, as {earlier} is; rename one of them"
            )  # fmt: skip
        named.append((path, category, name))
    return named


def _said(table: Mapping[str, Any], path: str, category: str) -> Mapping[str, Any]:
    """What the table says of a mesh: itself, else of its category, else of all."""
    levels = (table, table.get("category", {}).get(category, {}), table.get("mesh", {}).get(path))
    return {key: level[key] for level in levels if level for key in _KEYS if key in level}


def _check_said(file: File, faults: Faults) -> None:
    """What can be told without the mesh; that no unit is said is told with the mesh's size."""
    said = file.said

    def wrong(key: str, expected: str) -> None:
        seen = f"{key} is {shown(said[key])}" if key in said else f"no {key} is said of it"
        faults.add(key, file.path, f"{seen}; expected {expected} in {TABLE}")

    unit = said.get("unit", 1.0)
    metres = UNITS.get(unit, 0.0) if isinstance(unit, str) else unit
    number = isinstance(metres, int | float) and not isinstance(metres, bool)
    if not number or not 1e-9 <= metres <= 1e3:
        wrong("unit", f"one of {', '.join(UNITS)}, or metres as a number,")
    axes = [sign + axis for sign in ("", "-") for axis in "xyz"]
    up = said.get("up")
    if up not in axes:
        wrong("up", f'which of its axes points up, one of {", ".join(axes)}: up = "z"')
    elif "front" in said:
        across = [axis for axis in axes if axis[-1] != up[-1]]
        if said["front"] not in across:
            wrong("front", f"an axis across up, one of {', '.join(across)},")
    elif file.category in FRONT_IS and not str(said.get("symmetry", "")).startswith("y"):
        wrong("front", f'the axis that {FRONT_IS[file.category]}: front = "{_FRONTS[up[-1]]}"')
    if "symmetry" in said and said["symmetry"] != "found":
        try:
            parse_symmetry(str(said["symmetry"]))
        except ContractError:
            wrong("symmetry", f"found, {EXPECTED},")
    if not isinstance(said.get("open", False), bool):
        wrong("open", "true or false")


def _axis(text: str) -> Array:
    unit: Array = np.eye(3)["xyz".index(text[-1])]
    return -unit if text.startswith("-") else unit
