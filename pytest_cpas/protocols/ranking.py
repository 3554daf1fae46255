"""Average precision of detections, and what is kept of it: which of them are right."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pytest_cpas.facts import PairTable
from pytest_cpas.metrics.average_precision import Matches, interpolated_area
from pytest_cpas.protocols.columns import RankingColumn
from pytest_cpas.protocols.judging import Score, ScoreTable
from pytest_cpas.types import ContractError
from pytest_cpas.types._arrays import checked_integer
from pytest_cpas.types.samples import ALL

__all__ = ["RankedDetection", "Ranking", "rank", "ranking_table"]

#: Objects of a category in all images of a data set.
_MOST_COUNTED = 10**9


@dataclass(frozen=True, slots=True)
class RankedDetection:
    """A detection, how sure it is, and a character for each ranking column: right 1, wrong 0, takes
    no part -."""

    category: str
    score: float
    outcome: str


@dataclass(frozen=True)
class Ranking:
    """The detections by name, and per category how many objects each ranking column counts.

    Raises :class:`ContractError` for scores that are not finite, and for more detections that are
    right than objects are counted.
    """

    detections: Mapping[str, RankedDetection]
    counted: Mapping[str, tuple[int, ...]]

    def __post_init__(self) -> None:
        outcomes: dict[str, list[str]] = {category: [] for category in self.counted}
        for name, detection in self.detections.items():
            if not math.isfinite(detection.score):
                raise ContractError(
                    f"detection {name[:80]!r}: score {detection.score}, expected a finite number"
                )
            if detection.category in outcomes:
                outcomes[detection.category].append(detection.outcome)
        for category, counts in self.counted.items():
            for count in counts:
                checked_integer(count, f"objects counted of {category}", 0, _MOST_COUNTED)
            text = "".join(outcomes[category]).encode("ascii", "replace")
            if len(text) != len(counts) * len(outcomes[category]):
                raise ContractError(
                    f"detections of {category}: outcomes of {len(text)} characters, expected"
                    f" {len(counts)} for each of {len(outcomes[category])}"
                )
            right = np.frombuffer(text, np.uint8).reshape(
                len(outcomes[category]), len(counts)
            ) == ord("1")
            if (right.sum(axis=0) > counts).any():
                raise ContractError(
                    f"detections of {category}: {right.sum(axis=0).tolist()} are right by column,"
                    f" but {list(counts)} objects are counted"
                )

    def without(self, categories: Collection[str]) -> Ranking:
        """This ranking without some categories."""
        return Ranking(
            {k: d for k, d in self.detections.items() if d.category not in categories},
            {k: n for k, n in self.counted.items() if k not in categories},
        )

    def joined(self, other: Ranking) -> Ranking:
        """Both, which are of different categories."""
        return Ranking({**self.detections, **other.detections}, {**self.counted, **other.counted})


def rank(columns: Sequence[RankingColumn], pairs: PairTable) -> Ranking:
    """Match the detections of a data set with its objects, for every column."""
    detections, categories = pairs.detections, pairs.categories
    letters = np.full((len(pairs.detected), len(columns)), "-")
    counted = np.zeros((len(categories), len(columns)), dtype=int)
    for index, column in enumerate(columns):
        if (matches := _matches(column, pairs)) is None:
            continue
        letters[matches.taking_part, index] = "0"
        letters[matches.matched & matches.taking_part, index] = "1"
        counted[:, index] = np.bincount(
            detections.true_category[matches.counted], minlength=len(categories)
        )
    return Ranking(
        {
            detected.name: RankedDetection(detected.category, detected.score, "".join(own))
            for detected, own in zip(pairs.detected, letters.tolist(), strict=True)
        },
        dict(zip(categories, map(tuple, counted.tolist()), strict=True)),
    )


def _matches(column: RankingColumn, pairs: PairTable) -> Matches | None:
    """What a column ranks; None (n/a) if a fact is not known."""
    facts, detections = pairs.facts, pairs.detections
    if any(made.name not in facts for made in column.facts):
        return None
    if column.is_pose:
        (rotation, degrees), (position, metres) = column.pose_limits
        return detections.pose_matches(
            facts[rotation],
            facts[position],
            degrees,
            metres,
            match_iou=facts[column.matched] if column.matched else None,
        )
    [(name, limit)] = column.limits.items()
    return detections.iou_matches(facts[name], limit)


def ranking_table(columns: Sequence[RankingColumn], ranking: Ranking | None) -> ScoreTable:
    """AP of each category, and mAP as "all"; None where no object is counted."""
    if ranking is None:
        return {}
    groups: dict[str, list[RankedDetection]] = {name: [] for name in ranking.counted}
    for detection in ranking.detections.values():
        if detection.category in groups:  # of a category without objects nothing is right
            groups[detection.category].append(detection)
    table: ScoreTable = {
        category: {
            column.key: _average_precision(groups[category], index, counted[index])
            for index, column in enumerate(columns)
        }
        for category, counted in sorted(ranking.counted.items())
    }
    if table:
        table[ALL] = {column.key: _mean(column, table) for column in columns}
    return table


def _average_precision(
    detections: Sequence[RankedDetection], index: int, counted: int
) -> Score | None:
    part = [(d.score, d.outcome[index] == "1") for d in detections if d.outcome[index] != "-"]
    if not counted:
        return None
    scores = np.array([score for score, _ in part])
    correct = np.array([right for _, right in part], dtype=bool)
    return Score(interpolated_area(scores, correct, counted), counted)


def _mean(column: RankingColumn, table: ScoreTable) -> Score | None:
    cells = [cell for cells in table.values() if (cell := cells[column.key]) is not None]
    if not cells:
        return None
    return Score(float(np.mean([c.value for c in cells])), sum(c.samples for c in cells))
