"""Arrays on entry: copied, checked, read-only."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pytest_cpas.types.errors import ContractError

Array = NDArray[np.float64]


def frozen_array(value: ArrayLike, shape: tuple[int | None, ...], what: str) -> Array:
    """Return a read-only float64 copy of ``value`` with the given shape (None: any length)."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ContractError(f"{what}: not an array of numbers ({error})") from None
    if array.shape != shape and (
        array.ndim != len(shape)
        or any(want not in (None, have) for have, want in zip(array.shape, shape, strict=True))
    ):
        wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ")"
        raise ContractError(f"{what}: shape is {array.shape}, expected {wanted}")
    if not np.isfinite(array).all():
        bad = int(np.count_nonzero(~np.isfinite(array)))
        raise ContractError(f"{what}: {bad} of {array.size} values are NaN or infinite")
    array.setflags(write=False)
    return array


def checked_extents(value: ArrayLike) -> Array:
    """Three positive side lengths, metres, as of :func:`frozen_array`."""
    extents = frozen_array(value, (3,), "extents (metres)")
    if np.any(extents <= 0):
        raise ContractError(
            f"extents: {extents.tolist()}, expected three positive side lengths in metres (a"
            " negative one often comes from a mirrored axis or an unclamped network output)"
        )
    return extents
