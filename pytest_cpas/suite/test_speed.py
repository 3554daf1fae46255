"""One item per method and data set: how long a prediction takes."""

from __future__ import annotations

from typing import Any

import pytest

from pytest_cpas.evaluation import MethodError, RevisionError
from pytest_cpas.session.speed_session import MEASURED, speed_session
from pytest_cpas.session.suite_session import skip
from pytest_cpas.timing.records import RecordError
from pytest_cpas.timing.running import SpeedRun
from pytest_cpas.timing.workers import TimingError
from pytest_cpas.types import ContractError


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrise by run, each with a clock of its own for pytest-benchmark."""
    metafunc.parametrize(
        "speed_run",
        [
            pytest.param(
                speed_run,
                marks=pytest.mark.benchmark(timer=speed_run.elapsed),
                id=f"{speed_run.run.method}-{speed_run.run.dataset}",
            )
            for speed_run in speed_session(metafunc.config).speed_runs
        ],
    )


# where there is nothing to time, that is said, and not that it was not timed
@pytest.mark.filterwarnings("ignore:Benchmark fixture was not used")
def test_speed(speed_run: SpeedRun, benchmark: Any, request: pytest.FixtureRequest) -> None:
    """The method does not take much longer than it may."""
    session = speed_session(request.config)
    if obstacle := session.cpas.obstacle(speed_run.run):
        skip(request.node, f"the adapter is wrong: {obstacle}")
    problem = ""
    try:
        verdict, measured = speed_run.measure(benchmark)
    except (TimingError, RevisionError, MethodError, ContractError, RecordError) as error:
        problem = str(error)
    if problem:
        pytest.fail(problem, pytrace=False)
    document = session.speed_document(measured, verdict)
    request.node.stash[MEASURED] = benchmark.extra_info["cpas"] = document
    if session.outcome(verdict) == "failed":
        pytest.fail(str(verdict), pytrace=False)
    if session.outcome(verdict) == "skipped":
        skip(request.node, str(verdict))
