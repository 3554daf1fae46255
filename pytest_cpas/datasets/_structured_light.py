"""A structured-light depth sensor, as closely as a rendering allows.

A projector stands beside an infrared camera, and distance is where the camera finds the projector's
dots shifted to (disparity). What follows from that, and is modelled:

* disparity is measured in steps, so depth is too: 3.2 mm apart at 1 m, growing with the square of
  the distance. Read off the levels that occur in frames of REAL275;
* a window of pixels is compared, so errors are alike over a few pixels, and edges of depth are
  ragged by a pixel. The windows are as wide as the errors of REAL275 are alike;
* nothing is measured where the projector does not reach, left of what stands in front; in patches,
  at depth edges, at grazing angles, on what is dark, and where glass mirrors the projector; nor
  along the left and lower borders of the image;
* depth and colour are not quite registered: the depth image is shifted by whole pixels.

Left out: interference, motion blur, distortion of the lens, bias that varies over the image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pytest_cpas.datasets._fields import blobs, smooth_bell
from pytest_cpas.datasets.rendering import Rendering, camera_rays, dot
from pytest_cpas.types import Array, Camera

__all__ = ["draw_shift", "measure"]

#: One step of disparity, as inverse depth, 1 / m; and the deviation of its errors.
STEP, NOISE = 0.0032, 0.00177

#: Rows and columns over which errors are alike.
WINDOW = (5, 7)

#: Between projector and camera, metres.
BASELINE = 0.05

#: A change of depth over a pixel by more than this share is an edge, not a slope.
EDGE = 0.02

#: Left and lower border without depth, pixels.
BORDERS = (12, 4)

#: Longest shift between depth and colour, pixels, along the rows and along the columns.
SHIFTS = (4, 2)


def draw_shift(rng: np.random.Generator) -> tuple[int, int]:
    """By how many columns and rows depth lies beside colour: 1.4 to 4.5 pixels in all."""
    while True:
        columns, rows = (int(rng.integers(-most, most + 1)) for most in SHIFTS)
        if columns * columns + rows * rows >= 2:
            return columns, rows


def measure(
    seen: Rendering,
    infrared: Array,
    gloss: Array,
    camera: Camera,
    shift: tuple[int, int],
    rng: np.random.Generator,
) -> NDArray[np.uint16]:
    """What is measured of a rendering: (H, W) millimetres, 0 = missing.

    ``infrared`` (H, W) is the part of the projector's light that is scattered by what is seen, and
    ``gloss`` (H, W) the part that is mirrored. What the colour image has at column u and row v is
    measured at ``u + shift[0]``, ``v + shift[1]``.
    """
    shape = seen.depth.shape
    grid: NDArray[np.int64] = np.indices(shape)
    rows, columns = grid[0] - shift[1], grid[1] - shift[0]
    outside = (rows < 0) | (rows >= shape[0]) | (columns < 0) | (columns >= shape[1])
    rows, columns = rows.clip(0, shape[0] - 1), columns.clip(0, shape[1] - 1)
    # at edges, what is found belongs to a neighbour now and then
    ragged = [np.round(2.4 * blobs(shape, 6, rng) - 1.2).astype(np.int64) for _ in range(2)]
    beside = (
        (rows + ragged[0]).clip(0, shape[0] - 1),
        (columns + ragged[1]).clip(0, shape[1] - 1),
    )
    rays: Array = camera_rays(camera)
    z, cosine = _along(seen.depth[beside], seen.normal[beside], rays[beside], rays[rows, columns])
    nothing = z == 0
    inverse = 1 / np.where(nothing, 1.0, z)
    lost = outside | nothing | _unseen(z, cosine, infrared[beside], gloss[beside], rng)
    lost |= _unlit(np.where(nothing, 0.0, inverse), camera)
    lost = _most_around(lost)
    lost[:, : BORDERS[0]] = True
    lost[shape[0] - BORDERS[1] :] = True
    found = np.round((inverse + NOISE * smooth_bell(shape, WINDOW, rng)) / STEP) * STEP
    millimetres = np.round(1000 / np.maximum(found, STEP)).clip(0, 65535)
    return np.where(lost, 0, millimetres).astype(np.uint16)


def _along(z: Array, normal: Array, there: Array, here: Array) -> tuple[Array, Array]:
    """Depth where the rays ``here`` meet the surfaces that rays ``there`` see at depth ``z``, and
    the cosine between these rays and the normals."""
    facing = -dot(normal, here)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = -z * dot(normal, there) / facing
    near = np.abs(moved - z) < EDGE * z  # else the plane is seen from its side
    return np.where(near, moved, z), facing / np.sqrt(dot(here, here))


def _unseen(
    z: Array, cosine: Array, infrared: Array, gloss: Array, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Where the camera finds no dots although the projector's light arrives."""
    patches, fine = blobs(z.shape, 12, rng), blobs(z.shape, 6, rng)
    lost: NDArray[np.bool_] = cosine < 0.11 * (patches + fine)
    # light that comes back: less from afar, from the side, and from what is dark
    light = infrared * (0.4 + 0.6 * np.maximum(cosine, 0))
    lost |= light < 0.13 * np.minimum(z, 1.5) * patches * patches
    # glass that mirrors the projector, and glass seen from the side, whose light goes elsewhere
    lost |= (gloss > 0.9) & (patches > np.where(cosine > 0.97, 0.5, 0.78))
    step = ndimage.maximum_filter(z, 3) - ndimage.minimum_filter(z, 3)
    edge = step > EDGE * z
    wide = ndimage.maximum_filter(edge, (3, 5))
    lost |= (edge & (fine > 0.62)) | (wide & (patches > 0.72))
    return lost | (patches > 0.96)


def _unlit(inverse: Array, camera: Camera) -> NDArray[np.bool_]:
    """Where something hides a point from the projector, which stands to the right of the camera.

    From there the points of a row are seen in their order, but those behind what stands in front.
    """
    column = np.arange(camera.width) - camera.fx * BASELINE * inverse
    first = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    return column > first + 1


def _most_around(lost: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where most of 3 x 3 pixels are lost: what a window of pixels finds has no specks."""
    count = lost.astype(np.int8)
    for axis in (0, 1):
        count = sum((np.roll(count, step, axis) for step in (-1, 1)), count)
    return count >= 5
