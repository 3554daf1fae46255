"""One item per sample: its trace is recorded, and compared with the reference's.

Whether the two part is judged over all samples, after the last.
"""

from __future__ import annotations

import pytest

from pytest_cpas.evaluation import SampleError
from pytest_cpas.session.parity_session import TRACED, parity_session
from pytest_cpas.session.suite_session import end_run, grouped, skip
from pytest_cpas.traces.running import TracedRun
from pytest_cpas.types import SampleRef


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrise by run, and by sample (or group of samples)."""
    session = parity_session(metafunc.config)
    metafunc.parametrize(
        ("traced", "refs"),
        [
            pytest.param(traced, refs, id=f"{traced.run.method}-{traced.run.dataset}-{name}")
            for traced in session.traced_runs
            for name, refs in grouped(traced.run.samples, session.cpas.options.granularity)
        ],
    )


def test_parity(traced: TracedRun, refs: list[SampleRef], request: pytest.FixtureRequest) -> None:
    """The sample can be traced, on both sides."""
    session = parity_session(request.config)
    if obstacle := session.cpas.obstacle(traced.run):
        skip(request.node, f"the adapter is wrong: {obstacle}")
    found = request.node.stash[TRACED] = []
    errors = []
    for ref in refs:
        try:
            made = traced.trace(ref)
        except SampleError as error:
            errors.append(error)
        except OSError as error:  # a disk does not take it
            end_run(error)
        else:
            found += [] if made is None else [made]
    if len(errors) == 1 and errors[0].__cause__ is not None:
        raise errors[0]
    if errors:
        pytest.fail("\n".join(str(error) for error in errors), pytrace=False)
