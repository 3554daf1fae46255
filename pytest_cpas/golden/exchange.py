"""Answers that could be exchanged: how probable is a sum over samples.

Unless something changed, the answers of a run and the recorded ones are exchangeable for every
sample: which of them are the run's is a random draw, of which all outcomes are known. What a run
gave is therefore compared with the distribution of a sum over samples, which is exact (a
convolution of what each of them may add).

**Seeds that move many samples at once.** The draws take samples for independent. A seed may also
make many of them harder together. It then pulls the draws of all samples one way, by a normal
deviate whose standard deviation is 0, which is taken for :data:`INDEPENDENT` probable, or one of a
few sizes; the distribution is the mean of those under each of them, weighted by how well they
explain the totals of the recorded seeds.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: How probable it is, before the totals are looked at, that seeds do not move samples together.
INDEPENDENT = 0.95

#: Transforms up to this length are kept.
_CACHED = 1024

#: Relative error of the transforms, and the least probability that they can tell from none.
ROUNDING, _LEAST = 1e-6, 1e-14

#: Nodes of the Gauss-Hermite rule for the shift of a seed, and their weights.
_NODES, _NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(7)


@dataclass(frozen=True)
class Draw:
    """What a sample may add to the sum, in whole numbers from 0, and how probable each is.

    ``pull``: by what a seed that moves samples by 1 multiplies the probability, its logarithm.
    """

    points: tuple[int, ...]
    chance: tuple[float, ...]
    pull: tuple[float, ...]


@dataclass(frozen=True)
class Shifts:
    """How far a seed may move all samples: the standard deviations besides 0."""

    sizes: tuple[float, ...]

    @functools.cached_property
    def values(self) -> Array:
        """What is drawn for a seed, at the nodes of all sizes, 0 first."""
        return np.concatenate([[0.0], *(size * _NODES for size in self.sizes)])

    @functools.cached_property
    def weights(self) -> Array:
        """Per size, 0 first, the weights of :attr:`values`."""
        count, nodes = len(self.sizes), _NODE_WEIGHTS / _NODE_WEIGHTS.sum()
        weights = np.zeros((1 + count, 1 + count * len(nodes)))
        weights[0, 0] = 1
        for index in range(count):
            weights[1 + index, 1 + index * len(nodes) :][: len(nodes)] = nodes
        return weights

    def log_likelihood(self, values: NDArray[np.generic]) -> Array:
        """Per size, 0 first: how well it explains what K seeds gave of n samples, (n, K), in all.

        Without shifts, the squared deviations of the totals have K - 1 degrees of freedom and the
        variance of independent samples; with shifts it is larger. 0 where no sample varies.
        """
        seeds = values.shape[1]
        totals = values.sum(axis=0)
        independent = float(values.var(axis=1).sum()) * seeds / max(seeds - 1, 1)
        if not independent:
            return np.zeros(1 + len(self.sizes))
        excess = 1 + np.array([0.0, *self.sizes]) ** 2 * independent
        squares = float(((totals - totals.mean()) ** 2).sum()) / independent
        log: Array = -((len(totals) - 1) * np.log(excess) + squares / excess) / 2
        return log

    def posterior(self, log: Array) -> Array:
        """The probability of each size, 0 first, after a likelihood."""
        count = len(self.sizes)
        prior = np.array([INDEPENDENT, *[(1 - INDEPENDENT) / count] * count])
        weighed = prior * np.exp(log - log.max())
        posterior: Array = weighed / weighed.sum()
        return posterior


@dataclass(frozen=True, eq=False)
class Question:
    """Whether a sum is improbably large.

    ``tail`` descends: entry t is the probability of a sum of at least t. ``p`` is that of the run's
    own.
    """

    tail: Array
    p: float

    def attained(self, p: float) -> float:
        """The probability of an answer that is as improbable as ``p``, or more."""
        first = int(np.searchsorted(-self.tail, -p * (1 + ROUNDING)))
        return float(self.tail[first]) if first < len(self.tail) else 0.0


#: What is asked where nothing is open.
NOTHING = Question(np.ones(1), 1.0)


def question(
    counts: Mapping[Draw, int], seen: int, scale: float, shifts: Shifts, posterior: Array
) -> Question:
    """Is the sum ``seen`` improbably large?

    ``counts``: how many samples draw alike; ``scale``: of the shifts of a seed; ``posterior`` of
    their sizes.
    """
    probability = posterior @ _probabilities(tuple(counts.items()), scale, shifts)
    tail: Array = np.clip(np.cumsum(probability[::-1])[::-1], _LEAST, 1)
    return Question(tail, float(tail[seen]))


@functools.lru_cache(maxsize=64)
def _probabilities(counts: tuple[tuple[Draw, int], ...], scale: float, shifts: Shifts) -> Array:
    """Per size of the shifts, the probabilities of 0, 1, ... points in all."""
    top = sum(count * max(draw.points) for draw, count in counts)
    length = 1 << top.bit_length()
    log_size, angle = np.zeros((2, len(shifts.values), length // 2 + 1))
    make = _factor if length <= _CACHED else _factor.__wrapped__
    for draw, count in counts:
        factor = make(draw, scale, shifts, length)
        log_size += count * factor[0]
        angle += count * factor[1]
    size = np.exp(log_size)
    transform = shifts.weights @ (size * np.cos(angle))
    transform = transform + 1j * (shifts.weights @ (size * np.sin(angle)))
    probability: Array = np.maximum(np.fft.irfft(transform, n=length, axis=1)[:, : top + 1], 0)
    return probability


@functools.lru_cache(maxsize=512)
def _factor(draw: Draw, scale: float, shifts: Shifts, length: int) -> tuple[Array, Array]:
    """Of the Fourier transform of one sample's points, under every shift: log of size, angle."""
    chance = np.array(draw.chance) * np.exp(np.outer(scale * shifts.values, draw.pull))
    chance /= chance.sum(axis=1, keepdims=True)
    waves = np.exp(-2j * np.pi / length * np.outer(draw.points, np.arange(length // 2 + 1)))
    transform = chance @ waves
    with np.errstate(divide="ignore"):
        return np.log(np.abs(transform)), np.angle(transform)
