"""Methods and revisions in processes of their own."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from harness import RUN
from report_schema import follow_schema

from pytest_cpas.evaluation import Adapter, served_method
from pytest_cpas.timing.workers import TimingError, Worker

#: A method whose worker has the clock that the method says.
ADAPTER = """
import __main__, os, random
from tiny import *

SECONDS, NOISE = [0.0], random.Random(1)
TAKES = 0.1

class Revised(Perfect):
    takes = TAKES

    def load(self, assets, device):
        super().load(assets, device)
        if hasattr(__main__, "SCHEDSTAT"):
            __main__.now = lambda: SECONDS[0]

    def predict(self, batch, seed):
        print("methods print")
        os.write(1, b"and their libraries too\\n")
        SECONDS[0] += self.takes * NOISE.lognormvariate(0, 0.02)
        return super().predict(batch, seed)

class Slow(Revised):
    takes = 1.3 * TAKES

class Raises(Revised):
    def predict(self, batch, seed):
        raise RuntimeError("the network exploded")

class Dies(Revised):
    def predict(self, batch, seed):
        print("out of memory", flush=True)
        os._exit(9)
"""


def git(folder, *arguments):
    name = ("-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false")
    subprocess.run(["git", *name, *arguments], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def rivals(cpas, pytester, monkeypatch):
    """Run a method of ADAPTER against another one, each in a worker."""
    monkeypatch.delitem(sys.modules, "adapter", raising=False)
    (pytester.path / "adapter.py").write_text(ADAPTER)

    def run(method, against, *args):
        names = (f"--cpas-method=adapter:{method}", "--cpas-dataset=tiny:Tiny", "--cpas-benchmark")
        asked = (f"--cpas-benchmark-against={against}", "-k=test_speed", "--cpas-report=out")
        result = pytester.runpytest_inprocess(*RUN, *names, *asked, *args)
        content = json.loads((pytester.path / "out" / "report.json").read_text())
        follow_schema(content)
        run.speed = content["runs"][0]["speed"]
        return result

    return run


def test_a_slower_method_than_another_is_caught(rivals):
    result = rivals("Slow", "adapter:Revised", "--cpas-benchmark-fail=20%")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["SLOWER: 1.3 times the time of adapter:Revised *"])
    reference = rivals.speed["reference"]
    assert (reference["kind"], reference["name"]) == ("method", "adapter:Revised")
    assert rivals.speed["slowdown"]["median"] == pytest.approx(1.3, rel=0.02)
    assert rivals("Revised", "adapter:Slow", "--cpas-benchmark-fail=20%").ret == 0
    assert rivals.speed["verdict"]["word"] == "FASTER"


def test_a_slower_revision_is_caught(rivals, pytester):
    git(pytester.path, "init", "-q")
    git(pytester.path, "add", ".")
    git(pytester.path, "commit", "-qm", "quick")
    path = pytester.path / "adapter.py"
    path.write_text(ADAPTER.replace("TAKES = 0.1", "TAKES = 0.13"))
    git(pytester.path, "commit", "-qam", "slow")
    # imported by runs in this process
    sys.modules.pop("adapter", None)
    result = rivals("Revised", "git:HEAD~1", "--cpas-benchmark-fail=20%")
    assert (result.ret, rivals.speed["verdict"]["word"]) == (1, "SLOWER")
    assert rivals.speed["reference"]["kind"] == "revision"
    assert rivals.speed["reference"]["seconds"]["median"] == pytest.approx(0.1, rel=0.02)
    assert rivals.speed["seconds"]["median"] == pytest.approx(0.13, rel=0.02)
    result = rivals("Revised", "git:HEAD", "--cpas-benchmark-fail=20%")
    assert (result.ret, rivals.speed["verdict"]["word"]) == (0, "NOT SLOWER")


@pytest.mark.parametrize(
    ("method", "messages"),
    [
        ("Raises", ["adapter:Revised*", "*RuntimeError: the network exploded"]),
        ("Dies", ["*the worker of * ended with exit status 9:*", "*out of memory*"]),
    ],
)
def test_what_goes_wrong_in_a_worker_is_told(rivals, method, messages):
    result = rivals("Revised", f"adapter:{method}")
    assert result.ret == 1
    result.stdout.fnmatch_lines([messages[-1]])
    assert rivals.speed is None


def test_another_revision_must_be_what_is_imported(pytester, tmp_path):
    shutil.copy(Path(__file__).parents[1] / "tiny.py", pytester.path)
    file = tmp_path / "observations.npz"
    served_method.write_observations(file, [])
    adapter = Adapter("json", "JSONDecoder", tree=tmp_path, first=(tmp_path,))
    with pytest.raises(TimingError, match=r"json was imported from .*, not from the revision in"):
        Worker("git:HEAD", adapter, file, weights=None, seed=0, device="cpu")


def test_observations_survive_the_way_to_a_worker(tmp_path, cpas, pytester, monkeypatch):
    monkeypatch.syspath_prepend(pytester.path)
    import tiny

    dataset = tiny.Tiny(None)
    seen = [dataset.load(ref).observation for ref in dataset.samples[:3]]
    served_method.write_observations(tmp_path / "o.npz", seen)
    for before, after in zip(
        seen, served_method.read_observations(tmp_path / "o.npz"), strict=True
    ):
        assert (before.category, before.camera) == (after.category, after.camera)
        for part in ("rgb", "depth", "mask"):
            assert np.array_equal(getattr(before, part), getattr(after, part))
