"""The precision table in the paper's form: one line per method, one column per joint threshold."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, TypeVar

from pytest_cpas.documents import (
    ChangeDocument,
    CountDocument,
    Document,
    PairDocument,
    PrecisionDocument,
    PublishedCountDocument,
    PublishedMethodDocument,
    RunDocument,
    ScoreDocument,
)
from pytest_cpas.protocols import PAPER
from pytest_cpas.report.intervals import interval_messages
from pytest_cpas.types.samples import ALL

#: What the paper prints of a data set, by method.
Paper: TypeAlias = Mapping[str, PublishedMethodDocument]

_Entry = TypeVar("_Entry", PrecisionDocument, ChangeDocument)


@dataclass(frozen=True)
class Cell:
    """``correct`` of ``total`` samples; ``rank`` 1 to 3 marks the best of a column, else 0."""

    correct: int
    total: int
    rank: int = 0

    @classmethod
    def measured(cls, count: CountDocument) -> Cell:
        """Of a measured or golden count."""
        return cls(count["correct"], count["total"])

    @classmethod
    def published(cls, count: PublishedCountDocument) -> Cell:
        """Of a published count.

        The paper's print leaves two counts open at most, which are the same for people.
        """
        return cls(count["lowest"], count["total"])

    @property
    def share(self) -> float:
        """The precision."""
        return self.correct / self.total

    @property
    def percent(self) -> str:
        """The precision for people."""
        return f"{100 * self.share:.1f} %"


@dataclass(frozen=True)
class Line:
    """A method's cells, None where n/a; ``paper``: as printed there, not measured."""

    method: str
    paper: bool
    cells: Sequence[Cell | None]


def groups(document: Document) -> Iterator[tuple[str, list[RunDocument], Paper]]:
    """Per data set its title, its runs, and the paper's tables by method (empty if none)."""
    members: dict[tuple[str, str | None], list[RunDocument]] = {}
    for run in document["runs"]:
        members.setdefault((run["dataset"], run["published_as"]), []).append(run)
    for (dataset, name), runs in members.items():
        other = "" if name in (None, dataset) else f" (as many samples as {name})"
        yield dataset + other, runs, document["published"].get(name, {}) if name else {}


def precision_table(
    thresholds: Sequence[str], runs: Sequence[RunDocument], published: Paper
) -> list[Line]:
    """The table of one data set over all categories: the measured methods, then the paper's.

    The best three of a column are marked among those that were judged on as many samples as any;
    a single method is not marked.
    """
    return _lines(runs, published, [(ALL, threshold) for threshold in thresholds])


def category_tables(
    thresholds: Sequence[str], runs: Sequence[RunDocument], published: Paper
) -> Iterator[tuple[str, list[str], list[Line]]]:
    """The tables of one data set per category, as (threshold, categories, lines).

    There is one for each threshold at which more than one method is known per category; the last
    of the categories is "all". The best three are marked as in :func:`precision_table`.
    """
    known = {
        (entry["threshold"], entry["category"])
        for run in runs
        for entry in run["precision"]
        if entry["measured"] or entry["published"]
    }
    known |= {
        (entry["threshold"], entry["category"])
        for method in published.values()
        for entry in method["precision"]
    }
    for threshold in thresholds:
        named = {category for label, category in known if label == threshold}
        categories = [*sorted(named - {ALL}), ALL]
        lines = [
            line
            for line in _lines(runs, published, [(name, threshold) for name in categories])
            if any(line.cells[:-1])
        ]
        if len(lines) > 1:
            yield threshold, categories, lines


def _lines(
    runs: Sequence[RunDocument], published: Paper, columns: Sequence[tuple[str, str]]
) -> list[Line]:
    """Lines with a cell for each (category, threshold), the best three of a column marked."""
    known = [(run["method"], False, measured_cells(run)) for run in runs]
    known += [(name, True, published_cells(method)) for name, method in published.items()]
    lines = [
        (method, paper, [cells.get(column) for column in columns]) for method, paper, cells in known
    ]
    ranked = [_ranked(column) for column in zip(*(cells for *_, cells in lines), strict=True)]
    return [
        Line(method, paper, cells)
        for (method, paper, _), cells in zip(lines, zip(*ranked, strict=True), strict=True)
    ]


def split_label(label: str) -> tuple[str, str]:
    """The name of a column's protocol, and its own label: as of :func:`.document.label`."""
    protocol, found, own = label.partition(": ")
    return (protocol, own) if found else (PAPER, label)


def of_protocols(columns: Iterable[str]) -> dict[str, list[str]]:
    """The labels of columns by the name of their protocol, in order."""
    groups: dict[str, list[str]] = {}
    for label in columns:
        groups.setdefault(split_label(label)[0], []).append(label)
    return groups


def protocol_title(words: str, protocol: str) -> str:
    """What a table of a protocol is called; of the paper's, the words alone."""
    return words if protocol == PAPER else f"{protocol}: {words}"


@dataclass(frozen=True)
class SideCell:
    """A cell that is guarded, or a score: as measured, and as recorded if that is another.

    ``intervals``: of what was measured, in words.
    """

    measured: str
    golden: str
    worse: bool
    intervals: Sequence[str] = ()


@dataclass(frozen=True)
class SideTable:
    """Guards or scores of a run under one protocol: a line of cells per category."""

    title: str
    columns: Sequence[str]
    lines: Mapping[str, Sequence[SideCell]]


def side_tables(run: RunDocument, kind: Literal["guards", "scores"]) -> Iterator[SideTable]:
    """The tables of a run beside its main ones; columns in which nothing is known are left out."""
    cells: dict[str, dict[str, SideCell]] = {}
    if kind == "guards":
        for entry in run["guards"]:
            made = replace(_guard(entry), intervals=interval_messages(entry))
            cells.setdefault(entry["threshold"], {})[entry["category"]] = made
    else:
        for score in run["scores"]:
            made = replace(_score(score), intervals=interval_messages(score))
            cells.setdefault(score["score"], {})[score["category"]] = made
    known = [
        label
        for label, column in cells.items()
        if any(cell.measured != _UNKNOWN or cell.golden for cell in column.values())
    ]
    for protocol, own in of_protocols(known).items():
        yield SideTable(
            protocol_title(kind, protocol),
            [split_label(label)[1] for label in own],
            {category: [cells[label][category] for label in own] for category in cells[own[0]]},
        )


#: A cell of which nothing is known.
_UNKNOWN = "n/a"


def _guard(entry: PrecisionDocument) -> SideCell:
    now, before = entry["measured"], entry["golden"]
    told = Cell.measured(now).percent if now else _UNKNOWN
    if before is None or now == before:
        return SideCell(told, "", worse=False)
    recorded = Cell.measured(before)
    lost = now is not None and Cell.measured(now).share < recorded.share
    return SideCell(told, recorded.percent, worse=lost)


def _score(entry: ScoreDocument) -> SideCell:
    now, before = entry["measured"], entry["golden"]

    def words(value: float) -> str:
        return f"{100 * value:.1f} %" if entry["share"] else f"{value:.4g}"

    if now is not None:
        told = words(now)
    else:
        told = "infinite" if entry["samples"] else _UNKNOWN
    if before is None or now == before:
        return SideCell(told, "", worse=False)
    lost = now is None or (now > before if entry["better"] == "lower" else now < before)
    return SideCell(told, words(before), worse=lost)


def labels(entries: Sequence[_Entry]) -> list[str]:
    """The labels of the columns of a run, or of two, in order."""
    return list(dict.fromkeys(entry["threshold"] for entry in entries))


def column_count(run: RunDocument | PairDocument) -> int:
    """How many columns count samples, of those to be read and those to be guarded."""
    return len(labels([*run["precision"], *run["guards"]]))


def category_lines(
    entries: Sequence[_Entry], columns: Collection[str]
) -> Iterator[tuple[str, list[_Entry]]]:
    """The precision of a run, or of two, per category: the entries of some columns, in order."""
    own = [entry for entry in entries if entry["threshold"] in columns]
    for category in dict.fromkeys(entry["category"] for entry in own):
        yield category, [entry for entry in own if entry["category"] == category]


def measured_cells(run: RunDocument) -> dict[tuple[str, str], Cell]:
    """By category and threshold; what is n/a is left out."""
    return {
        (entry["category"], entry["threshold"]): Cell.measured(count)
        for entry in (*run["precision"], *run["guards"])
        if (count := entry["measured"]) is not None
    }


def published_cells(method: PublishedMethodDocument) -> dict[tuple[str, str], Cell]:
    """By category and threshold."""
    return {
        (entry["category"], entry["threshold"]): Cell.published(entry["published"])
        for entry in method["precision"]
    }


def other_cells(entry: PrecisionDocument) -> list[tuple[str, Cell]]:
    """What stands beside a measured count: where it comes from, and the cell."""
    cells = []
    if entry["golden"]:
        cells.append(("golden", Cell.measured(entry["golden"])))
    if entry["published"]:
        cells.append(("published", Cell.published(entry["published"])))
    return cells


def _ranked(column: Sequence[Cell | None]) -> list[Cell | None]:
    full = max((cell.total for cell in column if cell), default=0)
    values = sorted((cell.correct for cell in column if cell and cell.total == full), reverse=True)
    if len(values) < 2:
        return list(column)
    return [
        replace(cell, rank=place)
        if cell and cell.total == full and (place := 1 + values.index(cell.correct)) <= 3
        else cell
        for cell in column
    ]
