"""A run with ``--cpas-metrics``: one item per implementation and property, then the matrix."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from typing import Any

import pytest

from pytest_cpas.checks.known import KnownFailure
from pytest_cpas.checks.metrics import PROPERTIES, Result, Subject, load_subject
from pytest_cpas.checks.metrics.recorded import known_of, record
from pytest_cpas.checks.metrics.running import DEFAULT_EXAMPLES, DEFAULT_TIME_LIMIT
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.evaluation import can_watch
from pytest_cpas.registry import RegistryError
from pytest_cpas.report.metrics_matrix import Cell, aligned, as_table, write_matrix
from pytest_cpas.report.terminal import Terminal
from pytest_cpas.session.options import MetricsOptions
from pytest_cpas.session.suite_session import SuiteSession, usage_errors
from pytest_cpas.session.time_limit import time_limit
from pytest_cpas.types import ContractError

__all__ = ["RESULT", "MetricsSession"]

#: Seconds after which a property ends the process: five times what it has until its calls end.
LONGEST = 5 * DEFAULT_TIME_LIMIT

#: Where an item keeps its result, and whether that is the one that was recorded.
RESULT = pytest.StashKey[tuple[Result, bool]]()


class MetricsSession(SuiteSession):
    """The hooks of a run, and its state."""

    def __init__(self, config: pytest.Config) -> None:
        """Load the implementations; :class:`pytest.UsageError` if that fails."""
        super().__init__(config, "test_metrics.py", "cpas-metrics")
        with usage_errors(ValueError):
            self.options = MetricsOptions.of(config.option, config.invocation_params.dir)
        with usage_errors(RegistryError, ContractError):
            self.subjects: list[Subject] = [load_subject(name) for name in self.options.metrics]
            self._known: dict[str, dict[str, KnownFailure]] = {
                subject.name: known_of(subject.name) for subject in self.subjects
            }
        self._watchdog = time_limit(config).watchdog if can_watch() else None
        self._matrix: dict[str, dict[str, Cell]] = {subject.name: {} for subject in self.subjects}

    @property
    def examples(self) -> int:
        """Examples per property."""
        return self.options.examples or DEFAULT_EXAMPLES

    def within_time(self, subject: Subject, name: str) -> AbstractContextManager[None]:
        """What a property is checked in: compiled code that does not even return when the time of
        the property is over ends the process."""
        if self._watchdog is None:
            return nullcontext()
        hint = "It was in compiled code, or waited there, which nothing else interrupts"
        return self._watchdog.watch(f"{subject.name}: {name}", LONGEST, hint=hint)

    def known_failure(self, subject: Subject, name: str) -> KnownFailure | None:
        """The recorded violation of a property, unless violations are recorded anew."""
        return None if self.options.update else self._known[subject.name].get(name)

    def item_content(self, item: pytest.Item) -> Any:
        """An item's result, and whether it is the recorded one."""
        if RESULT not in item.stash:
            return None
        result, expected = item.stash[RESULT]
        return {**asdict(result), "outcome": result.outcome.value}, expected

    def collect(self, content: Any) -> None:
        """Enter a result into the matrix."""
        values, expected = content
        result = Result(**{**values, "outcome": Outcome(values["outcome"])})
        self._matrix[result.subject][result.property] = Cell(result, expected)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """The matrix; reports and recorded violations are written."""
        if self.has_nothing_to_tell(terminalreporter):
            return
        matrix = {
            name: {prop: cells[prop] for prop in PROPERTIES if prop in cells}
            for name, cells in self._matrix.items()
        }
        terminal = Terminal(terminalreporter)
        terminal.section("conformance of metrics")
        for line in aligned(as_table(matrix)):
            terminal.write_line(line)
        for name, cells in matrix.items():
            outcomes = [cell.result.outcome for cell in cells.values()]
            judged = len(outcomes) - outcomes.count(Outcome.NOT_OFFERED)
            known = sum(cell.expected for cell in cells.values())
            terminal.write_line(
                f"{name}: {outcomes.count(Outcome.PASSED)} of {judged} properties hold,"
                f" {known} known violations, {len(outcomes) - judged} n/a"
            )
            if self.options.update:
                self._record(terminal, name, cells)
        for path in self.options.reports:
            write_matrix(path, matrix)

    def _record(self, terminal: Terminal, name: str, cells: dict[str, Cell]) -> None:
        if len(cells) < len(PROPERTIES):
            terminal.write_line(
                f"NOT RECORDED: {len(cells)} of {len(PROPERTIES)} properties of {name} were"
                " checked; record a complete run",
                red=True,
            )
            return
        try:
            count, path = record(name, (cell.result for cell in cells.values()))
        except (ContractError, OSError) as error:
            terminal.write_line(f"NOT RECORDED: {error}", red=True)
            return
        terminal.write_line(f"recorded {count} violations of {name} in {path}")
