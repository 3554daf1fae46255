"""A pytest run with ``--cpas-trace`` or ``--cpas-parity``: what is asked for, and the verdicts."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from pytest_cpas import registry
from pytest_cpas._files import write_file
from pytest_cpas.documents import ParityDocument
from pytest_cpas.evaluation import MethodRun, Revision, RevisionError
from pytest_cpas.reading.text import folded, terminal_lines
from pytest_cpas.report.panels import ValuePictures
from pytest_cpas.report.terminal import Terminal
from pytest_cpas.session.method_session import CpasSession, cpas_session
from pytest_cpas.session.options import RunOptions
from pytest_cpas.session.resolution import make_method
from pytest_cpas.session.seen_items import seen_items
from pytest_cpas.session.suite_session import SuiteSession, report_outcome, usage_errors
from pytest_cpas.traces.files import DEFAULT_MOST, LARGEST_MOST
from pytest_cpas.traces.maps import NameMap, read_map
from pytest_cpas.traces.parity import SampleParity, judge_parity
from pytest_cpas.traces.proposing import map_text
from pytest_cpas.traces.references import MethodReference, RecordedReference, Reference
from pytest_cpas.traces.revisions import RevisionReference
from pytest_cpas.traces.running import Plan, Traced, TracedRun
from pytest_cpas.traces.told import parity_document
from pytest_cpas.traces.values import Array
from pytest_cpas.types import ContractError, Verdict

__all__ = ["TRACED", "ParitySession", "parity_session"]

#: Where an item keeps what became of its samples.
TRACED = pytest.StashKey[list[Traced]]()

#: How a revision is told from a method's name.
_REVISION = "git:"


@dataclass
class _Collected:
    """What has come back of a run."""

    traced: list[Traced] = field(default_factory=list)
    verdict: Verdict | None = None

    def pictures_of(self, told: ParityDocument) -> ValuePictures | None:
        """Those of the sample that is furthest off where the two part."""
        worst = told["parting"] and told["parting"]["sample"]
        for each in self.traced:
            if each.sample == worst and each.pictures is not None:
                return ValuePictures.of_plain(each.pictures)
        return None


class ParitySession(SuiteSession):
    """Traces every method on every data set of the run, after its samples have been judged."""

    verdicts_told = False

    def __init__(self, config: pytest.Config) -> None:
        """Resolve the reference; :class:`pytest.UsageError` for what cannot be meant."""
        super().__init__(config, "test_parity.py", "cpas-parity")
        self.cpas: CpasSession = cpas_session(config)
        options = self.cpas.options
        with usage_errors(
            registry.RegistryError, ContractError, RevisionError, ValueError, OSError
        ):
            plan = _plan(config.option, options, config.invocation_params.dir)
            # the parts of a profile are of the same method, and of changed data
            runs = [r for r in self.cpas.runs if isinstance(r, MethodRun) and r.shared is None]
            self.traced_runs = [
                TracedRun(run, plan, _reference(config.option.cpas_parity, run, options))
                for run in runs
            ]
        self.collected = {traced: _Collected() for traced in self.traced_runs}

    def item_content(self, item: pytest.Item) -> Any:
        """The run's index and what became of its samples."""
        if TRACED not in item.stash:
            return None
        traced: TracedRun = item.callspec.params["traced"]  # type: ignore[attr-defined]
        return self.traced_runs.index(traced), [each.plain() for each in item.stash[TRACED]]

    def collect(self, content: Any) -> None:
        """Put what an item found beside what has come back of the run."""
        index, found = content
        collected = self.collected[self.traced_runs[index]]
        collected.traced += [Traced.of_plain(each) for each in found]

    @pytest.hookimpl(wrapper=True, trylast=True)  # the report that is written next has them
    def pytest_runtestloop(self, session: pytest.Session) -> Generator[None, object, object]:
        """After the last item, on the controller: one report per run that is compared."""
        try:
            return (yield)
        finally:
            for traced in self.traced_runs:
                if traced.reference is not None:
                    traced.reference.close()
            if self.is_controller and not self.only_shows:
                if not isinstance(sys.exception(), KeyboardInterrupt):
                    self._judge(session)
                    self._write_map(session)
                self.verdicts_told = True

    def _judge(self, session: pytest.Session) -> None:
        for traced, collected in self.collected.items():
            if traced.reference is None:
                continue
            found: list[SampleParity] = [e.parity for e in collected.traced if e.parity]
            lacking = sum(each.lacking for each in collected.traced)
            run, reference = traced.run, traced.reference
            notes = reference.notes(run.identity)
            item = f"{self.node}::test_parity[{run.method}-{run.dataset}"
            failed = seen_items(self.config).failed([self.node])
            broken = sum(nodeid.startswith((f"{item}-", f"{item}]")) for nodeid in failed)
            collected.verdict = judge_parity(found, reference.told, lacking, notes, broken)
            told = parity_document(collected.verdict, found, reference.told)
            of_run = self.cpas.collected[run]
            of_run.parity = told
            of_run.value_pictures = collected.pictures_of(told)
            report_outcome(
                session,
                f"cpas-parity::verdict[{run.method}-{run.dataset}]",
                collected.verdict.outcome(False),
                folded(str(collected.verdict)),
            )

    def _write_map(self, session: pytest.Session) -> None:
        """Write the map of names that the samples propose."""
        name = self.config.option.cpas_parity_propose
        if name is None:
            return
        path = self.config.invocation_params.dir / name
        proposals = [
            each.proposal
            for collected in self.collected.values()
            for each in collected.traced
            if each.parity
        ]
        try:
            write_file(path, map_text(proposals))
        except OSError as error:
            message = f"{path}: the map cannot be written ({error})"
            report_outcome(session, "cpas-parity::map", "failed", message)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """What was recorded, and the verdicts."""
        if self.has_nothing_to_tell(terminalreporter):
            return
        terminal = Terminal(terminalreporter)
        for traced, collected in self.collected.items():
            if traced.folder is not None:
                new = [each for each in collected.traced if each.written]
                size = sum(each.written for each in new) / 2**20
                kept = sum(each.kept for each in collected.traced)
                there = f"; {kept} were there already" if kept else ""
                terminal.write_line(
                    f"trace: {len(new)} samples, {size:.1f} MiB, in {traced.folder}{there}"
                )
            if collected.verdict is not None:
                text = f"parity of {traced.run.method} on {traced.run.dataset}: {collected.verdict}"
                for line in terminal_lines(text).splitlines():
                    terminal.write_line(line)


def parity_session(config: pytest.Config) -> ParitySession:
    """The session of a run that has one."""
    session = config.pluginmanager.get_plugin("cpas-parity-session")
    if not isinstance(session, ParitySession):
        raise pytest.UsageError("the suite of traces runs with --cpas-trace or --cpas-parity")
    return session


def _plan(option: Namespace, options: RunOptions, here: Path) -> Plan:
    """Raises :class:`ValueError` and :class:`pytest_cpas.types.DataError`."""
    names = NameMap()
    if option.cpas_parity_map:
        names = read_map(here / option.cpas_parity_map)
    return Plan(
        folder=options.trace,
        most=_most(option.cpas_trace_max),
        spread=option.cpas_trace_spread,
        proposes=option.cpas_parity_propose is not None,
        names=names,
        draw=None if options.report is None else _draw,
    )


def _draw(here: Array, reference: Array) -> Mapping[str, Any] | None:
    from pytest_cpas.report.value_pictures import value_pictures  # Pillow, for a report only

    drawn = value_pictures(here, reference)
    return None if drawn is None else drawn.plain()


def _most(told: str | None) -> int:
    if told is None:
        return DEFAULT_MOST
    try:
        most = float(told) * 2**20
    except ValueError:
        most = 0.0
    if not 1 <= most <= LARGEST_MOST:
        raise ValueError(
            f"--cpas-trace-max is {told}, expected MiB for a sample, above 0 and at most"
            f" {LARGEST_MOST // 2**20}"
        )
    return int(most)


def _reference(name: str | None, run: MethodRun, options: RunOptions) -> Reference | None:
    """What a run is compared with."""
    if name is None:
        return None
    if name.startswith(_REVISION):
        revision = Revision.find(type(run.unloaded), name.removeprefix(_REVISION))
        return RevisionReference(name, revision, options.weights, options.device)
    if options.parity is not None:
        reference = RecordedReference(options.parity, run.method, run.dataset)
        if options.trace is not None:
            recorded = options.trace / run.method / run.dataset
            if recorded.resolve() == reference.folder.resolve():
                raise ValueError(
                    f"--cpas-trace {options.trace} would overwrite the trace in {reference.folder},"
                    " which --cpas-parity compares with; record into another folder"
                )
        return reference
    make = make_method(name, options.weights, options.root)
    return MethodReference(name, make, options.weights, options.device)
