"""A pytest run with ``--cpas-benchmark``: what may not be combined with it, and what was found."""

from __future__ import annotations

from typing import Any

import pytest

from pytest_cpas import registry
from pytest_cpas.documents import ItemOutcome, MeasuredSpeedDocument, SpeedDocument
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.session.method_session import CpasSession, cpas_session, make_method
from pytest_cpas.session.suite_session import SuiteSession
from pytest_cpas.timing.running import Plan, Rival, SpeedRun
from pytest_cpas.timing.verdicts import parse_limit
from pytest_cpas.timing.workers import TimingError
from pytest_cpas.types import ContractError, Verdict

#: Where an item keeps the document of what it measured.
MEASURED = pytest.StashKey[SpeedDocument]()

#: How a revision is told from a method's name.
_REVISION = "git:"


class SpeedSession(SuiteSession):
    """Times every method on every data set of the run, after its samples."""

    def __init__(self, config: pytest.Config) -> None:
        """Check what is asked for; :class:`pytest.UsageError` where timing would mean nothing."""
        check_usage(config)
        super().__init__(config, "test_speed.py", "cpas-speed")
        self.cpas: CpasSession = cpas_session(config)
        plan = _plan(config, self.cpas)
        #: One for each method and data set; the parts of a profile are not timed one by one.
        self.speed_runs = [
            SpeedRun(run, plan)
            for run in self.cpas.runs
            if isinstance(run, MethodRun) and run.shared is None
        ]
        try:
            for speed_run in self.speed_runs:
                if plan.rival:
                    plan.rival.of(type(speed_run.run.unloaded))
        except TimingError as error:
            raise pytest.UsageError(str(error)) from error

    def found(self, item: pytest.Item) -> Any:
        """The run's index and the document."""
        if MEASURED not in item.stash:
            return None
        speed_run: SpeedRun = item.callspec.params["speed_run"]  # type: ignore[attr-defined]
        return self.cpas.runs.index(speed_run.run), item.stash[MEASURED]

    def collect(self, found: Any) -> None:
        """Hand the document to the session that reports."""
        index, document = found
        self.cpas.speed[self.cpas.runs[index]] = document

    def outcome(self, verdict: Verdict) -> ItemOutcome:
        """As what the item ends."""
        return verdict.outcome(self.config.option.cpas_require_golden)

    def speed_document(self, measured: MeasuredSpeedDocument, verdict: Verdict) -> SpeedDocument:
        """What was measured, with the verdict on it."""
        word: Any = verdict.word.value  # of a SpeedWord
        return {
            **measured,
            "verdict": {
                "word": word,
                "details": verdict.details,
                "outcome": self.outcome(verdict),
                "limit": verdict.limit,
            },
        }


def speed_session(config: pytest.Config) -> SpeedSession:
    """The session of a run that has one."""
    session = config.pluginmanager.get_plugin("cpas-speed-session")
    if not isinstance(session, SpeedSession):
        raise pytest.UsageError("the suite of run times runs with --cpas-benchmark")
    return session


def check_usage(config: pytest.Config) -> None:
    """Raise :class:`pytest.UsageError` for what would time nothing, or time it wrongly."""
    options = config.option
    if not options.cpas_method:
        raise pytest.UsageError(
            "--cpas-benchmark times methods, and there is none: give --cpas-method NAME and"
            " --cpas-dataset NAME"
        )
    if getattr(options, "dist", "no") != "no":
        raise pytest.UsageError(
            "--cpas-benchmark under xdist: what runs beside a method changes its time, so nothing"
            " would be measured or judged. Leave out --numprocesses and --dist (or give -n 0)"
        )
    if not hasattr(options, "benchmark_disable"):
        raise pytest.UsageError(
            "--cpas-benchmark measures with pytest-benchmark, which is switched off here: leave out"
            " -p no:benchmark (without plugin autoload give -p pytest_benchmark.plugin)"
        )
    nothing = "nothing would be timed"
    for given, name, why in (
        (
            options.benchmark_disable and not options.benchmark_enable,
            "--benchmark-disable",
            nothing,
        ),
        (options.benchmark_skip and not options.benchmark_only, "--benchmark-skip", nothing),
        (options.benchmark_cprofile, "--benchmark-cprofile", "a profiler changes every time"),
    ):
        if given:
            raise pytest.UsageError(f"--cpas-benchmark and {name}: {why}; leave one of them out")


def _plan(config: pytest.Config, cpas: CpasSession) -> Plan:
    options, here = config.option, config.invocation_params.dir
    weights = here / options.cpas_weights if options.cpas_weights else None
    try:
        limit = (
            None
            if options.cpas_benchmark_fail is None
            else parse_limit(options.cpas_benchmark_fail)
        )
        rival = _rival(options.cpas_benchmark_against, weights)
    except (registry.RegistryError, ContractError, ValueError, OSError) as error:
        raise pytest.UsageError(str(error)) from error
    if rival and cpas.update:
        raise pytest.UsageError(
            "--snapshot-update records the ratio to the calibration kernel, which is not timed with"
            " --cpas-benchmark-against; leave one of them out"
        )
    return Plan(cpas.golden, weights, options.cpas_device, rival, limit, cpas.update)


def _rival(name: str | None, weights: Any) -> Rival | None:
    if name is None:
        return None
    if name.startswith(_REVISION):
        revision = name.removeprefix(_REVISION)
        if not revision:
            raise ValueError(f"--cpas-benchmark-against is {name!r}, expected such as git:HEAD~1")
        return Rival(name, revision=revision)
    made = make_method(name, weights)
    if not isinstance(made, type):
        raise ValueError(f"--cpas-benchmark-against {name}: {made!r}, expected a class")
    return Rival(name, made)
