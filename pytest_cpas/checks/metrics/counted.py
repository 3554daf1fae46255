"""Properties of what is counted of several hypotheses, at many thresholds, and how sure it is."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from hypothesis import strategies as st
from scipy.special import stdtr

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.precision import FINE, LARGER_IS_BETTER, LIMITS, NAMES, limits_of
from pytest_cpas.checks.metrics.properties import REFUSED, close, expect, prop, unless_refused
from pytest_cpas.checks.metrics.subject import Subject

BEST = "best_precision"
WORST = "worst_precision"
CURVE = "precision_curve"
COUNT = "count_interval"
MEAN = "mean_interval"
MEDIAN = "median_interval"


def _beside(name: str, good: bool) -> float:
    limit = LIMITS[name][1]
    return limit * (1.1 if good == (name in LARGER_IS_BETTER) else 0.9)


def _rows(sample: list[list[bool]], names: list[str]) -> list[dict[str, float]]:
    """Of each hypothesis the errors: right or wrong for each name."""
    return [
        {name: _beside(name, good) for name, good in zip(names, flags, strict=False)}
        for flags in sample
    ]


_FLAGS = st.lists(st.booleans(), min_size=3, max_size=3)


def _samples() -> Iterator[dict[str, Any]]:
    names = ["rotation_deg", "position_m", "fscore"]
    yes, no, half, other = [True] * 3, [False] * 3, [True, False, True], [False, True, True]
    for sample in ([yes, no], [no, yes], [half, other], [yes], [no], [no, no, yes], [yes, yes, no],
                   [half, yes], [half, half]):  # fmt: skip
        yield {"samples": [sample, [yes]], "names": names}
        yield {"samples": [sample], "names": names[:1]}
    yield {"samples": [[], [yes]], "names": names}
    yield {"samples": [[], [yes, no], [no]], "names": names}


def _of_each(metric: str, combine: Any) -> None:
    def by_hand(subject: Subject, samples: list[Any], names: list[str]) -> None:
        """It counts samples by their hypotheses; one without any is wrong."""
        right = [
            bool(sample) and combine(all(flags[: len(names)]) for flags in sample)
            for sample in samples
        ]
        args = [_rows(sample, names) for sample in samples], limits_of(names, 1)
        if all(samples):
            close(subject(metric, *args), sum(right) / len(right), FINE)
        elif (value := unless_refused(subject, metric, *args)) is not REFUSED:
            close(value, sum(right) / len(right), FINE)

    prop(
        metric,
        reason="any or all of the hypotheses must meet all limits at once, each of them by itself",
        given={
            "samples": st.lists(st.lists(_FLAGS, min_size=1, max_size=4), min_size=1, max_size=5),
            "names": NAMES,
        },
        weight=0.5,
        corners=_samples,
    )(by_hand)


_of_each(BEST, any)
_of_each(WORST, all)


@prop(BEST, WORST, reason="with one hypothesis each there is nothing to choose",
      given={"samples": st.lists(_FLAGS, min_size=1, max_size=5), "names": NAMES},
      weight=0.25)  # fmt: skip
def of_single_hypotheses(subject: Subject, samples: list[Any], names: list[str]) -> None:
    """With one hypothesis per sample the best and the worst precision are the same."""
    args = [_rows([flags], names) for flags in samples], limits_of(names, 1)
    close(subject(BEST, *args), subject(WORST, *args), FINE)


# -- curves ------------------------------------------------------------------------------------


@prop(CURVE, reason="one count for each threshold, in the order in which they are given, on the "
      "side that is better", given={
          "name": st.sampled_from(sorted(LIMITS)),
          "values": st.lists(st.integers(0, 8), min_size=1, max_size=8),
          "thresholds": st.lists(st.integers(0, 8), min_size=1, max_size=5),
      }, weight=0.5, corners=lambda: (
          {"name": name, "values": [0, 3, 3, 8, 5], "thresholds": thresholds}
          for name in sorted(LIMITS) for thresholds in ([0, 3, 8], [8, 3, 0], [5], [4, 4], [1, 7])
      ))  # fmt: skip
def counted_at_each_threshold(
    subject: Subject, name: str, values: list[int], thresholds: list[int]
) -> None:
    """It is the share of samples that meet each threshold, those that equal it included."""
    errors, limits = np.array(values) / 8, np.array(thresholds) / 8
    shares = [
        float((errors >= limit if name in LARGER_IS_BETTER else errors <= limit).mean())
        for limit in limits
    ]
    found = subject(CURVE, errors, name, limits)
    expect(len(found) == len(shares), f"{len(found)} values for {len(shares)} thresholds")
    for value, expected in zip(found, shares, strict=True):
        close(value, expected, FINE)


# -- intervals ---------------------------------------------------------------------------------


def _at_least(count: int, total: int, share: float) -> float:
    """The probability of so many correct ones or more."""
    return math.fsum(
        math.comb(total, k) * share**k * (1 - share) ** (total - k) for k in range(count, total + 1)
    )


@prop(COUNT, reason="the definition: at either end what was counted is as improbable as it says",
      given={
          "counts": st.tuples(st.integers(0, 30), st.integers(1, 30)).map(sorted).map(list),
          "confidence": st.sampled_from([0.5, 0.9, 0.95, 0.99]),
      }, weight=0.5, corners=lambda: (
          {"counts": list(counts), "confidence": confidence}
          for counts in ((0, 1), (1, 1), (0, 12), (12, 12), (3, 12), (11, 12), (20, 200), (1, 2))
          for confidence in (0.5, 0.95, 0.999)
      ))  # fmt: skip
def as_improbable_as_it_says(subject: Subject, counts: list[int], confidence: float) -> None:
    """At each end of the interval the tail beyond the count is half of what may lie outside."""
    correct, total = counts
    low, high = _two(subject(COUNT, correct, total, confidence))
    tail = (1 - confidence) / 2
    if correct == 0:
        close(low, 0, FINE, "the lower end")
    else:
        close(_at_least(correct, total, low), tail, 1e-8, "the tail above, at the lower end,")
    if correct == total:
        close(high, 1, FINE, "the upper end")
    else:
        below = 1 - _at_least(correct + 1, total, high)
        close(below, tail, 1e-8, "the tail below, at the upper end,")


def _two(found: Any) -> tuple[float, float]:
    expect(found is not None and len(found) == 2, f"{found!r}, expected two ends")
    low, high = found
    expect(low <= high, f"the ends are {low!r} and {high!r}")
    return low, high


_VALUES = st.lists(st.one_of(some.real(0, 20), st.just(math.pi)), min_size=2, max_size=12)


def _columns() -> Iterator[dict[str, Any]]:
    for values in ([1.0, 2.0], [0.0, 0.1, 5.0], [3.0, 1.0, 4.0, 1.0, 5.0, 9.0, 2.0, 6.0],
                   [float(i * i) for i in range(30)]):  # fmt: skip
        for confidence, unknown in itertools.product((0.5, 0.95), (0, 2)):
            yield {"values": values, "confidence": confidence, "unknown": unknown}


_SURE = st.sampled_from([0.5, 0.8, 0.95, 0.99])


@prop(MEAN, reason="the definition by Student's distribution; n/a is no value",
      given={"values": _VALUES, "confidence": _SURE, "unknown": st.integers(0, 2)}, weight=0.5,
      corners=_columns)  # fmt: skip
def by_student(subject: Subject, values: list[float], confidence: float, unknown: int) -> None:
    """The ends are as many standard errors from the mean as Student's distribution says."""
    if min(values) == max(values):
        return
    n, mean = len(values), math.fsum(values) / len(values)
    error = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (n - 1) / n)
    low, high = _two(subject(MEAN, np.array([math.nan] * unknown + values), confidence))
    close((low + high) / 2, mean, 1e-9, "the middle")
    close(float(stdtr(n - 1, (high - mean) / error)), (1 + confidence) / 2, 1e-9, "what is below")


@prop(MEDIAN, reason="the definition by order statistics: it holds for any distribution",
      given={"values": _VALUES, "confidence": _SURE, "unknown": st.integers(0, 2)}, weight=0.5,
      corners=_columns)  # fmt: skip
def by_order_statistics(
    subject: Subject, values: list[float], confidence: float, unknown: int
) -> None:
    """The ends are the k-th smallest and largest value, k as large as confidence allows."""
    n, ranked = len(values), sorted(values)
    below = list(itertools.accumulate(math.comb(n, k) / 2**n for k in range(n)))
    rank = sum(2 * tail <= 1 - confidence + 1e-15 for tail in below)
    found = subject(MEDIAN, np.array(values + [math.nan] * unknown), confidence)
    if rank == 0:
        expect(found is None, f"{found!r}, but {n} values are not that sure: None")
    else:
        low, high = _two(found)
        close(low, ranked[rank - 1], FINE, "the lower end")
        close(high, ranked[-rank], FINE, "the upper end")
