"""The active shape models of ASM-Net: a mean shape and its principal deformations."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from method_adapters._assets import AssetError, told_of_asset
from pytest_cpas.adapting import read_npz

Array = NDArray[np.float64]

#: Components that ASM-Net's network estimates coefficients for.
COMPONENTS = 3


@dataclass(frozen=True)
class ShapeModel:
    """``mean`` (N, 3) and ``components`` (3, N, 3), the strongest first, in model units."""

    mean: Array
    components: Array

    def deformed(self, coefficients: Array) -> Array:
        """The shape (N, 3) of three coefficients."""
        shape: Array = self.mean + np.tensordot(coefficients, self.components, axes=1)
        return shape


def read_shape_model(path: Path) -> ShapeModel:
    """The model in a published ``info.npz``; nothing pickled in it is read.

    What its arrays are called is not documented, so they are known by their shapes: of N points
    the mean (N, 3) or flat, x y z by point, and components (K, 3 N), (3 N, K) or (K, N, 3) with
    K at least 3. Raises :class:`AssetError` for a file without exactly one such pair.
    """
    with told_of_asset():
        arrays = read_npz(path)
    models = [
        model
        for mean, components in permutations(arrays, 2)
        if (model := _model(arrays[mean], arrays[components])) is not None
    ]
    if len(models) != 1:
        seen = ", ".join(f"{name} {x.shape} of {x.dtype}" for name, x in arrays.items())
        raise AssetError(
            f"{path}: {len(models)} pairs of a mean shape (N, 3) and its components (K, 3 N), K at"
            f" least {COMPONENTS}, all finite, expected one; it holds {seen or 'no plain arrays'}"
        )
    return models[0]


def _model(mean: NDArray[np.generic], components: NDArray[np.generic]) -> ShapeModel | None:
    """The model of two arrays, or None if their shapes are not those of a model."""
    if mean.dtype.kind != "f" or components.dtype.kind != "f":
        return None
    size = mean.size
    if size < 12 or mean.shape not in ((size // 3, 3), (size,), (1, size), (size, 1)) or size % 3:
        return None
    if components.shape[1:] == (size,):
        rows = components
    elif components.ndim == 2 and len(components) == size:
        rows = components.T
    elif components.shape[1:] == (size // 3, 3):
        rows = components.reshape(len(components), size)
    else:
        return None
    if len(rows) < COMPONENTS or not (np.isfinite(mean).all() and np.isfinite(rows).all()):
        return None
    return ShapeModel(
        mean.reshape(-1, 3).astype(float),
        rows[:COMPONENTS].reshape(COMPONENTS, -1, 3).astype(float),
    )
