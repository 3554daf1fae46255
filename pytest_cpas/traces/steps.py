"""A step that is left out, too many, or another one than the reference's, as the values before it
show."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from pytest_cpas.traces.fitting import FITS, PER_PARAMETER, Earlier, Real, along, fits

__all__ = ["RESIZINGS", "dropped", "functions", "of_others"]


def of_others(a: Real, b: Real, earlier: Earlier) -> Iterator[str]:
    """A step left out or too many, as values before it show."""
    if a.shape == b.shape and b.min() < 0 <= a.min() and fits(a, np.maximum(b, 0)):
        yield "negative numbers are 0: a ReLU that the reference does not have here"
    if a.shape == b.shape and a.min() < 0 <= b.min() and fits(np.maximum(a, 0), b):
        yield (
            "the reference is this with its negative numbers as 0: a ReLU is missing, or another"
            " function stands there"
        )
    for name, x in earlier:
        for words, x_as in _broadcasts(name, x, b.shape):
            if a.shape == b.shape and fits(b - a, x_as):
                yield f"{words} is added in the reference, and not here"
            elif a.shape == b.shape and fits(a - b, x_as):
                yield f"{words} is added here, and not in the reference"
            elif fits(a, x_as):
                yield f"it is {words} unchanged: a step is left out"
        if a.shape == b.shape and x.ndim - a.ndim in (0, 1):
            yield from _poolings(a, b, name, x)
        if x.shape == a.shape == b.shape:
            yield from _softmaxes(a, b, name, x)
        elif x.ndim == a.ndim >= 3 and x.shape[:-2] == a.shape[:-2] and a.shape == b.shape:
            yield from _resizings(a, b, name, x)


#: What a function makes larger than this is not looked at.
LARGEST = 1e100
#: What is left out where a value is not yet, or too many times, this of another one.
FUNCTIONS: Mapping[str, Callable[[Real], Real]] = {
    "sigmoid": lambda x: 1 / (1 + np.exp(-x)),
    "hyperbolic tangent": np.tanh,
    "exponential": np.exp,
    "square": np.square,
}


def functions(a: Real, b: Real) -> Iterator[str]:
    """A function that is left out on one side."""
    if a.shape != b.shape or a.size < PER_PARAMETER:
        return
    with np.errstate(over="ignore"):
        of_ours, of_theirs = ({name: f(x) for name, f in FUNCTIONS.items()} for x in (a, b))
    for name in FUNCTIONS:
        if _is_modest(of_ours[name]) and fits(of_ours[name], b):
            yield f"the reference is the {name} of this, which is left out here"
        if _is_modest(of_theirs[name]) and fits(a, of_theirs[name]):
            yield f"it is the {name} of the reference's"


def _is_modest(x: Real) -> bool:
    return float(np.abs(x).max()) < LARGEST


def dropped(a: Real, b: Real) -> Iterator[str]:
    """Some numbers 0, and the others as much larger."""
    if a.shape != b.shape or a.size < 4 * PER_PARAMETER:
        return
    gone = (a == 0) & (b != 0)
    left, right = a[~gone], b[~gone]
    energy = float((right * right).sum())
    if not gone.any() or not energy:
        return
    factor = float((left * right).sum()) / energy
    if factor > 1 + FITS and fits(left, factor * right):
        yield (
            f"{np.count_nonzero(gone)} of its {a.size} numbers are 0, where the reference's are"
            f" not, and the others {factor:.6g} times those: dropout is on"
        )


#: What features of many are brought to one by.
POOLINGS: Mapping[str, Callable[..., Real]] = {
    "largest": np.max,
    "mean": np.mean,
    "sum": np.sum,
    "least": np.min,
}


def _poolings(a: Real, b: Real, name: str, x: Real) -> Iterator[str]:
    keeps = x.ndim == a.ndim
    for axis in range(x.ndim):
        shape = (*x.shape[:axis], *((1,) if keeps else ()), *x.shape[axis + 1 :])
        if shape != a.shape or x.shape[axis] == 1:
            continue
        made = {words: f(x, axis=axis, keepdims=keeps) for words, f in POOLINGS.items()}
        for own, theirs in itertools.permutations(made, 2):
            if fits(a, made[own]) and fits(b, made[theirs]):
                yield f"the {own} of {name} along axis {axis}, in the reference the {theirs}"


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
        weight = along(at - low, axis % x.ndim, x.ndim)
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
