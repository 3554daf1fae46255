"""The precision tables as CSV, with exact counts, and as LaTeX, as a paper prints them."""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Iterator, Sequence

from pytest_cpas.datasets.perturbed import RobustnessPoint
from pytest_cpas.documents import (
    Document,
    IntervalsDocument,
    PrecisionDocument,
    RunDocument,
    ScoreDocument,
)
from pytest_cpas.golden.literature import LEGACY
from pytest_cpas.protocols import PAPER
from pytest_cpas.reading.text import csv_cell, latex
from pytest_cpas.report.intervals import KINDS, ends_of, interval_messages
from pytest_cpas.report.literature import REMARK, literature_table, printed_rows
from pytest_cpas.report.messages import method_title
from pytest_cpas.report.tables import (
    Cell,
    Line,
    Paper,
    category_tables,
    groups,
    of_protocols,
    precision_table,
    split_label,
)
from pytest_cpas.types.samples import ALL

#: Data sets beside each other in a table.
_BESIDE = 2

#: The intervals at 95 % of what was measured; empty where they say nothing, or are infinite.
_ENDS = ("sample_low", "sample_high", "scene_low", "scene_high")

_COLUMNS = (
    "dataset",
    "method",
    "source",
    "category",
    "protocol",
    "column",
    "correct_low",
    "correct_high",
    "total",
    "precision",
    *_ENDS,
)

_SCORES = (
    *("dataset", "method", "source", "category", "protocol", "column", "samples", "value"),
    *_ENDS,
)

#: How the best three of a column are marked.
_MARKS = ("{}", r"\textbf{{{}}}", r"\underline{{{}}}", r"\textit{{{}}}")

#: What the cell of the best begins with.
_BEST = _MARKS[1].partition("{{")[0]

_PLACES = ("first", "second", "third")


def precision_csv(document: Document) -> str:
    """One line per data set, method, category and column that counts; what is n/a has none.

    ``source`` is measured or paper; ``column`` is the label of a column of ``protocol``. Between
    ``correct_low`` and ``correct_high`` of ``total`` samples are correct: the same number, unless
    the paper's print leaves it open. The means and medians of scores stand in a second table, of
    :func:`scores_csv`.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for where, threshold, low, high, total, ends in _counts(document):
        texts = map(csv_cell, (*where, *split_label(threshold)))
        writer.writerow((*texts, low, high, total, f"{low / total:.4f}", *ends))
    return text.getvalue()


#: Data set, method, source, category.
_Where = tuple[str, str, str, str]


def _counts(document: Document) -> Iterator[tuple[_Where, str, int, int, int, list[str]]]:
    """Where, threshold, lowest and highest count, total, and the ends of the intervals."""
    for run in document["runs"]:
        for entry in (*run["precision"], *run["guards"]):
            if count := entry["measured"]:
                where = (run["dataset"], run["method"], "measured", entry["category"])
                correct, ends = count["correct"], _ends(entry["intervals"])
                yield where, entry["threshold"], correct, correct, count["total"], ends
    for dataset, methods in document["published"].items():
        for name, method in methods.items():
            for cell in method["precision"]:
                printed = cell["published"]
                yield (
                    (dataset, name, "paper", cell["category"]),
                    cell["threshold"],
                    printed["lowest"],
                    printed["highest"],
                    printed["total"],
                    _ends(None),
                )


def _ends(intervals: IntervalsDocument | None) -> list[str]:
    """In the order of :data:`_ENDS`."""
    if intervals is None:
        return [""] * len(_ENDS)
    pairs = (intervals["sample"] or [None, None], intervals["scene"] or [None, None])
    return ["" if end is None else f"{end:.6g}" for pair in pairs for end in pair]


def scores_csv(document: Document) -> str:
    """One line per data set, method, category and score; what is n/a has none.

    ``source`` is measured, or literature for what is printed elsewhere: of unknown ``samples``.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_SCORES)
    for run in document["runs"]:
        for entry in run["scores"]:
            if (value := entry["measured"]) is not None:
                where = (run["dataset"], run["method"], "measured", entry["category"])
                texts = map(csv_cell, (*where, *split_label(entry["score"])))
                ends = _ends(entry["intervals"])
                writer.writerow((*texts, entry["samples"], f"{value:.6g}", *ends))
    for dataset, rows in document.get("literature", {}).items():
        for row in rows:
            for label, percent in row["percent"].items():
                where = (dataset, row["method"], "literature", ALL)
                texts = map(csv_cell, (*where, *split_label(label)))
                writer.writerow((*texts, "", f"{percent / 100:.6g}", *_ends(None)))
    return text.getvalue()


def precision_tex(document: Document) -> str:
    r"""Tables for booktabs, to be taken in with ``\input``: over all categories, and per category;
    then what is guarded, the scores, intervals over all categories, and what the literature prints.

    Precision has four decimals, as in the paper; the best three of a column are marked.
    """
    thresholds = of_protocols(document["thresholds"])
    shown = [
        group for group in groups(document) if not RobustnessPoint.named(group[1][0]["dataset"])
    ]
    lines = [r"% Precision by pytest-cpas. Needs \usepackage{booktabs}."]
    for protocol, own in thresholds.items():
        for first in range(0, len(shown), _BESIDE):
            lines += _overall(shown[first : first + _BESIDE], protocol, own)
    for title, runs, published in shown:
        for threshold, categories, table in category_tables(
            document["thresholds"], runs, published
        ):
            lines += _table(
                f"Precision on {latex(title)} per category at {_threshold(threshold)}.",
                [[latex(category) for category in categories]],
                [(_method(line), _precision(line.cells)) for line in table],
            )
    for title, runs, _ in shown:
        for protocol, own in of_protocols(document["guards"]).items():
            table = precision_table(own, runs, {})
            known = [index for index in range(len(own)) if any(line.cells[index] for line in table)]
            lines += _table(
                f"Guarded columns{_under(protocol)} on {latex(title)}.",
                [[_own(own[index]) for index in known]],
                [(_method(line), _precision([line.cells[i] for i in known])) for line in table],
            )
        lines += _scores(title, runs)
        lines += _intervals(title, runs)
        lines += _literature(title, runs, document)
    return "\n".join(lines) + "\n"


def _scores(title: str, runs: Sequence[RunDocument]) -> Iterator[str]:
    """Per protocol the scores over all categories."""
    known: dict[str, dict[str, str]] = {}
    for run in runs:
        for entry in run["scores"]:
            if entry["category"] == ALL and entry["measured"] is not None:
                told = f"{entry['measured']:{'.4f' if entry['share'] else '.4g'}}"
                known.setdefault(entry["score"], {})[run["method"]] = told
    for protocol, own in of_protocols(known).items():
        yield from _table(
            f"Scores{_under(protocol)} on {latex(title)}.",
            [[_own(label) for label in own]],
            [
                (latex(run["method"]), [known[label].get(run["method"], "n/a") for label in own])
                for run in runs
            ],
        )


def _intervals(title: str, runs: Sequence[RunDocument]) -> Iterator[str]:
    """Per protocol the intervals of what is read over all categories: two lines a method."""
    entries: dict[str, dict[str, PrecisionDocument | ScoreDocument]] = {}
    for run in runs:
        read: list[tuple[str, PrecisionDocument | ScoreDocument]] = [
            *((entry["threshold"], entry) for entry in run["precision"]),
            *((score["score"], score) for score in run["scores"] if not score["guard"]),
        ]
        for label, entry in read:
            if entry["category"] == ALL and interval_messages(entry):
                entries.setdefault(label, {})[run["method"]] = entry
    for protocol, labels in of_protocols(entries).items():
        yield from _table(
            rf"Intervals at 95 \%{_under(protocol)} on {latex(title)}: per sample, as if all were"
            " independent, and by scene.",
            [[_own(label) for label in labels]],
            [
                (f"{latex(run['method'])}, {words}", [latex(cell or "n/a") for cell in cells])
                for run in runs
                for kind, words in KINDS.items()
                if any(
                    cells := [
                        ends_of(own, kind) if (own := entries[label].get(run["method"])) else ""
                        for label in labels
                    ]
                )
            ],
        )


def _literature(title: str, runs: Sequence[RunDocument], document: Document) -> Iterator[str]:
    """Average precision of the runs on a data set, above what is printed of it."""
    tables = [literature_table(run, printed_rows(run, document)) for run in runs]
    shown = [(run, table) for run, table in zip(runs, tables, strict=True) if table]
    if not shown:
        return
    _, table = shown[0]
    yield from _table(
        rf"AP in \% of {latex(LEGACY)} on {latex(title)}, measured and as printed."
        f" {latex(REMARK)}.",
        [[*map(latex, table.columns), "Paper"]],
        [
            *((latex(run["method"]), [*own.own, ""]) for run, own in shown),
            *(
                (latex(method_title(row["method"], paper=True)), [*cells, latex(row["paper"])])
                for row, cells in table.lines
            ),
        ],
    )


def _under(protocol: str) -> str:
    return "" if protocol == PAPER else f" of {latex(protocol)}"


def _own(label: str) -> str:
    return _threshold(split_label(label)[1])


def _overall(
    shown: Sequence[tuple[str, list[RunDocument], Paper]], protocol: str, thresholds: Sequence[str]
) -> Iterator[str]:
    """The table of some data sets beside each other; a method has one line."""
    tables = [precision_table(thresholds, runs, published) for _, runs, published in shown]
    known = [{(line.method, line.paper): line for line in table} for table in tables]
    names = dict.fromkeys(name for lines in known for name in lines)
    nothing: list[Cell | None] = [None] * len(thresholds)
    lines = []
    for name in sorted(names, key=lambda name: name[1]):  # what was measured first
        beside = [lines.get(name) for lines in known]
        cells = itertools.chain.from_iterable(line.cells if line else nothing for line in beside)
        lines.append((next(_method(line) for line in beside if line), _precision(list(cells))))
    yield from _table(
        f"Precision{_under(protocol)} on {' and '.join(latex(title) for title, *_ in shown)}.",
        [[_own(label) for label in thresholds] for _ in shown],
        lines,
        titles=[latex(title) for title, *_ in shown],
    )


def _table(
    caption: str,
    heads: Sequence[Sequence[str]],
    lines: Sequence[tuple[str, Sequence[str]]],
    titles: Sequence[str] = (),
) -> Iterator[str]:
    """A table whose columns stand in groups of ``heads``, each below its title if there are any."""
    columns = sum(map(len, heads))
    if not columns:
        return
    if any(cell.startswith(_BEST) for _, cells in lines for cell in cells):
        places = zip(_MARKS[1:], _PLACES, strict=True)
        caption += f" Best three: {'; '.join(mark.format(word) for mark, word in places)}."
    yield from ("", r"\begin{table*}", r"  \centering")
    yield rf"  \caption{{{caption}}}"
    yield rf"  \begin{{tabular}}{{l{'r' * columns}}}"
    yield r"    \toprule"
    if titles:
        spans = zip(titles, heads, strict=True)
        over = (rf"\multicolumn{{{len(head)}}}{{c}}{{{title}}}" for title, head in spans)
        yield rf"    & {' & '.join(over)} \\"
        last = 1
        for head in heads:
            yield rf"    \cmidrule(lr){{{last + 1}-{last + len(head)}}}"
            last += len(head)
    yield rf"    Method & {' & '.join(itertools.chain.from_iterable(heads))} \\"
    yield r"    \midrule"
    for method, cells in lines:
        yield rf"    {method} & {' & '.join(cells)} \\"
    yield from (r"    \bottomrule", r"  \end{tabular}", r"\end{table*}")


def _method(line: Line) -> str:
    return latex(method_title(line.method, line.paper))


def _precision(cells: Sequence[Cell | None]) -> list[str]:
    return [
        "n/a" if cell is None else _MARKS[cell.rank].format(f"{cell.share:.4f}") for cell in cells
    ]


def _threshold(label: str) -> str:
    """The label of a column, its limits in signs."""
    parts = []
    for part in label.split(", "):
        if score := re.fullmatch(r"F ([\d.]+)", part):
            parts.append(rf"$F \geq {score[1]}$")
        elif limit := re.fullmatch(r"([\d.]+) (deg|cm|mm)", part):
            value, unit = limit.groups()
            parts.append(rf"${value}^\circ$" if unit == "deg" else rf"{value}\,{unit}")
        else:
            parts.append(latex(part))
    return ", ".join(parts)
