"""How sure figures are: in a document, and in words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

from pytest_cpas.documents import IntervalsDocument, PrecisionDocument, RunDocument, ScoreDocument
from pytest_cpas.golden import RunTable
from pytest_cpas.metrics.intervals import FEW_SCENES, FEWEST_SCENES, Interval
from pytest_cpas.protocols import (
    Intervals,
    IntervalTable,
    count_intervals,
    score_columns,
    score_intervals,
)

__all__ = [
    "KINDS",
    "Kind",
    "ends_of",
    "interval_messages",
    "interval_note",
    "interval_table",
    "intervals_document",
    "scenes_of",
]

Kind = Literal["sample", "scene"]

#: What the two kinds of intervals are called.
KINDS: Mapping[Kind, str] = {"sample": "per sample", "scene": "by scene"}


def scenes_of(table: RunTable) -> list[str] | None:
    """The scene of each judged sample; None if it is not known of all of them."""
    scenes = [table.scenes.get(name, "") for name in table.samples]
    return scenes if all(scenes) and scenes else None


def interval_table(table: RunTable) -> IntervalTable:
    """Of the counts and the scores of a run, but for average precision."""
    samples, scenes = table.samples.values(), scenes_of(table)
    categories = [sample.category for sample in samples]
    outcomes = [(sample.category, sample.outcome) for sample in samples]
    made = count_intervals(table.columns, outcomes, scenes)
    facts = [sample.facts for sample in samples]
    scores = score_intervals(score_columns(table.protocols), categories, facts, scenes)
    for category, cells in scores.items():
        made[category].update(cells)
    return made


def intervals_document(intervals: Intervals | None) -> IntervalsDocument | None:
    """Those of one cell."""
    if intervals is None:
        return None
    return {"sample": _ends(intervals.sample), "scene": _ends(intervals.scene)}


def _ends(interval: Interval | None) -> list[float | None] | None:
    """Rounded for people."""
    if interval is None:
        return None
    ends = (interval.low, interval.high)
    return [float(f"{end:.6g}") if math.isfinite(end) else None for end in ends]


def ends_of(entry: PrecisionDocument | ScoreDocument, kind: Kind) -> str:
    """From what to what a cell may be; empty where an interval says nothing."""
    ends = entry["intervals"] and entry["intervals"][kind]
    if not ends or ends == [None, None]:
        return ""
    share = entry.get("share") is not False
    factor, pattern = (100, "{:.1f}") if share else (1, "{:.4g}")
    low, high = ("infinite" if end is None else pattern.format(factor * end) for end in ends)
    return f"{low} to {high}{' %' if share else ''}"


def interval_messages(entry: PrecisionDocument | ScoreDocument) -> list[str]:
    """The intervals of a cell, one to a line; none where they say nothing."""
    return [f"{ends} {words}" for kind, words in KINDS.items() if (ends := ends_of(entry, kind))]


def interval_note(run: RunDocument) -> str:
    """What the intervals of a run are, and what they leave out; empty if none is shown."""
    entries: list[PrecisionDocument | ScoreDocument] = [*run["precision"], *run["scores"]]
    if not any(map(interval_messages, entries)):
        return ""
    told = "intervals at 95 %: per sample, as if all were independent"
    scenes = run["scenes"]
    if scenes is None:
        return f"{told}; none by scene, as the samples do not say which they are of"
    if scenes == 1:
        return f"{told}; none by scene, as all samples are of one"
    if scenes == run["judged"]:
        return f"{told}; none by scene, as no two samples are of one"
    if scenes < FEWEST_SCENES:
        return f"{told}; none by scene, as {scenes} scenes are too few"
    told += f"; by scene, wherever the {scenes} scenes differ"
    if scenes < FEW_SCENES:
        told += ", and with so few the truth lies outside more often than in 5 %"
    return told
