"""Parts of a line of :mod:`pytest_cpas.submissions.jsonl`: numbers, tables, shapes."""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.reading.files import opened
from pytest_cpas.reading.structured import json_value
from pytest_cpas.submissions.jsonl import KINDS
from pytest_cpas.types import Array, ContractError, DataError, Mesh, shown
from pytest_cpas.types._arrays import frozen_array

__all__ = ["LARGEST", "SHAPES", "Place", "Shapes", "check_keys", "numbers", "shape_of", "table"]

#: Largest file, bytes.
LARGEST = 2**34

#: The forms of a shape.
SHAPES = {"points", "mesh"}


class Place(NamedTuple):
    """Where a shape is: a line of a file, and the hypothesis in it, or in one of the detections
    beside its sample."""

    file: Path
    offset: int
    length: int
    hypothesis: int = 0
    detection: int | None = None


class Shapes(Sequence[Mesh | Array | None]):
    """Shapes that are read when they are asked for: those of a data set fill more than memory."""

    def __init__(self, places: Sequence[Place | None]) -> None:
        self._places = places

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, index: int) -> Mesh | Array | None: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Mesh | Array | None]: ...
    def __getitem__(
        self, index: int | slice
    ) -> Mesh | Array | Sequence[Mesh | Array | None] | None:
        if isinstance(index, slice):
            return Shapes(self._places[index])
        place = self._places[index]
        if place is None:
            return None
        with opened(place.file, LARGEST) as file:
            file.seek(place.offset)
            line = file.read(place.length)
        where = f"{place.file}, byte {place.offset}"
        try:
            told = json_value(where, line)
            if place.detection is not None:
                told = told["detections"][place.detection]
            return shape_of(told["hypotheses"][place.hypothesis], where)
        except (DataError, LookupError, TypeError) as error:
            raise DataError(f"{where}: the file has changed since it was read ({error})") from None


def shape_of(told: Mapping[str, Any], where: str) -> Mesh | Array:
    """The shape of a hypothesis; :class:`DataError` for what is none."""
    if told.keys() >= SHAPES:
        raise DataError(f"{where}: it has points and a mesh; give one of them")
    try:
        if "points" in told:
            points = frozen_array(_array(told["points"], f"{where}: points"), (None, 3), "points")
            if not len(points):
                raise DataError("points: there are none")
            return points
        mesh = table(told["mesh"], f"{where}: mesh")
        check_keys(mesh, {"vertices", "triangles"}, {"vertices", "triangles"}, f"{where}: mesh")
        return Mesh(
            _array(mesh["vertices"], f"{where}: vertices"),
            _array(mesh["triangles"], f"{where}: triangles"),
        )
    except ContractError as error:
        message = str(error)
        raise DataError(message if message.startswith(where) else f"{where}: {message}") from None


def _array(value: Any, where: str) -> NDArray[Any]:
    """Rows of three numbers, as lists or in base64."""
    if isinstance(value, list):
        whole = all(isinstance(row, list) and all(type(n) is int for n in row) for row in value)
        array = numbers(value, (len(value), 3), where)
        return array.astype(np.int64) if whole and (np.abs(array) < 2**53).all() else array
    if isinstance(value, dict) and len(value) == 1:
        [(kind, text)] = value.items()
        if kind in KINDS and isinstance(text, str):
            try:
                content = base64.b64decode(text, validate=True)
                return np.frombuffer(content, KINDS[kind]).reshape(-1, 3)
            except (binascii.Error, ValueError) as error:
                raise DataError(f"{where}: no rows of three {kind} in base64 ({error})") from None
    raise DataError(
        f"{where}: {shown(value)}, expected rows of three numbers, or their base64 such as"
        f' {{"float32": "..."}}; kinds are {", ".join(KINDS)}'
    )


def numbers(value: Any, shape: tuple[int, ...], where: str) -> Array:
    """Numbers of JSON in this shape, or a flat list of them; they may be NaN."""
    flat = value if isinstance(value, list) else [None]
    if len(flat) == shape[0] and len(shape) > 1:
        flat = [n for row in flat for n in (row if isinstance(row, list) else [None])]
        fits = all(isinstance(row, list) and len(row) == shape[1] for row in value)
    else:
        fits = len(flat) == math.prod(shape)
    if not fits or not all(type(n) is float or (type(n) is int and abs(n) < 2**62) for n in flat):
        raise DataError(f"{where}: {shown(value)}, expected {' x '.join(map(str, shape))} numbers")
    return np.array(flat, dtype=np.float64).reshape(shape)


def table(value: Any, where: str) -> dict[str, Any]:
    """An object of JSON; :class:`DataError` that begins with ``where`` for what is none."""
    if not isinstance(value, dict):
        raise DataError(f"{where}: {shown(value)}, expected an object of JSON")
    return value


def check_keys(told: Mapping[str, Any], known: set[str], needed: set[str], where: str) -> None:
    """Raise :class:`DataError` where ``needed`` keys lack, or others are than ``known``."""
    if lacks := sorted(needed - told.keys()):
        raise DataError(f"{where}: lacks {', '.join(lacks)}")
    if strange := sorted(told.keys() - known):
        raise DataError(
            f"{where}: {shown(strange[0])} is not known; expected {', '.join(sorted(known))}"
        )
