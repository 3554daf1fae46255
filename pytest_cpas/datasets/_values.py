"""What annotations of several data sets hold, checked on entry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pytest_cpas.reading.numbers import numbers
from pytest_cpas.types import Array, DataError

#: Steps of a depth image in a metre: of a metre each, to a ten-thousandth of a millimetre.
_STEPS_PER_METRE = (1.0, 1e7)


def intrinsics(value: Any, what: str) -> list[float]:
    """fx, fy, cx, cy of a camera matrix (3, 3), pixels; :class:`DataError` if it has a skew."""
    matrix = numbers(value, (3, 3), what)
    rest = matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]]
    if not np.allclose(rest, (0, 0, 0, 0, 1), rtol=0, atol=1e-6):
        raise DataError(
            f"{what}: {matrix.tolist()}, expected fx, 0, cx; 0, fy, cy; 0, 0, 1: no skew, and not"
            " transposed"
        )
    found: list[float] = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return found


def steps_per_metre(value: Any, what: str, scale: float | None = None) -> float:
    """How many steps of a depth image are a metre.

    ``value``: that number; with ``scale``, how many of a ``scale``-th of a metre one step is.
    """
    number = float(numbers(value, (1,), what)[0])
    steps = number if scale is None else scale / number if number > 0 else 0.0
    least, most = _STEPS_PER_METRE
    if not least <= steps <= most:
        raise DataError(
            f"{what}: {number:g}, by which a metre has {steps:g} steps of depth; expected"
            f" {least:g} to {most:g}"
        )
    return steps


def integers(value: Any, count: int | None, what: str) -> list[int]:
    """So many integers, or any number of them, in a list or an array of one dimension."""
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str | bytes):
        raise DataError(f"{what}: a {type(value).__name__}, expected a list of integers")
    if isinstance(value, np.ndarray) and value.ndim != 1:
        raise DataError(f"{what}: shape {value.shape}, expected a list of integers")
    array = numbers(value, (len(value) if count is None else count,), what)
    others = any(isinstance(each, str | bool | np.bool_) for each in value)
    if others or (array != np.floor(array)).any():
        raise DataError(f"{what}: {array.tolist()[:20]}, expected integers")
    return [int(each) for each in array]


def rotation_of(value: Any, what: str) -> Array:
    """The rotation (3, 3) of a rigid transform (4, 4) whose last row is 0, 0, 0, 1."""
    matrix = numbers(value, (4, 4), what)
    check_last_rows(matrix[None], what)
    return matrix[:3, :3]


def check_last_rows(matrices: Array, what: str) -> None:
    """Raise :class:`DataError` unless all matrices (n, 4, 4) have the last row 0, 0, 0, 1."""
    wrong = np.flatnonzero(np.abs(matrices[:, 3] - (0, 0, 0, 1)).max(axis=1, initial=0) > 1e-6)
    if len(wrong):
        raise DataError(
            f"{what}: the last row of matrix {wrong[0]} is {matrices[wrong[0], 3].tolist()},"
            " expected 0, 0, 0, 1; is it transposed?"
        )


def text_of(value: Any, what: str) -> str:
    """``value`` if it is a text that is not empty; else :class:`DataError`."""
    if not isinstance(value, str) or not value:
        raise DataError(f"{what}: a {type(value).__name__}, expected a text that is not empty")
    return value


def list_of(value: Any, what: str) -> list[Any]:
    """``value`` if it is a list; else :class:`DataError`."""
    if not isinstance(value, list):
        raise DataError(f"{what}: a {type(value).__name__}, expected a list")
    return value
