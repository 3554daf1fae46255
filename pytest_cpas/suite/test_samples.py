"""One item per contract check, then one per sample: predict, validate, measure.

Accuracy is judged by the golden tables.
"""

from __future__ import annotations

import pytest

from pytest_cpas.checks.contract import CONTRACT, ContractCheck
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.evaluation import ResultsError, Run, SampleError
from pytest_cpas.session.collected import ItemResult
from pytest_cpas.session.method_session import ITEM_RESULT, cpas_session, listing_problem
from pytest_cpas.session.suite_session import end_run, grouped, known_failure, skip
from pytest_cpas.types import SampleRef


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrise by run, and by sample (or group of samples)."""
    session = cpas_session(metafunc.config)
    if "check" in metafunc.fixturenames:
        metafunc.parametrize(
            ("run", "check"),
            [
                pytest.param(run, check, id=f"{run.method}-{run.dataset}-{check.name}")
                for run in session.stages
                for check in CONTRACT.values()
            ],
        )
    elif "refs" in metafunc.fixturenames:
        metafunc.parametrize(
            ("run", "refs"),
            [
                pytest.param(run, refs, id=f"{run.method}-{run.dataset}-{name}")
                for run in session.runs
                for name, refs in grouped(run.samples, session.options.granularity)
            ],
        )
    else:
        metafunc.parametrize(
            "run", [pytest.param(run, id=f"{run.method}-{run.dataset}") for run in session.runs]
        )


def test_listing(run: Run) -> None:
    """Every sample can be listed, and a complete copy lists what was published."""
    if problem := listing_problem(run):
        pytest.fail(problem, pytrace=False)


def test_contract(run: Run, check: ContractCheck, request: pytest.FixtureRequest) -> None:
    """The method keeps the contract on a few samples; a known violation still happens."""
    stage = cpas_session(request.config).stages[run]
    result = stage.result(check)
    if result is None:
        skip(request.node, f"no shard has checked {check.name}")
    request.node.stash[ITEM_RESULT] = ItemResult(contract=result)
    if result.known and result.violated:
        known_failure(request.node, f"known: {result.message}")
    if result.known:
        pytest.fail(
            f"{check.name} is a known violation of {run.method}, but it holds; remove its"
            " [[contract]] entry from the known failures beside the method",
            pytrace=False,
        )
    if result.wrong:
        lines = [
            f"the adapter is wrong: {run.method} on {run.dataset}, {check.name}: {result.message}",
            f"demanded: {check.statement[0].lower()}{check.statement[1:]}",
            *(stage.explanation if check.smoke else ()),
        ]
        pytest.fail("\n".join(lines), pytrace=False)
    if result.outcome is Outcome.NOT_OFFERED:
        skip(request.node, f"{check.name}: {result.message}")
    if result.violated:
        skip(
            request.node,
            f"information, not demanded of {run.method}: {check.name}: {result.message}",
        )


def test_sample(run: Run, refs: list[SampleRef], request: pytest.FixtureRequest) -> None:
    """The sample can be read, the method answers, and the answer keeps the contract."""
    session = cpas_session(request.config)
    result = request.node.stash[ITEM_RESULT] = ItemResult()
    errors = []
    # the others were judged before the run was killed; of those a few are judged again
    collected = session.collected[run]
    refs = [ref for ref in refs if ref.id not in collected.rows or ref.id in collected.judged_again]
    if refs and (obstacle := session.obstacle(run)):
        skip(request.node, f"the adapter is wrong: {obstacle}")
    for ref in refs:
        try:
            row = run.judge(ref)
            if (kept := collected.judged_again.get(ref.id)) is not None:
                if told := collected.contradiction(row, kept):
                    errors.append(SampleError(told))
                    result.errors.append((ref.id, told))
                continue
            result.rows.append(row)
            session.keep(run, row)
        except SampleError as error:
            errors.append(error)
            result.errors.append((ref.id, str(error)))
        except ResultsError as error:  # a disk does not take the answer
            end_run(error)
        except BaseException as error:  # whatever a method raises that is no exception of a method
            if ref.id in collected.judged_again:
                result.errors.append((ref.id, f"judged again, it raised {type(error).__name__}"))
            raise
    if len(errors) == 1 and errors[0].__cause__ is not None:
        raise errors[0]
    if errors:
        pytest.fail("\n".join(str(error) for error in errors), pytrace=False)
