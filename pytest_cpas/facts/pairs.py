"""Detections of a data set beside all ground truth that they may be matched with."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pytest_cpas.facts.catalogue import fact
from pytest_cpas.facts.measuring import measure_facts
from pytest_cpas.metrics.average_precision import Detections
from pytest_cpas.types import Array, GroundTruth, Hypothesis

__all__ = ["Detected", "PairTable", "pair_table"]


@dataclass(frozen=True, kw_only=True)
class Detected:
    """A detection: its name, its image and category, how sure it is, and what was estimated.

    ``hypothesis``: in the standard frames; None for an answer that is none, which is never right.
    """

    name: str
    image: str
    category: str
    score: float
    hypothesis: Hypothesis | None


@dataclass(frozen=True, eq=False)
class PairTable:
    """All pairs of a detection and a ground truth of its image and category, with their facts.

    ``facts`` by name: (K,), one of each of the pairs of ``detections``; ``categories``: the names
    of the categories that it numbers from 0.
    """

    detected: Sequence[Detected]
    categories: Sequence[str]
    detections: Detections
    facts: Mapping[str, Array]


def _no_match(name: str) -> float:
    """Of a pair with an answer that is none."""
    return 0.0 if fact(name).better == "higher" else np.inf


def pair_table(
    names: Collection[str],
    detected: Sequence[Detected],
    truths: Sequence[tuple[str, str, GroundTruth]],
    gives: Collection[str],
) -> PairTable:
    """The table with the facts of those ``names``.

    ``truths``: the image, the category and the truth of each object. Raises as
    :func:`measure_facts`; a fact that a method does not give, or that needs more
    of a data set than it knows, is left out.
    """
    categories = sorted({category for _, category, _ in truths})
    images = {image: i for i, image in enumerate(sorted({*(d.image for d in detected)}))}
    # what is in no image with a detection pairs with nothing
    number = {category: i for i, category in enumerate(categories)}
    detections = Detections(
        [images[d.image] for d in detected],
        [number.get(d.category, -1) for d in detected],
        [d.score for d in detected],
        [images.get(image, -1) for image, _, _ in truths],
        [number[category] for _, category, _ in truths],
        range(len(categories)),
    )
    known = [name for name in names if fact(name).needs <= set(gives)]
    facts = {name: np.full(len(detections.pairs), _no_match(name)) for name in known}
    answered: list[int] = []
    estimates: list[Hypothesis] = []
    for index, prediction in enumerate(detections.pairs[:, 0].tolist()):
        hypothesis = detected[prediction].hypothesis
        if hypothesis is not None:
            answered.append(index)
            estimates.append(hypothesis)
    true = [truths[i][2] for i in detections.pairs[answered, 1].tolist()]
    measured = measure_facts(known, true, estimates, gives)
    for name in known:
        values = [each[name] for each in measured]
        if None in values:
            del facts[name]
        else:
            facts[name][answered] = values
    return PairTable(detected, categories, detections, facts)
