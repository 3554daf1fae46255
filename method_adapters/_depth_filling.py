"""Filling the holes of a depth image (Ku, Harakeh & Waslander, "In Defense of Classical Image
Processing: Fast Depth Completion on the CPU", CRV 2018), in the variant that DPDN uses.

All filters are made of operations on whole images, on the device that the network is on.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from method_adapters._networks.graphs import exponential_, queued

Image = NDArray[np.float32]

#: Depth is inverted, so that a maximum prefers what is near: metres.
MAX_DEPTH = 3.0
#: Inverted depth up to this counts as missing, metres.
MISSING = 0.01
#: Bands of depth (above, up to) and the cross with which each is dilated, the nearest last.
BANDS = ((2.0, torch.inf, 3), (1.0, 2.0, 5), (MISSING, 1.0, 7))
#: Rows that are filtered together on a CPU.
STRIP = 48
#: Exchanges that sort five values.
SORT = ((0, 1), (3, 4), (2, 4), (2, 3), (1, 4), (0, 3), (0, 2), (1, 3), (1, 2))
#: Of five by five values whose rows and columns are sorted, those that may be the median: more than
#: twelve are never below, or above, one of the others.
MIDDLE = [
    (r, c) for r in range(5) for c in range(5) if max((r + 1) * (c + 1), (5 - r) * (5 - c)) < 14
]


def fill_depth(depth: Image, device: str = "cpu") -> Image:
    """The depth (H, W), metres, 0 = missing, filled and smoothed.

    Depth beyond 3 m is lost and filled like a hole. Columns stay empty above their first value.
    """
    with torch.inference_mode():
        filled: Image = _filled(torch.tensor(depth, device=device)).cpu().numpy()
    return filled


def _filled(depth: Tensor) -> Tensor:
    inverted = torch.where(depth > MISSING, MAX_DEPTH - depth, depth)
    x = inverted
    for above, up_to, size in BANDS:
        band = torch.where((depth > above) & (depth <= up_to), inverted, 0)
        dilated = torch.maximum(*(_extreme(band, size, axis, torch.maximum) for axis in (0, 1)))
        x = torch.where(dilated > MISSING, dilated, x)
    x = _square(_square(x, 5, torch.maximum), 5, torch.minimum)
    x = torch.where(x > MISSING, _around(x, "replicate", _median), x)
    x = torch.where((x <= MISSING) & _below_first(x), _square(x, 9, torch.maximum), x)
    below = _below_first(x)
    for _ in range(6):
        x = torch.where((x < MISSING) & below, _square(x, 5, torch.maximum), x)
    x = torch.where((x > MISSING) & below, _around(x, "replicate", _median), x)
    x = torch.where((x > MISSING) & below, _around(x, "reflect", _bilateral), x)
    return torch.where(x > MISSING, MAX_DEPTH - x, x)


def _below_first(x: Tensor) -> Tensor:
    """The pixels at or below the first valid one of their column; all of a column without one."""
    valid = x > MISSING
    return (valid.cumsum(0, dtype=torch.int32) > 0) | ~valid.any(0)


Extreme = Callable[[Tensor, Tensor], Tensor]


def _extreme(x: Tensor, size: int, axis: int, of: Extreme) -> Tensor:
    """The largest (or smallest) of ``size`` values along an axis, around each; beyond the image
    there is none."""
    length, half = x.shape[axis], size // 2
    nothing = -torch.inf if of is torch.maximum else torch.inf
    found = F.pad(x, (half, half) if axis else (0, 0, half, half), value=nothing)
    width = 1
    while width < size:
        # those of two windows side by side, or as far apart as the size allows
        step = min(width, size - width)
        kept = found.shape[axis] - step
        found = of(found.narrow(axis, 0, kept), found.narrow(axis, step, kept))
        width += step
    return found.narrow(axis, 0, length)


def _square(x: Tensor, size: int, of: Extreme) -> Tensor:
    return _extreme(_extreme(x, size, 0, of), size, 1, of)


def _around(x: Tensor, mode: str, of: Callable[[Tensor], Tensor]) -> Tensor:
    """What a filter makes of an image (H + 4, W + 4) that reaches two pixels beyond ``x``."""
    padded = F.pad(x[None, None], (2, 2, 2, 2), mode=mode)[0, 0]
    if queued(x):
        return of(padded)
    # few rows at a time, whose intermediate results stay in the cache
    return torch.cat([of(padded[i : i + STRIP + 4]) for i in range(0, len(x), STRIP)])


def _median(padded: Tensor) -> Tensor:
    """Of five by five pixels."""
    height, width = (size - 4 for size in padded.shape)
    columns = _sorted([padded[i : i + height] for i in range(5)])
    rows = [_sorted([y[:, j : j + width] for j in range(5)]) for y in columns]
    left = [rows[r][c] for r, c in MIDDLE]
    # the smallest and the largest of more than half of them are not the median
    kept, left = left[: len(left) // 2 + 2], left[len(left) // 2 + 2 :]
    while len(kept) > 1:
        kept = _without_extremes(kept) + left[:1]
        left = left[1:]
    return kept[0]


def _sorted(values: list[Tensor]) -> list[Tensor]:
    """Five images, pixel by pixel ascending."""
    values = list(values)
    for i, j in SORT:
        _exchange(values, i, j)
    return values


def _without_extremes(values: list[Tensor]) -> list[Tensor]:
    values, last = list(values), len(values) - 1
    for i in range(len(values) // 2):
        _exchange(values, i, last - i)
    for i in range(1, (len(values) + 1) // 2):
        _exchange(values, 0, i)
        _exchange(values, last - i, last)
    return values[1:-1]


def _exchange(values: list[Tensor], i: int, j: int) -> None:
    low, high = torch.minimum(values[i], values[j]), torch.maximum(values[i], values[j])
    values[i], values[j] = low, high


def _bilateral(padded: Tensor) -> Tensor:
    """Diameter 5, deviations 0.5 m in depth and 2 pixels in the image."""
    height, width = (size - 4 for size in padded.shape)
    x = padded[2:-2, 2:-2]
    total, weights = torch.zeros_like(x), torch.zeros_like(x)
    for row in range(-2, 3):
        for column in range(-2, 3):
            squared = row * row + column * column
            if squared > 4:
                continue
            near = padded[2 + row : 2 + row + height, 2 + column : 2 + column + width]
            weight = exponential_(-(squared / (2 * 2.0**2)) - (near - x) ** 2 / (2 * 0.5**2))
            total += weight * near
            weights += weight
    return total / weights
