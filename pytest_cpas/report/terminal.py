"""The tables and verdicts at the end of a run, in the terminal."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import pytest

from pytest_cpas.checks import ContractResult, Outcome
from pytest_cpas.comparison import GOOD, Verdict, Word
from pytest_cpas.evaluation import THRESHOLDS, Row, Run, tabulate
from pytest_cpas.metrics.precision import Count

#: A run of at most this many samples shows each of them.
_FEW = 20


def print_run(
    terminal: pytest.TerminalReporter,
    run: Run,
    rows: Sequence[Row],
    verdicts: Sequence[Verdict],
    contract: Collection[ContractResult] = (),
) -> None:
    """Print what was missing, the contract, the samples of a small run, the precision table, the
    verdict."""
    terminal.section(f"{run.method} on {run.dataset}", bold=True)
    for line in run.missing:
        terminal.write_line(f"missing: {line}")
    _print_contract(terminal, contract)
    if rows and (len(rows) <= _FEW or terminal.config.get_verbosity() > 0):
        print_table(terminal, _sample_lines(rows))
    if rows:
        print_table(terminal, _precision_lines(rows))
    failed = sum(row.failure is not None for row in rows)
    answers = f", {failed} without an answer" if failed else ""
    total = sum(run.listed.values())
    terminal.write_line(f"{len(rows)} of {total} samples judged{answers}")
    by_word: dict[Word, list[Verdict]] = {}
    for verdict in verdicts:
        by_word.setdefault(verdict.word, []).append(verdict)
    for word, group in by_word.items():
        colour = {"red": group[0].failed, "green": word in GOOD}
        if len(group) == 1 or group[0].failed:
            for verdict in group:
                # the rest of it stands among the failures
                terminal.write_line(f"golden: {verdict}".splitlines()[0], **colour)
        else:
            names = ", ".join(verdict.category for verdict in group)
            terminal.write_line(f"golden: {word.value} ({names})", **colour)


def _print_contract(terminal: pytest.TerminalReporter, results: Collection[ContractResult]) -> None:
    judged = [result for result in results if result.outcome is not Outcome.NOT_OFFERED]
    if not judged:
        return
    violated = [result for result in judged if result.violated]
    parts = [f"contract: {len(judged) - len(violated)} of {len(judged)} checks passed"]
    wrong = [result.check for result in violated if result.wrong and not result.known]
    for names, words in (
        (wrong, "violated"),
        ([result.check for result in violated if result.known], "known"),
        (
            [result.check for result in violated if not result.wrong and not result.known],
            "not demanded (information)",
        ),
    ):
        if names:
            parts.append(f"{len(names)} {words}: {', '.join(names)}")
    terminal.write_line("; ".join(parts), red=bool(wrong))


def _precision_lines(rows: Sequence[Row]) -> list[list[str]]:
    table = tabulate(rows)
    categories = [name for name in table if name != "all"]
    lines = [["correct", *(threshold.label for threshold in THRESHOLDS)]]
    lines += [[name, *map(_cell, table[name].values())] for name in (*categories, "all")]
    return lines


def _cell(cell: Count | None) -> str:
    if cell is None:
        return "n/a"
    return f"{cell.correct}/{cell.total} {100 * cell.precision:5.1f} %"


def _sample_lines(rows: Sequence[Row]) -> list[list[str]]:
    lines = [["sample", "category", "position", "rotation", "IoU", "F 1 cm", ""]]
    for row in rows:
        if row.failure is not None:
            lines.append([row.sample, row.category, "-", "-", "-", "-", f"failed: {row.failure}"])
            continue
        lines.append(
            [
                row.sample,
                row.category,
                f"{100 * row.translation_error:.2f} cm",
                f"{row.rotation_error:.2f} deg",
                _number(row.iou),
                _number(row.fscore_1cm),
                "",
            ]
        )
    return lines


def _number(value: float | None) -> str:
    return "n/a" if value is None or not math.isfinite(value) else f"{value:.3f}"


def print_table(terminal: pytest.TerminalReporter, lines: Sequence[Sequence[str]]) -> None:
    """Print rows of cells, the first column to the left, the others to the right."""
    widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]
    for line in lines:
        first = line[0].ljust(widths[0])
        rest = [cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)]
        terminal.write_line("  ".join([first, *rest]).rstrip())
    terminal.write_line("")
