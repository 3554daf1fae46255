"""One item per metric implementation and property."""

from __future__ import annotations

import pytest

from pytest_cpas.checks.metrics import PROPERTIES, Property, Subject, check, replay
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.session.metrics_session import RESULT, MetricsSession
from pytest_cpas.session.suite_session import known_failure, skip


def _session(config: pytest.Config) -> MetricsSession:
    session = config.pluginmanager.get_plugin("cpas-metrics-session")
    assert isinstance(session, MetricsSession), "the suite needs --cpas-metrics"
    return session


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrise by implementation and property."""
    metafunc.parametrize(
        ("subject", "prop"),
        [
            pytest.param(subject, prop, id=f"{subject.name}-{prop.name}")
            for subject in _session(metafunc.config).subjects
            for prop in PROPERTIES.values()
        ],
    )


def test_metric(subject: Subject, prop: Property, request: pytest.FixtureRequest) -> None:
    """The property holds; a recorded violation still happens."""
    session = _session(request.config)
    known = session.known_failure(subject, prop.name)
    with session.within_time(subject, prop.name):
        if known is None:
            options = session.options
            result = check(
                subject, prop, seed=options.seed, examples=session.examples, shrink=options.shrink
            )
        else:
            result = replay(subject, prop, known.case)
    as_recorded = known is not None and result.outcome is known.outcome
    request.node.stash[RESULT] = (result, as_recorded)
    if result.outcome is Outcome.NOT_OFFERED and known is None:
        skip(request.node, f"{subject.name} does not offer it")
    if as_recorded:
        known_failure(request.node, f"known: {result.outcome.value}: {result.message}")
    if known is not None:
        pytest.fail(
            f"{prop.name}: recorded as {known.outcome.value}, but it is {result.outcome.value}"
            f" {result.message}\nrecord the violations anew with --snapshot-update",
            pytrace=False,
        )
    if result.outcome is not Outcome.PASSED and not session.options.update:
        pytest.fail(
            f"{prop.name}: {result.outcome.value}: {result.message}\n"
            f"property: {prop.statement}\nreason: {prop.reason}\n\n{result.snippet}",
            pytrace=False,
        )
