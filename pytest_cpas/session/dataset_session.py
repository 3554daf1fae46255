"""A run with ``--cpas-check-dataset``: one item per sample, then a verdict per check."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Generator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pytest

from pytest_cpas import registry
from pytest_cpas._open3d import import_open3d
from pytest_cpas.checks.dataset import CHECKS
from pytest_cpas.checks.dataset.facts import ImageFacts, MeshFacts, SampleFacts, Survey
from pytest_cpas.checks.dataset.verdicts import DatasetWord, judge
from pytest_cpas.checks.known import KnownFailure, known_failures, read_known
from pytest_cpas.evaluation import Selection
from pytest_cpas.evaluation.results import ResultsError, Shard
from pytest_cpas.report.sphere_picture import draw_up_axes
from pytest_cpas.report.terminal import print_survey
from pytest_cpas.session.suite_session import SuiteSession, report_outcome
from pytest_cpas.types import ContractError, Dataset, SampleRef, Verdict

__all__ = ["FOUND", "Checked", "DatasetSession"]

#: Where an item keeps the survey of its own samples.
FOUND = pytest.StashKey[Survey]()


@dataclass(eq=False)
class Checked:
    """A data set that is checked: the samples to look at, and what was measured of them.

    ``meshes``: keys of those that this process has measured.
    """

    dataset: Dataset
    refs: list[SampleRef]
    survey: Survey
    known: list[KnownFailure]
    verdicts: list[Verdict] = field(default_factory=list)
    meshes: set[str] = field(default_factory=set)


class DatasetSession(SuiteSession):
    """The hooks of a run, and its state."""

    def __init__(self, config: pytest.Config) -> None:
        """Find the data sets; :class:`pytest.UsageError` if that fails."""
        super().__init__(config, "test_dataset.py", "cpas-dataset")
        options = config.option
        here = config.invocation_params.dir
        self.pictures = here / options.cpas_pictures if options.cpas_pictures else None
        data = here / options.cpas_data if options.cpas_data else None
        files = [here / name for name in options.cpas_known_faults]
        try:
            import_open3d()
            shard = Shard.parse(options.cpas_shard)
            selection = Selection(
                categories=options.cpas_category,
                limit=options.cpas_limit,
                shard=shard.index,
                shards=shard.count,
            )
            self.checked = [
                _checked(registry.resolve("dataset", name)(data), selection, files)
                for name in dict.fromkeys(options.cpas_check_dataset)
            ]
        except (registry.RegistryError, ContractError, ResultsError, ImportError, OSError) as error:
            raise pytest.UsageError(str(error)) from error
        for checked in self.checked:
            if not checked.refs and not checked.survey.damaged:
                lines = [f"{checked.survey.name}: no samples to check", *checked.survey.missing]
                raise pytest.UsageError("\n".join(lines))

    def found(self, item: pytest.Item) -> Any:
        """What an item measured."""
        if FOUND not in item.stash:
            return None
        survey = item.stash[FOUND]
        index = self.checked.index(item.callspec.params["checked"])  # type: ignore[attr-defined]
        samples = [asdict(facts) for facts in survey.samples.values()]
        meshes = [asdict(facts) for facts in survey.meshes.values()]
        return index, samples, meshes, survey.unreadable

    def collect(self, found: Any) -> None:
        """Put together what the items measured."""
        index, samples, meshes, unreadable = found
        survey = self.checked[index].survey
        for values in samples:
            image = values["image"] and ImageFacts(**_tuples(values["image"]))
            facts = SampleFacts(**_tuples(values) | {"image": image})
            survey.samples[facts.sample] = facts
        for values in meshes:
            mesh = MeshFacts(**_tuples(values))
            survey.meshes.setdefault(mesh.key, mesh)
        survey.unreadable.update(unreadable)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtestloop(self, session: pytest.Session) -> Generator[None, object, object]:
        """After the last item, on the controller: one report per check."""
        if not self.is_controller or self.config.option.collectonly:
            return (yield)
        try:
            return (yield)
        finally:
            if not isinstance(sys.exception(), KeyboardInterrupt):
                self._judge(session)

    def _judge(self, session: pytest.Session) -> None:
        for checked in self.checked:
            checked.survey.sort()
            for name in CHECKS:
                verdict = judge(checked.survey, name, checked.known)
                checked.verdicts.append(verdict)
                report_outcome(
                    session,
                    f"cpas-dataset::{name}[{checked.survey.name}]",
                    verdict.outcome(require_golden=False),
                    verdict.details or "there is nothing that it could judge",
                    known=verdict.word is DatasetWord.KNOWN,
                )

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Verdicts and residuals; pictures are drawn."""
        if not self.is_controller or self.config.option.collectonly:
            return
        for checked in self.checked:
            print_survey(terminalreporter, checked.survey, len(checked.refs), checked.verdicts)
        if self.pictures is not None:
            path = draw_up_axes(
                {checked.survey.name: checked.survey.up_axes for checked in self.checked},
                self.pictures / "up_axes.png",
            )
            terminalreporter.write_line(f"up axes drawn in {path}")


def _checked(dataset: Dataset, selection: Selection, files: list[Path]) -> Checked:
    folder = Path(inspect.getfile(type(dataset))).parent
    known = known_failures(folder, dataset.name, "dataset", CHECKS)
    for path in files:
        known += read_known(path, "dataset", CHECKS)
    return Checked(dataset, selection.of(dataset.samples), Survey.of(dataset), known)


def _tuples(values: dict[str, Any]) -> dict[str, Any]:
    """The values as they were: what travels between processes has lists for tuples."""
    return {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
