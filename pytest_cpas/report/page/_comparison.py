"""The runs beside those of another one, on the page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pytest_cpas.documents import ChangeDocument, Document
from pytest_cpas.report._html import Element, element
from pytest_cpas.report.messages import change_messages, pair_lines, pair_title, worst_flips_first
from pytest_cpas.report.page._parts import flip_table, protocol_head, sample_link, table
from pytest_cpas.report.tables import category_lines, column_count, labels, of_protocols

#: Differences between two runs that are less probable than this by chance are coloured.
_TELLING = 0.05


def comparison(document: Document) -> Iterator[Element]:
    """The section, if the document has a comparison."""
    if "against" not in document:
        return
    against = document["against"]
    yield element("h2", "Compared with another run", id="against")
    for pair in against["pairs"]:
        yield element("h3", pair_title(pair))
        first, *conditions = pair_lines(pair)
        yield element("p", first)
        if conditions:
            yield element("pre", "\n".join(conditions))
        yield from _tables(pair["precision"])
        if pair["guards"]:
            yield element("details", element("summary", "Guards"), list(_tables(pair["guards"])))
        yield element(
            "p",
            "In brackets the difference in percentage points. p: McNemar's exact test, two-sided,"
            f" which takes samples for independent; below {_TELLING:g} it is coloured.",
            class_="faint",
        )
        if pair["flips"]:
            lost = sum(bool(flip["lost"]) for flip in pair["flips"])
            gained = sum(bool(flip["gained"]) for flip in pair["flips"])
            counts = ((lost, "lost since"), (gained, "gained since"))
            yield element("p", [sample_link(n, pair, verdict) for n, verdict in counts if n])
            yield from flip_table(worst_flips_first(pair["flips"]), column_count(pair))
    if against["unpaired"]:
        yield element("p", "Without a counterpart: ", ", ".join(against["unpaired"]))


def _tables(entries: Sequence[ChangeDocument]) -> Iterator[Element]:
    """A table for each protocol."""
    for protocol, own in of_protocols(labels(entries)).items():
        yield table(
            protocol_head("before → now", protocol, own),
            [
                element("tr", element("td", category), [_change_cell(entry) for entry in changes])
                for category, changes in category_lines(entries, own)
            ],
        )


def _change_cell(change: ChangeDocument) -> Element:
    precision, flips = change_messages(change)
    kind = None
    if change["p"] is not None and change["p"] < _TELLING:
        kind = "met" if change["gained"] > change["lost"] else "unmet"
    return element("td", element("span", precision, class_=kind), element("small", flips))
