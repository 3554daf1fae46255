"""Precision on one data set against that on another, with the run time as colour, as SVG."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from pytest_cpas.datasets.perturbed import RobustnessPoint
from pytest_cpas.documents import Document, RunDocument
from pytest_cpas.report._axes import Axes
from pytest_cpas.report._html import Element, element
from pytest_cpas.report.messages import duration_message, method_title
from pytest_cpas.report.tables import Cell, measured_cells, published_cells
from pytest_cpas.types.samples import ALL

#: Pairs of data sets that a page shows.
PAIRS = 6

#: Of a chart, of a letter (its mean width) and of a line of them, in units of the SVG.
_WIDTH, _HEIGHT = 360, 330
_LETTER, _LINE = 6.2, 11.0

#: Letters of a name that a chart has room for.
_LONGEST = 22

#: The colours of 10 ms to 10 s, evenly spaced by their logarithm (viridis).
_FASTEST, _SLOWEST = 0.01, 10.0
_COLOURS = (
    (68, 1, 84),
    (59, 82, 139),
    (33, 145, 140),
    (94, 201, 98),
    (253, 231, 37),
)


@dataclass(frozen=True)
class Method:
    """A method, as measured or in the paper: per data set and threshold its precision over all
    categories, and its mean seconds per prediction, if they are known."""

    name: str
    paper: bool
    precision: Mapping[str, Mapping[str, float]]
    seconds: float | None

    @property
    def title(self) -> str:
        """The name, and that it is the paper's."""
        return method_title(self.name, self.paper)


def methods(document: Document) -> list[Method]:
    """The paper's methods, and then those of the runs; a data set has the paper's name for it."""
    names = dict.fromkeys(name for printed in document["published"].values() for name in printed)
    known = []
    for name in names:
        tables = {
            dataset: printed[name]
            for dataset, printed in document["published"].items()
            if name in printed
        }
        time = next((table["run_time"] for table in tables.values() if table["run_time"]), None)
        precision = {dataset: _overall(published_cells(table)) for dataset, table in tables.items()}
        known.append(Method(name, True, precision, time and time["mean_seconds"]))
    for name in dict.fromkeys(run["method"] for run in document["runs"]):
        runs = [run for run in document["runs"] if run["method"] == name]
        times = [run["speed"]["mean_seconds"] for run in runs if run["speed"]]
        precision = {_dataset(run): _overall(measured_cells(run)) for run in runs}
        known.append(Method(name, False, precision, times[0] if times else None))
    return known


def dataset_pairs(document: Document) -> list[tuple[str, str]]:
    """Pairs of data sets, of the runs and of the paper, that several methods were judged on."""
    known = {_dataset(run) for run in document["runs"] if not RobustnessPoint.named(run["dataset"])}
    judged = [method.precision.keys() for method in methods(document)]
    return [
        pair
        for pair in itertools.combinations(sorted({*known, *document["published"]}), 2)
        if sum(set(pair) <= names for names in judged) > 1
    ]


def _dataset(run: RunDocument) -> str:
    return run["published_as"] or run["dataset"]


def _overall(cells: Mapping[tuple[str, str], Cell]) -> dict[str, float]:
    """By threshold the precision over all categories."""
    return {
        threshold: cell.share for (category, threshold), cell in cells.items() if category == ALL
    }


def charts(
    shown: Sequence[Method], pair: tuple[str, str], thresholds: Sequence[str]
) -> Iterator[Element]:
    """One chart for each threshold at which a method has a precision on both data sets, and what
    its signs mean."""
    drawn = False
    for threshold in thresholds:
        first, second = (
            [method.precision.get(name, {}).get(threshold) for method in shown] for name in pair
        )
        places = [
            place for place in zip(shown, first, second, strict=True) if place[1:] != (None, None)
        ]
        if any(None not in place for place in places):
            yield element("figure", _chart(places, pair, threshold), class_="chart")
            drawn = True
    if drawn:
        yield _legend()


_Place = tuple[Method, float | None, float | None]


def _chart(places: Sequence[_Place], pair: tuple[str, str], threshold: str) -> Element:
    ends = _end([x or 0 for _, x, _ in places]), _end([y or 0 for _, _, y in places])
    axes = Axes(_WIDTH, _HEIGHT, ends)
    about = f"Precision at {threshold} on {pair[0]} (across) and on {pair[1]} (up)"
    return element(
        "svg",
        element("title", about),
        element("desc", "; ".join(_place_text(*place, pair) for place in places)),
        axes.grid(
            lambda share: f"{100 * share:.3g}",
            lambda share: f"{100 * share:.3g} %",
            f"precision on {pair[0]}, %",
        ),
        element("text", f"on {pair[1]}", x=axes.left + 5, y=axes.margin + 11),
        element("text", f"at {threshold}", x=axes.right, y=axes.margin - 3, text_anchor="end"),
        [_mark(*place, axes, _place_text(*place, pair)) for place in places],
        _labels(places, axes),
        viewBox=f"0 0 {_WIDTH} {_HEIGHT}",
        role="img",
        aria_label=about,
    )


def _end(shares: Sequence[float]) -> float:
    """Where an axis ends, so that a fifth of it is a round number."""
    return next((end for end in (0.1, 0.25, 0.5, 0.75) if max(shares) <= end), 1.0)


def _mark(method: Method, x: float | None, y: float | None, axes: Axes, text: str) -> Element:
    """A dot, or a tick at the axis of the only data set on which a method is known."""
    title = element("title", text)
    at_x, at_y = axes.across(x or 0), axes.up(y or 0)
    if x is None:
        ends = {"x1": axes.left - 4, "x2": axes.left + 8, "y1": at_y, "y2": at_y}
        return element("line", title, **ends, class_="tick")
    if y is None:
        ends = {"x1": at_x, "x2": at_x, "y1": axes.bottom + 4, "y2": axes.bottom - 8}
        return element("line", title, **ends, class_="tick")
    fill = None if method.seconds is None else colour(method.seconds)
    if method.paper:
        return element("circle", title, cx=at_x, cy=at_y, r=5, class_="dot paper", fill=fill)
    diamond = f"{at_x},{at_y - 7} {at_x + 7},{at_y} {at_x},{at_y + 7} {at_x - 7},{at_y}"
    return element("polygon", title, points=diamond, class_="dot measured", fill=fill)


def _place_text(method: Method, x: float | None, y: float | None, pair: tuple[str, str]) -> str:
    known = [
        f"{100 * share:.1f} % on {name}"
        for name, share in zip(pair, (x, y), strict=True)
        if share is not None
    ]
    time = "not timed" if method.seconds is None else f"{duration_message(method.seconds)} each"
    return f"{method.title}: {', '.join(known)}, {time}"


def _labels(places: Sequence[_Place], axes: Axes) -> Iterator[Element]:
    """Names beside dots, each where it covers least of the other names and dots."""
    dots = [(axes.across(x or 0), axes.up(y or 0), _short(method.name)) for method, x, y in places]
    taken = [(x - 6, y - 6, x + 6, y + 6) for x, y, _ in dots]
    for x, y, name in sorted(dots):
        width = _LETTER * len(name)
        choices = []
        for dx, dy in itertools.product((8, -8 - width, -width / 2), (3.5, -8, 16, -19, 27)):
            box = (x + dx, y + dy - _LINE + 2, x + dx + width, y + dy + 2)
            outside = max(0, axes.left + 1 - box[0]) + max(0, box[2] - axes.right)
            outside += max(0, axes.margin - box[1]) + max(0, box[3] - axes.bottom)
            covered = sum(_shared(box, other) for other in taken)
            distance = abs(dx + width / 2) / 5 + abs(dy - 3.5)
            choices.append((covered + 50 * outside + distance, box))
        box = min(choices)[1]
        taken.append(box)
        yield element("text", name, x=round(box[0], 1), y=round(box[3] - 2, 1), class_="name")


def _short(name: str) -> str:
    return name if len(name) <= _LONGEST else f"{name[: _LONGEST - 1]}…"


_Box = tuple[float, float, float, float]


def _shared(a: _Box, b: _Box) -> float:
    """The area that two boxes (left, top, right, bottom) share."""
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    return max(0.0, width) * max(0.0, height)


def colour(seconds: float) -> str:
    """The colour of a time."""
    share = math.log(seconds / _FASTEST) / math.log(_SLOWEST / _FASTEST)
    at = min(max(share, 0.0), 1.0) * (len(_COLOURS) - 1)
    low = min(int(at), len(_COLOURS) - 2)
    mixed = (
        round(a + (at - low) * (b - a))
        for a, b in zip(_COLOURS[low], _COLOURS[low + 1], strict=True)
    )
    return f"rgb({' '.join(map(str, mixed))})"


def _legend() -> Element:
    steps, width = 60, 240
    bar = [
        element(
            "rect",
            x=round(width * step / steps, 1),
            y=0,
            width=width / steps + 0.5,
            height=10,
            fill=colour(_FASTEST * (_SLOWEST / _FASTEST) ** (step / (steps - 1))),
        )
        for step in range(steps)
    ]
    ticks = [
        element("text", label, x=width * index / 3, y=22, text_anchor=anchor)
        for index, (label, anchor) in enumerate(
            (("10 ms", "start"), ("100 ms", "middle"), ("1 s", "middle"), ("10 s", "end"))
        )
    ]
    scale = element(
        "svg",
        bar,
        ticks,
        viewBox=f"0 0 {width} 26",
        width=width,
        height=26,
        role="img",
        aria_label="colours of run times from 10 ms to 10 s",
    )
    return element(
        "p",
        "● the paper's methods, ◆ measured here; colour: mean run time per prediction, grey: not"
        " timed. A tick at an axis: known on that data set only. ",
        scale,
        class_="scale",
    )
