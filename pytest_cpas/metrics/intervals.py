"""Confidence intervals of shares, means and medians: of single samples, and of whole scenes.

An interval *per sample* takes samples for independent: the exact one of a share is
:meth:`pytest_cpas.metrics.Count.interval`, that of a mean is Student's t, that of a median is made
of two order statistics. Samples of one scene are alike, so that such an interval is too narrow for
what the next scenes would give. The interval *by scene* draws scenes with replacement, each with
all its samples, and computes the figure anew from each draw: the cluster bootstrap (Davison &
Hinkley 1997, section 3.8; Field & Welsh 2007, J. R. Statist. Soc. B 69, 369-390). A mean is then a
ratio of two sums over the scenes drawn. Its ends are quantiles of the draws at the levels of
Hesterberg (2015, The American Statistician 69, 371-386: the expanded percentile interval), which
allow for n scenes varying less than their source does: quantiles of Student's t with n - 1 degrees
of freedom, times sqrt(n / (n - 1)). Draws are of a fixed seed: the same values give the same
interval.

Few scenes stay few. Fewer than five have no interval at 95 %: the rarest of their draws is more
probable than what must lie outside. Of clustered shares of 0.7 (intra-scene correlation 0.15, 60
samples a scene) the interval at 95 % held the truth in 93 % of simulations with 6 scenes and in
95 % with 10, of shares of 0.9 in 87 % and 90 %; the interval per sample in less than half.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import bdtr, ndtr, stdtrit

from pytest_cpas.types import ContractError
from pytest_cpas.types._arrays import (
    LARGEST_OF_METRICS,
    Array,
    checked_number,
    finite_array,
    real_array,
)

__all__ = [
    "CONFIDENCE",
    "FEWEST_SCENES",
    "FEW_SCENES",
    "Interval",
    "mean_interval",
    "median_interval",
    "scene_mean_intervals",
    "scene_median_interval",
]

#: How sure an interval is that nothing is judged by.
CONFIDENCE = 0.95

#: Fewer scenes have no interval at :data:`CONFIDENCE`.
FEWEST_SCENES = 5

#: With fewer scenes an interval by scene holds the truth less often than it says.
FEW_SCENES = 10

#: Draws of scenes.
_DRAWS = 4000

_SEED = 18

#: Numbers that are held at a time.
_AT_ONCE = 1 << 22

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Interval:
    """Between what a figure lies; ``low`` <= ``high``, either may be infinite."""

    low: float
    high: float


def mean_interval(values: ArrayLike, confidence: float = CONFIDENCE) -> Interval | None:
    """Student's t interval of the mean of independent values (N,), NaN where n/a.

    None where it says nothing: of fewer than two values, or of equal ones.
    Raises :class:`ContractError` for values of another shape, and for infinite ones.
    """
    known = finite_array(_known(_vector(values)), "values", LARGEST_OF_METRICS)
    tail = _tail(confidence)
    if len(known) < 2 or known.min() == known.max():
        return None
    reach = -stdtrit(len(known) - 1, tail) * known.std(ddof=1) / np.sqrt(len(known))
    return Interval(float(known.mean() - reach), float(known.mean() + reach))


def median_interval(values: ArrayLike, confidence: float = CONFIDENCE) -> Interval | None:
    """The order-statistic interval of the median of independent values (N,), NaN where n/a.

    It holds for any distribution: between the k-th smallest and the k-th largest value, for the
    largest k with 2 P(Binomial(N, 1/2) < k) <= 1 - confidence. None for so few values that all of
    them together are not that sure. Raises :class:`ContractError` for values of another shape.
    """
    ranked = np.sort(_known(_vector(values)))
    below = bdtr(np.arange(len(ranked) // 2), len(ranked), 0.5)  # P(fewer than 1, 2, ...)
    rank = int(np.searchsorted(below, _tail(confidence), side="right"))
    return Interval(float(ranked[rank - 1]), float(ranked[-rank])) if rank else None


def scene_mean_intervals(
    values: ArrayLike, scenes: ArrayLike, confidence: float = CONFIDENCE
) -> list[Interval | None]:
    """By scene, of the means of K columns of values (N, K), NaN where n/a.

    ``scenes`` (N,): the name of each sample's scene, or its number. A share is the mean of zeros
    and ones. None where scenes say nothing: so few have known values that they are not that sure,
    each of them has one sample, or all have the same mean. Raises :class:`ContractError` for other
    shapes, and for infinite values.
    """
    table = real_array(values, "values")
    if table.ndim != 2:
        raise ContractError(f"values: shape {table.shape}, expected (N, K)")
    finite_array(_known(table), "values", LARGEST_OF_METRICS)
    codes = _codes(scenes, len(table))
    tail = _tail(confidence)
    if not len(table):
        return [None] * table.shape[1]
    order = np.argsort(codes, kind="stable")
    starts = np.flatnonzero(np.diff(codes[order], prepend=-1))
    known = ~np.isnan(table)
    sums = np.add.reduceat(np.where(known, table, 0.0)[order], starts, axis=0)
    sizes = np.add.reduceat(known[order].astype(np.float64), starts, axis=0)
    made: list[Interval | None] = [None] * table.shape[1]
    for present, columns in _alike(sizes > 0):
        own_sums, own_sizes = sums[np.ix_(present, columns)], sizes[np.ix_(present, columns)]
        telling = _tells(own_sums, own_sizes)
        columns, own_sums, own_sizes = columns[telling], own_sums[:, telling], own_sizes[:, telling]
        level = _level(len(present), tail)
        if level is None or not len(columns):
            continue
        draws = np.concatenate(
            [(part @ own_sums) / (part @ own_sizes) for part in _draws(len(present))]
        )
        lows, highs = _ends(draws, level)
        for column, low, high in zip(columns, lows, highs, strict=True):
            made[column] = Interval(float(low), float(high))
    return made


def scene_median_interval(
    values: ArrayLike, scenes: ArrayLike, confidence: float = CONFIDENCE
) -> Interval | None:
    """By scene, of the median of values (N,), NaN where n/a; infinite ones take part.

    ``scenes`` (N,): the name of each sample's scene, or its number. The median of a draw is its
    smallest value that has at least half of it at or below it. None, and :class:`ContractError`, as
    of :func:`scene_mean_intervals`; that all medians of draws are the same says nothing either.
    """
    column = _vector(values)
    codes = _codes(scenes, len(column))
    tail = _tail(confidence)
    known = ~np.isnan(column)
    order = np.argsort(column[known], kind="stable")
    ranked = column[known][order]
    names, own = np.unique(codes[known][order], return_inverse=True)
    level = _level(len(names), tail)
    if level is None or len(names) == len(ranked):
        return None
    medians = []
    for part in _draws(len(names)):
        # few scenes can be drawn in few ways
        rows, which = np.unique(part.astype(np.int64), axis=0, return_inverse=True)
        at = _first_half(rows, own)
        medians.append(ranked[at][which.reshape(-1)])
    draws = np.concatenate(medians)
    if draws.min() == draws.max():
        return None
    lows, highs = _ends(draws[:, None], level)
    return Interval(float(lows[0]), float(highs[0]))


def _first_half(rows: Integers, codes: Integers) -> Integers:
    """For each draw (M, C) of how often each scene is taken, the index of the first of the ranked
    samples, of the scenes ``codes`` (N,), at which half of the draw is reached."""
    found = []
    for start in range(0, len(rows), step := max(1, _AT_ONCE // len(codes))):
        reached = np.cumsum(rows[start : start + step, codes], axis=1)
        found.append(np.argmax(2 * reached >= reached[:, -1:], axis=1))
    return np.concatenate(found)


def _vector(values: ArrayLike) -> Array:
    column = real_array(values, "values")
    if column.ndim != 1:
        raise ContractError(f"values: shape {column.shape}, expected (N,)")
    return column


def _known(values: Array) -> Array:
    return values[~np.isnan(values)]


def _tail(confidence: float) -> float:
    """What lies outside on one side."""
    sure = float(checked_number(confidence, "confidence, between 0 and 1", 0, 1))
    if not 0 < sure < 1:
        raise ContractError(f"confidence: {confidence}, expected a number between 0 and 1")
    return (1 - sure) / 2


def _codes(scenes: ArrayLike, samples: int) -> Integers:
    """The scene of each sample as a number from 0."""
    try:
        names = np.asarray(scenes)
        codes = np.unique(names, return_inverse=True)[1]
    except (TypeError, ValueError) as error:
        raise ContractError(f"scenes: neither names nor numbers ({error})") from None
    if names.shape != (samples,):
        raise ContractError(f"scenes: shape {names.shape}, expected ({samples},) like the values")
    return codes


def _alike(present: NDArray[np.bool_]) -> Iterator[tuple[Integers, Integers]]:
    """The columns that are known in the same scenes: those scenes, and those columns."""
    patterns, which = np.unique(present, axis=1, return_inverse=True)
    for index, pattern in enumerate(patterns.T):
        if pattern.any():
            yield np.flatnonzero(pattern), np.flatnonzero(which.reshape(-1) == index)


def _tells(sums: Array, sizes: Array) -> NDArray[np.bool_]:
    """Whether scenes (C, K) say anything of a column."""
    means = sums / sizes
    telling: NDArray[np.bool_] = (sizes > 1).any(axis=0) & (means.min(axis=0) < means.max(axis=0))
    return telling


def _draws(scenes: int) -> Iterator[Array]:
    """How often each scene is taken: (_DRAWS, scenes) in parts."""
    step = max(1, _AT_ONCE // scenes)
    if scenes <= _AT_ONCE // _DRAWS:
        yield _whole_draw(scenes)
        return
    source = np.random.default_rng(_SEED)
    for start in range(0, _DRAWS, step):
        yield _taken(source, scenes, min(step, _DRAWS - start))


@functools.lru_cache(maxsize=8)
def _whole_draw(scenes: int) -> Array:
    return _taken(np.random.default_rng(_SEED), scenes, _DRAWS)


def _taken(source: np.random.Generator, scenes: int, draws: int) -> Array:
    drawn = source.integers(scenes, size=(draws, scenes))
    drawn += scenes * np.arange(draws)[:, None]
    taken = np.bincount(drawn.reshape(-1), minlength=draws * scenes)
    return taken.reshape(draws, scenes).astype(np.float64)


def _level(scenes: int, tail: float) -> float | None:
    """Which share of draws lies outside of an expanded percentile interval on one side; None where
    no draw of so few scenes is that rare."""
    if scenes < 2:
        return None
    level = float(ndtr(np.sqrt(scenes / (scenes - 1)) * stdtrit(scenes - 1, tail)))
    return level if -scenes * math.log(scenes) <= math.log(level) else None


def _ends(draws: Array, level: float) -> tuple[Array, Array]:
    """The ends of columns of draws (_DRAWS, K) with that share of them outside on each side."""
    ranked = np.sort(draws, axis=0)
    outside = int(level * len(ranked))
    return ranked[outside], ranked[len(ranked) - 1 - outside]
