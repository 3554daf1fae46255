"""From an observation to what the networks see: the crop rule of the NOCS code, and the sampling
of image and points that several ports share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.adapting import Camera, tap

Image = NDArray[np.float32]

#: Side of the networks' input image, pixels.
IMAGE_SIDE = 192
#: Observed points that the networks take.
POINT_COUNT = 1024
#: Fewer pixels with depth than this are no evidence to go by.
MIN_DEPTH_PIXELS = 32

MEAN = np.array([0.485, 0.456, 0.406], np.float32)
DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)


class NoAnswerError(Exception):
    """Why a method has no answer for an observation; becomes a failed prediction."""


@dataclass(frozen=True)
class Crop:
    """A window: first ``row`` and ``column``, ``height`` and ``width``, in pixels."""

    row: int
    column: int
    height: int
    width: int

    @property
    def limits(self) -> NDArray[np.int64]:
        """First row, first column, height and width (4,)."""
        return np.array([self.row, self.column, self.height, self.width])

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the window in an image."""
        return (
            slice(self.row, self.row + self.height),
            slice(self.column, self.column + self.width),
        )


def crop_of(mask: NDArray[np.bool_]) -> Crop:
    """The square window around a mask (H, W), at least 40 pixels each way.

    Its side is the next multiple of 40 above the longer side of the box, at most 440 and what the
    image holds; it is centred on the box and shifted into the image. Published codes take any
    image for one of 480 x 640.
    """
    height, width = mask.shape
    (top, bottom), (left, right) = mask_limits(mask)
    longer = max(bottom - top, right - left)
    side = min((longer // 40 + 1) * 40, 440, whole_forties(min(mask.shape)))
    row = placed(top + bottom, side, height)
    return Crop(row, placed(left + right, side, width), side, side)


def mask_limits(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last row, first and last column of a mask (H, W)."""
    used = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return [(int(places[0]), int(places[-1])) for places in used]


def whole_forties(size: int) -> int:
    """The largest multiple of 40 that ``size`` pixels hold; raises :class:`NoAnswerError` for 0."""
    if size < 40:
        raise NoAnswerError(f"the image is {size} pixels high or wide; expected at least 40")
    return size // 40 * 40


def placed(low_plus_high: int, side: int, size: int) -> int:
    """Where a window of ``side`` of ``size`` pixels begins that has the given middle, doubled."""
    return min(max(low_plus_high // 2 - side // 2, 0), size - side)


def resize(image: Image, side: int) -> Image:
    """A square image (S, S, C) to (``side``, ``side``, C), bilinear, with the conventions of
    OpenCV's INTER_LINEAR: pixel centres at halves, no smoothing, the border repeated."""
    size = len(image)
    source = (np.arange(side) + 0.5) * (size / side) - 0.5
    source = np.clip(source, 0, size - 1)
    low = np.floor(source).astype(int)
    high = np.minimum(low + 1, size - 1)
    weight = (source - low).astype(np.float32)[:, None]
    image = image[:, low] * (1 - weight) + image[:, high] * weight
    weight = weight[:, None]
    resized: Image = image[low] * (1 - weight) + image[high] * weight
    return resized


def network_image(rgb: Image, crop: Crop) -> Image:
    """The crop of ``rgb`` (H, W, 3), 0..1, as (3, 192, 192), normalised as for ImageNet."""
    resized = resize(rgb[crop.slices], IMAGE_SIDE)
    return np.ascontiguousarray(((resized - MEAN) / DEVIATION).transpose(2, 0, 1))


def depth_pixels(
    mask: NDArray[np.bool_], depth: Image, crop: Crop
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns, within the crop, of the mask's pixels that have a depth; row-major.

    Raises :class:`NoAnswerError` if there are fewer than ``MIN_DEPTH_PIXELS``.
    """
    valid = tap("seen", mask & (depth > 0))
    rows, columns = np.nonzero(valid[crop.slices])
    require_depth_pixels(len(rows))
    return rows, columns


def require_depth_pixels(count: int) -> None:
    """Raises :class:`NoAnswerError` if there are fewer than ``MIN_DEPTH_PIXELS``."""
    if count < MIN_DEPTH_PIXELS:
        raise NoAnswerError(
            f"{count} pixels of the mask have a depth, expected at least {MIN_DEPTH_PIXELS}"
        )


def subset_in_order(
    count: int, generator: np.random.Generator, wanted: int = POINT_COUNT
) -> NDArray[np.int64]:
    """SPD's, CR-Net's, SGPA's and CASS's choice of ``wanted`` from ``count`` pixels: a random
    subset in its old order, or all of them repeated cyclically."""
    if count > wanted:
        return np.sort(generator.choice(count, wanted, replace=False))
    return np.arange(wanted) % count


def back_project(
    v: NDArray[np.int64], u: NDArray[np.int64], depth: Image, camera: Camera
) -> NDArray[np.float32]:
    """Points (N, 3), metres, of the image's pixels in rows ``v`` and columns ``u``."""
    z = depth[v, u].astype(float)
    x, y = (u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy
    return np.stack([x, y, z], axis=-1).astype(np.float32)


def feature_index(
    rows: NDArray[np.int64], columns: NDArray[np.int64], crop: Crop
) -> NDArray[np.int64]:
    """Row-major indices into the 192 x 192 feature map of pixels within the crop."""
    ratio = IMAGE_SIDE / crop.width
    index = np.floor(rows * ratio) * IMAGE_SIDE + np.floor(columns * ratio)
    whole: NDArray[np.int64] = index.astype(np.int64)
    return whole
