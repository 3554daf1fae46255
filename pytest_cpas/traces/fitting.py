"""Whether numbers are the same but for float noise, and what trying that needs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.traces.values import Array

__all__ = ["Earlier", "Real", "along", "channels", "explaining", "fits"]

Real = NDArray[np.float64]

#: Values that came before another one, with their names.
Earlier = Sequence[tuple[str, Real]]

#: The relative difference that may be left, and the same without the mean.
FITS, FITS_WITHOUT_MEAN = 1e-5, 1e-4
#: Numbers that there must be for each that is fitted.
PER_PARAMETER = 3


#: The share of a difference that may be left of it where it is explained.
LEFT = 1 / 30
_difference = ContextVar("difference", default=math.inf)


@contextmanager
def explaining(difference: float) -> Iterator[None]:
    """Within, what fits leaves next to nothing of a difference of this L2 norm, too: beside a large
    value much would fit that hardly touches a small one."""
    before = _difference.set(difference)
    try:
        yield
    finally:
        _difference.reset(before)


def fits(a: Array, b: Array) -> bool:
    """Whether a is b, but for float noise."""
    if a.shape != b.shape:
        return False
    left, mean = float(np.linalg.norm(a - b)), b.mean() if b.size else 0.0
    scale, varying = float(np.linalg.norm(b)), float(np.linalg.norm(b - mean))
    if left > LEFT * _difference.get():
        return False
    # of constant ones the mean is all there is
    return left <= FITS * scale and (left <= FITS_WITHOUT_MEAN * varying or varying <= FITS * scale)


def channels(x: Any, axis: int) -> Any:
    """(length of the axis, all others)."""
    return np.moveaxis(x, axis, 0).reshape(x.shape[axis], -1)


def along(values: Real, axis: int, ndim: int) -> Real:
    """One number for each place of an axis, to multiply with."""
    shape = [1] * ndim
    shape[axis] = -1
    return values.reshape(shape)
