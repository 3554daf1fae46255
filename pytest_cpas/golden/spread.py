"""Whether a run differs from the recorded seeds of a method by more than the seeds do.

**One sample.** Unless something changed, the J answers of the run and the K recorded ones are
exchangeable for every sample: of the m correct among the K + J, the run's share is a random draw.
Nothing need be known of how hard a sample is. For K = J = 1 this is McNemar's exact test.

**A category, or all samples, at one threshold.** What the run loses of a sample counts by how
surprising it is: the negative logarithm of the probability that a draw loses as much, which for one
answer is the share of all K + 1 that are lost. The sum over samples (Fisher's way to combine tests)
is the statistic, and its distribution over all draws is exact (a convolution). So a loss of samples
that every recorded seed gets right is not hidden by samples that come and go.

**Seeds that move many samples at once.** The draws take samples for independent. A seed may also
make many of them harder together; how much is judged from how the recorded totals vary. It adds to
the log odds of a sample a normal deviate whose standard deviation is 0, which is taken for
:data:`_INDEPENDENT` probable, or one of :data:`_SHIFTS`; the distribution is the mean of those
under each of them, weighted by how well they explain the recorded totals (of all samples for all
together, of every category for a category).

**A run.** There are many such questions: every category and all samples, every threshold, fewer or
more. The probability that is told of an answer is that for the whole run: the sum, over all
questions, of the probability of an answer at least as improbable as this one. (The union bound;
questions that are the same are asked once, and a question of so few samples that no answer to it
could be as improbable adds nothing.)
"""

from __future__ import annotations

import bisect
import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.types.samples import ALL

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: The probability with which a run without any change is called REGRESSED or IMPROVED.
ALARM = 1e-3

#: A run that is this improbable without a change, but not as improbable as ``ALARM``, is doubtful.
DOUBT = 0.05

#: Standard deviations of what a seed adds to the log odds of all samples together.
_SHIFTS = (0.25, 0.5, 1.0)

#: How probable it is, before the totals are looked at, that seeds do not move samples together.
_INDEPENDENT = 0.95

#: Surprise is counted in whole numbers of a fraction of the natural logarithm: the finest for which
#: the sum over all samples stays near this.
_FINEST, _LONGEST = 4, 4096

#: Transforms up to this length are kept.
_CACHED = 1024

#: Relative error of the transforms, and the least probability that they can tell from none.
_ROUNDING, _LEAST = 1e-6, 1e-14

#: Nodes of the Gauss-Hermite rule for the shift of a seed, and their weights.
_NODES, _NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(7)

_SHIFT = np.concatenate([[0.0], *(size * _NODES for size in _SHIFTS)])


@dataclass(frozen=True)
class Answers:
    """What the recorded seeds and the run say of the same n samples at T thresholds.

    ``categories`` (n,) names; ``recorded`` (n, K, T) and ``run`` (n, J, T): whether a sample is
    correct under a seed; ``known`` (n, T): whether it can be judged at all.
    """

    categories: NDArray[np.str_]
    recorded: Flags
    run: Flags
    known: Flags

    @property
    def scopes(self) -> list[str]:
        """The categories, and "all" for all samples together."""
        return [*sorted(set(self.categories.tolist())), ALL]

    def among(self, scope: str) -> Flags:
        """(n,) which samples are of a scope."""
        among: Flags = np.logical_or(self.categories == scope, scope == ALL)
        return among

    def of(self, scope: str, column: int) -> tuple[Flags, Flags]:
        """What is judged of a scope at a threshold: (n', K) recorded and (n', J) of the run."""
        among = self.known[:, column] & self.among(scope)
        return self.recorded[among, :, column], self.run[among, :, column]


@dataclass(frozen=True, eq=False)
class _Question:
    """Whether the run has improbably few correct (or, asked of the opposite, many).

    ``tail`` descends: entry t is the probability of a statistic of at least t. ``p`` is that of
    the run's own.
    """

    tail: Array
    p: float

    def attained(self, p: float) -> float:
        """The probability of an answer that is as improbable as ``p``, or more."""
        first = int(np.searchsorted(-self.tail, -p * (1 + _ROUNDING)))
        return float(self.tail[first]) if first < len(self.tail) else 0.0


class Spread:
    """The run's answers against those of the recorded seeds."""

    def __init__(self, answers: Answers) -> None:
        """Ask all questions."""
        self.answers = answers
        self._together = _shifts(answers, [ALL])
        self._apart = _shifts(answers, answers.scopes[:-1])
        self._asked: dict[tuple[str, int, bool], _Question] = {}
        for scope in answers.scopes:
            for column in range(answers.known.shape[1]):
                twin = self._twin(scope, column)
                for better in (False, True):
                    self._asked[scope, column, better] = (
                        self._asked[*twin, better]
                        if twin
                        else self._ask(scope, *answers.of(scope, column), better)
                    )

    def _twin(self, scope: str, column: int) -> tuple[str, int] | None:
        """An earlier question that is the same, whatever the run had answered."""
        if scope == ALL and len(self.answers.scopes) == 2:
            return self.answers.scopes[0], column
        among = self.answers.among(scope)
        fields = (self.answers.known, self.answers.recorded, self.answers.run)
        own, *earlier = (
            [field[among][..., other] for field in fields] for other in (column, *range(column))
        )
        for other, content in enumerate(earlier):
            if all(map(np.array_equal, own, content)):
                return scope, other
        return None

    def _ask(self, scope: str, recorded: Flags, run: Flags, better: bool) -> _Question:
        shifts = self._together if scope == ALL else self._apart
        return _ask(recorded ^ better, run ^ better, shifts)

    def p(self, scope: str, column: int, *, better: bool = False) -> float:
        """How probable anything so improbable is in a whole run without a change."""
        asked = self._asked.get((scope, column, better))
        # of a scope of which nothing was judged there is nothing to see
        return min(1.0, self._of_run(asked.p)) if asked else 1.0

    @functools.cached_property
    def _distinct(self) -> list[tuple[str, _Question]]:
        """Every question once, with its scope."""
        scopes = {question: scope for (scope, *_), question in self._asked.items()}
        return [(scope, question) for question, scope in scopes.items()]

    def _of_run(self, p: float, but: Sequence[str] = ()) -> float:
        """The sum over all questions; those on a scope of ``but`` count as if all attained p."""
        return sum(p if scope in but else asked.attained(p) for scope, asked in self._distinct)

    def loss_shown(self, scope: str, level: float) -> tuple[int, int] | None:
        """How many samples of a scope must be lost for the run to be below ``level``.

        Of those that the run has right, the ones first that most seeds have; at the threshold
        where the run has most, whose column is given as well: who misses the loosest threshold
        misses all. None if losing all is not enough.
        """
        run = (self.answers.run & self.answers.known[:, None])[self.answers.among(scope)]
        column = int(run.sum(axis=(0, 1)).argmax())
        for asked in dict.fromkeys([scope, ALL]):
            if loss := self._loss_shown(scope, column, asked, self._critical(level, (scope, ALL))):
                return loss, column
        return None

    def _loss_shown(self, scope: str, column: int, asked: str, p: float) -> int | None:
        """The same, if the loss is to be below ``p`` in the question on ``asked``."""
        recorded, run = self.answers.of(asked, column)
        scopes = self.answers.categories[self.answers.known[:, column] & self.answers.among(asked)]
        right = np.flatnonzero(run.any(axis=1) & ((scopes == scope) | (scope == ALL)))
        surest = right[np.argsort(-recorded[right].sum(axis=1), kind="stable")]

        def shows(loss: int) -> bool:
            lost = run.copy()
            lost[surest[:loss]] = False
            return self._ask(asked, recorded, lost, False).p < p

        if not len(surest) or not shows(len(surest)):
            return None
        return 1 + bisect.bisect_left(range(1, len(surest)), True, key=shows)

    def _critical(self, level: float, own: Sequence[str]) -> float:
        """A p that is below ``level`` for the run, whatever the questions on ``own`` become."""
        low, high = level / len(self._asked), level
        for _ in range(20):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if self._of_run(middle, own) < level else (low, middle)
        return low


def _ask(recorded: Flags, run: Flags, shifts: Array) -> _Question:
    """Are there improbably few correct? (n, K) and (n, J); ``shifts`` as of :func:`_shifts`."""
    drawn = run.shape[1]
    total = recorded.shape[1] + drawn
    lost = drawn - run.sum(axis=1)
    wrong = lost + recorded.shape[1] - recorded.sum(axis=1)
    # nothing is open about samples on which all agree
    counts = {n: c for n, c in enumerate(np.bincount(wrong).tolist()) if c and 0 < n < total}
    most = sum(c * _draws(total, n, drawn)[1][-1] for n, c in counts.items())
    if not counts:
        return _Question(np.ones(1), 1.0)
    unit = min(_FINEST, _LONGEST / most)
    points = {n: _points(total, n, drawn, unit) for n in counts}
    tail = _tail(total, drawn, counts, points, shifts)
    seen = sum(
        points[n][k] for n, k in zip(wrong.tolist(), lost.tolist(), strict=True) if n in points
    )
    return _Question(tail, float(tail[seen]))


@functools.lru_cache(maxsize=4096)
def _draws(total: int, wrong: int, drawn: int) -> tuple[Array, Array]:
    """How probable it is that 0, 1, ... of ``wrong`` answers are among those drawn of ``total``;
    and the surprise at so many or more: the negative logarithm of its probability."""
    from scipy import stats  # slow to import, and most tables are of one seed

    lost = np.arange(min(wrong, drawn) + 1)
    at_least = stats.hypergeom.sf(lost - 1, total, wrong, drawn)
    return stats.hypergeom.pmf(lost, total, wrong, drawn), -np.log(np.minimum(at_least, 1))


def _points(total: int, wrong: int, drawn: int, unit: float) -> tuple[int, ...]:
    """The surprise in whole numbers of 1 / ``unit``, none of them lost to rounding."""
    surprise = _draws(total, wrong, drawn)[1]
    points = np.where(surprise > _ROUNDING, np.maximum(1, np.round(unit * surprise)), 0)
    return tuple(points.astype(int).tolist())


def _tail(
    total: int,
    drawn: int,
    counts: Mapping[int, int],
    points: Mapping[int, tuple[int, ...]],
    shifts: Array,
) -> Array:
    """The probabilities of at least 0, 1, ... points in all.

    ``counts``: how many samples were lost so often in all; ``points``: what each is worth.
    """
    top = sum(count * points[wrong][-1] for wrong, count in counts.items())
    length = 1 << top.bit_length()
    log_size, angle = np.zeros((2, len(shifts), length // 2 + 1))
    make = _factor if length <= _CACHED else _factor.__wrapped__
    for wrong, count in counts.items():
        factor = make(total, wrong, drawn, points[wrong], length)
        log_size += count * factor[0]
        angle += count * factor[1]
    size = np.exp(log_size)
    transform = shifts @ (size * np.cos(angle)) + 1j * (shifts @ (size * np.sin(angle)))
    probability = np.maximum(np.fft.irfft(transform, n=length)[: top + 1], 0)
    tail: Array = np.clip(np.cumsum(probability[::-1])[::-1], _LEAST, 1)
    return tail


@functools.lru_cache(maxsize=512)
def _factor(
    total: int, wrong: int, drawn: int, points: tuple[int, ...], length: int
) -> tuple[Array, Array]:
    """Of the Fourier transform of one sample's points, under every shift: log of size, angle."""
    # between the means of the run's seeds and of the recorded ones
    shift = _SHIFT * np.sqrt(1 / drawn + 1 / (total - drawn))
    chance = _draws(total, wrong, drawn)[0] * np.exp(np.outer(shift, np.arange(len(points))))
    chance /= chance.sum(axis=1, keepdims=True)
    waves = np.exp(-2j * np.pi / length * np.outer(points, np.arange(length // 2 + 1)))
    transform = chance @ waves
    with np.errstate(divide="ignore"):
        return np.log(np.abs(transform)), np.angle(transform)


def _shifts(answers: Answers, scopes: Sequence[str]) -> Array:
    """The probability of each of :data:`_SHIFT`, as the recorded totals of ``scopes`` tell.

    Without shifts, the squared deviations of K totals have K - 1 degrees of freedom and the
    variance that independent samples have; with shifts it is larger. Thresholds are much alike:
    their logarithms are averaged.
    """
    seeds, columns = answers.recorded.shape[1:]
    sizes = np.array([0.0, *_SHIFTS])
    log = np.zeros(len(sizes))
    for scope, column in itertools.product(scopes, range(columns)):
        recorded, _ = answers.of(scope, column)
        independent = float(recorded.var(axis=1).sum()) * seeds / max(seeds - 1, 1)
        if independent:
            excess = 1 + sizes**2 * independent
            totals = recorded.sum(axis=0)
            squares = float(((totals - totals.mean()) ** 2).sum()) / independent
            log -= ((seeds - 1) * np.log(excess) + squares / excess) / 2 / columns
    prior = np.array([_INDEPENDENT, *[(1 - _INDEPENDENT) / len(_SHIFTS)] * len(_SHIFTS)])
    posterior = prior * np.exp(log - log.max())
    posterior /= posterior.sum()
    nodes = _NODE_WEIGHTS / _NODE_WEIGHTS.sum()
    return np.concatenate([posterior[:1], np.outer(posterior[1:], nodes).ravel()])
