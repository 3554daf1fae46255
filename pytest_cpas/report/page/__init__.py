"""A document as one HTML page that needs no network and no server.

Tables and curves are in the page itself and need no script; a script lists the samples. The page's
policy admits that one script only, and nothing from elsewhere.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from pytest_cpas.documents import Document, RunDocument
from pytest_cpas.report._html import Child, Element, element, page_text
from pytest_cpas.report.document import SEVERITY
from pytest_cpas.report.messages import (
    judged_message,
    outcome_message,
    parity_message,
    run_title,
    verdicts_message,
)
from pytest_cpas.report.page._comparison import comparison
from pytest_cpas.report.page._methods import overview, precision, run_times, up_axes
from pytest_cpas.report.page._parts import badge, sample_link
from pytest_cpas.report.page._runs import run_details
from pytest_cpas.report.page._samples import sample_data, sample_list
from pytest_cpas.report.panels import ValuePictures


def page(
    document: Document,
    pictures: Mapping[tuple[str, str], Mapping[str, bytes]],
    values: Mapping[tuple[str, str], ValuePictures] = MappingProxyType({}),
) -> str:
    """The text of ``report.html``; ``pictures``: as of :func:`.pictures.pictures`; ``values``: by
    method and data set, of the value at which a method parts from another one."""
    runs = document["runs"]
    details = [
        run_details(run, index, document, pictures.get(key, {}), values.get(key))
        for index, run in enumerate(runs)
        for key in [(run["method"], run["dataset"])]
    ]
    failed = sum(run["outcome"] == "failed" for run in runs)
    script = _asset("page.js")
    main: list[Child] = [
        _header(document),
        element("div", [_card(run, index) for index, run in enumerate(runs)], class_="cards"),
        details[:failed],
        list(comparison(document)),
        list(precision(document)),
        list(up_axes(document)),
        list(overview(document)),
        list(run_times(document)),
        element("h2", "Runs without failures") if details[failed:] else None,
        details[failed:],
        sample_list(len(runs) > 1),
        element("script", sample_data(document), type="application/json", id="data"),
        element("script", script),
    ]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    admitted = f"img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    policy = f"default-src 'none'; {admitted}"
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", f"{outcome_message(document['outcome'])}: pytest-cpas"),
        element("style", _asset("page.css")),
    )
    return page_text(element("html", head, element("body", main), lang="en"))


def _asset(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def _header(document: Document) -> Element:
    runs = document["runs"]
    judged = sum(run["judged"] for run in runs)
    listed = sum(run["listed"] for run in runs)
    counts = [
        f"{sum(run['outcome'] == outcome for run in runs)} {outcome_message(outcome).lower()}"
        for outcome in SEVERITY
        if any(run["outcome"] == outcome for run in runs)
    ]
    items = document["failed_items"]
    failed = f"; {items} test {'item' if items == 1 else 'items'} failed" if items else ""
    return element(
        "header",
        element("h1", "pytest-cpas ", badge(document["outcome"])),
        element(
            "p",
            f"{judged} of {listed} samples judged in {len(runs)}"
            f" {'run' if len(runs) == 1 else 'runs'}: {', '.join(counts)}{failed}",
            class_="faint",
        ),
    )


def _card(run: RunDocument, index: int) -> Element:
    links: list[Child] = []
    lost = sum(bool(flip["lost"]) for flip in run["flips"])
    gained = sum(bool(flip["gained"]) for flip in run["flips"])
    errors = sum(sample["error"] is not None for sample in run["samples"])
    for count, verdict in (
        (errors, "not judged"),
        (lost, "lost"),
        (gained, "gained"),
        (run["unanswered"], "no answer"),
    ):
        if count:
            links.append(sample_link(count, run, verdict))
    return element(
        "div",
        badge(run["outcome"]),
        element("strong", element("a", run_title(run), href=f"#run-{index}")),
        element("p", judged_message(run)),
        element("p", verdicts_message(run), class_="faint"),
        element("p", f"speed: {run['speed']['verdict']['word']}", class_="faint")
        if run["speed"]
        else None,
        element("p", parity_message(run["parity"]), class_="faint") if "parity" in run else None,
        element("p", links) if links else None,
        class_=f"card {run['outcome']}",
    )
