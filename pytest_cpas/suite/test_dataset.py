"""One item per sample (or group of samples): measure it. The checks are judged at the end."""

from __future__ import annotations

import pytest

from pytest_cpas.checks.dataset.facts import Survey
from pytest_cpas.session.dataset_session import FOUND, Checked, DatasetSession
from pytest_cpas.session.suite_session import grouped
from pytest_cpas.types import SampleRef


def _session(config: pytest.Config) -> DatasetSession:
    session = config.pluginmanager.get_plugin("cpas-dataset-session")
    assert isinstance(session, DatasetSession), "the suite needs --cpas-check-dataset"
    return session


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrise by data set, and by sample (or group of samples)."""
    granularity = metafunc.config.option.cpas_granularity
    metafunc.parametrize(
        ("checked", "refs"),
        [
            pytest.param(checked, refs, id=f"{checked.survey.name}-{name}")
            for checked in _session(metafunc.config).checked
            for name, refs in grouped(checked.refs, granularity)
        ],
    )


def test_measure(checked: Checked, refs: list[SampleRef], request: pytest.FixtureRequest) -> None:
    """The sample is measured; one that cannot be read is a matter of the check `readable`."""
    found = request.node.stash[FOUND] = Survey.of(checked.dataset, checked.meshes)
    for ref in refs:
        found.examine(checked.dataset, ref)
    checked.meshes.update(found.meshes)
