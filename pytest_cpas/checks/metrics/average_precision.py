"""Properties of the average precision of a ranking."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pytest_cpas.checks.metrics import exact
from pytest_cpas.checks.metrics.properties import REFUSED, close, expect, prop, unless_refused
from pytest_cpas.checks.metrics.strategies import seeds
from pytest_cpas.checks.metrics.subject import Subject

FINE = 1e-6
AP = "average_precision"


@st.composite
def rankings(draw: st.DrawFn, ties: bool = False) -> list[Any]:
    """[scores, correct, ground truths] in any order, with or without equal scores."""
    count = draw(st.integers(1, 10))
    correct = draw(st.lists(st.booleans(), min_size=count, max_size=count))
    if ties:
        scores = draw(st.lists(st.sampled_from([0.25, 0.5, 0.75]), min_size=count, max_size=count))
    else:
        scores = [(rank + 1) / 16 for rank in draw(st.permutations(range(count)))]
    return [scores, correct, sum(correct) + draw(st.integers(0, 3)) or 1]


def _ap(subject: Subject, scores: Any, correct: Any, truths: int) -> Any:
    return subject(AP, np.array(scores, dtype=float), np.array(correct, dtype=bool), truths)


@prop(AP, reason="an independent computation in rational numbers", given={"ranking": rankings()})
def by_definition(subject: Subject, ranking: list[Any]) -> None:
    """Without ties it is the area under the precision-recall curve, interpolated as declared."""
    scores, correct, truths = ranking
    interpolated = subject.defines(AP, "interpolated")
    expected = exact.average_precision(scores, correct, truths, interpolated)
    close(_ap(subject, *ranking), expected, FINE)


@prop(AP, reason="the ends of the scale", given={"count": st.integers(1, 8)}, weight=0.25)
def perfect_and_hopeless(subject: Subject, count: int) -> None:
    """All correct and complete gives 1, none correct gives 0."""
    scores = np.arange(1, count + 1) / 16
    close(_ap(subject, scores, [True] * count, count), 1, FINE)
    close(_ap(subject, scores, [False] * count, count), 0, FINE)


@prop(AP, reason="a share of an area", given={"ranking": rankings(ties=True)}, weight=0.5)
def in_range(subject: Subject, ranking: list[Any]) -> None:
    """The AP is in [0, 1]."""
    value = _ap(subject, *ranking)
    expect(-FINE <= value <= 1 + FINE, f"the AP is {value!r}")


@prop(AP, reason="the file's order of detections means nothing",
      given={"ranking": rankings(), "seed": seeds})  # fmt: skip
def independent_of_order(subject: Subject, ranking: list[Any], seed: int) -> None:
    """Without ties the order of the input changes nothing."""
    scores, correct, truths = ranking
    order = np.random.default_rng(seed).permutation(len(scores))
    mixed = np.array(scores)[order], np.array(correct)[order], truths
    close(_ap(subject, *mixed), _ap(subject, *ranking), FINE)


@prop(AP, reason="networks give equal scores (1.0, say) all the time; an unstable sort, or the "
      "file's order, then decides",
      given={
          "seed": seeds, "count": st.integers(2, 64),
          "scores": st.lists(st.sampled_from([0.5, 1.0]), min_size=1, max_size=2, unique=True),
      })  # fmt: skip
def independent_of_order_under_ties(
    subject: Subject, seed: int, count: int, scores: list[float]
) -> None:
    """With equal scores, too, the order of the input changes nothing."""
    rng = np.random.default_rng(seed)
    values, correct = rng.choice(scores, size=count), rng.random(count) < 0.5
    truths = max(int(correct.sum()), 1)
    one = _ap(subject, values, correct, truths)
    order = rng.permutation(count)
    close(_ap(subject, values[order], correct[order], truths), one, FINE, "in another order the AP")


@prop(AP, reason="a ranking has no scale: logits and probabilities rank alike",
      given={"ranking": rankings(ties=True)}, weight=0.5)  # fmt: skip
def monotone_scores(subject: Subject, ranking: list[Any]) -> None:
    """A monotone change of the scores changes nothing."""
    scores, correct, truths = ranking
    one = _ap(subject, scores, correct, truths)
    close(_ap(subject, [math.exp(4 * s) for s in scores], correct, truths), one, FINE)


@prop(AP, reason="recall is of all ground truths, found or not", given={"ranking": rankings()},
      weight=0.5)  # fmt: skip
def missed_truths_count(subject: Subject, ranking: list[Any]) -> None:
    """Twice as many ground truths halve the AP."""
    scores, correct, truths = ranking
    close(2 * _ap(subject, scores, correct, 2 * truths), _ap(subject, *ranking), FINE)


def _all_short() -> Iterator[dict[str, Any]]:
    """Every ranking of up to five, with every number of truths that are missed, up to two."""
    for count in range(1, 6):
        scores = [(count - rank) / 16 for rank in range(count)]
        for correct in itertools.product((False, True), repeat=count):
            for missed in (0, 1, 2):
                if truths := sum(correct) + missed:
                    yield {"ranking": [scores, list(correct), truths]}


@prop(AP, reason="what a rule makes of a wrong one between two right ones, or of the last one, "
      "shows in few rankings", given={"ranking": rankings()}, weight=0.25,
      corners=_all_short)  # fmt: skip
def short_rankings(subject: Subject, ranking: list[Any]) -> None:
    """All short rankings have the area under their precision-recall curve."""
    by_definition(subject, ranking)


#: Monotone changes of scores from 0 to 1.
SCALES: dict[str, Any] = {
    "negative": lambda s: s - 2,
    "around zero": lambda s: s - 0.3,
    "tiny": lambda s: s * 1e-30,
    "near one": lambda s: 1 - (1 - s) * 2.0**-45,
    "large": lambda s: 1e6 + 1e3 * s,
    "logarithms": lambda s: math.log(s) * 40,
    "beyond one": lambda s: 100 * s,
}


@prop(AP, reason="scores may be logits, distances with a minus, or probabilities near 0 or 1: no "
      "threshold, no rounding and no sign has a say",
      given={"ranking": rankings(), "scale": st.sampled_from(sorted(SCALES))}, weight=0.5,
      corners=lambda: (
          {"ranking": [[5 / 16, 4 / 16, 3 / 16, 2 / 16, 1 / 16], [True, True, False, True, False],
                       4], "scale": scale}
          for scale in SCALES
      ))  # fmt: skip
def any_scores(subject: Subject, ranking: list[Any], scale: str) -> None:
    """Negative, tiny, large and nearly equal scores rank as others do."""
    scores, correct, truths = ranking
    by_definition(subject, [[SCALES[scale](s) for s in scores], correct, truths])


@prop(AP, reason="evaluations of images keep the best 100 of each; a category has more",
      given={"seed": seeds, "count": st.sampled_from([101, 150, 300])}, weight=0.1,
      corners=lambda: (
          {"seed": seed, "count": count} for seed, count in ((0, 101), (1, 260), (2, 1100))
      ))  # fmt: skip
def long_rankings(subject: Subject, seed: int, count: int) -> None:
    """Long rankings have the area under their precision-recall curve, to the last detection."""
    rng = np.random.default_rng(seed)
    correct = rng.random(count) < 0.3
    # what is cut off at the end would be right
    correct[: count // 20] = True
    scores = (np.arange(count) + 1) / count
    order = rng.permutation(count)
    truths = int(correct.sum()) + 3
    value = _ap(subject, scores[order], correct[order], truths)
    interpolated = subject.defines(AP, "interpolated")
    close(value, exact.average_precision(scores.tolist(), correct.tolist(), truths, interpolated),
          FINE)  # fmt: skip


def _tied() -> Iterator[dict[str, Any]]:
    for scores in ([1, 1], [1, 1, 1], [2, 1, 1], [2, 2, 1], [2, 2, 1, 1], [3, 2, 2, 1]):
        for correct in itertools.product((False, True), repeat=len(scores)):
            if any(correct):
                yield {"ranking": [[s / 4 for s in scores], list(correct), sum(correct)]}


@prop(AP, reason="of equal scores no order is known: more than the best one, or less than the "
      "worst, no order gives", given={"ranking": rankings(ties=True)}, weight=0.5,
      corners=_tied)  # fmt: skip
def ties_within_their_orders(subject: Subject, ranking: list[Any]) -> None:
    """With equal scores the AP lies between those of the worst and of the best order."""
    scores, correct, truths = ranking
    interpolated = subject.defines(AP, "interpolated")
    low, high = (
        exact.average_precision(
            [s + sign * 1e-3 * c for s, c in zip(scores, correct, strict=True)], correct, truths,
            interpolated,
        )
        for sign in (-1, 1)
    )  # fmt: skip
    value = _ap(subject, *ranking)
    expect(
        value is not None and low - FINE <= value <= high + FINE,
        f"the AP is {value!r}, but the worst order gives {low!r} and the best {high!r}",
    )


@prop(AP, reason="an empty ranking finds nothing: that is neither NaN nor n/a",
      given={"truths": st.integers(1, 5)}, weight=0.1)  # fmt: skip
def nothing_detected(subject: Subject, truths: int) -> None:
    """Without any detection the AP is 0, or an error."""
    value = unless_refused(subject, AP, np.zeros(0), np.zeros(0, dtype=bool), truths)
    if value is not REFUSED:
        close(value, 0, FINE)
