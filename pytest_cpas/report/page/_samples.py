"""The list of samples: its form and table, and what the script puts into them."""

from __future__ import annotations

import json
from collections.abc import Sequence

from pytest_cpas.documents import Document, FlipDocument
from pytest_cpas.reading.text import everywhere, html
from pytest_cpas.report._html import Element, element
from pytest_cpas.report.messages import run_title
from pytest_cpas.report.page._parts import table


def sample_list(several: bool) -> Element:
    """The form and the empty table; ``several``: there are several runs."""

    def choice(title: str, name: str, first: str, **options: str) -> Element:
        made = [element("option", label, value=value) for value, label in options.items()]
        return element(
            "label",
            title,
            element("select", element("option", first, value=""), made, name=name),
        )

    columns = ["sample", "category", "now", "golden", "position, cm", "rotation, deg", "IoU"]
    columns += ["F 1 cm", *(["run"] if several else []), "remark"]
    listed = table(columns, [], text=True)
    for body in listed.iter("tbody"):
        body.set("id", "samples")
    return element(
        "section",
        element("h2", "Samples"),
        element(
            "noscript",
            element("p", "The list of samples needs JavaScript; report.json beside it has all."),
        ),
        element(
            "form",
            choice("run", "run", "all"),
            choice("category", "category", "all"),
            choice("verdict", "verdict", "all"),
            choice("at", "at", "any threshold"),
            choice("order", "order", "by name", worst="worst first"),
            element("label", "name contains", element("input", name="name", type="search")),
            element("button", "reset", type="button", id="clear"),
            id="filters",
        ),
        element("p", class_="faint", id="told", aria_live="polite"),
        listed,
        element("button", "show more", type="button", id="more", hidden=True),
    )


def sample_data(document: Document) -> str:
    """What the script lists. No text in it can end the script element that it stands in."""
    pairs = document["against"]["pairs"] if "against" in document else []
    since = {(pair["method"], pair["dataset"]): pair["flips"] for pair in pairs}
    columns = [*document["thresholds"], *document["guards"]]
    runs = []
    for run in document["runs"]:
        flips = {flip["sample"]: flip for flip in since.get((run["method"], run["dataset"]), ())}
        categories = sorted({sample["category"] for sample in run["samples"]})
        samples = [
            [
                sample["sample"],
                categories.index(sample["category"]),
                sample["outcome"],
                sample["golden"],
                _short(sample["position_m"]),
                _short(sample["rotation_deg"]),
                _short(sample["iou"]),
                _short(sample["fscore_1cm"]),
                sample["error"] or sample["failure"],
                sample["failure"] is not None,
                _since(flips.get(sample["sample"]), columns),
            ]
            for sample in run["samples"]
        ]
        runs.append({"name": run_title(run), "categories": categories, "samples": samples})
    data = {"thresholds": columns, "runs": runs, "against": bool(pairs)}
    data = everywhere(html, data)
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")


def _since(flip: FlipDocument | None, thresholds: Sequence[str]) -> str | None:
    """Per threshold whether another run lost (-) or gained (+) a sample, or neither (0)."""
    if flip is None:
        return None
    return "".join(
        "-" if label in flip["lost"] else "+" if label in flip["gained"] else "0"
        for label in thresholds
    )


def _short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.6g}")
