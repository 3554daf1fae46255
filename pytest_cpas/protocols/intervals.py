"""How sure the cells of tables are: intervals per sample, and by scene."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.facts import Facts
from pytest_cpas.metrics.intervals import (
    Interval,
    mean_interval,
    median_interval,
    scene_mean_intervals,
    scene_median_interval,
)
from pytest_cpas.metrics.precision import Count
from pytest_cpas.protocols.columns import CountColumn, ScoreColumn
from pytest_cpas.protocols.judging import Known, sample_scores
from pytest_cpas.types import Array
from pytest_cpas.types.samples import ALL

__all__ = ["IntervalTable", "Intervals", "count_intervals", "score_intervals"]


@dataclass(frozen=True)
class Intervals:
    """Of one cell, at 95 %: of samples that are taken for independent, and of scenes; None where
    they say nothing."""

    sample: Interval | None
    scene: Interval | None


#: Intervals per category (and "all") and key of a column; what is n/a has none.
IntervalTable: TypeAlias = dict[str, dict[str, Intervals]]


def count_intervals(
    columns: Sequence[CountColumn],
    judged: Sequence[tuple[str, str]],
    scenes: Sequence[str] | None,
) -> IntervalTable:
    """Of the shares of samples given as (category, outcome), which are of those ``scenes``; None if
    that is not known."""
    text = "".join(outcome for _, outcome in judged).encode("ascii")
    letters = np.frombuffer(text, dtype=np.uint8).reshape(len(judged), len(columns))
    values = np.where(letters == ord("-"), np.nan, letters == ord("1"))
    table: IntervalTable = {}
    for category, among in _groups([category for category, _ in judged]):
        own = values[among]
        correct = np.nansum(own, axis=0).astype(int).tolist()
        totals = np.count_nonzero(~np.isnan(own), axis=0).tolist()
        by_scene = _by_scene(own, scenes, among)
        table[category] = {
            column.key: Intervals(Interval(*Count(right, total).interval()), scene)
            for column, right, total, scene in zip(columns, correct, totals, by_scene, strict=True)
            if total
        }
    return table


def score_intervals(
    columns: Sequence[ScoreColumn],
    categories: Sequence[str],
    facts: Sequence[Facts],
    scenes: Sequence[str] | None,
) -> IntervalTable:
    """Of the means and medians of samples whose categories, facts and ``scenes`` are given; None if
    the scenes are not known."""
    known = Known(facts)
    scores = {column.key: sample_scores(column, known) for column in columns}
    medians = [column.key for column in columns if column.median]
    means = [column.key for column in columns if not column.median]
    return {
        category: {
            **_medians({key: scores[key][among] for key in medians}, scenes, among),
            **_means({key: scores[key][among] for key in means}, scenes, among),
        }
        for category, among in _groups(categories)
    }


def _medians(
    columns: Mapping[str, Array], scenes: Sequence[str] | None, among: NDArray[np.bool_]
) -> dict[str, Intervals]:
    return {
        key: Intervals(
            median_interval(values),
            None if scenes is None else scene_median_interval(values, np.asarray(scenes)[among]),
        )
        for key, values in columns.items()
        if not np.isnan(values).all()
    }


def _means(
    columns: Mapping[str, Array], scenes: Sequence[str] | None, among: NDArray[np.bool_]
) -> dict[str, Intervals]:
    """Of shares, so between 0 and 1."""
    if not columns:
        return {}
    by_scene = _by_scene(np.stack(list(columns.values()), axis=1), scenes, among)
    made = {}
    for (key, values), scene in zip(columns.items(), by_scene, strict=True):
        if not np.isnan(values).all():
            sample = mean_interval(values)
            inside = sample and Interval(max(sample.low, 0.0), min(sample.high, 1.0))
            made[key] = Intervals(inside, scene)
    return made


def _by_scene(
    values: Array, scenes: Sequence[str] | None, among: NDArray[np.bool_]
) -> list[Interval | None]:
    if scenes is None:
        return [None] * values.shape[1]
    return scene_mean_intervals(values, np.asarray(scenes)[among])


def _groups(categories: Sequence[str]) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Each category, and "all", with which of the samples are in it."""
    of_sample = np.array(categories, dtype=str)
    for name in sorted(set(categories)):
        yield name, of_sample == name
    if len(of_sample):
        yield ALL, np.ones(len(of_sample), dtype=bool)
