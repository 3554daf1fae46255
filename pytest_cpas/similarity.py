"""The similarity transform between corresponding points, with outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.stages import draw

Array = NDArray[np.float64]

ITERATIONS = 128
DRAWN = 5
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
    hypotheses = umeyama(source[drawn], target[drawn])
    limit = hypotheses.scale[:, None] * diameter / 10
    inliers = hypotheses.residuals(source, target) < limit  # NaN is not
    ratio = inliers.mean(axis=1)
    best_so_far = np.maximum.accumulate(ratio)
    enough = 1 - (1 - best_so_far**DRAWN) ** np.arange(ITERATIONS) > CONFIDENCE
    tried = int(np.argmax(enough)) + 1 if enough.any() else ITERATIONS
    best = int(np.argmax(ratio[:tried]))
    if ratio[best] < LEAST_INLIERS:
        raise NoSimilarityError(
            f"no pose fits the correspondences: {np.count_nonzero(inliers[best])} of {len(source)}"
            f" agree with the best of {tried}, expected {100 * LEAST_INLIERS:.0f} % at least"
        )
    fitted = umeyama(source[inliers[best]], target[inliers[best]])
    if not fitted.scale > 0:
        raise NoSimilarityError(f"no pose fits the correspondences: their scale is {fitted.scale}")
    return fitted
