"""The precision table in the paper's form: one line per method, one column per joint threshold."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from pytest_cpas.report.document import Document


@dataclass(frozen=True)
class Cell:
    """``correct`` of ``total`` samples; ``rank`` 1 to 3 marks the best of a column, else 0."""

    correct: int
    total: int
    rank: int = 0

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


def groups(document: Document) -> Iterator[tuple[str, list[Document], Document]]:
    """Per data set its title, its runs, and the paper's tables by method (empty if none)."""
    members: dict[tuple[str, str | None], list[Document]] = {}
    for run in document["runs"]:
        members.setdefault((run["dataset"], run["published_as"]), []).append(run)
    for (dataset, name), runs in members.items():
        other = "" if name in (None, dataset) else f" (as many samples as {name})"
        yield dataset + other, runs, document["published"].get(name, {})


def precision_table(
    thresholds: Sequence[str], runs: Sequence[Document], published: Document
) -> list[Line]:
    """The table of one data set over all categories: the measured methods, then the paper's.

    The best three of a column are marked among those that were judged on as many samples as any;
    a single method is not marked.
    """
    return _lines(runs, published, [("all", threshold) for threshold in thresholds])


def category_tables(
    thresholds: Sequence[str], runs: Sequence[Document], published: Document
) -> Iterator[tuple[str, list[str], list[Line]]]:
    """The tables of one data set per category, as (threshold, categories, lines).

    There is one for each threshold at which more than one method is known per category; the last
    of the categories is "all". The best three are marked as in :func:`precision_table`.
    """
    entries = [entry for told in (*runs, *published.values()) for entry in told["precision"]]
    for threshold in thresholds:
        told = {
            entry["category"]
            for entry in entries
            if entry["threshold"] == threshold and (entry.get("measured") or entry["published"])
        }
        categories = [*sorted(told - {"all"}), "all"]
        lines = [
            line
            for line in _lines(runs, published, [(name, threshold) for name in categories])
            if any(line.cells[:-1])
        ]
        if len(lines) > 1:
            yield threshold, categories, lines


def _lines(
    runs: Sequence[Document], published: Document, columns: Sequence[tuple[str, str]]
) -> list[Line]:
    """Lines with a cell for each (category, threshold), the best three of a column marked."""
    lines = [(run["method"], False, _cells(run["precision"], "measured", columns)) for run in runs]
    lines += [
        (method, True, _cells(entry["precision"], "published", columns))
        for method, entry in published.items()
    ]
    ranked = [_ranked(column) for column in zip(*(cells for *_, cells in lines), strict=True)]
    return [
        Line(method, paper, cells)
        for (method, paper, _), cells in zip(lines, zip(*ranked, strict=True), strict=True)
    ]


def category_lines(told: Document) -> Iterator[tuple[str, list[Document]]]:
    """The precision of a run, or of two, per category: the entries in order of the thresholds."""
    for category in dict.fromkeys(entry["category"] for entry in told["precision"]):
        yield category, [entry for entry in told["precision"] if entry["category"] == category]


def percent(count: Document) -> str:
    """The precision of a measured, golden or published count for people."""
    return as_cell(count).percent


def _cells(
    entries: Sequence[Document], kind: str, columns: Sequence[tuple[str, str]]
) -> list[Cell | None]:
    counts = {
        (entry["category"], entry["threshold"]): entry[kind]
        for entry in entries
        if entry[kind] is not None
    }
    return [as_cell(counts[column]) if column in counts else None for column in columns]


def as_cell(count: Document) -> Cell:
    """A measured, golden or published count as a cell."""
    # the paper's print leaves two counts open at most, which are the same for people
    return Cell(count["correct"] if "correct" in count else count["lowest"], count["total"])


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
