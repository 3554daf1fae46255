"""Precision against one threshold, measured and published, as SVG."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from pytest_cpas.documents import (
    CurveName,
    CurvesDocument,
    PublishedCurvesDocument,
    RunDocument,
)
from pytest_cpas.report._axes import Axes
from pytest_cpas.report._html import Element, element
from pytest_cpas.report.messages import method_title
from pytest_cpas.report.tables import Paper

#: Per curve of the document: title, factor and unit for people.
_AXES: Mapping[CurveName, tuple[str, float, str]] = {
    "position_m": ("position error at most", 100, "cm"),
    "rotation_deg": ("rotation error at most", 1, "deg"),
    "fscore_1cm": ("F-score (1 cm) at least", 1, ""),
}

#: Of a chart, in units of the SVG.
_WIDTH, _HEIGHT = 360, 250

#: Colours in page/page.css.
_COLOURS = 12


@dataclass(frozen=True)
class Line:
    """A method's curves on a data set; ``colour`` is that of its name."""

    method: str
    paper: bool
    colour: int
    curves: CurvesDocument | PublishedCurvesDocument


def curve_lines(published: Paper, runs: Sequence[RunDocument]) -> list[Line]:
    """The curves of runs on one data set: the paper's, then on top of them the measured ones.

    A method has one colour, measured and in the paper, and in whatever order runs come.
    """
    names = list(dict.fromkeys([*published, *sorted(run["method"] for run in runs)]))
    colours = {name: index % _COLOURS for index, name in enumerate(names)}
    return [
        *(Line(name, True, colours[name], published[name]["curves"]) for name in published),
        *(Line(run["method"], False, colours[run["method"]], run["curves"]) for run in runs),
    ]


def charts(lines: Sequence[Line]) -> Iterator[Element]:
    """One chart for each threshold of which any line knows the precision, and the legend."""
    drawn = [name for name in _AXES if any(line.curves.get(name) for line in lines)]
    for name in drawn:
        title, factor, unit = _AXES[name]
        label = f"{title} ({unit})" if unit else title
        yield element(
            "figure",
            _chart(name, factor, label, lines),
            class_="chart",
        )
    if drawn:
        yield element("ul", [_legend(line) for line in reversed(lines)], class_="legend")


def _legend(line: Line) -> Element:
    swatch = element(
        "svg",
        element("line", x1=0, y1=5, x2=24, y2=5, class_=_style(line)),
        viewBox="0 0 24 10",
        width=24,
        height=10,
        aria_hidden="true",
    )
    return element("li", swatch, " ", method_title(line.method, line.paper))


def _style(line: Line) -> str:
    return f"curve c{line.colour}{' paper' if line.paper else ''}"


def _chart(name: CurveName, factor: float, label: str, lines: Sequence[Line]) -> Element:
    largest: float = max(
        factor * point["threshold"] for line in lines for point in line.curves.get(name) or ()
    )
    axes = Axes(_WIDTH, _HEIGHT, (largest, 1.0))
    parts: list[Element] = [
        *axes.grid(
            lambda value: f"{value:g}", lambda share: f"{100 * share:.0f} %", f"precision, {label}"
        )
    ]
    for line in lines:
        points = line.curves.get(name)
        if points:
            path = " ".join(
                f"{axes.across(factor * point['threshold'])},"
                f"{axes.up(point['correct'] / point['total'])}"
                for point in points
            )
            title = element("title", method_title(line.method, line.paper))
            parts.append(element("polyline", title, points=path, class_=_style(line)))
    names = ", ".join(dict.fromkeys(line.method for line in lines))
    return element(
        "svg",
        parts,
        viewBox=f"0 0 {_WIDTH} {_HEIGHT}",
        role="img",
        aria_label=f"Precision against {label}: {names}",
    )
