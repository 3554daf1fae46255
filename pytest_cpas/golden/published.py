"""The paper's tables as counts, and a run's counts against them.

A published table has no samples, so two counts are compared: a cell is worse if the exact
binomial interval of the run's precision lies below the published precision. The interval's
confidence is shared out among the cells of a run, so that a run as good as the published one is
called worse with at most ``FALSE_ALARMS`` probability, whatever the number of cells. The interval
is per sample, since both figures are of the same scenes; that by scene stands beside.
"""

from __future__ import annotations

import bisect
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from types import MappingProxyType

from pytest_cpas.golden.files import shipped_golden
from pytest_cpas.golden.words import Word
from pytest_cpas.metrics.intervals import CONFIDENCE, Interval
from pytest_cpas.metrics.precision import Count
from pytest_cpas.protocols import PAPER, CountColumn, Intervals, shipped_protocol
from pytest_cpas.reading.tables import read_csv
from pytest_cpas.types import Verdict
from pytest_cpas.types.datasets import STORED
from pytest_cpas.types.samples import ALL, COMPLETENESS

#: Probability that a run that is as good as the published one is called worse.
FALSE_ALARMS = 0.01


@dataclass(frozen=True, kw_only=True)
class PublishedCell:
    """Between ``low`` and ``high`` of ``total`` samples correct, as far as the paper tells.

    ``column``: the key of the column of the protocol ``cpas`` that it is in; ``label``: its label.
    """

    category: str
    column: str
    label: str
    low: int
    high: int
    total: int


def published_cells(dataset: str, method: str) -> list[PublishedCell]:
    """The paper's precision table of a method on a data set; empty if it has none."""
    return [
        PublishedCell(
            category=line["category"],
            column=_column(line).key,
            label=_column(line).label,
            low=int(line["correct_low"]),
            high=int(line["correct_high"]),
            total=int(line["total"]),
        )
        for line in _read("precision.csv")
        if (line["dataset"], line["method"]) == (dataset, method)
    ]


def published_datasets() -> list[str]:
    """The data sets that the paper's table has."""
    return sorted({line["dataset"] for line in _read("precision.csv")})


def published_methods(dataset: str) -> list[str]:
    """The methods that the paper's table of a data set has; empty if it has none."""
    return sorted({x["method"] for x in _read("precision.csv") if x["dataset"] == dataset})


def published_curves(dataset: str, method: str) -> dict[str, list[tuple[float, Count]]]:
    """The paper's counts against one threshold at a time.

    Points by what the threshold is on (``position_m``, ``rotation_deg``, ``fscore_1cm``); empty if
    the paper has none.
    """
    curves: dict[str, list[tuple[float, Count]]] = {}
    for line in _read("curves.csv"):
        if (line["dataset"], line["method"]) == (dataset, method):
            count = Count(int(line["correct"]), int(line["total"]))
            points = curves.setdefault(line["threshold_on"], [])
            points.append((float(line["threshold"]), count))
    return curves


@dataclass(frozen=True, kw_only=True)
class PublishedTime:
    """Mean seconds per prediction, on which data set and machine."""

    dataset: str
    mean_seconds: float
    machine: str


def published_time(method: str) -> PublishedTime | None:
    """The run time that the paper prints for a method; None if it prints none."""
    for line in _read("run_time.csv"):
        if line["method"] == method:
            return PublishedTime(
                dataset=line["dataset"],
                mean_seconds=float(line["mean_seconds"]),
                machine=line["hardware"],
            )
    return None


def published_name(dataset: str, listed: Mapping[str, int]) -> str | None:
    """The data set of the paper that a run's samples are of; None if it is none of them.

    Stored predictions do not say what they were made on; the numbers of samples per category do.
    """
    if published_methods(dataset):
        return dataset
    if dataset == STORED:
        for name in published_datasets():
            if published_sample_counts(name) == dict(listed):
                return name
    return None


def published_sample_counts(dataset: str) -> dict[str, int]:
    """How many samples of each category a complete copy of a data set has; empty if unknown."""
    return {
        line["category"]: int(line["total"])
        for line in _read("precision.csv")
        if line["dataset"] == dataset and line["category"] != ALL
    }


def count_problems(dataset: str, listed: Mapping[str, int], *, partial: bool) -> dict[str, str]:
    """Per category, what is wrong with how many samples are listed.

    A ``partial`` copy may have fewer than were published. Nothing is wrong where no count is known.
    """
    problems = {}
    for category, expected in published_sample_counts(dataset).items():
        count = listed.get(category, 0)
        if count > expected or (count < expected and not partial):
            incomplete = "" if partial else ", and nothing is missing"
            problems[category] = (
                f"{count} samples of {category}{incomplete}; the published data set has {expected}"
            )
    return problems


def _column(line: Mapping[str, str]) -> CountColumn:
    names = ("rotation_deg", "position_m", "fscore_1cm")
    limits = {name: float(line[name]) for name in names if line[name]}
    return next(c for c in shipped_protocol(PAPER).counts if c.limits == limits)


@functools.cache
def _read(name: str) -> list[dict[str, str]]:
    return read_csv(shipped_golden() / "published" / name)


def compare_published(
    cells: Sequence[PublishedCell],
    table: Mapping[str, Mapping[str, Count | None]],
    intervals: Mapping[str, Mapping[str, Intervals]] = MappingProxyType({}),
) -> list[Verdict]:
    """One verdict per category; it states the margin of every cell that both have, and its interval
    by scene, where there is one among ``intervals``.

    Worse in one cell makes a category REGRESSED; better ones pass. A part of the samples can be
    worse, but not agree: that is one more verdict, NOT CHECKED. It names the figures over all
    categories that are left out because other categories were judged. Pure.
    """
    compared = [
        (expected, count, _by_scene(intervals, cell))
        for cell in cells
        if (count := table.get(cell.category, {}).get(cell.column)) is not None
        if (expected := _expected(cell, cells, table)) is not None
    ]
    verdicts = []
    for category in sorted({expected.category for expected, *_ in compared}):
        lines: dict[Word, list[str]] = {Word.REGRESSED: [], Word.ABOVE: [], Word.AGREES: []}
        for expected, count, by_scene in compared:
            if expected.category == category:
                # a two-sided interval, of which only the lower side can raise a false alarm
                word, line = _judge(expected, count, 1 - 2 * FALSE_ALARMS / len(compared), by_scene)
                lines[word].append(line)
        word = next(word for word, told in lines.items() if told)
        verdicts.append(Verdict(word, category, "\n  ".join(chain.from_iterable(lines.values()))))
    counts = [table.get(cell.category, {}).get(cell.column) for cell in cells]
    seen = max((count.total for count in counts if count), default=0)
    total = max((cell.total for cell in cells), default=0)
    if 0 < seen < total:
        told = f"{seen} of the {total} samples of the published table judged"
        done = {(expected.category, expected.label) for expected, *_ in compared}
        if left := [c.label for c in cells if c.category == ALL and (ALL, c.label) not in done]:
            told += (
                f"; not compared: all at {' and at '.join(left)}, which is published over"
                f" {', '.join(_sizes(cells))}, and judged were {', '.join(_judged(table))}"
            )
        verdicts.append(Verdict(Word.NOT_CHECKED, COMPLETENESS, told))
    return verdicts


@dataclass(frozen=True)
class _Expected:
    """What the paper lets expect of a cell of a run: a share between two."""

    category: str
    label: str
    lowest: float
    highest: float
    words: str


def _expected(
    cell: PublishedCell,
    cells: Sequence[PublishedCell],
    table: Mapping[str, Mapping[str, Count | None]],
) -> _Expected | None:
    """What a published cell lets expect; None if it is over other categories than were judged.

    A figure over all categories depends on how many samples each has. Where the paper has the
    figure of every category that was judged, they are added up as they were judged. Elsewhere the
    share can be another one by as much as the mixture is, if the categories are the same.
    """
    lowest, highest = cell.low / cell.total, cell.high / cell.total
    published = f"published {100 * lowest:.1f} %"
    sizes, judged = _sizes(cells), _judged(table, cell.column)
    if cell.category != ALL or not sizes or judged == sizes:
        return _Expected(cell.category, cell.label, lowest, highest, published)
    total = sum(judged.values())
    parts = {other.category: other for other in cells if other.label == cell.label}
    if judged.keys() <= parts.keys():
        lowest, highest = (
            sum(n * getattr(parts[k], end) / parts[k].total for k, n in judged.items()) / total
            for end in ("low", "high")
        )
        words = f"published {100 * lowest:.1f} % for as many of {', '.join(judged)}"
        return _Expected(cell.category, cell.label, lowest, highest, words)
    if judged.keys() != sizes.keys():
        return None
    shift = sum(abs(judged[k] / total - n / sum(sizes.values())) for k, n in sizes.items()) / 2
    lowest, highest = max(lowest - shift, 0.0), min(highest + shift, 1.0)
    words = (
        f"{published}, {100 * lowest:.1f} to {100 * highest:.1f} % where the categories are mixed"
        " as here"
    )
    return _Expected(cell.category, cell.label, lowest, highest, words)


def _sizes(cells: Sequence[PublishedCell]) -> dict[str, int]:
    """Samples per category of a published table."""
    return dict(sorted((cell.category, cell.total) for cell in cells if cell.category != ALL))


def _judged(
    table: Mapping[str, Mapping[str, Count | None]], column: str | None = None
) -> dict[str, int]:
    """Samples per category of a run's table that are judged, in one column or in any."""
    judged = {
        category: max((c.total for k, c in row.items() if c and column in (None, k)), default=0)
        for category, row in sorted(table.items())
        if category != ALL
    }
    return {category: count for category, count in judged.items() if count}


def _by_scene(
    intervals: Mapping[str, Mapping[str, Intervals]], cell: PublishedCell
) -> Interval | None:
    made = intervals.get(cell.category, {}).get(cell.column)
    return None if made is None else made.scene


def _judge(
    expected: _Expected, count: Count, confidence: float, by_scene: Interval | None
) -> tuple[Word, str]:
    low, high = count.interval(confidence)
    # the smallest count that would not be called worse: what this many samples can detect
    needed = bisect.bisect_left(
        range(count.total),
        expected.lowest,
        key=lambda k: Count(k, count.total).interval(confidence)[1],
    )
    margin = f"worse below {needed}/{count.total}" if needed else "so few cannot show it worse"
    scenes = (
        f"; by scene, at {100 * CONFIDENCE:.0f} %, {100 * by_scene.low:.1f} to"
        f" {100 * by_scene.high:.1f} %"
        if by_scene
        else ""
    )
    line = (
        f"{expected.label}: {count.correct}/{count.total} correct (interval per sample, at"
        f" {100 * confidence:.5g} %, {100 * low:.1f} to {100 * high:.1f} %{scenes}),"
        f" {expected.words}; {margin}"
    )
    if high < expected.lowest:
        return Word.REGRESSED, line
    return (Word.ABOVE if low > expected.highest else Word.AGREES), line
