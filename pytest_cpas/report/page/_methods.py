"""Methods beside each other on the page: precision, up axes, two data sets, run time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pytest_cpas.documents import Document, PublishedTimeDocument
from pytest_cpas.report._html import Element, element
from pytest_cpas.report.curves import charts, curve_lines
from pytest_cpas.report.messages import duration_message, method_title, run_title, speed_lines
from pytest_cpas.report.page._parts import protocol_head, table
from pytest_cpas.report.scatter import PAIRS, dataset_pairs, methods
from pytest_cpas.report.scatter import charts as scatter_charts
from pytest_cpas.report.sphere import disc
from pytest_cpas.report.tables import (
    Cell,
    Line,
    category_tables,
    groups,
    of_protocols,
    precision_table,
)


def precision(document: Document) -> Iterator[Element]:
    """Per data set the tables, measured and published, and the curves."""
    thresholds = document["thresholds"]
    for title, runs, published in groups(document):
        yield element("h2", f"Precision on {title}")
        for protocol, own in of_protocols(thresholds).items():
            lines = precision_table(own, runs, published)
            yield _method_table(protocol_head("correct at", protocol, own), lines)
        for threshold, categories, lines in category_tables(thresholds, runs, published):
            yield element(
                "details",
                element("summary", f"Per category at {threshold}"),
                _method_table(["correct", *categories], lines),
            )
        yield element("div", list(charts(curve_lines(published, runs))), class_="charts")


def _method_table(head: Sequence[str], lines: Sequence[Line]) -> Element:
    return table(
        head,
        [
            element(
                "tr",
                element("td", method_title(line.method, line.paper)),
                [_precision_cell(cell) for cell in line.cells],
                class_="paper" if line.paper else None,
            )
            for line in lines
        ],
    )


def _precision_cell(cell: Cell | None) -> Element:
    if cell is None:
        return element("td", "n/a", class_="faint")
    return element(
        "td",
        cell.percent,
        element("sup", str(cell.rank)) if cell.rank else None,
        element("small", f"{cell.correct}/{cell.total}"),
        class_=f"rank{cell.rank}" if cell.rank else None,
    )


def up_axes(document: Document) -> Iterator[Element]:
    """Per data set where up axes point: the truth once, and the estimates of every run."""
    for title, runs, _ in groups(document):
        known = [(run["method"], axes) for run in runs if (axes := run["up_axes"])]
        true = next((axes["truth"] for _, axes in known if axes["truth"]), None)
        discs = [disc(true, "truth", estimate=False)] if true else []
        discs += [
            disc(axes["estimate"], method, estimate=True)
            for method, axes in known
            if axes["estimate"]
        ]
        if discs:
            yield element("h2", f"Up axes on {title}")
            yield element("div", discs, class_="spheres")


def overview(document: Document) -> Iterator[Element]:
    """Methods on two data sets each."""
    pairs, shown = dataset_pairs(document), methods(document)
    if pairs:
        yield element("h2", "Two data sets at a time", id="overview")
    for index, pair in enumerate(pairs[:PAIRS]):
        head = ["%", *(f"{name}, {label}" for label in document["thresholds"] for name in pair)]
        known = [method for method in shown if {*pair} & method.precision.keys()]
        lines = [
            element(
                "tr",
                element("td", method.title),
                [
                    element("td", "n/a" if share is None else f"{100 * share:.1f}")
                    for label in document["thresholds"]
                    for share in (method.precision.get(name, {}).get(label) for name in pair)
                ],
                element("td", "-" if method.seconds is None else duration_message(method.seconds)),
                class_="paper" if method.paper else None,
            )
            for method in known
        ]
        yield element(
            "details",
            element("summary", f"{pair[0]} and {pair[1]}"),
            element(
                "div",
                list(scatter_charts(known, pair, document["thresholds"])),
                class_="charts",
            ),
            element(
                "details",
                element("summary", "The numbers"),
                table([*head, "mean run time"], lines),
            ),
            open=index == 0,
            class_="overview",
        )
    if len(pairs) > PAIRS:
        rest = ", ".join(f"{a} and {b}" for a, b in pairs[PAIRS:])
        yield element("p", f"Not drawn: {rest}", class_="faint")


def run_times(document: Document) -> Iterator[Element]:
    """What was measured, and the paper's times with their machine; neither is judged here."""
    timed = [(run, speed) for run in document["runs"] if (speed := run["speed"])]
    if not timed:
        return
    yield element("h2", "Run time", id="run-time")
    for run, speed in timed:
        first, *rest = speed_lines(speed)
        yield element("h3", run_title(run))
        failed = speed["verdict"]["outcome"] == "failed"
        yield element("p", first, class_="failed" if failed else None)
        yield element("ul", [element("li", line) for line in rest])
    printed: dict[str, PublishedTimeDocument] = {
        name: time
        for methods in document["published"].values()
        for name, method in methods.items()
        if (time := method["run_time"])
    }
    if printed:
        machines = sorted({time["machine"] for time in printed.values()})
        datasets = sorted({time["dataset"] for time in printed.values()})
        yield element(
            "p",
            f"The paper prints, as means per prediction on {', '.join(datasets)} with"
            f" {'; '.join(machines)} (another machine: to look at, not to judge by):",
        )
        yield table(
            ["method", "mean run time"],
            [
                element(
                    "tr",
                    element("td", method_title(method, paper=True)),
                    element("td", duration_message(time["mean_seconds"])),
                    class_="paper",
                )
                for method, time in printed.items()
            ],
        )
