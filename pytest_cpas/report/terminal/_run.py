"""The tables and verdicts of a run."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import pytest

from pytest_cpas.documents import (
    ContractDocument,
    RunDocument,
    SampleDocument,
    SpeedDocument,
    VerdictDocument,
)
from pytest_cpas.golden import ELSEWHERE, Word
from pytest_cpas.golden.literature import LEGACY
from pytest_cpas.reading.text import WIDTH, folded
from pytest_cpas.report.intervals import interval_note
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
from pytest_cpas.report.terminal._cells import guard_tables, main_tables
from pytest_cpas.report.terminal._table import FEW, Terminal
from pytest_cpas.types.samples import COMPLETENESS

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
    for line in run.get("notes", []):
        _wrapped(terminal, f"note: {line}")
    _print_contract(terminal, run["contract"])
    if run["judged"] and shows_samples(terminal.config, run["judged"]):
        terminal.write_table(_sample_lines(run["samples"]))
    if run["judged"]:
        _print_tables(terminal, run)
    _wrapped(terminal, judged_message(run))
    terminal.write_line(f"rows: {origin}")
    by_word: dict[str, list[VerdictDocument]] = {}
    for verdict in run["verdicts"]:
        by_word.setdefault(verdict["word"], []).append(verdict)
    for word, group in by_word.items():
        outcome = group[0]["outcome"]
        colour = {"red": outcome == "failed", "green": outcome == "passed"}
        alone = len(group) == 1 or any(verdict["category"] == COMPLETENESS for verdict in group)
        if alone or outcome == "failed" or word in _TOLD:
            for verdict in group:
                # the rest of what failed stands among the failures
                first, *rest = verdict_message(verdict).splitlines()
                told = f"golden: {first}"
                if word != Word.RECORDED:  # a path stands where one looks for it
                    told = folded(told)
                for line in told.split("\n"):
                    terminal.write_line(line, **colour)
                if word in _TOLD and outcome != "failed":
                    for line in folded("\n".join(rest)).split("\n") if rest else ():
                        terminal.write_line(line)
        else:
            names = ", ".join(verdict["category"] for verdict in group)
            terminal.write_line(f"golden: {word} ({names})", **colour)
        if word == Word.MATCHES:
            details = [line.strip() for each in group for line in each["details"].splitlines()]
            for line in dict.fromkeys(line for line in details if line.startswith(ELSEWHERE)):
                _wrapped(terminal, f"  {line}")
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
    """Counts as they are read, what is guarded, scores, and what is to be known of them."""
    for lines in (*main_tables(run), *guard_tables(run)):
        terminal.write_table(lines)
    _print_literature(terminal, run)
    _wrapped(terminal, interval_note(run))
    for line in run["lacking"]:
        _wrapped(terminal, f"n/a: {line}")


def _wrapped(terminal: Terminal, text: str) -> None:
    for part in textwrap.wrap(text, WIDTH, subsequent_indent="  "):
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
    _wrapped(terminal, told)


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
