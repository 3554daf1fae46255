"""Facts in, judgements out. Everything here is pure."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from pytest_cpas.facts import Facts, fact, in_order
from pytest_cpas.metrics.precision import Count, share_met
from pytest_cpas.protocols.columns import (
    Column,
    CountColumn,
    Protocol,
    RankingColumn,
    ScoreColumn,
)
from pytest_cpas.types import Array
from pytest_cpas.types.samples import ALL

__all__ = [
    "Score",
    "ScoreTable",
    "Table",
    "count_columns",
    "count_table",
    "facts_of",
    "judge_outcomes",
    "ranking_columns",
    "score_columns",
    "score_table",
]


@dataclass(frozen=True)
class Score:
    """``value`` over ``samples`` samples; infinite where so many failed that there is none."""

    value: float
    samples: int


#: Counts per category (and "all") and key of a column; None where every sample is n/a.
Table: TypeAlias = dict[str, dict[str, Count | None]]

#: Scores in the same form.
ScoreTable: TypeAlias = dict[str, dict[str, Score | None]]


def count_columns(protocols: Iterable[Protocol]) -> tuple[CountColumn, ...]:
    """The columns that count samples, of all protocols in their order."""
    return tuple(column for protocol in protocols for column in protocol.counts)


def score_columns(protocols: Iterable[Protocol]) -> tuple[ScoreColumn, ...]:
    """The columns that have a number per sample, of all protocols in their order."""
    return tuple(column for protocol in protocols for column in protocol.scores)


def ranking_columns(protocols: Iterable[Protocol]) -> tuple[RankingColumn, ...]:
    """The columns that rank detections, of all protocols in their order."""
    return tuple(column for protocol in protocols for column in protocol.rankings)


def facts_of(columns: Iterable[Column]) -> tuple[str, ...]:
    """The names of the facts that columns need, each once."""
    return tuple(in_order(made.name for column in columns for made in column.facts))


class Known:
    """The facts of n answers as columns: (n,) each, NaN where n/a."""

    def __init__(self, facts: Sequence[Facts]) -> None:
        self.facts = facts
        self._columns: dict[str, Array] = {}

    def __getitem__(self, name: str) -> Array:
        if name not in self._columns:
            values = [facts.get(name) for facts in self.facts]
            self._columns[name] = np.array(values, dtype=np.float64)  # None becomes NaN
        return self._columns[name]


def judge_outcomes(columns: Sequence[CountColumn], facts: Sequence[Facts]) -> list[str]:
    """Per answer one character for each column: correct 1, not 0, n/a -."""
    known = Known(facts)
    letters = np.full((len(facts), len(columns)), ord("1"), dtype=np.uint8)
    for column, letter in zip(columns, letters.T, strict=True):
        values = [(made, limit, known[made.name]) for made, limit in column.conditions]
        for made, limit, value in values:
            letter[~made.meets(value, limit)] = ord("0")
        for *_, value in values:
            letter[np.isnan(value)] = ord("-")
    text, width = letters.tobytes().decode("ascii"), len(columns)
    # a few different ones only, however many answers: one object each
    return [sys.intern(text[i * width : (i + 1) * width]) for i in range(len(facts))]


def count_table(columns: Sequence[CountColumn], judged: Iterable[tuple[str, str]]) -> Table:
    """The counts of samples given as (category, outcome)."""
    groups: dict[str, list[str]] = {}
    for category, outcome in judged:
        groups.setdefault(ALL, []).append(outcome)
        groups.setdefault(category, []).append(outcome)
    table: Table = {}
    for category, members in sorted(groups.items()):
        table[category] = {}
        for index, column in enumerate(columns):
            letters = [outcome[index] for outcome in members if outcome[index] != "-"]
            cell = Count(letters.count("1"), len(letters)) if letters else None
            table[category][column.key] = cell
    return table


def score_table(
    columns: Sequence[ScoreColumn], categories: Sequence[str], facts: Sequence[Facts]
) -> ScoreTable:
    """The scores of samples whose categories and facts are given."""
    known, of_sample = Known(facts), np.array(categories, dtype=str)
    names = [*sorted(set(categories)), *([ALL] if categories else [])]
    table: ScoreTable = {name: {} for name in names}
    for column in columns:
        scores = sample_scores(column, known)
        for name in names:
            among = scores[(of_sample == name) | (name == ALL)]
            among = among[~np.isnan(among)]
            statistic = np.median if column.median else np.mean
            table[name][column.key] = (
                Score(float(statistic(among)), len(among)) if len(among) else None
            )
    return table


def sample_scores(column: ScoreColumn, known: Known) -> Array:
    """The number of each sample, NaN where n/a."""
    if column.median:
        return known[column.median]
    share: Array = np.ones(len(known.facts))
    for name, levels in column.levels.items():
        value, rising = known[name], np.array(levels)
        if fact(name).better == "higher":
            better = np.searchsorted(rising, value, side="left")
        else:
            better = len(rising) - np.searchsorted(rising, value, side="right")
        share = share * np.where(np.isnan(value), np.nan, better / len(rising))
    for name, (start, stop) in column.areas.items():
        value = known[name]
        # thresholds run from start to stop; those on the worse side of the value are met
        met = (value - start if fact(name).better == "higher" else stop - value) / (stop - start)
        share = share * np.where(np.isnan(met), np.nan, share_met(met, column.bins or None))
    return share
