"""A pytest run with ``--cpas-*``: the hooks that lead from what is asked for to what is reported.

Workers judge samples; what their items found rides on the test reports. The controller collects it
(:mod:`pytest_cpas.session.collected`), judges the runs (:mod:`pytest_cpas.session.judging`) and
reports them (:mod:`pytest_cpas.session.reporting`).
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Generator, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from pytest_cpas import registry
from pytest_cpas.documents import RunDocument
from pytest_cpas.evaluation import (
    Limit,
    MethodRun,
    ResultsError,
    Row,
    Run,
    found_programs,
    leave_out,
    take_programs,
)
from pytest_cpas.golden import orphans
from pytest_cpas.golden.published import count_problems
from pytest_cpas.golden.snapshot import alarm_level, golden_folder
from pytest_cpas.reading.text import folded
from pytest_cpas.remote import RemoteMethod, close_all, project_folder
from pytest_cpas.report.progress import watch
from pytest_cpas.report.stored import StoredReportError
from pytest_cpas.report.terminal import Terminal, shows_samples
from pytest_cpas.session.batching import plan_batches, scheduling
from pytest_cpas.session.beginning import began
from pytest_cpas.session.collected import CollectedRun, ItemResult
from pytest_cpas.session.contract_stage import contract_stages
from pytest_cpas.session.judging import JudgedRun, judge, record_run
from pytest_cpas.session.opened_files import opened_files
from pytest_cpas.session.options import RunOptions
from pytest_cpas.session.other_files import digests, outputs, plugin_files
from pytest_cpas.session.own_settings import own_settings
from pytest_cpas.session.protocol_names import resolve_protocols
from pytest_cpas.session.reporting import Reporter
from pytest_cpas.session.resolution import open_results, read_others, resolve_runs
from pytest_cpas.session.saved_predictions import open_saved
from pytest_cpas.session.seen_items import seen_items
from pytest_cpas.session.suite_session import (
    SuiteSession,
    end_run,
    report_outcome,
    sample_items,
    usage_errors,
)
from pytest_cpas.session.time_limit import sample_seconds, time_limit
from pytest_cpas.types import ContractError, SampleRef, Verdict, some_of

__all__ = ["ITEM_RESULT", "CpasSession", "cpas_session"]

#: Where an item keeps what it found out.
ITEM_RESULT = pytest.StashKey[ItemResult]()

#: Where a worker's input has the programs of its methods and data sets.
_PROGRAMS = "cpas_programs"


class CpasSession(SuiteSession):
    """The hooks of a run, and the objects between which they pass on what there is.

    ``options``: what is asked for; ``collected``: what has come back, run by run, in the order of
    the reports; ``stages``: the contract of each run that has one.
    """

    verdicts_told = False

    def __init__(self, config: pytest.Config) -> None:
        """Resolve methods, data sets and predictions; :class:`pytest.UsageError` if that fails."""
        super().__init__(config, "test_samples.py", "cpas")
        config.add_cleanup(close_all)
        take_programs(getattr(config, "workerinput", {}).get(_PROGRAMS, {}))
        with usage_errors(
            registry.RegistryError,
            ContractError,
            ResultsError,
            StoredReportError,
            ValueError,
            OSError,
        ):
            self.options = options = RunOptions.of(
                config.option,
                config.invocation_params.dir,
                golden=golden_folder(config),
                root=project_folder(config.rootpath, config.invocation_params.dir),
                alarm=alarm_level(config),
                protocols=resolve_protocols(
                    config.option.cpas_protocol or config.getini("cpas_protocol"),
                    config.invocation_params.dir,
                    config.rootpath,
                ),
                timeout=sample_seconds(config),
            )
            leave_out([*options.folders, *outputs(config)])
            if self.is_controller:
                options.check_written()
            runs = resolve_runs(options)
            plugins = plugin_files(config)
            watched = [file for files in plugins.values() for file in files]
            for run in runs:
                if isinstance(run, MethodRun):
                    run.provenance = {**run.provenance, **digests(plugins)}
                    run.files = {**run.files, **own_settings(config)}
                    run.began(began(config), watched)
            self._opened = opened_files()
            files = open_results(options, runs, writes=self.is_controller, opened=self._opened.told)
            worker = getattr(config, "workerinput", {}).get("workerid", "")
            self.saved = open_saved(options, runs, files, worker)
            self.stages = contract_stages(runs)
            others = read_others(options, runs) if self.is_controller else []
        self.collected = {run: CollectedRun(run, files.get(run)) for run in runs}
        self._reporter = Reporter(
            require_golden=options.require_golden,
            folder=options.report,
            others=others,
            lists=functools.partial(shows_samples, config),
        )
        self._progress = watch(config, runs, {run: c.rows for run, c in self.collected.items()})
        if options.timeout is not None:
            self._limit_time(options.timeout)
        self._with_contract: set[Run] = set()
        self._documents: list[RunDocument] = []
        self._report: Path | None = None

    def _limit_time(self, seconds: float) -> None:
        """Have this process ended by a prediction that takes longer."""
        if not self.is_controller:
            kept = "Other samples go on in other processes"
        elif self.options.results is not None:
            kept = (
                f"The rows that came before are kept in {self.options.results}: the same command"
                " goes on from there"
            )
        else:
            kept = (
                "No row is kept without --cpas-results DIR; with it, the same command goes on"
                " where it was ended"
            )
        for index, run in enumerate(self.runs):
            if isinstance(run, MethodRun):
                if not isinstance(run.unloaded, RemoteMethod):
                    run.batch = 1  # of several nobody could tell which of them takes long
                run.limit = Limit(
                    watchdog=time_limit(self.config).watchdog,
                    seconds=seconds,
                    hint=f"{kept}. If the method may take longer, raise --cpas-timeout",
                    about={"run": index},
                )

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: Any) -> None:
        """Spare a worker the search for the programs that the controller has found."""
        node.workerinput[_PROGRAMS] = found_programs()

    @property
    def runs(self) -> list[Run]:
        """The runs, in the order in which they are judged."""
        return list(self.collected)

    def obstacle(self, run: Run) -> str:
        """Why the samples of a run need not be judged: the contract that its method breaks."""
        first = _first_of(run)
        # where -k left the checks out, they stop nothing
        return self.stages[first].wrong if first in self._with_contract else ""

    # -- items ------------------------------------------------------------------------------

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """See for which runs the contract is checked; -k can leave that out."""
        super().pytest_collection_modifyitems(items)
        for item in items:
            callspec: Any = getattr(item, "callspec", None)
            if item.path != self._suite or not callspec or "check" not in callspec.params:
                continue
            self._with_contract.add(callspec.params["run"])

    @pytest.hookimpl(trylast=True)
    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """See which samples a method is asked about at once."""
        order = [item.nodeid for item in session.items]
        worker = getattr(self.config, "workerinput", {"workercount": 1, "workerid": "gw0"})
        workers = worker["workercount"]
        if int(worker["workerid"].lstrip("gw")) >= workers:
            return  # one has ended in a batch, and of which sample nobody knows
        for collected, run, items in self._in_batches():
            batches = plan_batches(collected, run, items, order, workers)
            run.batches.plan(batches, ahead=self.is_controller)

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_make_scheduler(self, config: pytest.Config, log: Any) -> Any:
        """Under xdist's usual distribution the items of a batch go to one worker."""
        runs = self._in_batches()
        return scheduling(config, log, runs) if runs and config.option.dist == "load" else None

    def _in_batches(self) -> list[tuple[CollectedRun, MethodRun, Mapping[str, list[SampleRef]]]]:
        return [
            (collected, run, sample_items(self.node, run, self.options.granularity))
            for run, collected in self.collected.items()
            if isinstance(run, MethodRun) and run.batch > 1
        ]

    def _exclude_categories(self) -> None:
        """See which categories are left out as a whole, by --cpas-category or by a selection of
        items: those are not asked for. What a limit or a shard leaves out is."""
        all_selected = seen_items(self.config).selected
        left = {i for i in all_selected if i.startswith(f"{self.node}::test_sample[")}
        deselected: dict[Run, set[str]] = {}
        for run in self.runs:
            there, selected = set[str](), set[str]()
            for nodeid, refs in sample_items(self.node, run, self.options.granularity).items():
                categories = {ref.category for ref in refs}
                there |= categories
                if nodeid in all_selected:
                    selected |= categories
                    left.discard(nodeid)
            deselected[run] = there - selected if selected and self._is_selection_asked else set()
        for run, collected in self.collected.items():
            # of an item that is none of those known nobody can say what it judges
            collected.exclude(
                named=self.options.selection.categories,
                deselected=() if left else deselected[run],
            )

    @property
    def _is_selection_asked(self) -> bool:
        """Whether the command line names what is to be run: what a plugin leaves out is not left
        out by whoever asked."""
        option = self.config.option
        named = (option.keyword, option.markexpr, option.deselect)
        return any(named) or any("::" in argument for argument in self.config.args)

    def item_content(self, item: pytest.Item) -> Any:
        """The run's index, what the item found, which files were opened, and what is told of its
        batches; None for items that judge no sample."""
        if ITEM_RESULT not in item.stash:
            return None
        run = item.callspec.params["run"]  # type: ignore[attr-defined]
        self._hear()
        opened = [] if self.is_controller else self._opened.news()
        told = run.batches.told if isinstance(run, MethodRun) else []
        return self.runs.index(run), item.stash[ITEM_RESULT].plain(), opened, told

    def collect(self, content: Any) -> None:
        """Collect what an item found."""
        index, values, opened, told = content
        self._opened.take((name, digest) for name, digest in opened)
        if isinstance(run := self.runs[index], MethodRun):
            for line in told:
                run.batches.tell(line)
        collected, result = self.collected[self.runs[index]], ItemResult.of(values)
        if self._progress:
            self._progress.add(collected.run, result.rows, len(result.errors))
        with self._ending_the_run():
            collected.add(result)

    def _hear(self) -> None:
        """Take in which files methods in other interpreters have read."""
        for run in self.runs:
            self._opened.take(run.newly_heard_there() if isinstance(run, MethodRun) else ())

    def keep(self, run: Run, row: Row) -> None:
        """Keep a row whose item has not ended, and may never end."""
        self._hear()
        if self.is_controller:
            with self._ending_the_run():
                self.collected[run].keep(row)
        elif self.options.timeout is not None:
            time_limit(self.config).keep(self.runs.index(run), row)

    @contextmanager
    def _ending_the_run(self) -> Iterator[None]:
        """A disk that does not take a row ends the run."""
        try:
            yield
        except ResultsError as error:
            end_run(error)

    # -- verdict ----------------------------------------------------------------------------

    @pytest.hookimpl(wrapper=True)
    def pytest_runtestloop(self, session: pytest.Session) -> Generator[None, object, object]:
        """After the last item, on the controller: one report per golden cell group."""
        if not self.is_controller or self.only_shows:
            return (yield)
        try:
            with ExitStack() as files:
                for collected in self.collected.values():
                    files.enter_context(collected)
                for run, saved in self.saved.items():
                    saved.begin(self.collected[run].rows)
                return (yield)
        except ResultsError as error:
            end_run(error)
        finally:
            if not isinstance(sys.exception(), KeyboardInterrupt):
                self._judge_runs(session)
                self._write_predictions(session)

    def _write_predictions(self, session: pytest.Session) -> None:
        for run, saved in self.saved.items():
            try:
                saved.finish(self.collected[run].rows)
            except ResultsError as error:
                nodeid = f"cpas::predictions[{run.method}-{run.dataset}]"
                report_outcome(session, nodeid, "failed", str(error))

    def _report_listing(self, session: pytest.Session, run: Run) -> None:
        """Report a damaged listing whose item was deselected: no selection makes it whole."""
        nodeid = f"{self.node}::test_listing[{run.method}-{run.dataset}]"
        if nodeid not in seen_items(self.config).ended and (problem := listing_problem(run)):
            report_outcome(session, nodeid, "failed", problem)

    def _judge_runs(self, session: pytest.Session) -> None:
        for run in self.runs:
            self._report_listing(session, run)
        self._exclude_categories()
        failed_items = len(
            seen_items(self.config).failed([self.node])
        )  # the verdicts of other runs are none
        for collected in self.collected.values():
            judged = self._judge(collected, failed_items)
            for verdict in judged.verdicts:
                self._report_verdict(session, judged.run, verdict)
            self._documents.append(self._reporter.document(judged))
        try:
            self._report = self._reporter.write(
                list(self.collected.values()), self._documents, session.testsfailed
            )
        except OSError as error:
            message = f"{self.options.report}: the report cannot be written ({error})"
            report_outcome(session, "cpas::report", "failed", message)
        self.verdicts_told = True

    def _judge(self, collected: CollectedRun, failed_items: int) -> JudgedRun:
        if self.collected[_first_of(collected.run)].breaks_smoke:
            collected.refuse_reused("the adapter is wrong")
        only_timed = self.options.benchmark and not collected.rows
        if self.options.update and not only_timed:
            return record_run(
                collected,
                self.options.golden,
                failed_items=failed_items,
                alarm=self.options.alarm,
            )
        return judge(collected, self.options.golden, alarm=self.options.alarm)

    def _report_verdict(self, session: pytest.Session, run: Run, verdict: Verdict) -> None:
        """Report a verdict as if it were an item."""
        outcome = verdict.outcome(self.options.require_golden)
        message = folded(str(verdict))
        if outcome == "skipped":
            message = f"{run.method} on {run.dataset}: {verdict}"
        nodeid = f"cpas::golden[{run.method}-{run.dataset}-{verdict.category}]"
        report_outcome(session, nodeid, outcome, message)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """The tables and verdicts."""
        if self.has_nothing_to_tell(terminalreporter):
            return
        # whoever interrupts a run sees what there is
        documents = self._documents or [
            self._reporter.document(JudgedRun.unjudged(collected))
            for collected in self.collected.values()
        ]
        terminal = Terminal(terminalreporter)
        self._reporter.print(terminal, list(self.collected.values()), documents)
        for saved in self.saved.values():
            terminal.write_line(saved.told)
        if self._report:
            terminal.write_line(f"report: {self._report}")
        if self.options.update:
            if self.options.require_golden:
                terminal.write_line(
                    "--snapshot-update has recorded, and nothing was judged: --cpas-require-golden"
                    " demands nothing of this run"
                )
            known = {run.method for run in self.runs}
            known |= {entry.name for entry in registry.registered("method")}
            if left := orphans(self.options.golden, known):
                names = some_of(sorted({folder.parent.name for folder in left}))
                terminal.write_line(
                    f"{len(left)} golden tables in {self.options.golden} are of what is neither"
                    f" registered nor judged now: {names}; remove those of what is gone"
                )


def _first_of(run: Run) -> Run:
    """The run whose contract is that of the method of ``run``."""
    return (run.shared if isinstance(run, MethodRun) else None) or run


def listing_problem(run: Run) -> str:
    """What is damaged in the listing of a data set, or differs from what was published; or ""."""
    if run.damaged:
        return "\n".join(run.damaged)
    problems = count_problems(run.dataset, run.listed, partial=bool(run.missing))
    return f"{run.dataset}: " + "\n".join(problems.values()) if problems else ""


def cpas_session(config: pytest.Config) -> CpasSession:
    """The session of a run that has one."""
    session = config.pluginmanager.get_plugin("cpas-session")
    if not isinstance(session, CpasSession):
        raise pytest.UsageError("the suite of pytest-cpas runs with --cpas-method and the like")
    return session
