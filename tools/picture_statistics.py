"""Measure how pictures of RGB-D data sets look: roughness and loss of depth, registration, colour.

    python tools/picture_statistics.py NAME=DIR [NAME=DIR ...] [--every N]

``DIR`` is a folder in the layout of REAL275 with ``real_test/scene_S/NNNN_{color,depth}.png`` and,
where there is one, ``NNNN_mask.png``. Prints the table of docs/pictures.md: of each statistic and
data set the least, the median and the largest value of a frame (of a mask, where it is of masks).
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

PATCH = 9

#: Distances, metres, of the patches that roughness is given for.
NEAR, BANDS = (0.4, 1.2), ((0.6, 0.8), (0.8, 1.0), (1.0, 1.3))

#: A patch that is so far off a plane, as a share of its distance, has an edge in it.
EDGE = 0.02

#: Fewer patches, pixels of edges or pixels of a mask say nothing.
MIN_PATCHES, MIN_EDGE, MIN_MASK = 10, 300, 500

#: Shifts up to so many pixels are tried.
REACH = 9

#: What is measured, in the order of the table, with the number of digits.
STATISTICS = {
    "roughness of depth, 0.4 to 1.2 m (mm)": 2,
    **{f"roughness of depth, {low:g} to {high:g} m (mm)": 2 for low, high in BANDS},
    "depth lost inside a mask (%)": 1,
    "depth lost in the image (%)": 1,
    "lost pixels that lie in patches of 20 or more (%)": 0,
    "patches of lost depth": 0,
    "colour from depth (pixels)": 1,
    "brightness (0 to 1)": 2,
    "contrast (deviation of brightness)": 2,
    "saturation (largest less smallest channel)": 2,
    "gradient, median": 4,
    "gradient, 90 %": 3,
    "gradient, 99 %": 2,
    "fine structure and noise": 4,
}


def roughness(depth: Array) -> tuple[Array, Array]:
    """Of every patch that is all measured and has no edge: its distance (N,), metres, and the
    deviation (N,), millimetres, of depth (H, W), millimetres, from the plane that fits it best."""
    k = PATCH
    rows, columns = (size // k for size in depth.shape)
    tiles = depth[: rows * k, : columns * k].reshape(rows, k, columns, k)
    patches = tiles.transpose(0, 2, 1, 3).reshape(-1, k * k)
    patches = patches[(patches > 0).all(axis=1)]
    down, right = (axis.ravel() for axis in np.mgrid[:k, :k] - k // 2)
    mean = patches.mean(axis=1)
    slopes = [patches @ axis / (axis @ axis) for axis in (down, right)]
    rest = patches - mean[:, None] - slopes[0][:, None] * down - slopes[1][:, None] * right
    plain = np.abs(rest).max(axis=1) < EDGE * mean
    deviation = np.sqrt((rest**2).sum(axis=1) / (k * k - 3))
    return mean[plain] / 1000, deviation[plain]


def registration(colour: Array, depth: Array) -> tuple[int, int] | None:
    """By how many columns and rows colour lies beside depth: where colour changes most along the
    border of what stands in front, in the depth; None where too little stands in front.

    ``colour`` (H, W) brightness, ``depth`` (H, W) millimetres.
    """
    border = np.zeros(depth.shape, dtype=bool)
    for step in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        beside = np.roll(depth, step, (0, 1))
        behind = beside.copy()
        for count in (2, 3):  # across what is lost
            further = np.roll(depth, (count * step[0], count * step[1]), (0, 1))
            behind = np.where(behind == 0, further, behind)
        border |= (behind > 1.04 * depth) & ((beside == 0) | (beside > 1.04 * depth))
    border &= depth > 0
    margin = REACH + 14
    border[:margin] = border[-margin:] = border[:, :margin] = border[:, -margin:] = False
    rows, columns = np.nonzero(border)
    if len(rows) < MIN_EDGE:
        return None
    change = ndimage.gaussian_filter(np.minimum(gradient(colour), 0.15), 0.7)
    reach = range(-REACH, REACH + 1)
    found = np.array([[change[rows + y, columns + x].mean() for x in reach] for y in reach])
    row, column = np.unravel_index(found.argmax(), found.shape)
    return int(column) - REACH, int(row) - REACH


def gradient(grey: Array) -> Array:
    """How much brightness (H, W) changes over a pixel (H, W)."""
    slopes = [ndimage.sobel(grey, axis) / 8 for axis in (0, 1)]
    steepest: Array = np.hypot(*slopes)
    return steepest


def patches_lost(lost: Bools) -> NDArray[np.int64]:
    """Sizes (N,) of the connected patches of lost pixels that do not reach the image's border."""
    label, count = ndimage.label(lost)
    rim = np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])
    sizes = np.bincount(label.ravel(), minlength=count + 1)
    sizes[np.unique(rim)] = 0
    sizes[0] = 0
    return sizes[sizes > 0]


def of_frame(
    colour: NDArray[np.uint8], depth: NDArray[np.uint16], mask: NDArray[np.uint8] | None
) -> dict[str, list[float]]:
    """What is measured of a frame by the names of :data:`STATISTICS`; of masks several values."""
    names = iter(STATISTICS)
    found: dict[str, list[float]] = {}
    levels = depth.astype(float)
    distance, deviation = roughness(levels)
    for low, high in (NEAR, *BANDS):
        part = deviation[(distance > low) & (distance <= high)]
        found[next(names)] = [float(np.median(part))] if len(part) >= MIN_PATCHES else []
    lost = depth == 0
    objects = [] if mask is None else [mask == i for i in np.unique(mask) if i != 255]
    found[next(names)] = [100 * float(lost[o].mean()) for o in objects if o.sum() >= MIN_MASK]
    sizes = patches_lost(lost)
    found[next(names)] = [100 * float(sizes.sum()) / lost.size]
    found[next(names)] = [100 * float(sizes[sizes >= 20].sum() / max(1, sizes.sum()))]
    found[next(names)] = [len(sizes)]
    grey = colour @ np.array([0.299, 0.587, 0.114]) / 255
    shift = registration(grey, levels)
    found[next(names)] = [] if shift is None else [float(np.hypot(*shift))]
    steep = gradient(grey)
    channels = colour.astype(int)
    second = ndimage.convolve(grey, np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]]))
    values = (
        grey.mean(),
        grey.std(),
        (channels.max(axis=2) - channels.min(axis=2)).mean() / 255,
        *np.quantile(steep, [0.5, 0.9, 0.99]),
        # the deviation of noise that is independent from pixel to pixel, were there nothing else
        np.median(np.abs(second)) / 0.6745 / 6,
    )
    return found | {name: [float(value)] for name, value in zip(names, values, strict=True)}


def frames(
    root: Path, every: int = 1
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.uint16], NDArray[np.uint8] | None]]:
    """Colour, depth and, where there is one, mask of every N-th frame of a folder."""
    for path in sorted(root.glob("real_test/scene_*/*_color.png"))[::every]:
        stem = str(path)[: -len("_color.png")]
        mask = Path(f"{stem}_mask.png")
        yield (
            np.asarray(Image.open(path).convert("RGB")),
            np.asarray(Image.open(f"{stem}_depth.png")).astype(np.uint16),
            np.asarray(Image.open(mask)) if mask.exists() else None,
        )


def of_folder(root: Path, every: int = 1) -> Mapping[str, Array]:
    """All values of a folder's frames by statistic."""
    values: dict[str, list[float]] = defaultdict(list)
    for frame in frames(root, every):
        for name, found in of_frame(*frame).items():
            values[name] += found
    return {name: np.array(found) for name, found in values.items()}


def main() -> None:
    """Measure the folders that are named and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", metavar="NAME=DIR")
    parser.add_argument("--every", type=int, default=1, help="take every N-th frame")
    options = parser.parse_args()
    named = [folder.partition("=") for folder in options.folders]
    columns = {name: of_folder(Path(path), options.every) for name, _, path in named}
    print("| of each frame |", " | ".join(columns), "|")
    print("|---|" + "---|" * len(columns))
    for statistic, digits in STATISTICS.items():
        cells = []
        for values in columns.values():
            found = values.get(statistic, np.array([]))
            ends = np.quantile(found, [0, 0.5, 1]) if len(found) else []
            cells.append(", ".join(f"{value:.{digits}f}" for value in ends) or "-")
        print(f"| {statistic} |", " | ".join(cells), "|")


if __name__ == "__main__":
    main()
