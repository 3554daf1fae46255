"""A document as Markdown that fits the page of a CI job: what fails stands first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pytest_cpas.documents import AgainstDocument, Document, FlipDocument, RunDocument
from pytest_cpas.reading.text import markdown as _text
from pytest_cpas.reading.text import markdown_fence
from pytest_cpas.report.messages import (
    change_messages,
    contract_message,
    flip_message,
    judged_message,
    method_title,
    outcome_message,
    pair_lines,
    pair_title,
    speed_lines,
    troubles,
    verdicts_message,
    worst_flips_first,
)
from pytest_cpas.report.tables import (
    Cell,
    Line,
    category_lines,
    category_tables,
    column_count,
    groups,
    other_cells,
    precision_table,
)

#: Lines of one kind before the rest is only counted: a job page takes 1 MiB.
_SHOWN = 25

_MARKS = ("", " ¹", " ²", " ³")


def markdown(document: Document) -> str:
    """The text of ``report.md``."""
    return "\n".join(_lines(document)) + "\n"


def _lines(document: Document) -> Iterator[str]:
    yield f"# pytest-cpas: {outcome_message(document['outcome'])}"
    yield ""
    yield from _table(
        ["run", "verdict", "samples", "golden"],
        [
            [
                _text(f"{run['method']} on {run['dataset']}"),
                f"**{outcome_message(run['outcome'])}**",
                judged_message(run),
                _text(verdicts_message(run)),
            ]
            for run in document["runs"]
        ],
        "---",
    )
    for run in document["runs"]:
        yield from _troubles(run)
    if "against" in document:
        yield from _against(document["against"], document["thresholds"])
    thresholds = document["thresholds"]
    for title, runs, published in groups(document):
        yield f"## {_text(title)}"
        yield ""
        yield from _methods(["correct", *thresholds], precision_table(thresholds, runs, published))
        for threshold, categories, lines in category_tables(thresholds, runs, published):
            yield f"<details><summary>per category at {threshold}</summary>"
            yield ""
            yield from _methods(["correct", *map(_text, categories)], lines)
            yield "</details>"
            yield ""
    for run in document["runs"]:
        yield from _speed(run)
    for run in document["runs"]:
        yield from _categories(run, document["thresholds"])


def _methods(head: Sequence[str], lines: Sequence[Line]) -> Iterator[str]:
    yield from _table(
        head,
        [[_text(method_title(line.method, line.paper)), *map(_cell, line.cells)] for line in lines],
    )


def _troubles(run: RunDocument) -> Iterator[str]:
    """What is wrong with a run, and what was missing; nothing for a run without either."""
    sections = troubles(run)
    if not sections and not run["flips"]:
        return
    yield f"## {_text(run['method'])} on {_text(run['dataset'])}"
    yield ""
    for title, lines in sections:
        yield f"**{title}**"
        yield ""
        yield from _fenced(lines)
    if run["flips"]:
        yield "**Judged otherwise than by the golden table**"
        yield ""
        yield from _flips(run["flips"], column_count(run))


def _speed(run: RunDocument) -> Iterator[str]:
    if run["speed"]:
        yield f"**Speed of {_text(run['method'])} on {_text(run['dataset'])}**"
        yield ""
        for line in speed_lines(run["speed"]):
            yield f"- {_text(line)}"
        yield ""


def _flips(flips: Sequence[FlipDocument], every: int) -> Iterator[str]:
    yield from _table(
        ["sample", "before", "now", "what changed"],
        [
            [
                _text(flip["sample"]),
                _text(flip["before"]),
                _text(flip["after"]),
                flip_message(flip, every),
            ]
            for flip in flips[:_SHOWN]
        ],
        "---",
    )
    yield from _rest(len(flips))


def _against(against: AgainstDocument, thresholds: Sequence[str]) -> Iterator[str]:
    """The runs beside those of another one."""
    for pair in against["pairs"]:
        yield f"## {_text(pair_title(pair))}"
        yield ""
        yield from _fenced(pair_lines(pair))
        yield from _table(
            ["before → now", *thresholds],
            [
                [
                    _text(category),
                    *("<br>".join(filter(None, change_messages(entry))) for entry in entries),
                ]
                for category, entries in category_lines(pair["precision"])
            ],
        )
        if pair["flips"]:
            yield from _flips(worst_flips_first(pair["flips"]), column_count(pair))
    if against["unpaired"]:
        yield "**Without a counterpart**"
        yield ""
        yield from _fenced(against["unpaired"])


def _categories(run: RunDocument, thresholds: Sequence[str]) -> Iterator[str]:
    yield f"<details><summary>{_text(run['method'])} on {_text(run['dataset'])}"
    yield "per category, with golden and published precision</summary>"
    yield ""
    lines = []
    for category, entries in category_lines(run["precision"]):
        cells = []
        for entry in entries:
            parts = [_count(Cell.measured(entry["measured"])) if entry["measured"] else "n/a"]
            parts += [f"{source} {cell.percent}" for source, cell in other_cells(entry)]
            cells.append("<br>".join(parts))
        lines.append([_text(category), *cells])
    yield from _table(["correct", *thresholds], lines)
    if message := contract_message(run["contract"]):
        yield _text(message)
        yield ""
    yield "</details>"
    yield ""


def _cell(cell: Cell | None) -> str:
    if cell is None:
        return "n/a"
    text = _count(cell) + _MARKS[cell.rank]
    return f"**{text}**" if cell.rank == 1 else text


def _count(cell: Cell) -> str:
    return f"{cell.correct}/{cell.total} {cell.percent}"


def _table(
    head: Sequence[str], lines: Sequence[Sequence[str]], align: str = "---:"
) -> Iterator[str]:
    yield f"| {' | '.join(head)} |"
    yield f"|---|{f'{align}|' * (len(head) - 1)}"
    for line in lines:
        yield f"| {' | '.join(line)} |"
    yield ""


def _fenced(lines: Sequence[str]) -> Iterator[str]:
    """Text from data, as it is."""
    shown = [line for text in lines for line in text.splitlines()]
    yield from markdown_fence(shown[:_SHOWN])
    yield ""
    yield from _rest(len(shown))


def _rest(count: int) -> Iterator[str]:
    if count > _SHOWN:
        yield f"and {count - _SHOWN} more (report.json has all)"
        yield ""
