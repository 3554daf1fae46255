"""Whether a run differs from the recorded seeds of a method by more than the seeds do.

The test is the generalisation of McNemar's exact test from one recorded run to several. Unless
something changed, the new run and the K recorded ones are exchangeable for every sample: of the m
correct answers among the K + 1, the new run has each with the same probability, so it is correct
with probability m / (K + 1), and the number of samples that it gets right has the distribution of
a sum of such draws. For K = 1 these are the discordant pairs of McNemar's test, with probability
1/2 each. Samples that all agree on say nothing.

That sum takes the samples for independent. Where the recorded totals themselves vary more than
independent samples would, the totals are compared instead (a prediction interval of Student's t),
and both tests must agree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Probability that a run without any change is called worse, or better.
FALSE_ALARMS = 1e-5

#: Recorded totals that vary this improbably much are not those of independent samples.
_DEPENDENT = 0.01

Outcomes = NDArray[np.bool_]


def fewer(recorded: Outcomes, new: Outcomes) -> float:
    """Probability of as few correct samples as ``new`` has, or fewer, if nothing changed.

    ``recorded`` (n, K): whether sample n was correct under seed K. ``new`` (n,).
    """
    from scipy import stats  # slow to import, and most tables are of one seed

    seeds = recorded.shape[1]
    correct = recorded.sum(axis=1) + new
    open_to_chance = (correct > 0) & (correct <= seeds)
    distribution = np.ones(1)
    for m, count in enumerate(np.bincount(correct[open_to_chance])):
        if count:
            draws = stats.binom.pmf(np.arange(count + 1), count, m / (seeds + 1))
            distribution = np.convolve(distribution, draws)
    exact = float(distribution[: int(new[open_to_chance].sum()) + 1].sum())
    totals = recorded.sum(axis=0)
    if not _dependent(recorded, totals):
        return min(exact, 1.0)
    deviation = np.std(totals, ddof=1) * np.sqrt(1 + 1 / seeds)
    by_totals = float(stats.t.cdf((new.sum() - totals.mean()) / deviation, seeds - 1))
    return max(exact, by_totals)


def more(recorded: Outcomes, new: Outcomes) -> float:
    """Probability of as many correct samples, or more, if nothing changed; see :func:`fewer`."""
    return fewer(~recorded, ~new)


def _dependent(recorded: Outcomes, totals: NDArray[np.int64]) -> bool:
    from scipy import stats

    expected = float(recorded.var(axis=1, ddof=1).sum()) if len(totals) > 1 else 0.0
    if expected == 0:
        return False
    excess = ((totals - totals.mean()) ** 2).sum() / expected
    return bool(stats.chi2.sf(excess, len(totals) - 1) < _DEPENDENT)


def detectable_loss(recorded: Outcomes, level: float) -> int | None:
    """The smallest loss that is called at ``level``; None if even losing every sample is not.

    The loss is of the samples that most seeds get right, from a run like the first seed.
    """
    new = recorded[:, 0].copy()
    order = np.argsort(-recorded.sum(axis=1), kind="stable")
    candidates = order[new[order]]

    def called(loss: int) -> bool:
        run = new.copy()
        run[candidates[:loss]] = False
        return fewer(recorded, run) < level

    low, high = 0, len(candidates)  # not called, called
    if not called(high):
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if called(middle) else (middle, high)
    return high
