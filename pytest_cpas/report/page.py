"""A document as one HTML page that needs no network and no server.

Tables and curves are in the page itself and need no script; a script lists the samples. The page's
policy admits that one script only, and nothing from elsewhere.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from urllib.parse import urlencode

from pytest_cpas.report._html import Child, Element, element, page_text
from pytest_cpas.report.curves import charts, curve_lines
from pytest_cpas.report.document import SEVERITY, Document
from pytest_cpas.report.scatter import PAIRS, dataset_pairs, methods
from pytest_cpas.report.scatter import charts as scatter_charts
from pytest_cpas.report.tables import (
    Cell,
    Line,
    category_lines,
    category_tables,
    groups,
    percent,
    precision_table,
)
from pytest_cpas.report.up_axes import disc
from pytest_cpas.report.words import (
    change_words,
    contract_words,
    flip_words,
    golden_words,
    judged_words,
    outcome_words,
    pair_title,
    pair_words,
    seconds_words,
    speed_lines,
    troubles,
    worst_flips_first,
)

#: Flips that the page lists with their errors; the list of samples has all.
_FLIPS = 50

#: Differences between two runs that are less probable than this by chance are coloured.
_TELLING = 0.05

#: Runs of which the details are unfolded although nothing is wrong with them.
_UNFOLDED = 2


def page(document: Document, pictures: Mapping[tuple[str, str], Mapping[str, bytes]]) -> str:
    """The text of ``report.html``; ``pictures``: as of :func:`.pictures.pictures`."""
    runs = document["runs"]
    details = [
        _run(run, index, document, pictures.get((run["method"], run["dataset"]), {}))
        for index, run in enumerate(runs)
    ]
    failed = sum(run["outcome"] == "failed" for run in runs)
    script = _asset("page.js")
    main: list[Child] = [
        _header(document),
        element("div", [_card(run, index) for index, run in enumerate(runs)], class_="cards"),
        details[:failed],
        _against(document["against"], document["thresholds"]) if "against" in document else None,
        [
            part
            for title, members, published in groups(document)
            for part in (
                element("h2", f"Precision on {title}"),
                _method_table(
                    ["correct at", *document["thresholds"]],
                    precision_table(document["thresholds"], members, published),
                ),
                *_category_tables(document["thresholds"], members, published),
                element("div", list(charts(curve_lines(published, members))), class_="charts"),
            )
        ],
        list(_up_axes(document)),
        list(_overview(document)),
        list(_run_times(document)),
        element("h2", "Runs without failures") if details[failed:] else None,
        details[failed:],
        _samples(len(runs) > 1),
        element("script", _data(document), type="application/json", id="data"),
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
        element("title", f"{outcome_words(document['outcome'])}: pytest-cpas"),
        element("style", _asset("page.css")),
    )
    return page_text(element("html", head, element("body", main), lang="en"))


def _asset(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def _badge(outcome: str) -> Element:
    return element("span", outcome_words(outcome), class_=f"badge {outcome}")


def _name(run: Document) -> str:
    return f"{run['method']} on {run['dataset']}"


def _header(document: Document) -> Element:
    runs = document["runs"]
    judged, listed = (sum(run[key] for run in runs) for key in ("judged", "listed"))
    counts = [
        f"{sum(run['outcome'] == outcome for run in runs)} {outcome_words(outcome).lower()}"
        for outcome in SEVERITY
        if any(run["outcome"] == outcome for run in runs)
    ]
    items = document["failed_items"]
    failed = f"; {items} test {'item' if items == 1 else 'items'} failed" if items else ""
    return element(
        "header",
        element("h1", "pytest-cpas ", _badge(document["outcome"])),
        element(
            "p",
            f"{judged} of {listed} samples judged in {len(runs)}"
            f" {'run' if len(runs) == 1 else 'runs'}: {', '.join(counts)}{failed}",
            class_="faint",
        ),
    )


def _card(run: Document, index: int) -> Element:
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
            there = "#" + urlencode({"run": _name(run), "verdict": verdict})
            links += [element("a", f"{count} {verdict}", href=there), " "]
    return element(
        "div",
        _badge(run["outcome"]),
        element("strong", element("a", _name(run), href=f"#run-{index}")),
        element("p", judged_words(run)),
        element("p", golden_words(run), class_="faint"),
        element("p", links) if links else None,
        class_=f"card {run['outcome']}",
    )


def _table(head: Sequence[Child], lines: Sequence[Element], *, text: bool = False) -> Element:
    """``text``: its cells are words rather than numbers."""
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


def _method_table(head: Sequence[str], lines: Sequence[Line]) -> Element:
    return _table(
        head,
        [
            element(
                "tr",
                element("td", line.method, " (paper)" if line.paper else None),
                [_precision_cell(cell) for cell in line.cells],
                class_="paper" if line.paper else None,
            )
            for line in lines
        ],
    )


def _category_tables(
    thresholds: Sequence[str], runs: Sequence[Document], published: Document
) -> Iterator[Element]:
    for threshold, categories, lines in category_tables(thresholds, runs, published):
        yield element(
            "details",
            element("summary", f"Per category at {threshold}"),
            _method_table(["correct", *categories], lines),
        )


def _up_axes(document: Document) -> Iterator[Element]:
    """Per data set where up axes point: the truth once, and the estimates of every run."""
    for title, runs, _ in groups(document):
        known = [run for run in runs if run["up_axes"]]
        true = next((run["up_axes"]["truth"] for run in known if run["up_axes"]["truth"]), None)
        discs = [disc(true, "truth", estimate=False)] if true else []
        discs += [
            disc(run["up_axes"]["estimate"], run["method"], estimate=True)
            for run in known
            if run["up_axes"]["estimate"]
        ]
        if discs:
            yield element("h2", f"Up axes on {title}")
            yield element("div", discs, class_="spheres")


def _overview(document: Document) -> Iterator[Element]:
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
                element("td", "-" if method.seconds is None else seconds_words(method.seconds)),
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
                _table([*head, "mean run time"], lines),
            ),
            open=index == 0,
            class_="overview",
        )
    if len(pairs) > PAIRS:
        rest = ", ".join(f"{a} and {b}" for a, b in pairs[PAIRS:])
        yield element("p", f"Not drawn: {rest}", class_="faint")


def _run_times(document: Document) -> Iterator[Element]:
    """What was measured, and the paper's times with their machine; neither is judged here."""
    timed = [run for run in document["runs"] if run["speed"]]
    if not timed:
        return
    yield element("h2", "Run time", id="run-time")
    for run in timed:
        first, *rest = speed_lines(run["speed"])
        yield element("h3", _name(run))
        failed = run["speed"]["verdict"]["outcome"] == "failed"
        yield element("p", first, class_="failed" if failed else None)
        yield element("ul", [element("li", line) for line in rest])
    printed: dict[str, Document] = {
        method: entry["run_time"]
        for entries in document["published"].values()
        for method, entry in entries.items()
        if entry["run_time"]
    }
    if printed:
        machines = sorted({time["machine"] for time in printed.values()})
        datasets = sorted({time["dataset"] for time in printed.values()})
        yield element(
            "p",
            f"The paper prints, as means per prediction on {', '.join(datasets)} with"
            f" {'; '.join(machines)} (another machine: to look at, not to judge by):",
        )
        yield _table(
            ["method", "mean run time"],
            [
                element(
                    "tr",
                    element("td", f"{method} (paper)"),
                    element("td", seconds_words(time["mean_seconds"])),
                    class_="paper",
                )
                for method, time in printed.items()
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


def _run(run: Document, index: int, document: Document, pictures: Mapping[str, bytes]) -> Element:
    opened = run["outcome"] == "failed" or len(document["runs"]) <= _UNFOLDED
    return element(
        "details",
        element("summary", f"{_name(run)} ", _badge(run["outcome"])),
        list(_told(run)),
        _gallery(run, pictures) if pictures else None,
        element("h3", "Per category"),
        _category_table(run, document["thresholds"]),
        element("p", contract_words(run["contract"]), class_="faint"),
        element("h3", "Conditions"),
        _table(
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


def _told(run: Document) -> Iterator[Element]:
    """What is wrong, or missing."""
    for title, lines in troubles(run):
        yield element("h3", title)
        yield element("pre", "\n".join(lines))
    if run["flips"]:
        yield element("h3", "Judged otherwise than by the golden table")
        yield from _flips(run["flips"])


def _flips(flips: Sequence[Document]) -> Iterator[Element]:
    yield _table(
        ["sample", "category", "before", "now", "what changed"],
        [
            element(
                "tr",
                element("td", flip["sample"]),
                element("td", flip["category"]),
                element("td", flip["before"]),
                element("td", flip["after"]),
                element("td", flip_words(flip), class_="wrap"),
            )
            for flip in flips[:_FLIPS]
        ],
        text=True,
    )
    if len(flips) > _FLIPS:
        yield element("p", f"and {len(flips) - _FLIPS} more", class_="faint")


def _against(against: Document, thresholds: Sequence[str]) -> Iterator[Element]:
    """The runs beside those of another one."""
    yield element("h2", "Compared with another run", id="against")
    for pair in against["pairs"]:
        yield element("h3", pair_title(pair))
        first, *conditions = pair_words(pair)
        yield element("p", first)
        if conditions:
            yield element("pre", "\n".join(conditions))
        yield _table(
            ["before → now", *thresholds],
            [
                element("tr", element("td", category), [_change_cell(entry) for entry in entries])
                for category, entries in category_lines(pair)
            ],
        )
        yield element(
            "p",
            "In brackets the difference in percentage points. p: McNemar's exact test, two-sided,"
            f" which takes samples for independent; below {_TELLING:g} it is coloured.",
            class_="faint",
        )
        if pair["flips"]:
            run = f"{pair['method']} on {pair['dataset']}"
            links: list[Child] = []
            for verdict, kind in (("lost since", "lost"), ("gained since", "gained")):
                if count := sum(bool(flip[kind]) for flip in pair["flips"]):
                    there = "#" + urlencode({"run": run, "verdict": verdict})
                    links += [element("a", f"{count} {verdict}", href=there), " "]
            yield element("p", links)
            yield from _flips(worst_flips_first(pair["flips"]))
    if against["unpaired"]:
        yield element("p", "Without a counterpart: ", ", ".join(against["unpaired"]))


def _change_cell(entry: Document) -> Element:
    precision, flips = change_words(entry)
    kind = None
    if entry["p"] is not None and entry["p"] < _TELLING:
        kind = "met" if entry["gained"] > entry["lost"] else "unmet"
    return element("td", element("span", precision, class_=kind), element("small", flips))


def _gallery(run: Document, pictures: Mapping[str, bytes]) -> Child:
    samples = {sample["sample"]: sample for sample in run["samples"]}
    figures = []
    for name, content in pictures.items():
        sample = samples[name]
        if sample["position_m"] is None or sample["rotation_deg"] is None:
            words = f"no answer: {sample['failure']}" if sample["failure"] else "no errors"
        else:
            words = f"{100 * sample['position_m']:.2f} cm, {sample['rotation_deg']:.1f} deg"
            words += "" if sample["fscore_1cm"] is None else f", F {sample['fscore_1cm']:.2f}"
        source = f"data:image/webp;base64,{base64.b64encode(content).decode()}"
        figures.append(
            element(
                "figure",
                element(
                    "img", src=source, alt=f"boxes and surfaces in {name}", width=512, height=256
                ),
                element("figcaption", f"{sample['category']} {name}", element("small", words)),
            )
        )
    return (
        element("h3", f"Lost and worst samples ({len(figures)})"),
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


def _category_table(run: Document, thresholds: Sequence[str]) -> Element:
    lines = []
    for category, entries in category_lines(run):
        cells = []
        for entry in entries:
            count = entry["measured"]
            others = [
                element("small", f"{kind} {percent(entry[kind])}")
                for kind in ("golden", "published")
                if entry[kind]
            ]
            if count is None:
                cells.append(element("td", "n/a", others, class_="faint"))
                continue
            width = f"width:{100 * count['correct'] / count['total']:.1f}%"
            bar = element("span", element("span", style=width), class_="bar")
            fraction = f"{count['correct']}/{count['total']}"
            cells.append(element("td", f"{fraction} {percent(count)}", bar, others))
        lines.append(element("tr", element("td", category), cells))
    return _table(["correct at", *thresholds], lines)


def _samples(several: bool) -> Element:
    def choice(title: str, name: str, first: str, **options: str) -> Element:
        made = [element("option", words, value=value) for value, words in options.items()]
        return element(
            "label",
            title,
            element("select", element("option", first, value=""), made, name=name),
        )

    columns = ["sample", "category", "now", "golden", "position, cm", "rotation, deg", "IoU"]
    columns += ["F 1 cm", *(["run"] if several else []), "remark"]
    table = _table(columns, [], text=True)
    for body in table.iter("tbody"):
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
        table,
        element("button", "show more", type="button", id="more", hidden=True),
    )


def _data(document: Document) -> str:
    """What the script lists. No text in it can end the script element that it stands in."""
    pairs = document.get("against", {"pairs": []})["pairs"]
    since = {(pair["method"], pair["dataset"]): pair["flips"] for pair in pairs}
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
                *(_short(sample[key]) for key in ("position_m", "rotation_deg")),
                *(_short(sample[key]) for key in ("iou", "fscore_1cm")),
                sample["error"] or sample["failure"],
                sample["failure"] is not None,
                _since(flips.get(sample["sample"]), document["thresholds"]),
            ]
            for sample in run["samples"]
        ]
        runs.append({"name": _name(run), "categories": categories, "samples": samples})
    data = {"thresholds": document["thresholds"], "runs": runs, "against": bool(pairs)}
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")


def _since(flip: Document | None, thresholds: Sequence[str]) -> str | None:
    """Per threshold whether another run lost (-) or gained (+) a sample, or neither (0)."""
    if flip is None:
        return None
    return "".join(
        "-" if label in flip["lost"] else "+" if label in flip["gained"] else "0"
        for label in thresholds
    )


def _short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.6g}")
