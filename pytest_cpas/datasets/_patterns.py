"""Where the surfaces of the rendered data sets have their second colour."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.types import Array

__all__ = ["second_colour"]


def second_colour(name: str, points: Array, relative: Array) -> NDArray[np.bool_]:
    """Where (N,) an object has its second colour; ``relative`` points lie in -1/2..1/2."""
    x, y, z = relative.T
    second: NDArray[np.bool_]
    match name:
        case "planks":
            # no scenery has a side at x = (n + 1/2) / 7, where rounding would choose
            second = np.floor(7 * points[:, 0] + 0.5) % 2 == 1
        case "bottle":  # a label and a cap
            second = (np.abs(y + 0.15) < 0.15) | (y > 0.42)
        case "bowl":  # a stripe below the rim
            second = np.abs(y - 0.35) < 0.06
        case "camera":  # the lens
            second = z < -0.15
        case "laptop":  # keyboard and display within their frames
            second = (np.abs(x) < 0.45) & ((y > -0.4) | (np.abs(z + 0.1) < 0.25)) & (y < 0.45)
        case _:  # a band around can, mug and box
            second = np.abs(y) < 0.28
    return second
