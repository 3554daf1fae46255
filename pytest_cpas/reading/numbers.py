"""Numbers from annotation files, checked on entry."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_cpas.types import Array, DataError, shown
from pytest_cpas.types._arrays import LARGEST


def numbers(value: Any, shape: tuple[int, ...], what: str) -> Array:
    """Finite numbers of this shape, given as (nested) lists or flat."""
    try:
        with np.errstate(over="ignore"):  # what becomes infinite is refused
            array = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError, RecursionError):
        array = np.array([np.nan])
    if array.size != math.prod(shape) or not (np.abs(array) <= LARGEST).all():
        raise DataError(f"{what}: {shown(value)}, expected {math.prod(shape)} finite numbers")
    return array.reshape(shape)


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
