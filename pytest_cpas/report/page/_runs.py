"""One run on the page: what is wrong with it, pictures, categories, conditions."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Literal

from pytest_cpas.documents import Document, PrecisionDocument, RunDocument
from pytest_cpas.golden.literature import LEGACY
from pytest_cpas.report._html import Child, Element, element
from pytest_cpas.report.intervals import interval_messages, interval_note
from pytest_cpas.report.literature import REMARK, literature_table, printed_rows
from pytest_cpas.report.messages import contract_message, flip_message, run_title, troubles
from pytest_cpas.report.page._parity import parity
from pytest_cpas.report.page._parts import badge, flip_table, protocol_head, table
from pytest_cpas.report.panels import ValuePictures
from pytest_cpas.report.tables import (
    Cell,
    SideCell,
    category_lines,
    column_count,
    labels,
    of_protocols,
    other_cells,
    side_tables,
)

#: Runs of which the details are unfolded although nothing is wrong with them.
_UNFOLDED = 2


def run_details(
    run: RunDocument,
    index: int,
    document: Document,
    pictures: Mapping[str, bytes],
    values: ValuePictures | None = None,
) -> Element:
    """Everything about a run, folded unless something is wrong with it."""
    opened = run["outcome"] == "failed" or len(document["runs"]) <= _UNFOLDED
    return element(
        "details",
        element("summary", f"{run_title(run)} ", badge(run["outcome"])),
        list(_troubles(run)),
        list(parity(run, values)),
        _gallery(run, pictures) if pictures else None,
        element("h3", "Per category"),
        list(_category_tables(run)),
        element("p", interval_note(run), class_="faint"),
        [element("p", f"n/a: {line}", class_="faint") for line in run["lacking"]],
        list(_beside(run)),
        list(_literature(run, document)),
        element("p", contract_message(run["contract"]), class_="faint"),
        element("h3", "Conditions"),
        table(
            ["what", "value"],
            [
                element("tr", element("td", key), element("td", value, class_="wrap"))
                for key, value in {**run["identity"], **run["provenance"]}.items()
            ],
            text=True,
        ),
        class_="run",
        id=f"run-{index}",
        open=opened,
    )


def _troubles(run: RunDocument) -> Iterator[Element]:
    """What is wrong, or missing."""
    for title, lines in troubles(run):
        yield element("h3", title)
        yield element("pre", "\n".join(lines))
    if run["flips"]:
        yield element("h3", "Judged otherwise than by the golden table")
        yield from flip_table(run["flips"], column_count(run))


def _gallery(run: RunDocument, pictures: Mapping[str, bytes]) -> Child:
    samples = {sample["sample"]: sample for sample in run["samples"]}
    every = column_count(run)
    flips = {flip["sample"]: flip_message(flip, every) for flip in run["flips"]}
    figures = []
    for name, content in pictures.items():
        sample = samples[name]
        if sample["position_m"] is None or sample["rotation_deg"] is None:
            errors = f"no answer: {sample['failure']}" if sample["failure"] else "no errors"
        else:
            errors = f"{100 * sample['position_m']:.2f} cm, {sample['rotation_deg']:.1f} deg"
            errors += "" if sample["fscore_1cm"] is None else f", F {sample['fscore_1cm']:.2f}"
        source = f"data:image/webp;base64,{base64.b64encode(content).decode()}"
        figures.append(
            element(
                "figure",
                element(
                    "img", src=source, alt=f"boxes and surfaces in {name}", width=512, height=256
                ),
                element(
                    "figcaption",
                    f"{sample['category']} {name}",
                    element("small", errors),
                    element("small", flips[name]) if name in flips else None,
                ),
            )
        )
    return (
        element("h3", f"Lost, gained and worst samples ({len(figures)})"),
        element(
            "p",
            "Boxes: ",
            element("span", "truth", class_="truth"),
            ", ",
            element("span", "estimate", class_="estimate"),
            "; lines from the middle of a box show its up axis and its right (+x). Beside it the"
            " depth, seen from its right and from above: the object's points are bright, the true"
            " surface and the estimated one have the colours of their boxes",
        ),
        element("div", figures, class_="gallery"),
    )


def _category_tables(run: RunDocument) -> Iterator[Element]:
    """A table for each protocol."""
    for protocol, own in of_protocols(labels(run["precision"])).items():
        lines = _category_rows(category_lines(run["precision"], own))
        yield table(protocol_head("correct at", protocol, own), list(lines))


def _category_rows(
    categories: Iterable[tuple[str, Sequence[PrecisionDocument]]],
) -> Iterator[Element]:
    for category, entries in categories:
        cells = []
        for entry in entries:
            beside = [f"{source} {cell.percent}" for source, cell in other_cells(entry)]
            others = [element("small", told) for told in (*interval_messages(entry), *beside)]
            if entry["measured"] is None:
                cells.append(element("td", "n/a", others, class_="faint"))
                continue
            cell = Cell.measured(entry["measured"])
            width = f"width:{100 * cell.correct / cell.total:.1f}%"
            bar = element("span", element("span", style=width), class_="bar")
            text = f"{cell.correct}/{cell.total} {cell.percent}"
            cells.append(element("td", text, bar, others))
        yield element("tr", element("td", category), cells)


def _beside(run: RunDocument) -> Iterator[Element]:
    """What is guarded, and the scores, folded."""
    kinds: tuple[Literal["guards", "scores"], ...] = ("guards", "scores")
    for kind in kinds:
        tables = [
            table(
                [shown.title, *shown.columns],
                [
                    element("tr", element("td", category), [_side_cell(cell) for cell in cells])
                    for category, cells in shown.lines.items()
                ],
            )
            for shown in side_tables(run, kind)
        ]
        if tables:
            yield element("details", element("summary", kind.capitalize()), tables)


def _literature(run: RunDocument, document: Document) -> Iterator[Element]:
    """What the literature prints, folded; where it was read stands below the paper."""
    shown = literature_table(run, printed_rows(run, document))
    if shown is None:
        return
    own = element("tr", element("td", "this run"), [element("td", c) for c in shown.own])
    lines = [
        element(
            "tr",
            element("td", row["method"]),
            [element("td", cell) for cell in cells],
            element(
                "td",
                row["paper"],
                element("small", "; ".join(filter(None, (row["read_in"], row["also_in"])))),
                element("small", row["note"]) if row["note"] else None,
                class_="wrap",
            ),
            class_="paper",
        )
        for row, cells in shown.lines
    ]
    yield element(
        "details",
        element("summary", "Beside the literature"),
        table(
            [f"{LEGACY}: AP in %", *shown.columns, "paper, and where it was read"], [own, *lines]
        ),
        element("p", f"{REMARK}.", class_="faint"),
    )


def _side_cell(cell: SideCell) -> Element:
    """What got worse than its golden cell is coloured."""
    golden = [f"golden {cell.golden}"] if cell.golden else []
    return element(
        "td",
        element("span", cell.measured, class_="unmet" if cell.worse else None),
        [element("small", told) for told in (*cell.intervals, *golden)],
    )
