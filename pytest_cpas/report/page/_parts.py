"""What several sections of the page are made of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from urllib.parse import urlencode

from pytest_cpas.documents import FlipDocument, ItemOutcome, RunName
from pytest_cpas.reading.text import html
from pytest_cpas.report._html import Child, Element, element
from pytest_cpas.report.messages import flip_message, outcome_message, run_title
from pytest_cpas.report.tables import protocol_title, split_label

#: Flips that the page lists with their errors; the list of samples has all.
_FLIPS = 50


def badge(outcome: ItemOutcome) -> Element:
    """An outcome, in its colour."""
    return element("span", outcome_message(outcome), class_=f"badge {outcome}")


def table(head: Sequence[Child], lines: Sequence[Element], *, text: bool = False) -> Element:
    """A table that scrolls; ``text``: its cells are text rather than numbers."""
    return element(
        "div",
        element(
            "table",
            element("thead", element("tr", [element("th", title) for title in head])),
            element("tbody", list(lines)),
            class_="text" if text else None,
        ),
        class_="scroll",
    )


def flip_table(flips: Sequence[FlipDocument], every: int) -> Iterator[Element]:
    """Flips with their errors before and after, and how many more there are; ``every``: columns."""
    yield table(
        ["sample", "category", "before", "now", "what changed"],
        [
            element(
                "tr",
                element("td", flip["sample"]),
                element("td", flip["category"]),
                element("td", flip["before"]),
                element("td", flip["after"]),
                element("td", flip_message(flip, every), class_="wrap"),
            )
            for flip in flips[:_FLIPS]
        ],
        text=True,
    )
    if len(flips) > _FLIPS:
        yield element("p", f"and {len(flips) - _FLIPS} more", class_="faint")


def protocol_head(words: str, protocol: str, own: Sequence[str]) -> list[str]:
    """The head of a table that has the columns of a protocol."""
    return [protocol_title(words, protocol), *(split_label(label)[1] for label in own)]


def sample_link(count: int, run: RunName, verdict: str) -> Child:
    """How many samples of a run have a verdict, as a link to the list of them."""
    # the run as the script lists it
    there = "#" + urlencode({"run": html(run_title(run)), "verdict": verdict})
    return [element("a", f"{count} {verdict}", href=there), " "]
