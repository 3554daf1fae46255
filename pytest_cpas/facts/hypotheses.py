"""Facts of all hypotheses of an answer: how near the best, or the worst, comes to joint limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from pytest_cpas.facts.answers import AnswerBatch
from pytest_cpas.facts.fact import Fact
from pytest_cpas.metrics.definitions import definition

__all__ = ["joint_margin"]

#: Of a score of 0, which no factor brings to its limit.
_FARTHEST = 1e30


def joint_margin(
    name: str,
    which: Literal["best", "worst"],
    conditions: Sequence[tuple[Fact, float]],
) -> Fact:
    """The fact that is at most 1 where the best (worst) hypothesis meets all ``conditions``.

    Of a hypothesis it is the largest of its errors over their limits (of scores that are better if
    larger: the limit over the score), of an answer the least (greatest) of its hypotheses'."""

    def compute(batch: AnswerBatch) -> Sequence[float | None]:
        every, starts = batch.hypotheses
        margins = np.zeros(len(every))
        for made, limit in conditions:
            # None, which is n/a, becomes NaN, and stays it
            values = np.array(made.compute(every), dtype=np.float64)
            with np.errstate(divide="ignore"):
                share = values / limit if made.better == "lower" else limit / values
            margins = np.maximum(margins, np.minimum(share, _FARTHEST))
        reduce = np.minimum if which == "best" else np.maximum
        found = reduce.reduceat(margins, starts).tolist() if len(starts) else []
        return [None if np.isnan(margin) else margin for margin in found]

    made = [made for made, _ in conditions]
    limits = [each.limit_label(limit) for each, limit in conditions]
    told = ";".join(label.replace(" ", "") for label in limits)
    return Fact(
        name,
        definition("joint_margin", f"{which}-hypothesis").id(limits=told),
        "",
        "lower",
        f"{which}: {{}} % of {', '.join(limits)}",
        compute,
        frozenset().union(*(each.needs for each in made)),
        frozenset().union(*(each.knows for each in made)),
        factor=100,
        of_all=True,
    )
