"""The tables of a run: what is read, and what is guarded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

from pytest_cpas.documents import CountDocument, PrecisionDocument, RunDocument, ScoreDocument
from pytest_cpas.reading.text import WIDTH
from pytest_cpas.report.intervals import KINDS, ends_of
from pytest_cpas.report.tables import protocol_title, split_label
from pytest_cpas.types.samples import ALL

__all__ = ["guard_tables", "main_tables"]

_Lines: TypeAlias = list[list[str]]

_UNKNOWN = "n/a"


@dataclass(frozen=True)
class _Cell:
    """A category in a column, in words: now, as recorded, and below that further lines by their
    titles. What is empty, or is empty in all columns, is not printed."""

    label: str
    category: str
    now: str
    recorded: str
    below: Mapping[str, str]


def main_tables(run: RunDocument) -> Iterator[_Lines]:
    """Counts and scores as they are read, with intervals below those over all categories."""
    counts = [
        _Cell(
            *(entry["threshold"], entry["category"], _count(entry["measured"]), ""),
            _intervals(entry),
        )
        for entry in run["precision"]
    ]
    # of the columns that count, what is n/a is told; of the others, only what there is
    scores = _known(
        _Cell(score["score"], score["category"], _score(score), "", _intervals(score))
        for score in run["scores"]
        if not score["guard"]
    )
    for first, cells in (("correct", counts), ("scores", scores)):
        for protocol, own in _by_protocol(cells).items():
            yield from _side_by_side(protocol_title(first, protocol), own)


def guard_tables(run: RunDocument) -> Iterator[_Lines]:
    """What is guarded: categories that are as recorded in a line each, the others in full, and none
    of which nothing was judged."""
    counted = [
        (e["threshold"], e["category"], _share(e["measured"]), _share(e["golden"]))
        for e in run["guards"]
    ]
    scored = [
        (s["score"], s["category"], _score(s), _value(s, s["golden"]))
        for s in run["scores"]
        if s["guard"]
    ]
    cells = _known(
        _Cell(*cell, {"  recorded": "" if cell[3] in (_UNKNOWN, cell[2]) else cell[3]})
        for cell in (*counted, *scored)
    )
    judged = {cell.category for cell in cells if cell.now != _UNKNOWN}
    whole = judged >= {cell.category for cell in cells}
    cells = [
        # what was recorded over all categories is of others, if some were not judged
        cell if whole or cell.category != ALL else replace(cell, recorded="", below={})
        for cell in cells
        if cell.category in judged
    ]
    flipped = {
        (category, label)
        for flip in run["flips"]
        for label in (*flip["lost"], *flip["gained"], *flip["changed"])
        for category in (flip["category"], ALL)
    }
    other = {
        (split_label(cell.label)[0], cell.category)
        for cell in cells
        if cell.now != cell.recorded or (cell.category, cell.label) in flipped
    }
    for protocol, own in _by_protocol(cells).items():
        title = protocol_title("guards", protocol)
        count = len({cell.label for cell in own})
        same = dict.fromkeys(c.category for c in own if (protocol, c.category) not in other)
        if same:
            lines = [[category, f"{count} of {count}"] for category in same]
            yield [[title, "as recorded"], *lines]
        yield from _side_by_side(title, [cell for cell in own if cell.category not in same])


def _intervals(entry: PrecisionDocument | ScoreDocument) -> dict[str, str]:
    if entry["category"] != ALL:
        return {}
    return {f"  {words}": ends_of(entry, kind) for kind, words in KINDS.items()}


def _known(cells: Iterable[_Cell]) -> list[_Cell]:
    """Those in columns of which anything is known."""
    cells = list(cells)
    known = {c.label for c in cells if c.now != _UNKNOWN or c.recorded not in ("", _UNKNOWN)}
    return [cell for cell in cells if cell.label in known]


def _by_protocol(cells: Sequence[_Cell]) -> dict[str, list[_Cell]]:
    """The cells of each protocol."""
    groups: dict[str, list[_Cell]] = {}
    for cell in cells:
        groups.setdefault(split_label(cell.label)[0], []).append(cell)
    return groups


def _side_by_side(first: str, cells: Sequence[_Cell]) -> Iterator[_Lines]:
    """Tables with as many columns as are readable side by side, their protocol's name left out."""
    columns: dict[str, dict[tuple[str, str], str]] = {}
    for cell in cells:
        lines = {"": cell.now, **cell.below}
        column = columns.setdefault(cell.label, {})
        column.update({(cell.category, title): text for title, text in lines.items()})
    rows = dict.fromkeys(row for column in columns.values() for row in column)
    shown = [row for row in rows if any(column.get(row) for column in columns.values())]
    head = [first, *(title or category for category, title in shown)]
    table, width = [head], max(map(len, head))
    for label, column in columns.items():
        made = [split_label(label)[1], *(column.get(row, "") for row in shown)]
        widest = 2 + max(map(len, made))
        if width + widest > WIDTH and len(table) > 1:
            yield [list(line) for line in zip(*table, strict=True)]
            table, width = [head], max(map(len, head))
        table.append(made)
        width += widest
    if len(table) > 1:
        yield [list(line) for line in zip(*table, strict=True)]


def _count(count: CountDocument | None) -> str:
    if count is None:
        return _UNKNOWN
    return f"{count['correct']}/{count['total']} {100 * count['correct'] / count['total']:5.1f} %"


def _share(count: CountDocument | None) -> str:
    return _UNKNOWN if count is None else f"{100 * count['correct'] / count['total']:.1f} %"


def _score(entry: ScoreDocument) -> str:
    if entry["measured"] is None and entry["samples"]:
        return "infinite"
    return _value(entry, entry["measured"])


def _value(entry: ScoreDocument, value: float | None) -> str:
    if value is None:
        return _UNKNOWN
    return f"{100 * value:.1f} %" if entry["share"] else f"{value:.4g}"
