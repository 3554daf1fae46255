"""A run with ``--cpas-check-dataset``: one item per sample, then a verdict per check."""

from __future__ import annotations

import sys
from collections.abc import Generator
from typing import Any

import pytest

from pytest_cpas import registry
from pytest_cpas._open3d import import_open3d
from pytest_cpas.checks.dataset.facts import Survey
from pytest_cpas.checks.dataset.verdicts import DatasetWord
from pytest_cpas.report.sphere_picture import draw_up_axes
from pytest_cpas.report.terminal import Terminal, print_survey
from pytest_cpas.session.checked_dataset import CheckedDataset, plain_survey
from pytest_cpas.session.options import DatasetOptions
from pytest_cpas.session.resolution import categorised
from pytest_cpas.session.suite_session import SuiteSession, report_outcome, usage_errors
from pytest_cpas.types import ContractError, Verdict

__all__ = ["SURVEY", "DatasetSession"]

#: Where an item keeps the survey of its own samples.
SURVEY = pytest.StashKey[Survey]()


class DatasetSession(SuiteSession):
    """The hooks of a run; ``checked``: its data sets, in the order of the reports."""

    verdicts_told = False

    def __init__(self, config: pytest.Config) -> None:
        """Find the data sets; :class:`pytest.UsageError` if that fails."""
        super().__init__(config, "test_dataset.py", "cpas-dataset")
        with usage_errors(registry.RegistryError, ContractError, ValueError, ImportError, OSError):
            self.options = options = DatasetOptions.of(config.option, config.invocation_params.dir)
            if self.is_controller:
                options.check_written()
            import_open3d()
            self.checked = [
                CheckedDataset.of(
                    categorised(dataset, options.categories),
                    options.selection,
                    options.known_faults,
                )
                for dataset in registry.open_datasets(options.datasets, options.data)
            ]
            for checked in self.checked:
                if not checked.refs and not checked.survey.damaged:
                    lines = [f"{checked.name}: no samples to check", *checked.survey.missing]
                    raise ValueError("\n".join(lines))
            options.selection.check({c for checked in self.checked for c in checked.categories})
        self._verdicts: dict[CheckedDataset, list[Verdict]] = {
            checked: [] for checked in self.checked
        }

    def item_content(self, item: pytest.Item) -> Any:
        """The data set's index and what an item measured."""
        if SURVEY not in item.stash:
            return None
        index = self.checked.index(item.callspec.params["checked"])  # type: ignore[attr-defined]
        return index, plain_survey(item.stash[SURVEY])

    def collect(self, content: Any) -> None:
        """Put together what the items measured."""
        index, survey = content
        self.checked[index].add(survey)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtestloop(self, session: pytest.Session) -> Generator[None, object, object]:
        """After the last item, on the controller: one report per check."""
        if not self.is_controller or self.only_shows:
            return (yield)
        try:
            return (yield)
        finally:
            if not isinstance(sys.exception(), KeyboardInterrupt):
                self._judge(session)

    def _judge(self, session: pytest.Session) -> None:
        for checked in self.checked:
            for verdict in checked.verdicts():
                self._verdicts[checked].append(verdict)
                report_outcome(
                    session,
                    f"cpas-dataset::{verdict.subject}[{checked.name}]",
                    verdict.outcome(require_golden=False),
                    verdict.details or "there is nothing that it could judge",
                    known=verdict.word is DatasetWord.KNOWN,
                )
        self.verdicts_told = True

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Verdicts and residuals; pictures are drawn."""
        if self.has_nothing_to_tell(terminalreporter):
            return
        terminal = Terminal(terminalreporter)
        for checked, verdicts in self._verdicts.items():
            print_survey(terminal, checked.survey, len(checked.refs), verdicts)
        if self.options.pictures is not None:
            path = draw_up_axes(
                {checked.name: checked.survey.up_axes for checked in self.checked},
                self.options.pictures / "up_axes.png",
            )
            terminal.write_line(f"up axes drawn in {path}")
