import os
import shutil
import sys
from collections import Counter
from pathlib import Path

import hypothesis  # noqa: F401 - else every run of pytest in this process imports it anew
import pytest
from harness import RUN

import pytest_cpas.session.method_session  # noqa: F401 - runs in this process must share our modules

pytest_plugins = ["pytester"]


@pytest.hookimpl(tryfirst=True)  # before marks select
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    cases: Counter[str] = Counter()
    for item in items:
        if (mark := item.get_closest_marker("thinned")) is not None:
            name = item.nodeid.partition("[")[0]
            if cases[name] % mark.args[0]:
                item.add_marker("minutes")
            cases[name] += 1


@pytest.fixture(scope="session")
def test_data() -> Path:
    """The folder of real data, which is not part of this repository."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("CPAS_TEST_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder} (set CPAS_TEST_DATA)")
    return folder.resolve()


@pytest.fixture
def cpas(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch):
    """Run ``method`` on ``dataset`` of tests/tiny.py with further arguments."""
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    # runs in this process import the copy, whatever tests import
    monkeypatch.delitem(sys.modules, "tiny", raising=False)
    shutil.copy(Path(__file__).with_name("tiny.py"), pytester.path)
    (pytester.path / "golden").mkdir()

    def run(method: str, *args: str, dataset: str = "Tiny") -> pytest.RunResult:
        names = ("--cpas-method", f"tiny:{method}", "--cpas-dataset", f"tiny:{dataset}")
        start = pytester.runpytest_subprocess if "-n2" in args else pytester.runpytest_inprocess
        return start(*RUN, *names, *args)

    return run


@pytest.fixture
def recorded(cpas):
    """The same, with a golden table of the perfect method."""
    assert cpas("Perfect", "--snapshot-update").ret == 0
    return cpas
