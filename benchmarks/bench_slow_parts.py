"""What made the ports slow beside their networks, against the plain way of the same: RANSAC with
all its hypotheses at once, depth filled by scipy's filters, farthest points by one table or one
cloud at a time.

    OMP_NUM_THREADS=1 python benchmarks/bench_slow_parts.py

Both ways find the same, to the last digit but for the depth's rounding. Ends with an error if they
do not, or if ours takes longer.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from method_adapters._depth_filling import BANDS, MAX_DEPTH, MISSING, Image, fill_depth
from method_adapters._networks import pointnet2
from pytest_cpas.similarity import (
    CONFIDENCE,
    DRAWN,
    ITERATIONS,
    Array,
    Similarity,
    robust_umeyama,
    umeyama,
)


def correspondences(wrong: float) -> tuple[Array, Array]:
    random = np.random.default_rng(0)
    source = random.uniform(-0.5, 0.5, (1024, 3))
    target = 0.2 * source + [0, 0, 0.8]
    outlier = random.random(1024) < wrong
    target[outlier] = random.uniform(-0.3, 0.3, (outlier.sum(), 3))
    return source, target


def all_hypotheses(source: Array, target: Array) -> Similarity:
    drawn = np.random.default_rng(1).integers(len(source), size=(ITERATIONS, DRAWN))
    hypotheses = umeyama(source[drawn], target[drawn])
    diameter = 2 * np.linalg.norm(source - source.mean(axis=0), axis=1).max()
    inliers = hypotheses.residuals(source, target) < hypotheses.scale[:, None] * diameter / 10
    ratio = inliers.mean(axis=1)
    so_far = np.maximum.accumulate(ratio)
    enough = 1 - (1 - so_far**DRAWN) ** np.arange(ITERATIONS) > CONFIDENCE
    tried = int(np.argmax(enough)) + 1 if enough.any() else ITERATIONS
    best = inliers[np.argmax(ratio[:tried])]
    return umeyama(source[best], target[best])


def depth_image() -> Image:
    random = np.random.default_rng(0)
    v, u = np.mgrid[:480, :640]
    depth = 0.5 + u / 500 + 0.3 * np.sin(v / 40) + 0.01 * random.standard_normal((480, 640))
    depth[200:350, 200:400] = 0.8
    depth[random.random((480, 640)) < 0.2] = depth[:60, 100:300] = 0
    return depth.astype(np.float32)


def filled_by_scipy(depth: Image) -> Image:
    def largest(x: Image, kernel: np.ndarray) -> Image:
        return ndimage.maximum_filter(x, footprint=kernel, mode="constant", cval=-np.inf)

    def square(size: int) -> np.ndarray:
        return np.ones((size, size), bool)

    def below(x: Image) -> np.ndarray:
        return np.arange(len(x))[:, None] >= np.argmax(x > MISSING, axis=0)

    x = inverted = np.where(depth > MISSING, np.float32(MAX_DEPTH) - depth, depth)
    for above, up_to, size in BANDS:
        middle = np.arange(size) == size // 2
        band = np.where((depth > above) & (depth <= up_to), inverted, 0)
        dilated = largest(band, middle[:, None] | middle)
        x = np.where(dilated > MISSING, dilated, x)
    x = largest(x, square(5))
    x = ndimage.minimum_filter(x, footprint=square(5), mode="constant", cval=np.inf)
    x = np.where(x > MISSING, ndimage.median_filter(x, size=5, mode="nearest"), x)
    x = np.where((x <= MISSING) & below(x), largest(x, square(9)), x)
    lower = below(x)
    for _ in range(6):
        x = np.where((x < MISSING) & lower, largest(x, square(5)), x)
    x = np.where((x > MISSING) & lower, ndimage.median_filter(x, size=5, mode="nearest"), x)
    padded, total, weights = np.pad(x, 2, mode="reflect"), np.zeros_like(x), np.zeros_like(x)
    for row, column in np.ndindex(5, 5):
        squared = (row - 2) ** 2 + (column - 2) ** 2
        if squared <= 4:
            near = padded[row : row + 480, column : column + 640]
            weight = np.exp(-(squared / 8) - (near - x) ** 2 / 0.5)
            total += weight * near
            weights += weight
    x = np.where((x > MISSING) & lower, total / weights, x)
    return np.where(x > MISSING, np.float32(MAX_DEPTH) - x, x)


def farthest_step_by_step(xyz: Tensor, count: int) -> Tensor:
    """The kernels' choice, all distances to the last one anew."""
    n = xyz.shape[1]
    order = pointnet2.tie_order(n, 1024, xyz.device)
    ordered, running, chosen = xyz[:, order], torch.full((1, n), torch.inf), [0]
    for _ in range(count - 1):
        last = ordered[:, chosen[-1] : chosen[-1] + 1]
        running = running.minimum(pointnet2.squared_distances(last, ordered)[:, 0])
        chosen.append(int(running.argmax()))
    return order[chosen][None]


def compare(
    name: str, plain: Callable[[], object], ours: Callable[[], object], least: float
) -> None:
    """Prints how much longer the plain way takes; at least so much is asked for."""
    times: tuple[list[float], list[float]] = [], []
    for _ in range(7):
        for function, kept in zip((plain, ours), times, strict=True):
            start = time.process_time()
            function()
            kept.append(1000 * (time.process_time() - start))
    before, now = map(statistics.median, times)
    told = f"{name:44} plain {before:7.1f} ms   ours {now:7.1f} ms   ratio {before / now:5.2f}"
    print(f"{told} (at least {least:g})", flush=True)
    if before < least * now:
        sys.exit(f"{name}: ours is not that much quicker")


def main() -> None:
    for wrong, least in ((0.1, 3.0), (0.5, 1.2)):
        pair = correspondences(wrong)
        plain, ours = all_hypotheses(*pair), robust_umeyama(*pair, np.random.default_rng(1))
        if not np.array_equal(plain.translation, ours.translation):
            sys.exit("RANSAC: the two do not find the same")
        compare(
            f"RANSAC, 1024 points, {wrong:.0%} of them wrong",
            lambda pair=pair: all_hypotheses(*pair),
            lambda pair=pair: robust_umeyama(*pair, np.random.default_rng(1)),
            least,
        )
    depth = depth_image()
    if abs(filled_by_scipy(depth) - fill_depth(depth)).max() > 1e-5:
        sys.exit("depth filling: the two do not find the same")
    compare(
        "depth filling, 480 x 640",
        lambda: filled_by_scipy(depth),
        lambda: fill_depth(depth),
        1.5,
    )
    random = torch.Generator().manual_seed(0)
    cloud = torch.rand((1, 8000, 3), generator=random)
    if not torch.equal(
        farthest_step_by_step(cloud, 800),
        pointnet2.farthest_points(cloud, 800, max_threads=1024),
    ):
        sys.exit("farthest points: the two do not find the same")
    compare(
        "farthest points, 800 of 8000",
        lambda: farthest_step_by_step(cloud, 800),
        lambda: pointnet2.farthest_points(cloud, 800, max_threads=1024),
        1.5,
    )
    pair = torch.rand((2, 1024, 3), generator=random)
    sampling = pointnet2.Sampling((512, 256, 128, 64), 1024)
    compare(
        "farthest points of two clouds, four levels",
        lambda: [sampling.levels(x[None]) for x in pair],
        lambda: sampling.levels(pair),
        1.0,
    )


if __name__ == "__main__":
    torch.set_num_threads(1)
    with torch.inference_mode():
        main()
