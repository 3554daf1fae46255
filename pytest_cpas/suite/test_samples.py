"""One item per sample: predict, validate, measure. Accuracy is judged by the golden tables."""

from __future__ import annotations

import pytest

from pytest_cpas._suite_session import grouped
from pytest_cpas.evaluation import Run, SampleError
from pytest_cpas.published import count_problems
from pytest_cpas.session import FOUND, Found, cpas_session
from pytest_cpas.types import SampleRef


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrise by run, and by sample (or group of samples)."""
    session = cpas_session(metafunc.config)
    if "refs" in metafunc.fixturenames:
        metafunc.parametrize(
            ("run", "refs"),
            [
                pytest.param(run, refs, id=f"{run.method}-{run.dataset}-{name}")
                for run in session.runs
                for name, refs in grouped(run.samples, metafunc.config.option.cpas_granularity)
            ],
        )
    else:
        metafunc.parametrize(
            "run", [pytest.param(run, id=f"{run.method}-{run.dataset}") for run in session.runs]
        )


def test_listing(run: Run) -> None:
    """Every sample can be listed, and a complete copy lists what was published."""
    if run.damaged:
        pytest.fail("\n".join(run.damaged), pytrace=False)
    problems = count_problems(run.dataset, run.listed, partial=bool(run.missing))
    if problems:
        pytest.fail(f"{run.dataset}: " + "\n".join(problems.values()), pytrace=False)


def test_sample(run: Run, refs: list[SampleRef], request: pytest.FixtureRequest) -> None:
    """The sample can be read, the method answers, and the answer keeps the contract."""
    session = cpas_session(request.config)
    found = request.node.stash[FOUND] = Found()
    errors = []
    for ref in refs:
        if ref.id in session.rows[run]:
            continue  # judged before the run was killed
        try:
            found.rows.append(run.judge(ref))
        except SampleError as error:
            errors.append(error)
            found.errors.append((ref.id, str(error)))
    if len(errors) == 1 and errors[0].__cause__ is not None:
        raise errors[0]
    if errors:
        pytest.fail("\n".join(str(error) for error in errors), pytrace=False)
