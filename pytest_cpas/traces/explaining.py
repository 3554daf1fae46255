"""What explains that a value differs from the reference's: usual mistakes, each tried.

Nothing is said that a check has not confirmed: what is named turns the reference's numbers into
ours, to within float noise. All that fit equally well are named. Where nothing fits, it is said
which part of the value differs, and what only makes the difference smaller.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.traces.values import Array, Value

__all__ = ["Explanation", "explain"]

Real = NDArray[np.float64]

#: Values that came before it, with their names.
_Earlier = Sequence[tuple[str, Real]]

#: The relative difference that may be left, and the same without the mean.
FITS, FITS_WITHOUT_MEAN = 1e-5, 1e-4
#: Numbers of a value that are looked at; a larger one is not explained.
MOST_NUMBERS = 2**23
#: Values before it that are tried as its parts, and numbers of them together.
MOST_BEFORE, MOST_BEFORE_NUMBERS = 200, 2**24
#: Numbers that there must be for each that is fitted.
PER_PARAMETER = 3
#: A shift of an image, pixels, that is tried.
REACH = 2
#: The share of a difference that what does not fit must remove to be named.
NAMED_SHARE = 0.8

#: Largest relative rounding error of numbers of half precision, and of TF32.
HALF_STEP = 2.0**-11


@dataclass(frozen=True)
class Explanation:
    """``fits``: what explains a difference, each alone; ``near``: what is known of it besides."""

    fits: Sequence[str] = field(default=())
    near: Sequence[str] = field(default=())


def explain(own: Value, theirs: Value, before: Sequence[tuple[Value, Value]] = ()) -> Explanation:
    """What explains the difference of a value from the reference's.

    ``before``: pairs of values that came before it and agree.
    """
    if not (own.is_whole and theirs.is_whole):
        return Explanation(near=["only a part of its numbers was kept, so nothing was tried"])
    kinds = own.kept.dtype.kind + theirs.kept.dtype.kind
    if "U" in kinds or max(own.size, theirs.size) > MOST_NUMBERS or not own.size:
        return Explanation()
    a, b = own.kept.astype(float), theirs.kept.astype(float)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        count = int(np.count_nonzero(~np.isfinite(a)))
        return Explanation(near=[f"{count} of its {a.size} numbers are not finite"])
    earlier = _earlier(before, own.shape)
    for alike in ((_rearranged,), (_of_others, _rescaled), (_per_channel,)):
        fits = [*dict.fromkeys(words for ask in alike for words in ask(a, b, earlier))]
        if fits:
            return Explanation(fits=fits)
    if rounded := _rounded(own.kept, theirs.kept):
        return Explanation(fits=rounded)
    return Explanation(near=[*_where(a, b), *_moved(a, b), *_small(a, b, kinds)])


def _earlier(before: Sequence[tuple[Value, Value]], shape: tuple[int, ...]) -> _Earlier:
    """The values before it that are whole and hold numbers: those of its shape, with or without an
    axis of length 1, then the last of the others. Of several that are the same, one."""
    found: list[tuple[str, Real]] = []
    seen: set[str] = set()
    left = MOST_BEFORE_NUMBERS
    alike = {shape, (1, *shape), shape[1:] if shape[:1] == (1,) else shape}
    nearest = [own for own, _ in reversed(before)]
    for own in sorted(nearest, key=lambda value: value.shape not in alike):
        if own.digest in seen or not own.is_whole or own.kept.dtype.kind not in "fiub":
            continue
        seen.add(own.digest)
        left -= own.size
        if left < 0 or len(found) == MOST_BEFORE:
            break
        if own.size > 1:
            found.append((own.told, own.kept.astype(float)))
    return found


def fits(a: Array, b: Array) -> bool:
    """Whether a is b, but for float noise."""
    if a.shape != b.shape:
        return False
    left, mean = float(np.linalg.norm(a - b)), b.mean() if b.size else 0.0
    scale, varying = float(np.linalg.norm(b)), float(np.linalg.norm(b - mean))
    # of constant ones the mean is all there is
    return left <= FITS * scale and (left <= FITS_WITHOUT_MEAN * varying or varying <= FITS * scale)


def _rearranged(a: Real, b: Real, _: _Earlier) -> Iterator[str]:
    """The same numbers in another order, or of another sign."""
    if a.shape != b.shape and a.size == b.size and fits(a.ravel(), b.ravel()):
        yield f"the same numbers in the same order, as {a.shape} for {b.shape}"
    if fits(a, -b):
        yield "every sign is the other one"
    if 2 <= b.ndim <= 5:
        for axes in itertools.permutations(range(b.ndim)):
            long = [axis for axis in axes if b.shape[axis] > 1]
            if long != sorted(long) and fits(a, b.transpose(axes)):
                yield f"transposed: the reference's axes in the order {list(axes)}"
    if a.shape != b.shape:
        return
    for axis, length in enumerate(b.shape):
        if length < 2:
            continue
        reversed_ = fits(a, np.flip(b, axis))
        if reversed_:
            of = "; of colours, BGR for RGB" if length == 3 else ""
            yield f"reversed along axis {axis}, of {length}{of}"
        if length == 4 and axis == b.ndim - 1:
            for turn, words in ((1, "last for scalar first"), (-1, "first for scalar last")):
                if fits(a, np.roll(b, -turn, axis)):
                    yield f"its four numbers are turned by one: of quaternions, scalar {words}"
        elif not reversed_ and length > 2 and _permuted(a, b, axis):
            yield f"in another order along axis {axis}, of {length}"
    for axes in itertools.combinations(range(b.ndim), 2):
        yield from _shifted(a, b, axes)
    for axis, length in enumerate(b.shape):
        if 2 <= length <= 16 and b.size >= PER_PARAMETER * length:
            signs = np.sign((_channels(a, axis) * _channels(b, axis)).sum(1))
            flipped = np.flatnonzero(signs < 0)
            if 0 < len(flipped) < length and fits(a, b * _along(signs, axis, b.ndim)):
                yield f"along axis {axis} the sign of {flipped.tolist()} is the other one"


def _permuted(a: Real, b: Real, axis: int) -> bool:
    """Whether the slices along an axis are the same in another order."""
    rows, others = _channels(a, axis), _channels(b, axis)
    weights = np.random.default_rng(0).standard_normal(rows.shape[1])
    order, other = np.argsort(rows @ weights, kind="stable"), np.argsort(others @ weights)
    return fits(rows[order], others[other])


def _shifted(a: Real, b: Real, axes: tuple[int, ...]) -> Iterator[str]:
    """As an image that was cropped some pixels beside the place."""
    if min(a.shape[axis] for axis in axes) < 4 * REACH:
        return
    for steps in itertools.product(range(-REACH, REACH + 1), repeat=2):
        if steps == (0, 0):
            continue
        mine: list[slice] = [slice(None)] * a.ndim
        other = list(mine)
        for axis, step in zip(axes, steps, strict=True):
            length = a.shape[axis]
            mine[axis] = slice(max(-step, 0), length - max(step, 0))
            other[axis] = slice(max(step, 0), length - max(-step, 0))
        if fits(a[tuple(mine)], b[tuple(other)]):
            yield (
                f"shifted by {list(steps)} along axes {list(axes)}, where both have it: a crop or"
                " a padding beside the place"
            )


def _of_others(a: Real, b: Real, earlier: _Earlier) -> Iterator[str]:
    """A step left out or too many, as values before it show."""
    if a.shape == b.shape and b.min() < 0 <= a.min() and fits(a, np.maximum(b, 0)):
        yield "negative numbers are 0: a ReLU that the reference does not have here"
    if a.shape == b.shape and a.min() < 0 <= b.min() and fits(np.maximum(a, 0), b):
        yield "the reference is this with its negative numbers as 0: a ReLU is missing"
    for name, x in earlier:
        for words, x_as in _broadcasts(name, x, b.shape):
            if a.shape == b.shape and fits(b - a, x_as):
                yield f"{words} is added in the reference, and not here"
            elif a.shape == b.shape and fits(a - b, x_as):
                yield f"{words} is added here, and not in the reference"
            elif fits(a, x_as):
                yield f"it is {words} unchanged: a step is left out"
        if x.shape == a.shape == b.shape:
            yield from _softmaxes(a, b, name, x)
        elif x.ndim == a.ndim >= 3 and x.shape[:-2] == a.shape[:-2] and a.shape == b.shape:
            yield from _resizings(a, b, name, x)


def _broadcasts(name: str, x: Real, shape: tuple[int, ...]) -> Iterator[tuple[str, Real]]:
    if x.shape == shape:
        yield name, x
    elif x[None].shape == shape:
        yield name, x[None]
    elif x.shape[1:] == shape and len(x) == 1:
        yield name, x[0]


def _softmaxes(a: Real, b: Real, name: str, x: Real) -> Iterator[str]:
    if max(a.max(), b.max()) > 1 + FITS:
        return
    logarithm = max(a.max(), b.max()) <= 0
    kind = "logarithm of the softmax" if logarithm else "softmax"
    made = {axis: _softmax(x, axis) for axis in range(x.ndim) if x.shape[axis] > 1}
    if logarithm:
        a, b = np.exp(a), np.exp(b)
    for own, theirs in itertools.permutations(made, 2):
        if fits(a, made[own]) and fits(b, made[theirs]):
            yield f"the {kind} of {name} along axis {own}, in the reference along {theirs}"


def _softmax(x: Real, axis: int) -> Real:
    share: Real = np.exp(x - x.max(axis=axis, keepdims=True))
    share /= share.sum(axis=axis, keepdims=True)
    return share


def _resizings(a: Real, b: Real, name: str, x: Real) -> Iterator[str]:
    size = (a.shape[-2], a.shape[-1])
    made = {words: resize(x, size) for words, resize in RESIZINGS.items()}
    for own, theirs in itertools.permutations(made, 2):
        if fits(a, made[own]) and fits(b, made[theirs]):
            yield f"{name} resized {own}, in the reference {theirs}"


def _bilinear(x: Real, size: tuple[int, int], aligned: bool) -> Real:
    for axis, length in zip((-2, -1), size, strict=True):
        before = x.shape[axis]
        if aligned:
            at = np.arange(length) * ((before - 1) / max(length - 1, 1))
        else:
            at = ((np.arange(length) + 0.5) * (before / length) - 0.5).clip(0, before - 1)
        low = np.floor(at).astype(int)
        weight = _along(at - low, axis % x.ndim, x.ndim)
        high = np.minimum(low + 1, before - 1)
        x = x.take(low, axis) * (1 - weight) + x.take(high, axis) * weight
    return x


def _nearest(x: Real, size: tuple[int, int]) -> Real:
    for axis, length in zip((-2, -1), size, strict=True):
        x = x.take(np.arange(length) * x.shape[axis] // length, axis)
    return x


RESIZINGS: dict[str, Callable[[Real, tuple[int, int]], Real]] = {
    "bilinearly with corners aligned": lambda x, size: _bilinear(x, size, True),
    "bilinearly with corners not aligned": lambda x, size: _bilinear(x, size, False),
    "to the nearest": _nearest,
}


def _rescaled(a: Real, b: Real, _: _Earlier) -> Iterator[str]:
    """One factor or one offset for all, or one factor for each of a few."""
    if a.shape != b.shape:
        return
    if b.size >= PER_PARAMETER and (energy := float((b * b).sum())):
        factor = float((a * b).sum()) / energy
        if factor and fits(a, factor * b):
            yield f"scaled by {factor:.6g}{_unit(factor)}"
        offset = float((a - b).mean())
        if fits(a, b + offset):
            yield f"{offset:+.6g} is added to every number"
    for axis, length in enumerate(b.shape):
        if 2 <= length <= 16 and b.size >= PER_PARAMETER * length and b.ndim > 1:
            own, theirs = _channels(a, axis), _channels(b, axis)
            energies = (theirs * theirs).sum(1)
            if energies.all():
                factors = (own * theirs).sum(1) / energies
                if np.ptp(factors) > FITS and fits(a, b * _along(factors, axis, b.ndim)):
                    words = ", ".join(f"{factor:.6g}" for factor in factors)
                    yield f"scaled along axis {axis} by {words}"
            offsets = (own - theirs).mean(1)
            if np.ptp(offsets) > 0 and fits(a, b + _along(offsets, axis, b.ndim)):
                words = ", ".join(f"{offset:+.6g}" for offset in offsets)
                yield f"along axis {axis}, {words} are added"


def _unit(factor: float) -> str:
    for scale, words in ((1000, "millimetres for metres"), (255, "0..255 for 0..1")):
        if abs(factor / scale - 1) < FITS:
            return f": {words}"
        if abs(factor * scale - 1) < FITS:
            return f": {' for '.join(reversed(words.split(' for ')))}"
    return ""


def _per_channel(a: Real, b: Real, _: _Earlier) -> Iterator[str]:
    """Each channel scaled and offset, of colours also in another order."""
    if a.shape != b.shape:
        return
    for axis, length in enumerate(b.shape):
        if length < 2 or b.size < 2 * PER_PARAMETER * length:
            continue
        own, theirs = _channels(a, axis), _channels(b, axis)
        orders = itertools.permutations(range(length)) if length == 3 else [tuple(range(length))]
        for order in orders:
            moved = _affine(own, theirs[list(order)])
            if moved is not None and fits(own, moved):
                known = " (a mean, a deviation, or batch norm in training mode)"
                words = f"scaled and offset along axis {axis}, each of {length} on its own"
                if list(order) != sorted(order):
                    bgr = " (of colours, BGR for RGB)" if list(order) == [2, 1, 0] else ""
                    yield f"in the order {list(order)} along axis {axis}{bgr}, {words}"
                else:
                    yield f"{words}{known}"


def _affine(own: Real, theirs: Real) -> Real | None:
    """Every row of ``theirs``, scaled and offset to fit that of ``own`` best."""
    centre = theirs - theirs.mean(1, keepdims=True)
    energy = (centre * centre).sum(1, keepdims=True)
    if not energy.any():
        return None
    factor = (own * centre).sum(1, keepdims=True) / np.where(energy > 0, energy, 1)
    moved: Real = own.mean(1, keepdims=True) + factor * centre
    return moved


def _rounded(own: Array, theirs: Array) -> list[str]:
    """Numbers that fewer bits can say."""
    if own.shape != theirs.shape or "".join((own.dtype.kind, theirs.dtype.kind)) != "ff":
        return []
    words = {"half precision (float16)": _is_half, "bfloat16": _is_bfloat}
    found = []
    for name, is_of in words.items():
        step = 2.0**-11 if is_of is _is_half else 2.0**-8
        apart = np.linalg.norm(own.astype(float) - theirs) / np.linalg.norm(theirs.astype(float))
        if is_of(own) and not is_of(theirs) and apart <= 20 * step:
            found.append(
                f"all its numbers are ones of {name}, the reference's are not: it was computed or"
                " kept in that"
            )
    return found


def _is_half(array: Array) -> bool:
    with np.errstate(over="ignore"):
        return bool((array.astype(np.float16).astype(array.dtype) == array).all())


def _is_bfloat(array: Array) -> bool:
    single = array.astype(np.float32)
    low = single.view(np.uint32) & np.uint32(0xFFFF)
    return bool((low == 0).all() and (single == array).all())


def _where(a: Real, b: Real) -> Iterator[str]:
    """Which part of the value differs, if another is the same."""
    if a.shape != b.shape:
        return
    differs = np.abs(a - b) > FITS * max(float(np.abs(b).max()), float(np.abs(a).max()))
    if differs.all() or not differs.any():
        return
    for axis, length in enumerate(a.shape):
        touched = np.flatnonzero(_channels(differs, axis).any(1))
        if 0 < len(touched) <= length // 2 or 0 < len(touched) < length <= 16:
            first, last = int(touched[0]), int(touched[-1])
            span = f"{first} to {last}" if last > first else f"{first}"
            count = f", {len(touched)} of them," if len(touched) < last - first + 1 else ""
            yield f"along axis {axis}, of {length}, it differs at {span}{count} alone"
    yield f"{np.count_nonzero(differs)} of its {differs.size} numbers differ"


def _moved(a: Real, b: Real) -> Iterator[str]:
    """How far an image was moved, in parts of a pixel, where that removes most of the
    difference."""
    if a.shape != b.shape or a.ndim not in (2, 3, 4):
        return
    total = float(np.linalg.norm(a - b))
    pairs = {(a.ndim - 2, a.ndim - 1), (0, 1)}
    for axes in sorted(pairs):
        if min(a.shape[axis] for axis in axes) < 16 or not total:
            continue
        slopes = [np.gradient(b, axis=axis).ravel() for axis in axes]
        steps, *_ = np.linalg.lstsq(np.stack(slopes, axis=1), (a - b).ravel(), rcond=None)
        left = (a - b).ravel() - np.stack(slopes, axis=1) @ steps
        share = 1 - float(np.linalg.norm(left)) / total
        if share >= NAMED_SHARE and np.abs(steps).max() < 2 * REACH:
            moved = [round(float(step), 2) for step in steps]
            yield (
                f"moved by {moved} pixels along axes {list(axes)} the reference is nearer by"
                f" {100 * share:.0f} %: another crop, or other pixel centres"
            )


def _small(a: Real, b: Real, kinds: str) -> Iterator[str]:
    """What a difference is no larger than."""
    if a.shape != b.shape or kinds != "ff":
        return
    size = float(np.linalg.norm(a - b) / max(float(np.linalg.norm(b)), 1e-300))
    if size <= HALF_STEP:
        yield (
            f"{size:.1e} is no more than one rounding to half precision or TF32 makes,"
            f" {HALF_STEP:.1e}"
        )


def _channels(x: Any, axis: int) -> Any:
    """(length of the axis, all others)."""
    return np.moveaxis(x, axis, 0).reshape(x.shape[axis], -1)


def _along(values: Real, axis: int, ndim: int) -> Real:
    """One number for each place of an axis, to multiply with."""
    shape = [1] * ndim
    shape[axis] = -1
    return values.reshape(shape)
