"""Precision against the severity of perturbations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import pytest

from pytest_cpas.datasets.perturbed import PERTURBATIONS, SEVERITIES, UNPERTURBED, perturbation_of
from pytest_cpas.documents import RunDocument
from pytest_cpas.evaluation import THRESHOLDS
from pytest_cpas.report.terminal._table import print_table


def print_robustness(terminal: pytest.TerminalReporter, runs: Sequence[RunDocument]) -> None:
    """One table per method and data set whose perturbations are among the runs."""
    curves: dict[tuple[str, str], dict[tuple[str, int], RunDocument]] = {}
    for run in runs:
        parts = perturbation_of(run["dataset"])
        if parts is not None:
            base, name, severity = parts
            curves.setdefault((run["method"], base), {})[name, severity] = run
    for (method, base), points in curves.items():
        terminal.section(f"robustness of {method} on {base}", bold=True)
        cells = {point: _cell(run) for point, run in points.items()}
        severities = [f"severity {severity}" for severity in range(SEVERITIES + 1)]
        lines = [[f"correct at {THRESHOLDS[0].label}", *severities, "1, 2, 3 is"]]
        for name, perturbation in PERTURBATIONS.items():
            if any(point[0] == name for point in cells):
                at = [cells.get((UNPERTURBED, 0), "-")]
                at += [cells.get((name, severity), "-") for severity in range(1, SEVERITIES + 1)]
                levels = ", ".join(f"{level:g}" for level in perturbation.levels)
                lines.append([name, *at, f"{levels}: {perturbation.words}"])
        print_table(terminal, lines)
        words = Counter(verdict["word"] for run in points.values() for verdict in run["verdicts"])
        counts = ", ".join(f"{word} {count}" for word, count in words.items())
        terminal.write_line(f"golden, categories of all {len(points)} curve points: {counts}")


def _cell(run: RunDocument) -> str:
    for cell in run["precision"]:
        if (cell["category"], cell["threshold"]) == ("all", THRESHOLDS[0].label):
            count = cell["measured"]
            return f"{count['correct']}/{count['total']}" if count else "-"
    return "-"
