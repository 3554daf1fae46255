"""Whether a run differs from the recorded seeds of a method by more than the seeds do.

**One sample.** Unless something changed, the J answers of the run and the K recorded ones are
exchangeable for every sample: of the m correct among the K + J, the run's share is a random draw.
Nothing need be known of how hard a sample is. For K = J = 1 this is McNemar's exact test.

**A category, or all samples, at one threshold.** What the run loses of a sample counts by how
surprising it is: the negative logarithm of the probability that a draw loses as much, which for one
answer is the share of all K + 1 that are lost. The sum over samples (Fisher's way to combine tests)
is the statistic, and its distribution over all draws is exact (:mod:`pytest_cpas.golden.exchange`,
which also says what is made of seeds that move many samples at once). So a loss of samples that
every recorded seed gets right is not hidden by samples that come and go.

**Facts** are judged by their ranks (:mod:`pytest_cpas.golden.ranks`), so that what moved without
crossing a threshold is seen as well.

**A run.** There are many such questions: every category and all samples, every threshold and fact,
worse or better. The level of a run is shared among the four kinds (:data:`_SHARES`), and among the
questions of a kind equally: losses have most of it, since a gain that is overlooked costs little.
The probability that is told of an answer is that for the whole run: the sum, over all questions, of
the probability of an answer that is at least as improbable for its share as this one. (The union
bound; questions that are the same are asked once, and a question of so few samples that no answer
to it could be as improbable adds nothing.)
"""

from __future__ import annotations

import bisect
import functools
import itertools
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.golden.exchange import (
    NOTHING,
    ROUNDING,
    Array,
    Draw,
    Question,
    Shifts,
    question,
)
from pytest_cpas.golden.ranks import SHIFTS, Bound, Moves, bounds
from pytest_cpas.types.samples import ALL

Flags = NDArray[np.bool_]
_Asked: TypeAlias = Question | Bound

#: The probability with which a run without any change is called REGRESSED or IMPROVED.
ALARM = 1e-3

#: A run that is this improbable without a change, but not as improbable as ``ALARM``, is doubtful.
DOUBT = 0.05

#: Shares of the level, by whether a fact is asked about (or a count), and whether it got better.
_SHARES: Mapping[tuple[bool, bool], float] = {
    (False, False): 0.6,
    (False, True): 0.1,
    (True, False): 0.25,
    (True, True): 0.05,
}

_OF_FACTS = sum(share for (of_fact, _), share in _SHARES.items() if of_fact)

#: Standard deviations of what a seed adds to the log odds of all samples together.
_SHIFTS = Shifts((0.25, 0.5, 1.0))

#: Surprise is counted in whole numbers of a fraction of the natural logarithm: the finest for which
#: the sum over all samples stays near this.
_FINEST, _LONGEST = 4, 4096


@dataclass(frozen=True)
class Answers:
    """What the recorded seeds and the run say of the same n samples at T thresholds.

    ``categories`` (n,) names; ``recorded`` (n, K, T) and ``run`` (n, J, T): whether a sample is
    correct under a seed; ``known`` (n, T): whether it can be judged at all. ``facts``: by name,
    what both know of them; ``names`` of the samples.
    """

    categories: NDArray[np.str_]
    recorded: Flags
    run: Flags
    known: Flags
    facts: Mapping[str, Moves] = field(default_factory=dict)
    names: Sequence[str] = ()

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


class Spread:
    """The run's answers, and their facts, against those of the recorded seeds."""

    def __init__(self, answers: Answers) -> None:
        """Ask all questions."""
        self.answers = answers
        self._together = _shifts(answers, [ALL])
        self._apart = _shifts(answers, answers.scopes[:-1])
        self._of_facts = {
            (name, together): _fact_shifts(answers, name, scopes)
            for name in answers.facts
            for together, scopes in ((True, [ALL]), (False, answers.scopes[:-1]))
        }
        self._asked: dict[tuple[str, int | str, bool], _Asked] = {}
        once: dict[tuple[str | bytes, ...], tuple[_Asked, _Asked]] = {}
        everything = [*range(answers.known.shape[1]), *answers.facts]
        self._contents: dict[tuple[str, int | str], tuple[str | bytes, ...]] = {}
        for scope, asked in itertools.product(answers.scopes, everything):
            same = self._contents[scope, asked] = self._content(scope, asked)
            if same not in once:
                once[same] = self._both(scope, asked)
            self._asked[scope, asked, False], self._asked[scope, asked, True] = once[same]

    def _content(self, scope: str, asked: int | str) -> tuple[str | bytes, ...]:
        """What is the same of questions that are, whatever the run had answered."""
        if scope == ALL and len(self.answers.scopes) == 2:
            scope = self.answers.scopes[0]
        among = self.answers.among(scope)
        if isinstance(asked, str):
            return scope, "fact", self.answers.facts[asked].ranks[among].tobytes()
        known = self.answers.known[:, asked]
        recorded, run = self.answers.of(scope, asked)
        return scope, known[among].tobytes(), recorded.tobytes(), run.tobytes()

    def _both(self, scope: str, asked: int | str) -> tuple[_Asked, _Asked]:
        """Whether something got worse, and better."""
        if isinstance(asked, int):
            recorded, run = self.answers.of(scope, asked)
            return self._ask(scope, recorded, run), self._ask(scope, ~recorded, ~run)
        moves = self.answers.facts[asked]
        posterior = self._of_facts[asked, scope == ALL]
        return bounds(moves, self.answers.among(scope), posterior) or (NOTHING, NOTHING)

    def _ask(self, scope: str, recorded: Flags, run: Flags) -> Question:
        """Are there improbably few correct?"""
        return _ask(recorded, run, self._together if scope == ALL else self._apart)

    def p(self, scope: str, asked: int | str, *, better: bool = False) -> float:
        """How probable anything so improbable is in a whole run without a change.

        ``asked``: the index of a threshold, or the name of a fact.
        """
        key = scope, asked, better
        # of a scope of which nothing was judged there is nothing to see
        own = self._asked.get(key, NOTHING)
        return 1.0 if own is NOTHING else min(1.0, self._of_run(own.p / self._share(key)))

    def _share(self, key: tuple[str, int | str, bool]) -> float:
        """Of the level of the run, what a question has."""
        kind = _kind(key)
        return _SHARES[kind] / self._counts[kind]

    @functools.cached_property
    def _distinct(self) -> dict[tuple[str, int | str, bool], _Asked]:
        """Every question that asks something once, by its scope, about what, and whether better."""
        once = {each: key for key, each in self._asked.items() if each is not NOTHING}
        return {key: each for each, key in once.items()}

    @functools.cached_property
    def _counts(self) -> Mapping[tuple[bool, bool], int]:
        """How many questions there are of each kind."""
        return Counter(map(_kind, self._distinct))

    def _of_run(self, level: float) -> float:
        """The sum over all questions of the probability of an answer that is below its share of
        ``level``, or 1; facts that are not there count as if all were."""
        total = 0.0 if self.answers.facts else _OF_FACTS * level
        for key, asked in self._distinct.items():
            total += asked.attained(self._share(key) * level)
            if total >= 1:
                break
        return total

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
            return self._ask(asked, recorded, lost).p < p

        if not len(surest) or not shows(len(surest)):
            return None
        return 1 + bisect.bisect_left(range(1, len(surest)), True, key=shows)

    def _critical(self, level: float, own: Sequence[str]) -> float:
        """A p of a loss that is below ``level`` for the run, whatever the questions on ``own``
        become: those that ask nothing now as well."""
        kept = {
            content: key
            for key, content in self._contents.items()
            if isinstance(key[1], int)
            and (key[0] in own or self._asked[*key, False] is not NOTHING)
        }
        shares = {better: _SHARES[False, better] / max(len(kept), 1) for better in (False, True)}

        def of_run(level: float) -> float:
            return _OF_FACTS * level + sum(
                p if key[0] in own else self._asked[*key, better].attained(p)
                for key in kept.values()
                for better, p in ((each, level * share) for each, share in shares.items())
            )

        low, high = level, level * len(self._asked) / min(_SHARES.values())
        for _ in range(30):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if of_run(middle) < level else (low, middle)
        return low * shares[False]


def _kind(key: tuple[str, int | str, bool]) -> tuple[bool, bool]:
    """Whether a question is about a fact, and whether that got better."""
    _, asked, better = key
    return isinstance(asked, str), better


def _ask(recorded: Flags, run: Flags, posterior: Array) -> Question:
    """Are there improbably few correct? (n, K) and (n, J); ``posterior`` as of :func:`_shifts`."""
    drawn = run.shape[1]
    total = recorded.shape[1] + drawn
    lost = drawn - run.sum(axis=1)
    wrong = lost + recorded.shape[1] - recorded.sum(axis=1)
    # nothing is open about samples on which all agree
    counts = {n: c for n, c in enumerate(np.bincount(wrong).tolist()) if c and 0 < n < total}
    if not counts:
        return NOTHING
    most = sum(c * _surprise(total, n, drawn)[-1] for n, c in counts.items())
    unit = min(_FINEST, _LONGEST / most)
    draws = {n: _draw(total, n, drawn, unit) for n in counts}
    seen = sum(
        draws[n].points[k] for n, k in zip(wrong.tolist(), lost.tolist(), strict=True) if n in draws
    )
    # between the means of the run's seeds and of the recorded ones
    scale = math.sqrt(1 / drawn + 1 / (total - drawn))
    alike: Counter[Draw] = Counter()
    for n, count in counts.items():
        alike[draws[n]] += count
    return question(alike, seen, scale, _SHIFTS, posterior)


@functools.lru_cache(maxsize=4096)
def _surprise(total: int, wrong: int, drawn: int) -> Array:
    """How surprising it is that 0, 1, ... or more of ``wrong`` answers are among those drawn of
    ``total``: the negative logarithm of its probability."""
    from scipy import stats  # slow to import, and most tables are of one seed

    at_least = stats.hypergeom.sf(_lost(wrong, drawn) - 1, total, wrong, drawn)
    surprise: Array = -np.log(np.minimum(at_least, 1))
    return surprise


@functools.lru_cache(maxsize=4096)
def _draw(total: int, wrong: int, drawn: int, unit: float) -> Draw:
    """The surprise in whole numbers of 1 / ``unit``, none of it lost to rounding."""
    from scipy import stats

    surprise, lost = _surprise(total, wrong, drawn), _lost(wrong, drawn)
    points = np.where(surprise > ROUNDING, np.maximum(1, np.round(unit * surprise)), 0)
    chance = stats.hypergeom.pmf(lost, total, wrong, drawn)
    return Draw(
        *(tuple(each.tolist()) for each in (points.astype(int), chance, lost.astype(float)))
    )


def _lost(wrong: int, drawn: int) -> NDArray[np.int64]:
    return np.arange(min(wrong, drawn) + 1)


def _shifts(answers: Answers, scopes: Sequence[str]) -> Array:
    """The probability of each size of a shift, as the recorded totals of ``scopes`` tell.

    Thresholds are much alike: their logarithms are averaged.
    """
    columns = answers.recorded.shape[2]
    log = np.zeros(1 + len(_SHIFTS.sizes))
    for scope, column in itertools.product(scopes, range(columns)):
        recorded, _ = answers.of(scope, column)
        log += _SHIFTS.log_likelihood(recorded) / columns
    return _SHIFTS.posterior(log)


def _fact_shifts(answers: Answers, name: str, scopes: Iterable[str]) -> Array:
    """The same of a fact."""
    log = np.zeros(1 + len(SHIFTS.sizes))
    for scope in scopes:
        log += SHIFTS.log_likelihood(answers.facts[name].luck[answers.among(scope)])
    return SHIFTS.posterior(log)
