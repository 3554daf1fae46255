"""Whether the facts of a run moved beside those of the recorded seeds, by their ranks.

**One sample.** The J values of the run and the K recorded ones are put in order, the worst last;
values within the tolerance of a fact are ties and share their mean rank. Unless something changed,
the run's are any J of them (Wilcoxon's rank sum; nothing need be known of how values are spread).

**A category, or all samples.** The rank sums, in units of the spread of the ranks in each sample,
are added up. How probable a sum as large is has an upper bound that holds for any number of samples
and ties (Chernoff's, of the cumulants that the draws have). A fact that is a little worse in most
samples shows so, however hard the samples are, and although none of them crosses a threshold.

Seeds may move a fact of all samples together: what is made of that is said in
:mod:`pytest_cpas.golden.exchange`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from pytest_cpas.facts import SAME, Fact
from pytest_cpas.golden.drift import Drift
from pytest_cpas.golden.exchange import Array, Shifts

__all__ = ["SHIFTS", "Bound", "Moves", "bounds"]

#: Standard deviations of what a seed adds to a fact of all samples, in those of its spread.
SHIFTS = Shifts((0.05, 0.1, 0.2, 0.4, 0.8))

#: Where cumulants are looked at, and the shifts of seeds: rising, the same on both sides of 0.
_STEPS = np.geomspace(0.005, 12, 32)
_GRID: Array = np.concatenate([-_STEPS[::-1], [0.0], _STEPS])

#: Samples of which the cumulants are made at once.
_AT_ONCE = 512


@dataclass(frozen=True, eq=False)
class Bound:
    """How probable ranks as extreme as those of the run are at most."""

    p: float

    def attained(self, p: float) -> float:
        """The most that the probability of a bound as small as ``p`` can be."""
        return p


@dataclass(frozen=True, eq=False)
class Moves:
    """A fact of n samples: ``recorded`` (n, K) and ``run`` (n, J), NaN where it is n/a."""

    fact: Fact
    recorded: Array
    run: Array

    @functools.cached_property
    def known(self) -> NDArray[np.bool_]:
        """(n,) of which samples all seeds know it."""
        known: NDArray[np.bool_] = np.logical_not(np.isnan(self._pooled).any(axis=1))
        return known

    @functools.cached_property
    def ranks(self) -> NDArray[np.int64]:
        """(n, K + J) twice the mean ranks, from 0, the worst last; all alike where it is not
        known."""
        return _ranks(self.fact, np.where(self.known[:, None], self._pooled, 0.0))

    @functools.cached_property
    def luck(self) -> Array:
        """(n, K) how high every recorded seed stands among the recorded ones: of mean 0 and
        variance 1 in every sample, 0 where all are alike or it is not known."""
        ranks = _ranks(self.fact, np.where(self.known[:, None], self.recorded, 0.0))
        return _standardised(ranks)

    def told(self, names: Sequence[str], among: NDArray[np.bool_]) -> str:
        """In words, of the samples ``among`` those that have ``names``: how their medians moved."""
        known = np.flatnonzero(self.known & among).tolist()
        then, now = (np.median(each[known], axis=1).tolist() for each in (self.recorded, self.run))
        moved = [
            (names[index], before, after)
            for index, before, after in zip(known, then, now, strict=True)
            if before != after
        ]
        if not moved:
            return f"{self.fact.name} moved between the seeds of its samples, their medians did not"
        lower = self.fact.better == "lower"
        worse = sum((after > before) == lower for _, before, after in moved)
        finite = [each for each in moved if math.isfinite(each[1] - each[2])]
        told = Drift(self.fact.name, finite or moved, len(known), []).told()
        return f"{told}; worse in {worse}, better in {len(moved) - worse}"

    @functools.cached_property
    def standing(self) -> Array:
        """(n,) the sum of the run's ranks, of which all are of mean 0 and variance 1."""
        standing: Array = _standardised(self.ranks)[:, self.recorded.shape[1] :].sum(axis=1)
        return standing

    @functools.cached_property
    def cumulants(self) -> Array:
        """(n, G) the logarithm of the mean of exp(t s) over all draws, where s is
        :attr:`standing` and t are those of the grid."""
        kinds, kind = np.unique(np.sort(self.ranks, axis=1), axis=0, return_inverse=True)
        drawn = self.run.shape[1]
        return np.concatenate(
            [
                _cumulants(_standardised(kinds[start : start + _AT_ONCE]), drawn)
                for start in range(0, len(kinds), _AT_ONCE)
            ]
        )[kind.ravel()]

    @property
    def _pooled(self) -> Array:
        return np.hstack([self.recorded, self.run])


def _ranks(fact: Fact, values: Array) -> NDArray[np.int64]:
    """(n, N) twice the mean ranks of n times N values, from 0, the worst last."""
    badness = values if fact.better == "lower" else -values
    order = np.argsort(badness, axis=1, kind="stable")
    rising = np.take_along_axis(badness, order, axis=1)
    # a tie has what is close to the best of it: whose it is does not matter, only what there is
    first, group = rising[:, 0].copy(), np.zeros((len(values), values.shape[1]), dtype=np.int64)
    for column in range(1, rising.shape[1]):
        value = rising[:, column]
        with np.errstate(invalid="ignore"):
            size = np.maximum(np.abs(value), np.abs(first))
            far = np.abs(value - first) > np.maximum(SAME * size, fact.finest)
        apart = far | (np.isinf(size) & (value != first))
        first[apart] = value[apart]
        group[:, column] = group[:, column - 1] + apart
    flat = group + group.shape[1] * np.arange(len(group))[:, None]
    sizes = np.bincount(flat.ravel(), minlength=group.size).reshape(group.shape)
    below = np.cumsum(sizes, axis=1) - sizes
    ranks = np.empty_like(group)
    np.put_along_axis(
        ranks, order, np.take_along_axis(2 * below + sizes - 1, group, axis=1), axis=1
    )
    return ranks


def _standardised(ranks: NDArray[np.int64]) -> Array:
    centred = ranks - ranks.mean(axis=1, keepdims=True)
    spread = centred.std(axis=1, keepdims=True)
    standardised: Array = np.divide(centred, spread, out=np.zeros(ranks.shape), where=spread > 0)
    return standardised


def bounds(moves: Moves, among: NDArray[np.bool_], posterior: Array) -> tuple[Bound, Bound] | None:
    """How probable ranks as bad as those of the run are at most, and as good ones.

    ``among`` (n,): the samples that are asked about; ``posterior`` of the sizes of the shifts. None
    where nothing is open, since all seeds are alike in every sample.
    """
    total, cumulants = moves.standing[among].sum(), moves.cumulants[among].sum(axis=0)
    if not cumulants.any():
        return None
    # a sum of at least s has at most the probability exp(K(t) - t s), for every t > 0; where a
    # seed has moved all samples by d, exp(K(t) - K(d) - (t - d) s) for every t > d
    exponent = cumulants - _GRID * total
    above = np.minimum.accumulate(exponent[::-1])[::-1] - exponent
    below = np.minimum.accumulate(exponent) - exponent
    weights = posterior @ _weights(moves.recorded.shape[1], moves.run.shape[1])
    worse, better = (Bound(min(1.0, float(weights @ np.exp(each)))) for each in (above, below))
    return worse, better


@functools.cache
def _weights(recorded: int, drawn: int) -> Array:
    """Per size of the shifts, 0 first, the probabilities of those of the grid: between the mean of
    the run's seeds and that of the recorded ones."""
    scale = math.sqrt(1 / drawn + 1 / recorded)
    edges = np.concatenate([[-np.inf], (_GRID[1:] + _GRID[:-1]) / 2, [np.inf]])
    rows = [(_GRID == 0).astype(float)]
    rows += [np.diff(ndtr(edges / (scale * size))) for size in SHIFTS.sizes]
    return np.array(rows)


def _cumulants(scores: Array, drawn: int) -> Array:
    """(n, G) the logarithm of the mean of exp(t s), where s is the sum of ``drawn`` of the N rising
    ``scores``, (n, N)."""
    # in units of the largest sum that there is, so that none is lost
    lowest, highest = scores[:, :drawn].mean(axis=1), scores[:, -drawn:].mean(axis=1)
    largest = np.maximum(np.outer(lowest, _GRID), np.outer(highest, _GRID))[..., None]
    factors = np.exp(_GRID[:, None] * scores[:, None, :] - largest)
    sums = np.zeros((*factors.shape[:2], drawn + 1))
    sums[..., 0] = 1.0
    for index in range(scores.shape[1]):
        sums[..., 1:] += sums[..., :-1] * factors[..., index, None]
    logs: Array = np.log(sums[..., -1]) + drawn * largest[..., 0]
    return logs - math.log(math.comb(scores.shape[1], drawn))
