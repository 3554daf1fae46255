"""A document as Markdown that fits the page of a CI job: what fails stands first."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from pytest_cpas.report.document import Document
from pytest_cpas.report.tables import (
    Cell,
    Line,
    category_lines,
    category_tables,
    groups,
    percent,
    precision_table,
)
from pytest_cpas.report.words import (
    change_words,
    contract_words,
    flip_words,
    golden_words,
    judged_words,
    method_title,
    outcome_words,
    pair_title,
    pair_words,
    speed_lines,
    troubles,
    worst_flips_first,
)

#: Lines of one kind before the rest is only counted: a job page takes 1 MiB.
_SHOWN = 25

_MARKS = ("", " ¹", " ²", " ³")


def markdown(document: Document) -> str:
    """The text of ``report.md``."""
    return "\n".join(_lines(document)) + "\n"


def _lines(document: Document) -> Iterator[str]:
    yield f"# pytest-cpas: {outcome_words(document['outcome'])}"
    yield ""
    yield from _table(
        ["run", "verdict", "samples", "golden"],
        [
            [
                _escape(f"{run['method']} on {run['dataset']}"),
                f"**{outcome_words(run['outcome'])}**",
                judged_words(run),
                _escape(golden_words(run)),
            ]
            for run in document["runs"]
        ],
        "---",
    )
    for run in document["runs"]:
        yield from _told(run)
    if "against" in document:
        yield from _against(document["against"], document["thresholds"])
    thresholds = document["thresholds"]
    for title, runs, published in groups(document):
        yield f"## {_escape(title)}"
        yield ""
        yield from _methods(["correct", *thresholds], precision_table(thresholds, runs, published))
        for threshold, categories, lines in category_tables(thresholds, runs, published):
            yield f"<details><summary>per category at {threshold}</summary>"
            yield ""
            yield from _methods(["correct", *map(_escape, categories)], lines)
            yield "</details>"
            yield ""
    for run in document["runs"]:
        yield from _speed(run)
    for run in document["runs"]:
        yield from _categories(run, document["thresholds"])


def _methods(head: Sequence[str], lines: Sequence[Line]) -> Iterator[str]:
    yield from _table(
        head,
        [
            [_escape(method_title(line.method, line.paper)), *map(_cell, line.cells)]
            for line in lines
        ],
    )


def _told(run: Document) -> Iterator[str]:
    """What is wrong with a run, and what was missing; nothing for a run without either."""
    told = troubles(run)
    if not told and not run["flips"]:
        return
    yield f"## {_escape(run['method'])} on {_escape(run['dataset'])}"
    yield ""
    for title, lines in told:
        yield f"**{title}**"
        yield ""
        yield from _fenced(lines)
    if run["flips"]:
        yield "**Judged otherwise than by the golden table**"
        yield ""
        yield from _flips(run["flips"])


def _speed(run: Document) -> Iterator[str]:
    if run["speed"]:
        yield f"**Speed of {_escape(run['method'])} on {_escape(run['dataset'])}**"
        yield ""
        for line in speed_lines(run["speed"]):
            yield f"- {_escape(line)}"
        yield ""


def _flips(flips: Sequence[Document]) -> Iterator[str]:
    yield from _table(
        ["sample", "before", "now", "what changed"],
        [
            [
                _escape(flip["sample"]),
                _escape(flip["before"]),
                _escape(flip["after"]),
                flip_words(flip),
            ]
            for flip in flips[:_SHOWN]
        ],
        "---",
    )
    yield from _rest(len(flips))


def _against(against: Document, thresholds: Sequence[str]) -> Iterator[str]:
    """The runs beside those of another one."""
    for pair in against["pairs"]:
        yield f"## {_escape(pair_title(pair))}"
        yield ""
        yield from _fenced(pair_words(pair))
        yield from _table(
            ["before → now", *thresholds],
            [
                [
                    _escape(category),
                    *("<br>".join(filter(None, change_words(entry))) for entry in entries),
                ]
                for category, entries in category_lines(pair)
            ],
        )
        if pair["flips"]:
            yield from _flips(worst_flips_first(pair["flips"]))
    if against["unpaired"]:
        yield "**Without a counterpart**"
        yield ""
        yield from _fenced(against["unpaired"])


def _categories(run: Document, thresholds: Sequence[str]) -> Iterator[str]:
    yield f"<details><summary>{_escape(run['method'])} on {_escape(run['dataset'])}"
    yield "per category, with golden and published precision</summary>"
    yield ""
    lines = []
    for category, entries in category_lines(run):
        cells = []
        for entry in entries:
            count = entry["measured"]
            told = f"{count['correct']}/{count['total']} {percent(count)}" if count else "n/a"
            for kind in ("golden", "published"):
                if entry[kind]:
                    told += f"<br>{kind} {percent(entry[kind])}"
            cells.append(told)
        lines.append([_escape(category), *cells])
    yield from _table(["correct", *thresholds], lines)
    if words := contract_words(run["contract"]):
        yield _escape(words)
        yield ""
    yield "</details>"
    yield ""


def _cell(cell: Cell | None) -> str:
    if cell is None:
        return "n/a"
    text = f"{cell.correct}/{cell.total} {cell.percent}{_MARKS[cell.rank]}"
    return f"**{text}**" if cell.rank == 1 else text


def _table(
    head: Sequence[str], lines: Sequence[Sequence[str]], align: str = "---:"
) -> Iterator[str]:
    yield f"| {' | '.join(head)} |"
    yield f"|---|{f'{align}|' * (len(head) - 1)}"
    for line in lines:
        yield f"| {' | '.join(line)} |"
    yield ""


def _fenced(lines: Sequence[str]) -> Iterator[str]:
    """Text from data, verbatim: a fence longer than any in it."""
    shown = [line for text in lines for line in text.splitlines()][:_SHOWN]
    longest = max((len(run) for line in shown for run in re.findall("`+", line)), default=0)
    fence = "`" * max(3, longest + 1)
    yield fence + "text"
    yield from shown
    yield fence
    yield ""
    yield from _rest(sum(len(text.splitlines()) for text in lines))


def _rest(count: int) -> Iterator[str]:
    if count > _SHOWN:
        yield f"and {count - _SHOWN} more (report.json has all)"
        yield ""


def _escape(text: str) -> str:
    """Text from data so that Markdown and the HTML in it leave it as it is."""
    text = " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"([\\`*_\[\]#!|~])", r"\\\1", text)
