"""Precision against the severity of perturbations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from pytest_cpas.datasets.perturbed import PERTURBATIONS, SEVERITIES, RobustnessPoint
from pytest_cpas.documents import RunDocument
from pytest_cpas.report.terminal._table import Terminal
from pytest_cpas.types.samples import ALL


def print_robustness(
    terminal: Terminal, runs: Iterable[tuple[RobustnessPoint | None, RunDocument]]
) -> None:
    """One table per method and data set, of those runs that are points of curves."""
    curves: dict[tuple[str, str], dict[RobustnessPoint, RunDocument]] = {}
    for point, run in runs:
        if point:
            curves.setdefault((run["method"], point.base), {})[point] = run
    for (method, base), points in curves.items():
        terminal.section(f"robustness of {method} on {base}")
        cells = {point: _cell(run) for point, run in points.items()}
        severities = [f"severity {severity}" for severity in range(SEVERITIES + 1)]
        first = next((e["threshold"] for run in points.values() for e in run["precision"]), "")
        lines = [[f"correct at {first}", *severities, "1, 2, 3 is"]]
        for name, perturbation in PERTURBATIONS.items():
            if any(point.perturbation == name for point in cells):
                shown = [RobustnessPoint(base)]
                shown += [RobustnessPoint(base, name, 1 + i) for i in range(SEVERITIES)]
                at = [cells.get(point, "-") for point in shown]
                levels = ", ".join(f"{level:g}" for level in perturbation.levels)
                lines.append([name, *at, f"{levels}: {perturbation.words}"])
        terminal.write_table(lines)
        words = Counter(verdict["word"] for run in points.values() for verdict in run["verdicts"])
        counts = ", ".join(f"{word} {count}" for word, count in words.items())
        terminal.write_line(f"golden, categories of all {len(points)} curve points: {counts}")


def _cell(run: RunDocument) -> str:
    for cell in run["precision"]:
        if cell["category"] == ALL:  # in the first column
            count = cell["measured"]
            return f"{count['correct']}/{count['total']}" if count else "-"
    return "-"
