"""A reconstruction over the measured points, seen from the side, drawn without a display.

What is wrong with a shape, or with a position along the line of sight, is not seen from where the
camera stood. The picture looks from the right and from above, without perspective.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from pytest_cpas.evaluation.estimates import decode_estimates, decode_shape
from pytest_cpas.metrics.surfaces import Surface
from pytest_cpas.types import Array, Sample

TRUTH_COLOUR, ESTIMATE_COLOUR = (0, 200, 255), (255, 140, 0)

#: What is behind all.
GROUND = (28, 33, 37)

#: The measured points of the object, and those around it.
_OBJECT, _AROUND = (225, 225, 225), (110, 115, 120)

#: From camera coordinates to those of the view: further points move to the right and up.
_VIEW: Array = Rotation.from_euler("yx", [50, 25], degrees=True).as_matrix()

#: Half of what is shown is the true box's half diagonal times this, ...
_LEAST = 1.15

#: ... or up to this, where an estimate is further off.
_MOST = 2.0

#: Points that stand for the true surface.
_TRUE_POINTS = 2500

#: Dots, pixels across.
_SMALL, _LARGE = 2, 4

#: How much darker the furthest points are than the nearest.
_FADE = 0.5


def reconstruction(
    sample: Sample,
    estimate: str | None,
    shape: str | None,
    window: tuple[int, int, int, int],
    side: int,
) -> Image.Image:
    """The measured points in a window of the image, the true surface and the estimated one.

    ``estimate``, ``shape``: as on a row. ``window``: left, top, right and bottom, pixels.
    ``side``: of the square picture, pixels.
    """
    observation, truth = sample.observation, sample.truth
    left, top, right, bottom = window
    inside = np.zeros_like(observation.mask)
    inside[top:bottom, left:right] = True
    mask, back_project = observation.mask, observation.camera.back_project
    clouds = [
        (back_project(observation.depth, inside & ~mask), _AROUND, _SMALL),
        (back_project(observation.depth, mask), _OBJECT, _SMALL),
    ]
    radius = float(np.linalg.norm(truth.extents)) / 2
    half = _LEAST * radius
    if truth.surface is not None:
        surface = Surface.of(truth.surface, seed=0, count=_TRUE_POINTS).points
        surface = surface[:: -(-len(surface) // _TRUE_POINTS)]
        clouds.append((truth.pose.apply(surface), TRUTH_COLOUR, _SMALL))
    if estimate is not None and shape is not None:
        answer = decode_estimates([estimate])
        points = decode_shape(shape) @ answer.rotation[0].T + answer.translation[0]
        points = points[np.isfinite(points).all(axis=1)]
        clouds.append((points, ESTIMATE_COLOUR, _LARGE))
        off = np.linalg.norm(points - truth.pose.translation, axis=1).max(initial=0)
        half = float(np.clip(off, half, _MOST * radius))
    canvas = np.full((side, side, 3), GROUND, np.uint8)
    seen = [
        ((points - truth.pose.translation) @ _VIEW.T / half, colour, dot)
        for points, colour, dot in clouds
    ]
    _paint(canvas, seen)
    return Image.fromarray(canvas)


def _paint(
    canvas: NDArray[np.uint8], clouds: list[tuple[Array, tuple[int, int, int], int]]
) -> None:
    """Dots (x right, y down, z away, each from -1 to 1), the nearer over the further ones."""
    side = len(canvas)
    dots = []
    for points, colour, dot in clouds:
        shown = points[(abs(points) < 1).all(axis=1)]
        corner = np.floor((shown[:, :2] + 1) / 2 * side - (dot - 1) / 2).astype(int)
        shade = 1 - _FADE * (shown[:, 2:] + 1) / 2
        dots += [(shown[:, 2], corner + offset, shade * colour) for offset in np.ndindex(dot, dot)]
    z, at, colours = (np.concatenate(parts) for parts in zip(*dots, strict=True))
    inside = ((at >= 0) & (at < side)).all(axis=1)
    order = np.flatnonzero(inside)[np.argsort(-z[inside], kind="stable")]
    # of two dots at one place, numpy keeps the later one
    canvas[at[order, 1], at[order, 0]] = np.round(colours[order])
