"""Numbers from annotation files, checked on entry."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_cpas.reading.words import decimal
from pytest_cpas.types import Array, DataError, shown
from pytest_cpas.types._arrays import LARGEST


def numbers(value: Any, shape: tuple[int, ...], what: str) -> Array:
    """Finite numbers of this shape, given as (nested) lists, texts in decimal digits, or flat."""
    try:
        if isinstance(value, np.ndarray) and value.dtype.kind in "iuf":
            array = value.astype(float)
        else:
            leaves = np.array(value, dtype=object)
            with np.errstate(over="ignore"):  # what becomes infinite is refused
                array = np.array([_number(leaf) for leaf in leaves.ravel()], dtype=float)
    except (TypeError, ValueError, OverflowError, RecursionError):
        array = np.array([np.nan])
    if array.ndim > 1 and _sides(array.shape) != _sides(shape):
        raise DataError(f"{what}: shape {array.shape}, expected {shape}")
    if array.size != math.prod(shape) or not (np.abs(array) <= LARGEST).all():
        raise DataError(f"{what}: {shown(value)}, expected {math.prod(shape)} finite numbers")
    return array.reshape(shape)


def _sides(shape: Sequence[int]) -> list[int]:
    return [side for side in shape if side != 1]


def _number(leaf: object) -> float:
    """NaN for what is no number."""
    if isinstance(leaf, str):
        number = decimal(leaf)
        return math.nan if number is None else number
    if isinstance(leaf, int | float | np.integer | np.floating) and not isinstance(leaf, bool):
        return float(leaf)
    return math.nan


def whole(text: object) -> int | None:
    """The number that a text of one to nine digits is, else None."""
    if isinstance(text, str) and text.isdecimal() and text.isascii() and len(text) < 10:
        return int(text)
    return None


def quaternion_rotation(value: Any, what: str) -> Array:
    """The rotation matrix of a unit quaternion, scalar last."""
    quaternion = numbers(value, (4,), what)
    if abs(np.linalg.norm(quaternion) - 1) > 1e-3:
        raise DataError(f"{what}: {quaternion.tolist()}, expected a unit quaternion")
    return Rotation.from_quat(quaternion).as_matrix()
