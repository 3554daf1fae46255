"""A pytest run with ``--cpas-benchmark``: what may not be combined with it, and what was found."""

from __future__ import annotations

import importlib.util
from argparse import Namespace
from pathlib import Path
from typing import Any

import pytest

from pytest_cpas import registry
from pytest_cpas.documents import ItemOutcome, MeasuredSpeedDocument, SpeedDocument
from pytest_cpas.evaluation import MethodRun, RevisionError
from pytest_cpas.remote import RemoteMethod
from pytest_cpas.session.method_session import CpasSession, cpas_session
from pytest_cpas.session.options import RunOptions
from pytest_cpas.session.resolution import make_method
from pytest_cpas.session.suite_session import SuiteSession, usage_errors
from pytest_cpas.timing.running import Plan, Rival, SpeedRun
from pytest_cpas.timing.verdicts import parse_limit
from pytest_cpas.types import ContractError, Method, Verdict

#: Where an item keeps the document of what it measured.
MEASURED = pytest.StashKey[SpeedDocument]()

#: How a revision is told from a method's name.
_REVISION = "git:"


class SpeedSession(SuiteSession):
    """Times every method on every data set of the run, after its samples."""

    def __init__(self, config: pytest.Config) -> None:
        """Check what is asked for; :class:`pytest.UsageError` where timing would mean nothing."""
        check_usage(config.option)
        super().__init__(config, "test_speed.py", "cpas-speed")
        self.cpas: CpasSession = cpas_session(config)
        with usage_errors(registry.RegistryError, ContractError, ValueError, OSError):
            plan = plan_of(config.option, self.cpas.options)
            for run in self.cpas.runs:
                if plan.rival and isinstance(run, MethodRun):
                    _check_comparable(run.unloaded)
        #: One for each method and data set; the parts of a profile are not timed one by one.
        self.speed_runs = [
            SpeedRun(run, plan)
            for run in self.cpas.runs
            if isinstance(run, MethodRun) and run.shared is None
        ]
        with usage_errors(RevisionError):
            for speed_run in self.speed_runs:
                if plan.rival:
                    plan.rival.of(type(speed_run.run.unloaded))

    def item_content(self, item: pytest.Item) -> Any:
        """The run's index and the document."""
        if MEASURED not in item.stash:
            return None
        speed_run: SpeedRun = item.callspec.params["speed_run"]  # type: ignore[attr-defined]
        return self.cpas.runs.index(speed_run.run), item.stash[MEASURED]

    def collect(self, content: Any) -> None:
        """Put the document beside what else has come back of the run."""
        index, document = content
        self.cpas.collected[self.cpas.runs[index]].add_speed(document)

    def outcome(self, verdict: Verdict) -> ItemOutcome:
        """As what the item ends."""
        return verdict.outcome(self.cpas.options.require_golden)

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


def check_usage(options: Namespace) -> None:
    """Raise :class:`pytest.UsageError` for what would time nothing, or time it wrongly."""
    if getattr(options, "dist", "no") != "no":
        raise pytest.UsageError(
            "--cpas-benchmark under xdist: what runs beside a method changes its time, so nothing"
            " would be measured or judged. Leave out --numprocesses and --dist (or give -n 0)"
        )
    if importlib.util.find_spec("pytest_benchmark") is None:
        raise pytest.UsageError(
            "--cpas-benchmark measures with pytest-benchmark, which is not installed:"
            " pip install 'pytest-cpas[benchmark]'"
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


def plan_of(options: Namespace, run_options: RunOptions) -> Plan:
    """How methods are timed; ``run_options``: what their runs are asked for.

    Raises :class:`ValueError` for options that cannot be meant, and as
    :func:`pytest_cpas.session.resolution.make_method` for the method to compare with.
    """
    fail = options.cpas_benchmark_fail
    limit = None if fail is None else parse_limit(fail)
    rival = _rival(options.cpas_benchmark_against, run_options.weights, run_options.root)
    if rival and run_options.update:
        raise ValueError(
            "--snapshot-update records the ratio to the calibration kernel, which is not timed with"
            " --cpas-benchmark-against; leave one of them out"
        )
    return Plan(
        golden=run_options.golden,
        weights=run_options.weights,
        device=run_options.device,
        rival=rival,
        limit=limit,
        update=run_options.update,
    )


_NOT_ELSEWHERE = (
    "methods are compared in processes of one kind, and this one answers from another interpreter;"
    " leave out --cpas-benchmark-against to time it against the calibration kernel"
)


def _check_comparable(method: Method) -> None:
    if isinstance(method, RemoteMethod):
        raise ValueError(f"--cpas-benchmark-against, of {method.info.name}: {_NOT_ELSEWHERE}")


def _rival(name: str | None, weights: Path | None, root: Path) -> Rival | None:
    if name is None:
        return None
    if name.startswith(_REVISION):
        revision = name.removeprefix(_REVISION)
        if not revision:
            raise ValueError(f"--cpas-benchmark-against is {name!r}, expected such as git:HEAD~1")
        return Rival(name, revision=revision)
    made = make_method(name, weights, root)
    if isinstance(made, type) and issubclass(made, RemoteMethod):
        made.remote.close()
        raise ValueError(f"--cpas-benchmark-against {name}: {_NOT_ELSEWHERE}")
    if not isinstance(made, type):
        raise ValueError(f"--cpas-benchmark-against {name}: {made!r}, expected a class")
    return Rival(name, made)
