"""The models of a data set in BOP format: what describes them, and their meshes."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pytest_cpas.datasets._values import list_of, rotation_of
from pytest_cpas.reading.files import read_bytes
from pytest_cpas.reading.meshes import read_mesh
from pytest_cpas.reading.numbers import numbers, whole
from pytest_cpas.reading.structured import parse_json
from pytest_cpas.types import Array, ContractError, DataError, Mesh, Symmetry, shortened

#: What a model's mesh may be, the format's own first.
MODEL_FILES = (".ply", ".obj")

#: Share of an object's diagonal by which the box of its OBJ file may differ from the described one.
_SAME_BOX = 0.01

_MODELS = ("models_eval", "models", "models_cad")

HOW = """\
A data set in BOP format is named with its folder, --cpas-dataset bop:DIR, or with one of its \
splits, bop:DIR/SPLIT. DIR has models_eval/ or models/ with models_info.json, and splits such as \
test/ with scenes 000001/, ... (https://bop.felk.cvut.cz/datasets)"""


class Model(NamedTuple):
    """An object: centre (3,) and side lengths (3,) of its box, metres, and its symmetry."""

    centre: Array
    extents: Array
    symmetry: Symmetry


def read_models(path: Path) -> tuple[dict[int, Model], list[str]]:
    """The objects of a ``models_info.json`` by number, and what is wrong with the others."""
    models, damaged = {}, []
    for key, info in parse_json(path, read_bytes(path)).items():
        try:
            number = whole(key)
            if number is None or not isinstance(info, dict):
                raise DataError("expected a number, and min_x, size_x, ...")
            if number in models:
                raise DataError(f"number {number} is there twice")
            models[number] = _model(info)
        except ContractError as error:
            damaged.append(f"{path}: object {shortened(key, 30)}: {error}")
    return models, damaged


def _model(info: dict[str, Any]) -> Model:
    """An entry of ``models_info.json``, whose lengths are millimetres."""
    low = numbers([info.get(f"min_{axis}") for axis in "xyz"], (3,), "min_x, min_y, min_z") / 1000
    size = numbers([info.get(f"size_{axis}") for axis in "xyz"], (3,), "size_x, size_y, size_z")
    if (size <= 0).any():
        raise DataError(f"size is {size.tolist()}, expected positive millimetres")
    discrete = _given(info, "symmetries_discrete")
    rotations = [np.eye(3)]
    rotations += [rotation_of(s, "symmetries_discrete") for s in discrete]
    axes = [
        numbers(s.get("axis") if isinstance(s, dict) else s, (3,), "symmetries_continuous")
        for s in _given(info, "symmetries_continuous")
    ]
    symmetry = (
        Symmetry.full()  # two axes generate all rotations
        if len(axes) > 1
        else Symmetry(np.stack(rotations), axes[0] if axes else None)
    )
    return Model(low + size / 2000, size / 1000, symmetry)


def read_model_mesh(path: Path, model: Model) -> Mesh:
    """The mesh of a model, metres, its box centred on the origin.

    A PLY file is in millimetres, as the format has it. What an OBJ file is in is said by nothing
    but its box: it must be the one that ``models_info.json`` describes, in millimetres or in
    metres. Raises :class:`DataError`.
    """
    mesh = read_mesh(path)
    unit = 1000.0 if path.suffix == ".ply" else _unit_of(path, mesh, model)
    return Mesh(mesh.vertices / unit - model.centre, mesh.triangles)


def _unit_of(path: Path, mesh: Mesh, model: Model) -> float:
    """How many of the file's units are a metre."""
    box = model.centre + np.stack([-model.extents, model.extents]) / 2
    most = _SAME_BOX * np.linalg.norm(model.extents)
    for unit in (1000.0, 1.0):
        if np.abs(mesh.bounds / unit - box).max() <= most:
            return unit
    ply = path.with_suffix(".ply")
    raise DataError(
        f"{path}: its box is {_box(mesh.bounds)}, and models_info.json has {_box(1000 * box)} mm;"
        " expected the same in millimetres or metres: are its axes others (z up in BOP)? It is not"
        " read. Export it in the axes of the poses, or put the model's .ply beside it:"
        f" python -c \"import trimesh; trimesh.load('{path.name}').export('{ply.name}')\" writes"
        " one once axes and millimetres are right"
    )


def _box(bounds: Array) -> str:
    return " to ".join("(" + ", ".join(f"{v:.4g}" for v in corner) + ")" for corner in bounds)


def _given(info: dict[str, Any], key: str) -> list[Any]:
    """A list that need not be there."""
    return list_of(info.get(key, []), key)


def find_models(root: Path) -> str:
    """The ``models_info.json`` below ``root`` that BOP's evaluation uses."""
    for name in _MODELS:
        if (root / name / "models_info.json").is_file():
            return f"{name}/models_info.json"
    raise FileNotFoundError(
        f"{root} has no models_info.json in its models, which has each object's box and symmetries;"
        f" bop_toolkit's scripts/calc_model_info.py writes the boxes from the models.\n{HOW}"
    )
