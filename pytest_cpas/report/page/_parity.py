"""A method beside a reference, on the page: the verdict, and pictures of where the two part."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_cpas.documents import RunDocument
from pytest_cpas.report._html import Element, element
from pytest_cpas.report.messages import parity_lines
from pytest_cpas.report.panels import RAMPS, Panel, Scale, ValuePictures


def parity(run: RunDocument, pictures: ValuePictures | None) -> Iterator[Element]:
    """The section, if the run has a verdict."""
    if "parity" not in run:
        return
    told = run["parity"]
    yield element("h3", f"Parity with {told['reference']}")
    yield element("pre", "\n".join(parity_lines(told)))
    if told["parting"] is None or pictures is None:
        return
    yield element("p", f"{told['parting']['value']} in {told['parting']['sample']}:")
    for words, panels in pictures.rows:
        yield element("p", words, class_="faint") if words else element("p")
        yield element("div", [_figure(panel) for panel in panels], class_="values")
    for remark in pictures.remarks:
        yield element("p", remark, class_="faint")


def _figure(panel: Panel) -> Element:
    return element(
        "figure",
        element(
            "img",
            src=f"data:image/webp;base64,{panel.image}",
            alt=panel.title,
            width=panel.width,
            height=panel.height,
        ),
        element(
            "figcaption", panel.title, _scale(panel.scale) if panel.scale is not None else None
        ),
    )


def _scale(scale: Scale) -> Element:
    """A bar of the colours between the numbers at its ends."""
    colours = ",".join(f"rgb{colour}" for colour in RAMPS[scale.ramp])
    return element(
        "span",
        element("span", style=f"background:linear-gradient(to right,{colours})"),
        element("small", f"{scale.low:.3g}"),
        element("small", f"{scale.high:.3g}"),
        class_="ramp",
    )
