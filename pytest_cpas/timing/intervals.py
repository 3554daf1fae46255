"""Medians of paired ratios, with intervals that are exact for any distribution.

The median m of a continuous distribution lies between the k-th smallest and the k-th largest of n
independent values with probability 1 - 2 P(Binomial(n, 1/2) < k), whatever the distribution (the
sign test turned round). With ties the probability is no less.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

#: Quadruples (candidate, reference, reference, candidate) after which a run is looked at; the last
#: number is the most that are timed.
LOOKS = (12, 24, 48, 96)

#: Probability of a wrong verdict (SLOWER, NOT SLOWER or FASTER that is not true), over all looks.
ERROR = 0.01

#: How sure an interval is that one of :data:`LOOKS` is judged by.
LOOK_CONFIDENCE = 1 - ERROR / len(LOOKS)

#: The same where a recorded ratio, half of the error, is compared with: of both.
RECORD_CONFIDENCE = 1 - ERROR / 2
RECORD_LOOK_CONFIDENCE = 1 - ERROR / 2 / len(LOOKS)

#: How sure an interval is that nothing is judged by.
CONFIDENCE = 1 - ERROR


@dataclass(frozen=True)
class Interval:
    """A median, and between what it lies with probability ``confidence``."""

    median: float
    lower: float
    upper: float
    confidence: float


def median_interval(values: Sequence[float], confidence: float) -> Interval:
    """The median of ``values`` and its order-statistic interval, at least ``confidence`` sure.

    Raises ValueError for so few values that even all of them together are not that sure.
    """
    ranked = sorted(values)
    rank = _rank(len(ranked), confidence)
    if rank == 0:
        raise ValueError(
            f"{len(ranked)} values hold their median with less than {confidence:.4g} probability"
        )
    return Interval(statistics.median(ranked), ranked[rank - 1], ranked[-rank], confidence)


def _rank(count: int, confidence: float) -> int:
    """The largest k with 2 P(Binomial(count, 1/2) < k) <= 1 - confidence."""
    allowed = (1 - confidence) / 2 * 2**count
    rank, outside = 0, 1
    while outside <= allowed:
        rank += 1
        outside += math.comb(count, rank)
    return rank


def quotient(over: Interval, under: Interval) -> Interval:
    """Of two independent medians; as sure as both intervals are together. Positive values."""
    return Interval(
        over.median / under.median,
        over.lower / under.upper,
        over.upper / under.lower,
        over.confidence + under.confidence - 1,
    )


def relative_to_others(groups: Sequence[Sequence[float]]) -> list[float]:
    """Each value over the median of the others of its group, at least two in each.

    This is how far a value lies from what the group would be taken for without it. Positive values.
    """
    return [
        value / statistics.median([*group[:index], *group[index + 1 :]])
        for group in groups
        for index, value in enumerate(group)
    ]


def decide(
    slowdown: Interval, limit: float
) -> Literal["slower", "not slower", "faster", "undecided"]:
    """Whether a slow-down by more than the factor ``limit`` (> 1) happened."""
    if slowdown.lower > limit:
        return "slower"
    if slowdown.upper < 1 / limit:
        return "faster"
    return "not slower" if slowdown.upper <= limit else "undecided"
