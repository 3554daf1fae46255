"""Precision against one threshold, measured and published, as SVG."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from pytest_cpas.report._html import Element, element
from pytest_cpas.report.document import Document

#: Per curve of the document: title, factor and unit for people.
_AXES = {
    "position_m": ("position error at most", 100, "cm"),
    "rotation_deg": ("rotation error at most", 1, "deg"),
    "fscore_1cm": ("F-score (1 cm) at least", 1, ""),
}

#: Of a chart and of its axes, in units of the SVG.
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 360, 250, 40, 10, 10, 40

#: Colours in page.css.
_COLOURS = 12


@dataclass(frozen=True)
class Line:
    """A method's curves on a data set; ``colour`` is that of its name."""

    method: str
    paper: bool
    colour: int
    curves: Mapping[str, Sequence[Document] | None]


def curve_lines(published: Document, runs: Sequence[Document]) -> list[Line]:
    """The curves of runs on one data set: the paper's, then on top of them the measured ones.

    A method has one colour, measured and in the paper.
    """
    names = list(dict.fromkeys([*published, *(run["method"] for run in runs)]))
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
    return element("li", swatch, f" {line.method}{' (paper)' if line.paper else ''}")


def _style(line: Line) -> str:
    return f"curve c{line.colour}{' paper' if line.paper else ''}"


def _chart(name: str, factor: float, label: str, lines: Sequence[Line]) -> Element:
    largest: float = max(
        factor * point["threshold"] for line in lines for point in line.curves.get(name) or ()
    )
    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM

    def across(value: float) -> float:
        return round(_LEFT + (right - _LEFT) * value / largest, 1)

    def up(share: float) -> float:
        return round(bottom - (bottom - _TOP) * share, 1)

    parts: list[Element] = []
    for step in range(6):
        share, value = step / 5, largest * step / 5
        x, y = across(value), up(share)
        parts += [
            element("line", x1=_LEFT, x2=right, y1=y, y2=y, class_="grid"),
            element("line", x1=x, x2=x, y1=_TOP, y2=bottom, class_="grid"),
            element("text", f"{100 * share:.0f} %", x=_LEFT - 5, y=y + 3.5, text_anchor="end"),
            element("text", f"{value:g}", x=x, y=bottom + 15, text_anchor="middle"),
        ]
    middle = (_LEFT + right) / 2
    parts.append(
        element("text", f"precision, {label}", x=middle, y=_HEIGHT - 6, text_anchor="middle")
    )
    for line in lines:
        points = line.curves.get(name)
        if points:
            path = " ".join(
                f"{across(factor * point['threshold'])},{up(point['correct'] / point['total'])}"
                for point in points
            )
            told = element("title", f"{line.method}{' (paper)' if line.paper else ''}")
            parts.append(element("polyline", told, points=path, class_=_style(line)))
    names = ", ".join(dict.fromkeys(line.method for line in lines))
    return element(
        "svg",
        parts,
        viewBox=f"0 0 {_WIDTH} {_HEIGHT}",
        role="img",
        aria_label=f"Precision against {label}: {names}",
    )
