"""A pytest run with ``--cpas-metrics``: one item per implementation and property, then the matrix.

Results ride on the test reports, so that the controller of an xdist run has them all.
"""

from __future__ import annotations

import sys
from collections.abc import Generator
from dataclasses import asdict
from pathlib import Path

import pytest

from pytest_cpas.checks import PROPERTIES, Result, Subject, load_subject
from pytest_cpas.checks.expectations import (
    Expectation,
    expectations_file,
    read_expectations,
    write_expectations,
)
from pytest_cpas.checks.matrix import Cell, aligned, as_table, write_matrix
from pytest_cpas.checks.running import DEFAULT_EXAMPLES
from pytest_cpas.checks.subject import Outcome
from pytest_cpas.registry import RegistryError
from pytest_cpas.types import ContractError

__all__ = ["RESULT", "MetricsSession"]

#: Where an item keeps its result, and whether that is the one that was recorded.
RESULT = pytest.StashKey[tuple[Result, bool]]()

SUITE = Path(__file__).parents[1] / "suite" / "test_metrics.py"


class MetricsSession:
    """The hooks of a run, and its state."""

    def __init__(self, config: pytest.Config) -> None:
        """Load the implementations; :class:`pytest.UsageError` if that fails."""
        self.config = config
        options = config.option
        self.is_controller = not hasattr(config, "workerinput")
        self.update = bool(config.getoption("update_snapshots", False))
        self.examples: int = options.cpas_examples or DEFAULT_EXAMPLES
        self.seed: int = options.cpas_seed
        if self.examples < 1:
            raise pytest.UsageError(f"--cpas-examples is {self.examples}, expected at least 1")
        here = config.invocation_params.dir
        self.reports = [here / path for path in options.cpas_metrics_report]
        for path in self.reports:
            if path.suffix not in (".json", ".md"):
                raise pytest.UsageError(f"--cpas-metrics-report {path}: expected .json or .md")
        if str(here) not in sys.path:  # package.module is looked for where pytest was started
            sys.path.insert(0, str(here))
        try:
            self.subjects: list[Subject] = [
                load_subject(name) for name in dict.fromkeys(options.cpas_metrics)
            ]
            self.expected: dict[str, dict[str, Expectation]] = {
                subject.name: read_expectations(expectations_file(subject.name))
                for subject in self.subjects
            }
        except (RegistryError, ContractError) as error:
            raise pytest.UsageError(str(error)) from error
        self.matrix: dict[str, dict[str, Cell]] = {subject.name: {} for subject in self.subjects}
        named = config.args_source is pytest.Config.ArgsSource.ARGS
        beside = named or config.pluginmanager.has_plugin("cpas-session")
        config.args = [*config.args, str(SUITE)] if beside else [str(SUITE)]

    def expectation(self, subject: Subject, name: str) -> Expectation | None:
        """The recorded violation of a property, unless violations are recorded anew."""
        return None if self.update else self.expected[subject.name].get(name)

    @pytest.hookimpl(tryfirst=True)
    def pytest_pycollect_makemodule(
        self, module_path: Path, parent: pytest.Collector
    ) -> pytest.Module | None:
        """Give the shipped suite short node ids that are the same wherever it is installed."""
        if module_path != SUITE:
            return None
        module: pytest.Module = pytest.Module.from_parent(
            parent, path=module_path, name="cpas-metrics", nodeid="cpas-metrics"
        )
        return module

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Put an item's result on its report, as plain values that xdist can send."""
        report = yield
        if report.when == "call" and RESULT in item.stash:
            result, expected = item.stash[RESULT]
            values = {**asdict(result), "outcome": result.outcome.value}
            report.cpas_result = (values, expected)  # type: ignore[attr-defined]
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """On the controller: collect results."""
        if self.is_controller and hasattr(report, "cpas_result"):
            values, expected = report.cpas_result
            result = Result(**{**values, "outcome": Outcome(values["outcome"])})
            self.matrix[result.subject][result.property] = Cell(result, expected)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """The matrix; reports and recorded violations are written."""
        if not self.is_controller or self.config.option.collectonly:
            return
        matrix = {
            name: {prop: cells[prop] for prop in PROPERTIES if prop in cells}
            for name, cells in self.matrix.items()
        }
        terminalreporter.section("conformance of metrics", bold=True)
        for line in aligned(as_table(matrix)):
            terminalreporter.write_line(line)
        for name, cells in matrix.items():
            outcomes = [cell.result.outcome for cell in cells.values()]
            judged = len(outcomes) - outcomes.count(Outcome.NOT_OFFERED)
            known = sum(cell.expected for cell in cells.values())
            terminalreporter.write_line(
                f"{name}: {outcomes.count(Outcome.PASSED)} of {judged} properties hold,"
                f" {known} known violations, {len(outcomes) - judged} n/a"
            )
            if self.update:
                self._record(terminalreporter, name, cells)
        for path in self.reports:
            write_matrix(path, matrix)

    def _record(
        self, terminalreporter: pytest.TerminalReporter, name: str, cells: dict[str, Cell]
    ) -> None:
        path = expectations_file(name)
        if len(cells) < len(PROPERTIES):
            terminalreporter.write_line(
                f"NOT RECORDED: {len(cells)} of {len(PROPERTIES)} properties of {name} were"
                " checked; record a complete run",
                red=True,
            )
            return
        count = write_expectations(path, (cell.result for cell in cells.values()))
        terminalreporter.write_line(f"recorded {count} violations of {name} in {path}")
