"""The similarity transform between corresponding points, with outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.stages import draw

Array = NDArray[np.float64]

ITERATIONS = 128
DRAWN = 5
#: Of the iterations, those whose hypotheses are made and looked at together.
TOGETHER = 16
CONFIDENCE = 0.99
LEAST_INLIERS = 0.1
#: Points whose variance is smaller, relative to their squared length, are one point.
SAME = 1e-12


class NoSimilarityError(ValueError):
    """No similarity transform fits the correspondences."""


@dataclass(frozen=True)
class Similarity:
    """``target = scale * rotation @ source + translation``: () or (K,), (..., 3, 3), (..., 3)."""

    scale: Array
    rotation: Array
    translation: Array

    def residuals(self, source: Array, target: Array) -> Array:
        """Distances (..., N) of the moved source (..., N, 3) from the target."""
        moved = self.scale[..., None, None] * (source @ self.rotation.swapaxes(-1, -2))
        distances: Array = np.linalg.norm(moved + self.translation[..., None, :] - target, axis=-1)
        return distances


def umeyama(source: Array, target: Array) -> Similarity:
    """The least-squares similarity from (..., N, 3) to (..., N, 3): Umeyama, TPAMI 1991, eq. 40-42.

    The scale is NaN where all source points are the same.
    """
    source_mean, target_mean = source.mean(axis=-2), target.mean(axis=-2)
    centred = source - source_mean[..., None, :]
    covariance = (target - target_mean[..., None, :]).swapaxes(-1, -2) @ centred / source.shape[-2]
    u, singular, vt = np.linalg.svd(covariance)
    mirrored = np.linalg.det(u) * np.linalg.det(vt) < 0
    sign = np.ones_like(singular)
    sign[..., 2] = np.where(mirrored, -1, 1)
    rotation = (u * sign[..., None, :]) @ vt
    variance = np.square(centred).sum(axis=-1).mean(axis=-1)
    trace = (singular * sign).sum(axis=-1)
    # five draws of one point leave only rounding, and a scale of 1e9
    spread = variance > SAME * np.square(source).sum(axis=-1).max(axis=-1)
    scale = np.divide(trace, variance, where=spread, out=np.full_like(trace, np.nan))
    moved = scale[..., None] * (rotation @ source_mean[..., None])[..., 0]
    return Similarity(scale, rotation, target_mean - moved)


def rigid(source: Array, target: Array) -> tuple[Array, Array]:
    """The least-squares rotation (3, 3) and translation (3,) from (N, 3) to (N, 3).

    Of points on a line, one of the rotations that fit; of a single one, any.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    u[:, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = u @ vt
    return rotation, target_mean - rotation @ source_mean


def robust_umeyama(source: Array, target: Array, generator: np.random.Generator) -> Similarity:
    """The same from (N, 3) to (N, 3) with RANSAC, as the NOCS code and those after it do it.

    A point is an inlier if it ends within a tenth of the source's diameter, scaled. Raises
    :class:`NoSimilarityError` if no hypothesis has a tenth of the points for inliers.
    """
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise NoSimilarityError("the correspondences are not finite")
    diameter = 2 * np.linalg.norm(source - source.mean(axis=0), axis=1).max()
    drawn = draw("ransac", generator.integers(len(source), size=(ITERATIONS, DRAWN)))
    # a hypothesis is as good as it is, however many are looked at; most clouds need few of them
    best, ratio, tried = np.zeros(len(source), bool), 0.0, 0
    for block in drawn.reshape(-1, TOGETHER, DRAWN):
        inliers = _inliers(umeyama(source[block], target[block]), source, target, diameter)
        ratios = inliers.mean(axis=1)
        best_so_far = np.maximum(np.maximum.accumulate(ratios), ratio)
        sure = 1 - (1 - best_so_far**DRAWN) ** (tried + np.arange(TOGETHER)) > CONFIDENCE
        enough = bool(sure.any())
        looked_at = int(np.argmax(sure)) + 1 if enough else TOGETHER
        tried += looked_at
        first = int(np.argmax(ratios[:looked_at]))
        if ratios[first] > ratio:
            best, ratio = inliers[first], float(ratios[first])
        if enough:
            break
    if ratio < LEAST_INLIERS:
        raise NoSimilarityError(
            f"no pose fits the correspondences: {np.count_nonzero(best)} of {len(source)}"
            f" agree with the best of {tried}, expected {100 * LEAST_INLIERS:.0f} % at least"
        )
    fitted = umeyama(source[best], target[best])
    if not fitted.scale > 0:
        raise NoSimilarityError(f"no pose fits the correspondences: their scale is {fitted.scale}")
    return fitted


def _inliers(
    hypotheses: Similarity, source: Array, target: Array, diameter: float
) -> NDArray[np.bool_]:
    """Which points (K, N) of each of K hypotheses end near enough; coordinate by coordinate, for
    sums over an axis of three are slow."""
    scaled = hypotheses.scale[:, None, None] * hypotheses.rotation
    moved = scaled @ source.T
    moved -= target.T - hypotheses.translation[:, :, None]
    np.square(moved, out=moved)
    squared = moved[:, 0] + moved[:, 1] + moved[:, 2]
    # a scale is positive, 0 or NaN, which no distance is below
    near: NDArray[np.bool_] = squared < np.square(hypotheses.scale * diameter / 10)[:, None]
    return near
