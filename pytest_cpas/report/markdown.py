"""A document as Markdown that fits the page of a CI job: what fails stands first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

from pytest_cpas.documents import (
    AgainstDocument,
    ChangeDocument,
    Document,
    FlipDocument,
    RunDocument,
)
from pytest_cpas.golden.literature import LEGACY
from pytest_cpas.reading.text import markdown as _text
from pytest_cpas.reading.text import markdown_fence
from pytest_cpas.report.intervals import interval_messages, interval_note
from pytest_cpas.report.literature import REMARK, literature_table, printed_rows
from pytest_cpas.report.messages import (
    change_messages,
    contract_message,
    flip_message,
    judged_message,
    method_title,
    outcome_message,
    pair_lines,
    pair_title,
    parity_lines,
    run_title,
    speed_lines,
    troubles,
    verdicts_message,
    worst_flips_first,
)
from pytest_cpas.report.tables import (
    Cell,
    Line,
    SideCell,
    category_lines,
    category_tables,
    column_count,
    groups,
    labels,
    of_protocols,
    other_cells,
    precision_table,
    protocol_title,
    side_tables,
    split_label,
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
                _text(judged_message(run)),
                _text(verdicts_message(run)),
            ]
            for run in document["runs"]
        ],
        "---",
    )
    for run in document["runs"]:
        yield from _troubles(run)
    for run in document["runs"]:
        yield from _parity(run)
    if "against" in document:
        yield from _against(document["against"])
    thresholds = document["thresholds"]
    for title, runs, published in groups(document):
        yield f"## {_text(title)}"
        yield ""
        for protocol, own in of_protocols(thresholds).items():
            lines = precision_table(own, runs, published)
            yield from _methods(_head("correct", protocol, own), lines)
        for threshold, categories, lines in category_tables(thresholds, runs, published):
            yield f"<details><summary>per category at {_text(threshold)}</summary>"
            yield ""
            yield from _methods(["correct", *map(_text, categories)], lines)
            yield "</details>"
            yield ""
    for run in document["runs"]:
        yield from _speed(run)
    for run in document["runs"]:
        yield from _categories(run)
        yield from _beside(run)
        yield from _literature(run, document)


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


def _parity(run: RunDocument) -> Iterator[str]:
    if "parity" in run:
        reference = _text(run["parity"]["reference"])
        yield f"**Parity of {_text(run_title(run))} with {reference}**"
        yield ""
        yield from _fenced(parity_lines(run["parity"]))


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
                _text(flip_message(flip, every)),
            ]
            for flip in flips[:_SHOWN]
        ],
        "---",
    )
    yield from _rest(len(flips))


def _against(against: AgainstDocument) -> Iterator[str]:
    """The runs beside those of another one."""
    for pair in against["pairs"]:
        yield f"## {_text(pair_title(pair))}"
        yield ""
        yield from _fenced(pair_lines(pair))
        yield from _changes(pair["precision"])
        if pair["guards"]:
            yield "<details><summary>guards</summary>"
            yield ""
            yield from _changes(pair["guards"])
            yield "</details>"
            yield ""
        if pair["flips"]:
            yield from _flips(worst_flips_first(pair["flips"]), column_count(pair))
    if against["unpaired"]:
        yield "**Without a counterpart**"
        yield ""
        yield from _fenced(against["unpaired"])


def _changes(entries: Sequence[ChangeDocument]) -> Iterator[str]:
    for protocol, own in of_protocols(labels(entries)).items():
        yield from _table(
            _head("before → now", protocol, own),
            [
                [
                    _text(category),
                    *("<br>".join(filter(None, change_messages(entry))) for entry in changes),
                ]
                for category, changes in category_lines(entries, own)
            ],
        )


def _categories(run: RunDocument) -> Iterator[str]:
    yield f"<details><summary>{_text(run['method'])} on {_text(run['dataset'])}"
    yield "per category, with golden and published precision</summary>"
    yield ""
    for protocol, own in of_protocols(labels(run["precision"])).items():
        lines = []
        for category, entries in category_lines(run["precision"], own):
            cells = []
            for entry in entries:
                parts = [_count(Cell.measured(entry["measured"])) if entry["measured"] else "n/a"]
                parts += interval_messages(entry)
                parts += [f"{source} {cell.percent}" for source, cell in other_cells(entry)]
                cells.append("<br>".join(parts))
            lines.append([_text(category), *cells])
        yield from _table(_head("correct", protocol, own), lines)
    remarks = [*filter(None, [interval_note(run)]), *(f"n/a: {line}" for line in run["lacking"])]
    for line in remarks:
        yield f"- {_text(line)}"
    if remarks:
        yield ""
    if message := contract_message(run["contract"]):
        yield _text(message)
        yield ""
    yield "</details>"
    yield ""


def _beside(run: RunDocument) -> Iterator[str]:
    """What is guarded, and the scores, folded; what got worse than its golden cell is bold."""
    kinds: tuple[Literal["guards", "scores"], ...] = ("guards", "scores")
    for kind in kinds:
        tables = list(side_tables(run, kind))
        if not tables:
            continue
        yield f"<details><summary>{_text(run_title(run))}: {kind}</summary>"
        yield ""
        for table in tables:
            yield from _table(
                [_text(table.title), *map(_text, table.columns)],
                [
                    [_text(category), *map(_side_cell, cells)]
                    for category, cells in table.lines.items()
                ],
            )
        yield "</details>"
        yield ""


def _literature(run: RunDocument, document: Document) -> Iterator[str]:
    """What the literature prints, folded."""
    table = literature_table(run, printed_rows(run, document))
    if table is None:
        return
    yield f"<details><summary>{_text(run_title(run))}: beside the literature</summary>"
    yield ""
    yield from _table(
        [f"{LEGACY}: AP in %", *table.columns, "paper"],
        [
            ["this run", *(f"**{cell}**" for cell in table.own), ""],
            *([_text(row["method"]), *cells, _text(row["paper"])] for row, cells in table.lines),
        ],
    )
    yield f"{REMARK}."
    yield ""
    yield "</details>"
    yield ""


def _side_cell(cell: SideCell) -> str:
    told = f"**{cell.measured}**" if cell.worse else cell.measured
    golden = [f"golden {cell.golden}"] if cell.golden else []
    return "<br>".join([told, *cell.intervals, *golden])


def _head(words: str, protocol: str, own: Sequence[str]) -> list[str]:
    """The first line of a table that has the columns of a protocol."""
    title = protocol_title(words, protocol)
    return [_text(title), *(_text(split_label(label)[1]) for label in own)]


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
