"""Filling the holes of a depth image (Ku, Harakeh & Waslander, "In Defense of Classical Image
Processing: Fast Depth Completion on the CPU", CRV 2018), in the variant that DPDN uses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Image = NDArray[np.float32]

#: Depth is inverted, so that a maximum prefers what is near: metres.
MAX_DEPTH = 3.0
#: Inverted depth up to this counts as missing, metres.
MISSING = 0.01
#: Bands of depth (above, up to) and the cross with which each is dilated, the nearest last.
BANDS = ((2.0, np.inf, 3), (1.0, 2.0, 5), (MISSING, 1.0, 7))


def fill_depth(depth: Image) -> Image:
    """The depth (H, W), metres, 0 = missing, filled and smoothed.

    Depth beyond 3 m is lost and filled like a hole. Columns stay empty above their first value.
    """
    x = depth.copy()
    known = depth > MISSING
    x[known] = np.float32(MAX_DEPTH) - x[known]
    inverted = x.copy()
    for above, up_to, size in BANDS:
        band = np.where((depth > above) & (depth <= up_to), inverted, 0)
        dilated = _dilate(band, _cross(size))
        x = np.where(dilated > MISSING, dilated, x)
    x = _erode(_dilate(x, _square(5)), _square(5))
    x = np.where(x > MISSING, _median(x), x)
    x = np.where((x <= MISSING) & _below_first(x), _dilate(x, _square(9)), x)
    below = _below_first(x)
    for _ in range(6):
        x = np.where((x < MISSING) & below, _dilate(x, _square(5)), x)
    x = np.where((x > MISSING) & below, _median(x), x)
    valid = (x > MISSING) & below
    x = np.where(valid, _bilateral(x), x)
    return np.where(x > MISSING, np.float32(MAX_DEPTH) - x, x).astype(np.float32)


def _below_first(x: Image) -> NDArray[np.bool_]:
    """The pixels at or below the first valid one of their column; all of a column without one."""
    valid = x > MISSING
    first = np.argmax(valid, axis=0)
    below: NDArray[np.bool_] = np.arange(len(x))[:, None] >= first
    return below


def _cross(size: int) -> NDArray[np.bool_]:
    middle = np.arange(size) == size // 2
    cross: NDArray[np.bool_] = middle[:, None] | middle
    return cross


def _square(size: int) -> NDArray[np.bool_]:
    return np.ones((size, size), bool)


def _dilate(x: Image, kernel: NDArray[np.bool_]) -> Image:
    dilated: Image = ndimage.maximum_filter(x, footprint=kernel, mode="constant", cval=-np.inf)
    return dilated


def _erode(x: Image, kernel: NDArray[np.bool_]) -> Image:
    eroded: Image = ndimage.minimum_filter(x, footprint=kernel, mode="constant", cval=np.inf)
    return eroded


def _median(x: Image) -> Image:
    median: Image = ndimage.median_filter(x, size=5, mode="nearest")
    return median


def _bilateral(x: Image) -> Image:
    """Diameter 5, deviations 0.5 m in depth and 2 pixels in the image."""
    height, width = x.shape
    padded = np.pad(x, 2, mode="reflect")
    total, weights = np.zeros_like(x), np.zeros_like(x)
    for row in range(-2, 3):
        for column in range(-2, 3):
            distance_squared = row * row + column * column
            if distance_squared > 4:
                continue
            near = padded[2 + row : 2 + row + height, 2 + column : 2 + column + width]
            weight = np.exp(-(distance_squared / (2 * 2.0**2)) - (near - x) ** 2 / (2 * 0.5**2))
            total += weight * near
            weights += weight
    return total / weights
