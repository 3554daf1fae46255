"""What explains that a value differs from the reference's: usual mistakes, each tried.

Nothing is said that a check has not confirmed: what is named turns the reference's numbers into
ours, to within float noise. All that fit equally well are named. Where nothing fits, it is said
which part of the value differs, and what only makes the difference smaller.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from pytest_cpas.traces.fitting import (
    FITS,
    PER_PARAMETER,
    Earlier,
    Real,
    along,
    channels,
    explaining,
    fits,
)
from pytest_cpas.traces.steps import dropped, functions, of_others
from pytest_cpas.traces.values import Array, Value

__all__ = ["Explanation", "explain"]

#: Numbers of a value that are looked at; a larger one is not explained.
MOST_NUMBERS = 2**23
#: Values before it that are tried as its parts, and numbers of them together.
MOST_BEFORE, MOST_BEFORE_NUMBERS = 200, 2**24
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
    if fits(a, b):  # and so would everything that hardly changes it
        return Explanation(near=["it is too small to be told from float noise by what is tried"])
    if a.size > 1 and np.ptp(a) == 0 < np.ptp(b):
        return Explanation(
            near=[f"it is {a.flat[0]:.6g} everywhere, the reference is not constant"]
        )
    earlier = _earlier(before, own.shape)
    size = float(np.linalg.norm(a - b)) if a.shape == b.shape else math.inf
    for alike in ((_rearranged,), (of_others, _rescaled, _changed), (_per_channel,)):
        with explaining(size):
            found = [*dict.fromkeys(words for ask in alike for words in ask(a, b, earlier))]
        if found:
            return Explanation(fits=found)
    if rounded := _rounded(own.kept, theirs.kept):
        return Explanation(fits=rounded)
    near = [*_where(a, b), *_steps(a, b), *_moved(a, b), *_small(a, b, kinds)]
    return Explanation(near=near)


def _earlier(before: Sequence[tuple[Value, Value]], shape: tuple[int, ...]) -> Earlier:
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


def _rearranged(a: Real, b: Real, _: Earlier) -> Iterator[str]:
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
            signs = np.sign((channels(a, axis) * channels(b, axis)).sum(1))
            flipped = np.flatnonzero(signs < 0)
            if 0 < len(flipped) < length and fits(a, b * along(signs, axis, b.ndim)):
                yield f"along axis {axis} the sign of {flipped.tolist()} is the other one"


def _permuted(a: Real, b: Real, axis: int) -> bool:
    """Whether the slices along an axis are the same in another order."""
    rows, others = channels(a, axis), channels(b, axis)
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
                f"shifted by {list(steps)} along axes {list(axes)}, where both have it, as by a"
                " crop or a padding beside the place"
            )


def _changed(a: Real, b: Real, _: Earlier) -> Iterator[str]:
    """Each number on its own, or a mask at its edge."""
    yield from functions(a, b)
    yield from dropped(a, b)
    is_mask = b.ndim == 2 and all(((x == 0) | (x == 1)).all() for x in (a, b))
    if not is_mask or a.shape != b.shape:
        return
    for pixels, (words, diagonal) in itertools.product((1, 2, 3), (("", 1), (" and diagonal", 2))):
        shape = ndimage.generate_binary_structure(2, diagonal)
        wider, narrower = (
            change(b.astype(bool), shape, iterations=pixels)
            for change in (ndimage.binary_dilation, ndimage.binary_erosion)
        )
        told = f"by {pixels} pixel{'s' if pixels > 1 else ''}, with the neighbours beside{words}"
        for changed, how in ((wider, "dilated"), (narrower, "eroded")):
            if np.array_equal(a, changed):
                yield f"the reference's mask {how} {told}"


def _rescaled(a: Real, b: Real, _: Earlier) -> Iterator[str]:
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
            own, theirs = channels(a, axis), channels(b, axis)
            energies = (theirs * theirs).sum(1)
            if energies.all():
                factors = (own * theirs).sum(1) / energies
                if np.ptp(factors) > FITS and fits(a, b * along(factors, axis, b.ndim)):
                    words = ", ".join(f"{factor:.6g}" for factor in factors)
                    yield f"scaled along axis {axis} by {words}"
            offsets = (own - theirs).mean(1)
            if np.ptp(offsets) > 0 and fits(a, b + along(offsets, axis, b.ndim)):
                words = ", ".join(f"{offset:+.6g}" for offset in offsets)
                yield f"along axis {axis}, {words} are added"


def _unit(factor: float) -> str:
    for scale, words in ((1000, "millimetres for metres"), (255, "0..255 for 0..1")):
        if abs(factor / scale - 1) < FITS:
            return f": {words}"
        if abs(factor * scale - 1) < FITS:
            return f": {' for '.join(reversed(words.split(' for ')))}"
    return ""


def _per_channel(a: Real, b: Real, _: Earlier) -> Iterator[str]:
    """Each channel scaled and offset, of colours also in another order."""
    if a.shape != b.shape:
        return
    for axis, length in enumerate(b.shape):
        if length < 2 or b.size < 2 * PER_PARAMETER * length:
            continue
        own, theirs = channels(a, axis), channels(b, axis)
        if (own != theirs).any(1).sum() == 1:
            continue  # of one alone it is said where it is
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
    apart = np.linalg.norm(own.astype(float) - theirs) / np.linalg.norm(theirs.astype(float))
    # numbers of bfloat16 are ones of half precision as well, unless they are very large or small
    words = {"bfloat16": (_is_bfloat, 2.0**-8), "half precision (float16)": (_is_half, 2.0**-11)}
    for name, (is_of, step) in words.items():
        if is_of(own) and not is_of(theirs) and apart <= 20 * step:
            return [
                f"all its numbers are ones of {name}, the reference's are not: it was computed or"
                " kept in that"
            ]
    return []


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
        touched = np.flatnonzero(channels(differs, axis).any(1))
        if 0 < len(touched) <= length // 2 or 0 < len(touched) < length <= 16:
            first, last = int(touched[0]), int(touched[-1])
            span = f"{first} to {last}" if last > first else f"{first}"
            count = f", {len(touched)} of them," if len(touched) < last - first + 1 else ""
            yield f"along axis {axis}, of {length}, it differs at {span}{count} alone"
    yield f"{np.count_nonzero(differs)} of its {differs.size} numbers differ"


def _steps(a: Real, b: Real) -> Iterator[str]:
    """Numbers that were rounded."""
    if a.shape != b.shape:
        return
    for step, words in ((1.0, "whole numbers"), (1e-3, "thousandths"), (1 / 255, "255ths")):
        own, theirs = np.rint(a / step), np.rint(b / step)
        exact = all((np.abs(x / step - whole) < 0.01).all() for x, whole in ((a, own), (b, theirs)))
        if exact and np.abs(theirs).max() > 1 and np.abs(own - theirs).max() == 1:
            yield f"all are {words}, and none is off by more than one, as if rounded another way"
            return


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
