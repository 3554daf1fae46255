"""Numbers and arrays on entry: copied, checked, read-only."""

from __future__ import annotations

import math
import operator
import sys
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pytest_cpas.types.errors import ContractError, shown

Array = NDArray[np.float64]

#: How many times a box may be as long as it is thin.
LARGEST_RATIO = 1e15

#: Largest magnitude of a coordinate or a length that enters, metres, and smallest side of a box.
#: What is beyond is a slip of a unit, or of a network; these fit into single precision.
LARGEST, SMALLEST_SIDE = 1e30, 1e-30

#: The same for the metrics of poses and boxes: products of three of them are numbers still.
LARGEST_OF_METRICS, SMALLEST_OF_METRICS = 1e100, 1e-100

#: Largest magnitude of a coordinate or a focal length in an image, pixels.
LARGEST_PIXEL = 1e9

#: Largest finite number.
MAX = sys.float_info.max


def real_array(value: ArrayLike, what: str) -> Array:
    """``value`` as float64, not copied if it is that; NaN and infinities are taken.

    Raises :class:`ContractError` for what is no real number.
    """
    array = value if type(value) is np.ndarray else _as_array(value, what)
    return array if array.dtype == np.float64 else _as_real(array, what)


def finite_array(value: ArrayLike, what: str, most: float = LARGEST) -> Array:
    """``value`` as float64, not copied if it is that, of magnitudes up to ``most``.

    Raises :class:`ContractError` for NaN, for what is larger, and for what is no real number.
    """
    array = real_array(value, what)
    # two passes without a copy; both propagate NaN, which is not within anything
    if array.size and not (array.min() >= -most and array.max() <= most):
        bad = int(np.count_nonzero(~np.isfinite(array)))
        if bad:
            raise ContractError(f"{what}: {bad} of {array.size} values are NaN or infinite")
        raise ContractError(
            f"{what}: values from {array.min():.3g} to {array.max():.3g}, expected magnitudes of"
            f" at most {most:g}"
        )
    return array


def frozen_array(value: ArrayLike, shape: tuple[int | None, ...], what: str) -> Array:
    """Return a read-only float64 copy of ``value`` with the given shape (None: any length).

    Raises :class:`ContractError` as :func:`finite_array`, and for another shape.
    """
    given = real_array(value, what)
    if given.shape != shape and (
        given.ndim != len(shape)
        or any(want not in (None, have) for have, want in zip(given.shape, shape, strict=True))
    ):
        wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ")"
        raise ContractError(f"{what}: shape is {given.shape}, expected {wanted}")
    array = np.array(finite_array(given, what))
    array.setflags(write=False)
    return array


def _as_array(value: ArrayLike, what: str) -> NDArray[Any]:
    try:
        return np.asarray(value)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ContractError(f"{what}: not an array of numbers ({error})") from None


def _as_real(array: NDArray[Any], what: str) -> Array:
    """Texts would be taken for the numbers that they spell, and half of a complex number lost."""
    kinds = {type(each).__name__ for each in array.flat} if array.dtype == object else set()
    if array.dtype.kind not in "biufO" or kinds & {"str", "bytes", "complex"}:
        seen = ", ".join(sorted(kinds)) or array.dtype
        raise ContractError(f"{what}: not an array of numbers (of {seen})")
    try:
        with np.errstate(over="ignore"):  # it becomes infinite, which is refused
            return np.asarray(array.astype(np.float64))
    except (TypeError, ValueError, OverflowError) as error:
        raise ContractError(f"{what}: not an array of numbers ({error})") from None


def checked_extents(value: ArrayLike) -> Array:
    """Three positive side lengths, metres, as of :func:`frozen_array`."""
    extents = frozen_array(value, (3,), "extents (metres)")
    check_sides(extents, "extents (metres)")
    return extents


def check_sides(extents: Array, what: str, shortest: float = SMALLEST_SIDE) -> None:
    """Raise :class:`ContractError` unless all (..., 3) are side lengths of boxes: at least
    ``shortest``, and of a box none more than :data:`LARGEST_RATIO` times another."""
    if not extents.size:
        return
    least = extents.min()
    if least < shortest:
        worst = extents.reshape(-1, 3)[extents.min(axis=-1).argmin()]
        raise ContractError(
            f"{what}: {worst.tolist()}, expected three positive side lengths, at least"
            f" {shortest:g} (a negative one often comes from a mirrored axis or an unclamped"
            " network output)"
        )
    if extents.max() > LARGEST_RATIO * least:  # perhaps of different boxes
        ratios = extents.max(axis=-1) / extents.min(axis=-1)
        if ratios.max() > LARGEST_RATIO:
            worst = extents.reshape(-1, 3)[ratios.argmax()]
            raise ContractError(
                f"{what}: {worst.tolist()}, one side is {ratios.max():.3g} times another, at most"
                f" {LARGEST_RATIO:g}: of thinner boxes rounding is all that a volume shows"
            )


def checked_number(
    value: object, what: str, least: float = -LARGEST, most: float = LARGEST
) -> float:
    """``value`` as float; :class:`ContractError` unless it is a number from ``least`` to ``most``.

    A NumPy scalar, an array or a tensor of one element and no dimension counts as a number.
    """
    try:
        kind = getattr(getattr(value, "dtype", None), "kind", "f")  # of what is NumPy's
        if isinstance(value, bool | str | bytes | complex) or kind not in "iufO":
            raise TypeError
        if getattr(value, "shape", ()) != ():
            raise TypeError
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not least <= number <= most:
        seen = shown(value) if isinstance(value, int | float | str) else type(value).__name__
        raise ContractError(f"{what}: {seen}, expected {_range(least, most)}")
    return number


def checked_integer(value: object, what: str, least: int, most: int = 2**62) -> int:
    """``value`` as int; :class:`ContractError` unless it is one from ``least`` to ``most``."""
    try:
        if isinstance(value, bool | np.bool_):
            raise TypeError
        number = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        number = least - 1
    if not least <= number <= most:
        limit = f"at least {least}" if most == 2**62 else f"from {least} to {most}"
        seen = shown(value) if isinstance(value, int | float | str) else type(value).__name__
        raise ContractError(f"{what}: {seen}, expected an integer, {limit}")
    return number


def _range(least: float, most: float) -> str:
    if most == math.inf:
        return f"a number, at least {least:g}"
    if (least, most) == (-LARGEST, LARGEST):
        return f"a finite number of magnitude {LARGEST:g} at most"
    return f"a finite number from {least:g} to {most:g}"
