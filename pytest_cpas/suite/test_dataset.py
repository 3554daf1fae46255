"""One item per sample (or group of samples): measure it. The checks are judged at the end."""

from __future__ import annotations

import pytest

from pytest_cpas.session.checked_dataset import CheckedDataset
from pytest_cpas.session.dataset_session import SURVEY, DatasetSession
from pytest_cpas.session.suite_session import grouped
from pytest_cpas.types import SampleRef


def _session(config: pytest.Config) -> DatasetSession:
    session = config.pluginmanager.get_plugin("cpas-dataset-session")
    assert isinstance(session, DatasetSession), "the suite needs --cpas-check-dataset"
    return session


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrise by data set, and by sample (or group of samples)."""
    session = _session(metafunc.config)
    metafunc.parametrize(
        ("checked", "refs"),
        [
            pytest.param(checked, refs, id=f"{checked.name}-{name}")
            for checked in session.checked
            for name, refs in grouped(checked.refs, session.options.granularity)
        ],
    )


def test_measure(
    checked: CheckedDataset, refs: list[SampleRef], request: pytest.FixtureRequest
) -> None:
    """The sample is measured; one that cannot be read is a matter of the check `readable`."""
    request.node.stash[SURVEY] = checked.measure(refs)
