"""Random numbers in space and on images, the same on every processor.

Made of integers, uniform draws and elementwise arithmetic alone: no sine, logarithm or sum whose
last digit a mathematical library or a vector instruction could choose.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.types import Array

__all__ = ["bell", "blobs", "cells", "smooth_bell"]

#: Odd numbers with mixed bits, by which the coordinates of a cell are multiplied.
_FACTORS = (0x9E3779B1, 0x85EBCA6B, 0xC2B2AE35, 0x27D4EB2F)


def cells(seed: int, *coordinates: Array) -> Array:
    """A number in 0..1 for the cell that each point (N,) is in: coordinates are rounded down."""
    mixed = np.full(coordinates[0].shape, seed & 0xFFFFFFFF, dtype=np.uint32)
    for coordinate, factor in zip(coordinates, _FACTORS, strict=False):
        whole = np.floor(coordinate).astype(np.int64).astype(np.uint32)
        mixed = (mixed ^ whole) * np.uint32(factor)
        mixed ^= mixed >> np.uint32(15)
    mixed *= np.uint32(_FACTORS[-1])
    mixed ^= mixed >> np.uint32(13)
    values: Array = mixed.astype(np.float64) * 2.0**-32
    return values


def bell(shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Nearly normal numbers of mean 0 and deviation 1: sums of four bytes, at most 3.45."""
    values: Array = _sums(shape, rng).astype(np.float64) / _DEVIATION
    return values


def smooth_bell(shape: tuple[int, int], size: tuple[int, int], rng: np.random.Generator) -> Array:
    """The same (H, W), averaged over windows of ``size`` rows and columns and scaled to deviation
    1, so that neighbours are alike."""
    height, width = size
    total = _sums((shape[0] + height, shape[1] + width), rng)
    total = total.cumsum(axis=0)
    total = total[height:] - total[:-height]
    total = total.cumsum(axis=1)
    total = total[:, width:] - total[:, :-width]
    values: Array = total.astype(np.float64) / (_DEVIATION * float(np.sqrt(height * width)))
    return values


#: Deviation of a sum of four bytes that are evenly distributed.
_DEVIATION = float(np.sqrt((256**2 - 1) / 3))


def _sums(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.int64]:
    drawn = rng.integers(0, 256, (4, *shape), dtype=np.uint8).astype(np.int64)
    summed: NDArray[np.int64] = drawn[0] + drawn[1] + drawn[2] + drawn[3] - 510
    return summed


def blobs(shape: tuple[int, int], size: int, rng: np.random.Generator) -> Array:
    """Values in 0..1 (H, W) that change over about ``size`` pixels, and less over half of it."""
    return (2 * _interpolated(shape, size, rng) + _interpolated(shape, max(2, size // 2), rng)) / 3


def _interpolated(shape: tuple[int, int], size: int, rng: np.random.Generator) -> Array:
    """Random numbers on a grid of ``size`` pixels, with straight lines between."""
    grid = rng.random((shape[0] // size + 2, shape[1] // size + 2))
    row, down = np.divmod(np.arange(shape[0]), size)
    column, right = np.divmod(np.arange(shape[1]), size)
    a, b = (down / size)[:, None], right / size
    rows = grid[row] * (1 - a) + grid[row + 1] * a
    values: Array = rows[:, column] * (1 - b) + rows[:, column + 1] * b
    return values
