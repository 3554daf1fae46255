"""The tables and verdicts of a run."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence

import pytest

from pytest_cpas.documents import (
    ContractDocument,
    CountDocument,
    RunDocument,
    SampleDocument,
    ScoreDocument,
    SpeedDocument,
    VerdictDocument,
)
from pytest_cpas.golden import Word
from pytest_cpas.golden.literature import LEGACY
from pytest_cpas.report.literature import (
    REMARK,
    literature_table,
    nearest,
    printed_beside,
)
from pytest_cpas.report.messages import (
    contract_message,
    judged_message,
    speed_lines,
    verdict_message,
)
from pytest_cpas.report.tables import protocol_title, split_label
from pytest_cpas.report.terminal._table import FEW, Terminal

#: Characters of a line that is read at a glance.
_WIDTH = 100

#: Lines of the literature that stand beside a run, those nearest to it.
_NEAREST = 5

#: Verdicts that are told in full, although they need not fail.
_TOLD = (Word.RECORDED, Word.PROBABLY_WORSE)


def shows_samples(config: pytest.Config, judged: int) -> bool:
    """Whether each sample of a run is printed."""
    return judged <= FEW or config.get_verbosity() > 0


def print_run(terminal: Terminal, run: RunDocument, origin: str) -> None:
    """Print what was missing, the contract, the samples of a small run, the precision table, the
    ``origin`` of the rows in words, the verdict, and what explains it."""
    terminal.section(f"{run['method']} on {run['dataset']}")
    for line in run["missing"]:
        terminal.write_line(f"missing: {line}")
    _print_contract(terminal, run["contract"])
    if run["judged"] and shows_samples(terminal.config, run["judged"]):
        terminal.write_table(_sample_lines(run["samples"]))
    if run["judged"]:
        _print_tables(terminal, run)
    terminal.write_line(judged_message(run))
    terminal.write_line(f"rows: {origin}")
    by_word: dict[str, list[VerdictDocument]] = {}
    for verdict in run["verdicts"]:
        by_word.setdefault(verdict["word"], []).append(verdict)
    for word, group in by_word.items():
        outcome = group[0]["outcome"]
        colour = {"red": outcome == "failed", "green": outcome == "passed"}
        if len(group) == 1 or outcome == "failed" or word in _TOLD:
            for verdict in group:
                # the rest of what failed stands among the failures
                first, *rest = verdict_message(verdict).splitlines()
                terminal.write_line(f"golden: {first}", **colour)
                if word in _TOLD and outcome != "failed":
                    for line in rest:
                        terminal.write_line(line)
        else:
            names = ", ".join(verdict["category"] for verdict in group)
            terminal.write_line(f"golden: {word} ({names})", **colour)
    for finding in run["findings"]:
        for line in finding["lines"]:
            terminal.write_line(line, yellow=True)
    if run["speed"]:
        _print_speed(terminal, run["speed"])


def _print_speed(terminal: Terminal, speed: SpeedDocument) -> None:
    verdict, *facts = speed_lines(speed)
    outcome = speed["verdict"]["outcome"]
    terminal.write_line(f"speed: {verdict}", red=outcome == "failed", green=outcome == "passed")
    for line in facts:
        terminal.write_line(f"  {line}")


def _print_contract(terminal: Terminal, results: Sequence[ContractDocument]) -> None:
    if message := contract_message(results):
        wrong = any(result["status"] in ("violated", "gone") for result in results)
        terminal.write_line(message, red=wrong)


def _print_tables(terminal: Terminal, run: RunDocument) -> None:
    """Counts as they are read, what is guarded in one line a category, and scores."""
    counts = [(e["threshold"], e["category"], _cell(e["measured"])) for e in run["precision"]]
    guards = [(e["threshold"], e["category"], _share(e["measured"])) for e in run["guards"]]
    scores = [(e["score"], e["category"], _score(e)) for e in run["scores"]]
    for first, cells in (("correct", counts), ("guards", guards), ("scores", scores)):
        known = {label for label, _, cell in cells if cell != "n/a"}
        # of the columns that are read, what is n/a is told; of the others, only what there is
        shown = [cell for cell in cells if first == "correct" or cell[0] in known]
        for protocol, own in _by_protocol(shown).items():
            for lines in _tables(protocol_title(first, protocol), own):
                terminal.write_table(lines)
    _print_literature(terminal, run)
    for line in run["lacking"]:
        for part in textwrap.wrap(f"n/a: {line}", _WIDTH, subsequent_indent="  "):
            terminal.write_line(part)


def _print_literature(terminal: Terminal, run: RunDocument) -> None:
    """What the literature prints nearest to the run."""
    rows = printed_beside(run)
    table = literature_table(run, nearest(run, rows, _NEAREST))
    if table is None:
        return
    lines = [[f"{LEGACY}: AP in %", *table.columns], ["this run", *table.own]]
    lines += [[row["method"], *cells] for row, cells in table.lines]
    terminal.write_table(lines)
    told = f"literature: the nearest {len(table.lines)} of {len(rows)} printed lines. {REMARK}"
    for part in textwrap.wrap(told, _WIDTH, subsequent_indent="  "):
        terminal.write_line(part)


#: A column's label, a category and what stands there.
_TableCell = tuple[str, str, str]


def _by_protocol(cells: Sequence[_TableCell]) -> dict[str, list[_TableCell]]:
    """The cells of each protocol, whose name is taken off the labels."""
    groups: dict[str, list[_TableCell]] = {}
    for label, category, cell in cells:
        protocol, own = split_label(label)
        groups.setdefault(protocol, []).append((own, category, cell))
    return groups


def _tables(first: str, cells: Sequence[_TableCell]) -> Iterator[list[list[str]]]:
    """Tables of (column, category, cell) with as many columns as are readable side by side."""
    categories = list(dict.fromkeys(category for _, category, _ in cells))
    names = max(map(len, [first, *categories]))
    columns: dict[str, list[str]] = {}
    for label, _, cell in cells:
        columns.setdefault(label, [label]).append(cell)
    table, width = [[first, *categories]], names
    for column in columns.values():
        widest = 2 + max(map(len, column))
        if width + widest > _WIDTH and len(table) > 1:
            yield [list(line) for line in zip(*table, strict=True)]
            table, width = [[first, *categories]], names
        table.append(column)
        width += widest
    if len(table) > 1:
        yield [list(line) for line in zip(*table, strict=True)]


def _cell(count: CountDocument | None) -> str:
    if count is None:
        return "n/a"
    return f"{count['correct']}/{count['total']} {100 * count['correct'] / count['total']:5.1f} %"


def _share(count: CountDocument | None) -> str:
    return "n/a" if count is None else f"{100 * count['correct'] / count['total']:.1f} %"


def _score(entry: ScoreDocument) -> str:
    value = entry["measured"]
    if value is None:
        return "n/a"
    return f"{100 * value:.1f} %" if entry["share"] else f"{value:.4g}"


def _sample_lines(samples: Sequence[SampleDocument]) -> list[list[str]]:
    lines = [["sample", "category", "position", "rotation", "IoU", "F 1 cm", ""]]
    for sample in samples:
        if sample["outcome"] is None:  # it stands among the failures
            continue
        if sample["failure"] is None:
            errors = [
                _number(sample["position_m"], 100, 2, " cm"),
                _number(sample["rotation_deg"], 1, 2, " deg"),
                _number(sample["iou"], 1, 3),
                _number(sample["fscore_1cm"], 1, 3),
                "",
            ]
        else:
            errors = ["-"] * 4 + [f"failed: {sample['failure']}"]
        lines.append([sample["sample"], sample["category"], *errors])
    return lines


def _number(value: float | None, factor: float, decimals: int, unit: str = "") -> str:
    return "n/a" if value is None else f"{factor * value:.{decimals}f}{unit}"
