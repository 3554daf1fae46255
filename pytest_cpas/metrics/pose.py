"""Rotation and translation error of poses, under any symmetry group."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pytest_cpas.types import ContractError, Symmetry
from pytest_cpas.types._arrays import LARGEST_OF_METRICS, finite_array
from pytest_cpas.types.geometry import ORTHONORMAL_TOLERANCE

__all__ = ["rotation_error", "translation_error"]

Array = NDArray[np.float64]

#: R^T R of a rotation that was only rounded stays below this distance from I.
_ROUNDED = 1e-14


def rotation_error(
    estimate: ArrayLike, truth: ArrayLike, symmetry: Symmetry | None = None
) -> Array:
    """The angle of ``R~ R^-1``, radians in [0, pi]; smallest over the symmetry group.

    ``estimate`` and ``truth`` are object-to-camera rotations (..., 3, 3) that broadcast against
    each other; the result has the broadcast shape without the last two axes. With a symmetry the
    error is the minimum of the angle between ``estimate`` and ``truth @ S`` over all S of the
    group; it is the same if S is applied to the estimate instead.

    Accurate to a few 1e-16 rad everywhere, also near 0 and pi, where the arccos of the trace
    loses half of the digits: sine and cosine of the angle both come from the matrix, and atan2
    is well conditioned on the whole circle. For a continuous axis a the minimum over the spin
    has a closed form: the spin that fits best leaves the smallest rotation that takes one axis to
    the other, so the error is the angle between the two directions of a.

    Source: paper section 3.1 (the printed formula lacks the arccos).

    Raises :class:`ContractError` for matrices that are not rotations: NaN, not orthonormal (to
    ``ORTHONORMAL_TOLERANCE``), or a reflection. What is within the tolerance is replaced by the
    nearest rotation.
    """
    symmetry = Symmetry.none() if symmetry is None else symmetry
    estimate = checked_rotations(estimate, "estimated rotation")
    truth = checked_rotations(truth, "true rotation")
    relative = _product(np.swapaxes(truth, -1, -2), estimate)
    if symmetry.sphere:
        return np.zeros(relative.shape[:-2])
    errors = [
        _angle_of(_product(relative, element.T))
        if symmetry.axis is None
        else _angle_between(symmetry.axis, _turned(relative, element.T @ symmetry.axis))
        for element in symmetry.rotations
    ]
    return np.asarray(np.min(errors, axis=0))


def translation_error(estimate: ArrayLike, truth: ArrayLike) -> Array:
    """Euclidean distance of two positions (..., 3), which broadcast; metres in, metres out.

    Exact to rounding for distances of 1e-150 m and more. Source: paper section 3.1. Raises
    :class:`ContractError` for NaN, coordinates above 1e100 m or another last axis.
    """
    estimate = checked_vectors(estimate, "estimated translation (metres)")
    truth = checked_vectors(truth, "true translation (metres)")
    return np.asarray(np.linalg.norm(estimate - truth, axis=-1))


def checked_rotations(value: ArrayLike, what: str) -> Array:
    """Return (..., 3, 3) ``value`` as exact rotations; raise ContractError if it holds none."""
    rotations = finite_array(value, what, LARGEST_OF_METRICS)
    if rotations.shape[-2:] != (3, 3):
        raise ContractError(f"{what}: shape is {rotations.shape}, expected (..., 3, 3)")
    # the three columns, component first: long rows are several times faster than small matrices
    columns = np.ascontiguousarray(np.moveaxis(rotations, (-1, -2), (0, 1)))
    deviation = _gram_deviation(columns)
    refused = deviation > ORTHONORMAL_TOLERANCE
    if np.any(refused):
        raise ContractError(
            f"{what}: {_first(refused)} not orthonormal (R^T R differs from I by up to"
            f" {deviation.max():.3g}); expected a rotation matrix. Usual causes: a scale left in"
            " the rotation, a quaternion that was not normalised"
        )
    mirrored = _determinant(columns) < 0
    if np.any(mirrored):
        raise ContractError(
            f"{what}: {_first(mirrored)} a reflection (determinant -1); expected +1. Usual"
            " causes: one axis flipped instead of two, a frame change that mirrors"
        )
    rounded = deviation < _ROUNDED
    if np.all(rounded):
        return rotations
    # Newton's iteration for the polar factor squares the deviation: 1e-4, 1e-8, 1e-16
    nearest = rotations
    for _ in range(2):
        gram = _product(np.swapaxes(nearest, -1, -2), nearest)
        nearest = _product(nearest, 1.5 * np.eye(3) - 0.5 * gram)
    return np.where(rounded[..., None, None], rotations, nearest)


def _product(a: Array, b: Array) -> Array:
    """``a @ b`` of (..., 3, 3): the same bits in any batch, which BLAS does not promise."""
    columns, rows = a[..., :, None, :], b[..., None, :, :]
    return np.asarray(
        columns[..., 0] * rows[..., 0, :]
        + columns[..., 1] * rows[..., 1, :]
        + columns[..., 2] * rows[..., 2, :]
    )


def _turned(rotations: Array, vector: Array) -> Array:
    """``rotations @ vector`` of (..., 3, 3) and (3,), as :func:`_product`."""
    return _product(rotations, vector[:, None])[..., 0]


def _determinant(columns: Array) -> Array:
    a, b, c = columns
    return np.asarray(
        c[0] * (a[1] * b[2] - a[2] * b[1])
        + c[1] * (a[2] * b[0] - a[0] * b[2])
        + c[2] * (a[0] * b[1] - a[1] * b[0])
    )


def _gram_deviation(columns: Array) -> Array:
    """The largest entry of R^T R - I of matrices (3, 3, ...) given by columns."""
    deviation = np.zeros(columns.shape[2:])
    for i in range(3):
        for j in range(i, 3):
            product = (columns[i] * columns[j]).sum(axis=0)
            np.maximum(deviation, np.abs(product - (i == j)), out=deviation)
    return deviation


def checked_vectors(value: ArrayLike, what: str) -> Array:
    """Return (..., 3) ``value`` as float64 of magnitudes up to 1e100; else ContractError."""
    vectors = finite_array(value, what, LARGEST_OF_METRICS)
    if vectors.shape[-1:] != (3,):
        raise ContractError(f"{what}: shape is {vectors.shape}, expected (..., 3)")
    return vectors


def _first(bad: NDArray[np.bool_]) -> str:
    """Name the first of the entries that a check refuses."""
    if bad.ndim == 0:
        return "it is"
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    return f"{np.count_nonzero(bad)} of {bad.size} entries (the first at {index}) are"


def _angle_of(rotations: Array) -> Array:
    """The angles of rotation matrices (..., 3, 3)."""
    r = rotations
    twice_sine = np.sqrt(
        (r[..., 2, 1] - r[..., 1, 2]) ** 2
        + (r[..., 0, 2] - r[..., 2, 0]) ** 2
        + (r[..., 1, 0] - r[..., 0, 1]) ** 2
    )
    twice_cosine = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2] - 1
    return np.asarray(np.arctan2(twice_sine, twice_cosine))


def _angle_between(a: Array, b: Array) -> Array:
    """The angles between unit vectors (..., 3)."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1)))
