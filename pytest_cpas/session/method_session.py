"""A pytest run with ``--cpas-*``: what is judged, the rows that come back, the verdict at the end.

Workers judge; their rows ride on the test reports; the controller collects them, compares with the
golden tables and reports.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from pytest_cpas import registry
from pytest_cpas.checks.contract import CONTRACT, ContractResult
from pytest_cpas.datasets.perturbed import perturbation_of, perturbed
from pytest_cpas.diagnosis import Explanation
from pytest_cpas.diagnosis.running import diagnose_run, expected_precision
from pytest_cpas.documents import RunConditions, RunDocument, SpeedDocument
from pytest_cpas.evaluation import MethodRun, Row, Run, Selection
from pytest_cpas.evaluation.merging import MergedRun, merge
from pytest_cpas.evaluation.predictions import StoredRun
from pytest_cpas.evaluation.results import ResultsError, ResultsFile, Shard
from pytest_cpas.golden import GoldenError, RunTable, find_golden, orphans, record
from pytest_cpas.golden.comparison import Word, compare
from pytest_cpas.golden.published import compare_published, published_cells
from pytest_cpas.golden.snapshot import golden_folder
from pytest_cpas.report.against import against, pairs
from pytest_cpas.report.document import document, run_document
from pytest_cpas.report.files import write_report
from pytest_cpas.report.progress import watch
from pytest_cpas.report.stored import StoredReportError, read_runs
from pytest_cpas.report.terminal import print_robustness, print_run, shows_samples
from pytest_cpas.report.up_axes import up_axes
from pytest_cpas.session.contract_stage import ContractStage, Stage, StoredStage
from pytest_cpas.session.suite_session import SuiteSession, report_outcome
from pytest_cpas.types import (
    ContractError,
    Dataset,
    DeclarationError,
    Method,
    MethodInfo,
    Verdict,
    assets_of,
)

#: Where an item keeps what it found out: rows, and errors of samples without one.
FOUND = pytest.StashKey["Found"]()


@dataclass
class Found:
    """The rows of the samples that an item judged, and (sample, message) of those it could not;
    or the :meth:`ContractResult.plain` of a contract check."""

    rows: list[Row] = field(default_factory=list)
    errors: list[tuple[str, str]] = field(default_factory=list)
    contract: dict[str, Any] | None = None


class CpasSession(SuiteSession):
    """The hooks of a run, and its state."""

    def __init__(self, config: pytest.Config) -> None:
        """Resolve methods, data sets and predictions; :class:`pytest.UsageError` if that fails."""
        super().__init__(config, "test_samples.py", "cpas")
        self.golden = golden_folder(config)
        self.runs: list[Run] = _resolve_runs(config)
        self.files = _results_files(config, self.runs)
        self.rows: dict[Run, dict[str, Row]] = {
            run: dict(self.files[run].rows) if run in self.files else {} for run in self.runs
        }
        self.stages = _contract_stages(self.runs)
        self.contract: dict[Run, dict[str, ContractResult]] = {run: {} for run in self.runs}
        self.errors: dict[Run, dict[str, str]] = {run: {} for run in self.runs}
        #: What --cpas-benchmark measured; see :mod:`pytest_cpas.session.speed_session`.
        self.speed: dict[Run, SpeedDocument] = {}
        self.documents: list[RunDocument] = []
        self.others = _other_runs(config, self.runs)
        self.progress = watch(config, self.runs, self.rows)
        self._broken = 0
        self._report: Path | None = None

    def stage(self, run: Run) -> Stage | None:
        """The contract of a run's method, if it is checked."""
        first = run.shared if isinstance(run, MethodRun) else None
        return self.stages.get(first or run)

    # -- items ------------------------------------------------------------------------------

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """See for which runs the contract is checked; -k can leave that out."""
        for item in list(items):
            callspec: Any = getattr(item, "callspec", None)
            if item.path != self._suite or not callspec or "check" not in callspec.params:
                continue
            if self.stages:
                self.stages[callspec.params["run"]].asked = True
            else:  # what pytest makes of no values for a parameter
                items.remove(item)

    def found(self, item: pytest.Item) -> Any:
        """The run's index and what the item found; None for items that judge no sample."""
        if FOUND not in item.stash:
            return None
        run = item.callspec.params["run"]  # type: ignore[attr-defined]
        return self.runs.index(run), asdict(item.stash[FOUND])

    def collect(self, found: Any) -> None:
        """Collect rows, and keep them on disk if asked to; a disk that is full ends the run."""
        index, content = found
        run = self.runs[index]
        # one object each, which the samples' references have already
        shared = ("sample", "category")
        rows = [
            Row(**values | {name: sys.intern(values[name]) for name in shared})
            for values in content["rows"]
        ]
        self.rows[run] |= {row.sample: row for row in rows}
        self.errors[run] |= dict(content["errors"])
        if self.progress:
            self.progress.add(run, rows, len(content["errors"]))
        if file := self.files.get(run):
            try:
                for row in rows:
                    file.add(row)
                for sample, message in content["errors"]:
                    file.add_error(sample, message)
                if content["contract"]:
                    file.add_contract(content["contract"])
            except ResultsError as error:
                pytest.exit(str(error))
        if content["contract"]:
            result = ContractResult(**content["contract"])
            self.contract[run][result.check] = result

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """On the controller: collect, and count what failed."""
        super().pytest_runtest_logreport(report)
        if self.is_controller and report.failed:
            self._broken += 1

    # -- verdict ----------------------------------------------------------------------------

    @pytest.hookimpl(wrapper=True)
    def pytest_runtestloop(self, session: pytest.Session) -> Generator[None, object, object]:
        """After the last item, on the controller: one report per golden cell group."""
        if not self.is_controller or self.config.option.collectonly:
            return (yield)
        try:
            with ExitStack() as files:
                for file in self.files.values():
                    files.enter_context(file)
                return (yield)
        except ResultsError as error:
            pytest.exit(str(error))
        finally:
            if not isinstance(sys.exception(), KeyboardInterrupt):
                self._judge_runs(session)

    def _judge_runs(self, session: pytest.Session) -> None:
        for run in self.runs:
            rows = self._ordered(run)
            table = RunTable.of(run, rows)
            golden = damaged = None
            try:
                golden = find_golden(self.golden, run.method, run.dataset)
            except GoldenError as error:
                damaged = Verdict(Word.DAMAGED, "all", str(error))
            findings = diagnose_run(run, rows, table, expected_precision(golden, run))
            only_timed = not rows and self.config.option.cpas_benchmark
            if self.update and not only_timed:
                found = [self._record(run, table)]
            else:
                found = [damaged] if damaged else _verdicts(run, table, golden)
            verdicts = [_explained(verdict, findings) for verdict in found]
            for verdict in verdicts:
                self._emit(session, run, verdict)
            self.documents.append(self._document(run, table, golden, verdicts, findings))
        if folder := self.config.option.cpas_report:
            self._write_report(session, self.config.invocation_params.dir / folder)

    def _document(
        self,
        run: Run,
        table: RunTable,
        golden: RunTable | None = None,
        verdicts: Sequence[Verdict] = (),
        findings: Sequence[Explanation] = (),
    ) -> RunDocument:
        return run_document(
            run,
            table,
            errors=self.errors[run],
            verdicts=verdicts,
            require_golden=self.config.option.cpas_require_golden,
            contract=self.contract[run].values(),
            findings=findings,
            golden=golden,
            speed=self.speed.get(run),
            # a large run has too many samples to list them for nobody
            samples=bool(self.config.option.cpas_report)
            or shows_samples(self.config, len(table.samples)),
        )

    def _write_report(self, session: pytest.Session, folder: Path) -> None:
        try:
            from pytest_cpas.report.pictures import pictures  # Pillow, for a report only

            for run, told in zip(self.runs, self.documents, strict=True):
                told["up_axes"] = up_axes(run, self._ordered(run))
            content = document(self.documents, session.testsfailed)
            if self.others:
                content["against"] = against(content["runs"], self.others)
            drawn = pictures(self.runs, self.rows, self.documents, content.get("against"))
            write_report(content, folder, drawn)
            self._report = folder / "report.html"
        except OSError as error:
            message = f"{folder}: the report cannot be written ({error})"
            report_outcome(session, "cpas::report", "failed", message)

    def _ordered(self, run: Run) -> list[Row]:
        """The rows in the data set's order, however they arrived."""
        rows = self.rows[run]
        return [rows[ref.id] for ref in run.samples if ref.id in rows]

    def _record(self, run: Run, table: RunTable) -> Verdict:
        try:
            if self._broken or run.damaged:
                raise GoldenError(f"{self._broken} items failed; a golden table needs none to")
            if run in self.stages and len(self.contract[run]) < len(CONTRACT):
                raise GoldenError("the contract of the method was not checked; leave out -k")
            return Verdict(Word.RECORDED, "all", str(record(self.golden, table)))
        except GoldenError as error:
            return Verdict(Word.NOT_RECORDED, "all", str(error))

    def _emit(self, session: pytest.Session, run: Run, verdict: Verdict) -> None:
        """Report a verdict as if it were an item."""
        outcome = verdict.outcome(self.config.option.cpas_require_golden)
        message = str(verdict)
        if outcome == "skipped":
            message = f"{run.method} on {run.dataset}: {verdict}"
        nodeid = f"cpas::golden[{run.method}-{run.dataset}-{verdict.category}]"
        report_outcome(session, nodeid, outcome, message)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """The tables and verdicts."""
        if not self.is_controller:
            return
        # whoever interrupts a run sees what there is
        documents = self.documents or [
            self._document(run, RunTable.of(run, self._ordered(run))) for run in self.runs
        ]
        for run in documents:
            sound = not any(verdict["outcome"] == "failed" for verdict in run["verdicts"])
            if perturbation_of(run["dataset"]) and sound and self.config.get_verbosity() <= 0:
                continue  # a point of the curves below
            print_run(terminalreporter, run)
        print_robustness(terminalreporter, documents)
        if self._report:
            terminalreporter.write_line(f"report: {self._report}")
        if self.update:
            known = {run.method for run in self.runs} | {
                entry.name for entry in registry.registered("method")
            }
            for folder in orphans(self.golden, known):
                terminalreporter.write_line(
                    f"orphaned golden table: no method {folder.parent.name} is registered or was"
                    f" judged; if it is gone, remove {folder}"
                )


def _verdicts(run: Run, table: RunTable, golden: RunTable | None) -> list[Verdict]:
    """Against the golden table; where there is none, against the published counts."""
    if golden is None and table.samples:
        verdicts = compare_published(published_cells(run.dataset, run.method), table.table)
        if verdicts:
            return verdicts
    return compare(golden, table)


def _explained(verdict: Verdict, findings: Sequence[Explanation]) -> Verdict:
    """A bad verdict with what explains it."""
    if verdict.passed:
        return verdict
    lines = [
        f"\n  {line}"
        for finding in findings
        if "all" in (finding.category, verdict.category) or finding.category == verdict.category
        for line in finding.lines()
    ]
    return replace(verdict, details=verdict.details + "".join(lines))


def cpas_session(config: pytest.Config) -> CpasSession:
    """The session of a run that has one."""
    session = config.pluginmanager.get_plugin("cpas-session")
    if not isinstance(session, CpasSession):
        raise pytest.UsageError("the suite of pytest-cpas runs with --cpas-method and the like")
    return session


def _resolve_runs(config: pytest.Config) -> list[Run]:
    options = config.option
    for_pictures = options.cpas_dataset and options.cpas_merge and options.cpas_report
    if bool(options.cpas_method) != bool(options.cpas_dataset) and not for_pictures:
        given: registry.Kind = "method" if options.cpas_method else "dataset"
        lacking: registry.Kind = "dataset" if options.cpas_method else "method"
        known = ", ".join(entry.name for entry in registry.registered(lacking))
        raise pytest.UsageError(
            f"--cpas-{given} needs --cpas-{lacking} NAME as well; registered: {known}"
        )
    if options.cpas_limit is not None and options.cpas_limit < 1:
        raise pytest.UsageError(f"--cpas-limit is {options.cpas_limit}, expected at least 1")
    if options.cpas_jitter < 1:
        raise pytest.UsageError(f"--cpas-jitter is {options.cpas_jitter}, expected at least 1")
    data, weights = (
        None if folder is None else config.invocation_params.dir / folder
        for folder in (options.cpas_data, options.cpas_weights)
    )
    runs: list[Run] = []
    try:
        shard = Shard.parse(options.cpas_shard)
        selection = Selection(
            categories=options.cpas_category,
            limit=options.cpas_limit,
            shard=shard.index,
            shards=shard.count,
        )
        methods = [make_method(name, weights) for name in options.cpas_method]
        datasets = [registry.resolve("dataset", name)(data) for name in options.cpas_dataset]
        for make, dataset in itertools.product(methods, datasets):
            runs += _method_runs(make(), dataset, options, selection, weights)
        for name in options.cpas_predictions:
            runs.append(StoredRun(config.invocation_params.dir / name, selection=selection))
        merged = [config.invocation_params.dir / name for name in options.cpas_merge]
        for stored in merge(merged, allow_gaps=options.cpas_allow_gaps):
            for dataset in datasets:
                if dataset.name == stored.dataset:
                    stored.take_images(dataset)
            runs.append(stored)
        judged = {run.dataset for run in runs}
        if for_pictures and not judged.issuperset(dataset.name for dataset in datasets):
            raise ResultsError(
                f"--cpas-dataset {', '.join(options.cpas_dataset)}: the results are of"
                f" {', '.join(sorted(judged))}"
            )
    except (registry.RegistryError, ContractError, ResultsError, ValueError, OSError) as error:
        raise pytest.UsageError(str(error)) from error
    for run in runs:
        if not run.samples and not run.damaged:
            asked = f" of {', '.join(options.cpas_category)}" if options.cpas_category else ""
            raise pytest.UsageError(
                "\n".join([f"{run.method} on {run.dataset}: no samples{asked}", *run.missing])
            )
    names = [(run.method, run.dataset) for run in runs]
    if len(set(names)) < len(names):
        raise pytest.UsageError(f"the same method and data set twice: {names}")
    return runs


def _contract_stages(runs: Sequence[Run]) -> dict[Run, Stage]:
    try:
        return {
            run: StoredStage(run.contract) if isinstance(run, MergedRun) else ContractStage(run)
            for run in runs
            if isinstance(run, MergedRun | MethodRun) and run.under_contract
        }
    except ContractError as error:
        raise pytest.UsageError(str(error)) from error


def _method_runs(
    method: Method,
    dataset: Dataset,
    options: argparse.Namespace,
    selection: Selection,
    weights: Path | None,
) -> list[MethodRun]:
    """The run of a method on a data set; with a profile, one for each part that this makes."""
    robustness = options.cpas_profile == "robustness"
    runs: list[MethodRun] = []
    for part in perturbed(dataset, method.info) if robustness else (dataset,):
        run = MethodRun(
            method,
            part,
            weights=weights,
            device=options.cpas_device,
            seed=options.cpas_seed,
            seeds=options.cpas_jitter,
            selection=selection,
            shared=runs[0] if runs else None,
            keeps_shapes=bool(options.cpas_report) and not perturbation_of(part.name),
        )
        runs.append(run)
    return runs


def _other_runs(config: pytest.Config, runs: Sequence[Run]) -> list[RunDocument]:
    """What to compare the runs with; that they fit is known before any is judged."""
    here = config.invocation_params.dir
    paths = [here / name for name in config.option.cpas_against]
    if not paths or hasattr(config, "workerinput"):
        return []
    conditions: list[RunConditions] = [
        {"method": run.method, "dataset": run.dataset, "identity": dict(run.identity)}
        for run in runs
    ]
    try:
        others = read_runs(paths)
        pairs(conditions, others)
    except (ResultsError, StoredReportError) as error:
        raise pytest.UsageError(str(error)) from error
    return others


def _results_files(config: pytest.Config, runs: Sequence[Run]) -> dict[Run, ResultsFile]:
    folder = config.option.cpas_results
    if folder is None:
        return {}
    shard = Shard.parse(config.option.cpas_shard)
    try:
        return {run: ResultsFile(config.invocation_params.dir / folder, run, shard) for run in runs}
    except ResultsError as error:
        raise pytest.UsageError(str(error)) from error


def make_method(name: str, weights: Path | None) -> Callable[[], Method]:
    """Check a method's class and its assets; nothing is loaded."""
    factory = registry.resolve("method", name)
    info = getattr(factory, "info", None)
    if not isinstance(info, MethodInfo):
        raise DeclarationError(
            f"method {name!r}: {factory!r} has no attribute info of type MethodInfo; a method is a"
            " class with info, load(assets, device) and predict(batch, seed)"
        )
    for asset in assets_of(factory, weights):
        try:
            asset.locate(weights)
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{info.name} needs {error}") from None
    make: Callable[[], Method] = factory
    return make
