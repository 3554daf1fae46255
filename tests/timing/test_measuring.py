"""Rounds, and what is measured in one process."""

import gc
import math
import subprocess
import sys
import threading
import types
from pathlib import Path

import numpy as np
import pytest

from pytest_cpas import stages
from pytest_cpas.timing import contestant
from pytest_cpas.timing.calibration import Calibration, CpuKernel, TorchKernel
from pytest_cpas.timing.contestant import Contestant, PeakMemory
from pytest_cpas.timing.measuring import SAMPLES, Rounds, timed_samples
from pytest_cpas.types import ContractError, SampleRef

# -- rounds ------------------------------------------------------------------------------------


class Drifting:
    """Takes so many seconds, ever more of them with every call of any contestant."""

    def __init__(self, name, seconds, calls):
        self.name, self.seconds, self.calls = name, seconds, calls

    def run(self, index):
        self.calls.append((self.name, index))
        return self.seconds * math.exp(0.1 * len(self.calls))


def test_order_and_drift_cancel():
    calls: list[tuple[str, int]] = []
    rounds = Rounds(Drifting("c", 2.6, calls), Drifting("r", 2.0, calls), 3)
    for _ in range(12):
        rounds.setup()
        rounds.time_candidate()
        rounds.teardown()
    order = "".join(name for name, _ in calls)
    assert order == "crrc" + "rccr" + "crrc" + "rccr" + "crrc" + "rccr"
    assert [index for _, index in calls[::4]] == [0, 1, 2, 0, 1, 2]
    assert [sample for sample, _ in rounds.ratios] == [0, 1, 2, 0, 1, 2]
    assert [ratio for _, ratio in rounds.ratios] == pytest.approx([1.3] * 6, rel=1e-12)
    assert [len(group) for group in rounds.by_sample()] == [2, 2, 2]
    assert rounds.elapsed() == pytest.approx(sum(rounds.candidate_seconds))


class Listed:
    """A run whose samples of the first category are damaged, but for one."""

    dataset = "d"

    def __init__(self, *counts):
        self.samples = [
            SampleRef(id=f"{kind:02d}/{i:03d}", category=f"kind{kind:02d}", scene="s")
            for kind, count in enumerate(counts)
            for i in range(count)
        ]

    def read(self, ref):
        if ref.category == "kind00" and ref.id != "00/009":
            raise ContractError("torn")
        return ref


def test_timed_samples_are_spread_over_the_categories():
    run = Listed(10, 100, 3)
    names = {ref.category for ref in run.samples}
    assert [ref.id for ref in timed_samples(run, names)] == [
        "00/009", *(f"01/{i:03d}" for i in (0, 25, 50, 75)), "02/000", "02/001", "02/002",
    ]  # fmt: skip
    assert [ref.id for ref in timed_samples(run, ["kind02"])] == ["02/000", "02/001", "02/002"]
    many = Listed(*[20] * 30)
    found = timed_samples(many, {ref.category for ref in many.samples})
    assert len(found) <= SAMPLES
    assert len({ref.category for ref in found}) == len(found) > SAMPLES - 2
    with pytest.raises(ContractError, match="d: no samples of can"):
        timed_samples(run, ["can"])
    with pytest.raises(ContractError, match="no sample of d can be read"):
        timed_samples(Listed(5), ["kind00"])


# -- one process -------------------------------------------------------------------------------


class Recorder:
    """A method, and a torch, that say what was called."""

    def __init__(self):
        self.calls = []

    def predict(self, batch, seed):
        self.calls.append(("predict", *batch, seed, gc.isenabled()))
        with stages.stage("network"):
            pass


def fake_torch(calls):
    cuda = types.SimpleNamespace(
        synchronize=lambda device: calls.append(("synchronize", device)),
        reset_peak_memory_stats=lambda device: calls.append(("reset", device)),
        max_memory_allocated=lambda device: 123 * 2**20,
        get_device_name=lambda device: "A GPU",
    )
    version = types.SimpleNamespace(cuda="12.6")
    return types.SimpleNamespace(
        cuda=cuda, version=version, __version__="2.9", get_num_threads=lambda: 3
    )


def test_a_device_is_waited_for_before_and_after(monkeypatch):
    method = Recorder()
    monkeypatch.setitem(sys.modules, "torch", fake_torch(method.calls))
    Contestant(method, ["seen"], 5, "cuda:1").run(0)
    wait = ("synchronize", "cuda:1")
    assert method.calls == [wait, ("predict", "seen", 5, False), wait]
    assert gc.isenabled()
    method.calls.clear()
    Contestant(method, ["seen"], 5, "cpu").run(0)
    assert method.calls == [("predict", "seen", 5, False)]


def test_stages_wait_for_the_device_and_memory_is_that_of_the_device(monkeypatch):
    method = Recorder()
    monkeypatch.setitem(sys.modules, "torch", fake_torch(method.calls))
    told = Contestant(method, ["a", "b"], 0, "cuda").examine()
    assert told["memory"]["device_bytes"] == 123 * 2**20
    assert [call[0] for call in method.calls[:5]] == [
        "reset",
        "synchronize",
        "predict",
        "synchronize",
        "synchronize",
    ]
    assert (list(told["stages"]), told["predictions"]) == (["network"], 2)
    assert told["total"] > told["stages"]["network"] > 0


def test_facts_name_device_threads_and_versions(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", fake_torch([]))
    told = Contestant(Recorder(), [], 0, "cuda").facts()
    assert told["device"] == "A GPU"
    assert (told["threads"]["torch"], told["versions"]["torch"]) == (3, "2.9")
    assert (told["versions"]["cuda"], told["versions"]["numpy"]) == ("12.6", np.__version__)
    on_cpu = Contestant(Recorder(), [], 0, "cpu").facts()
    assert (on_cpu["device"], "cuda" in on_cpu["versions"]) == ("cpu", False)
    monkeypatch.delitem(sys.modules, "torch")
    assert "torch" not in Contestant(Recorder(), [], 0, "cpu").facts()["versions"]


def test_driver_version_is_read_from_the_kernel_module(monkeypatch, tmp_path):
    line = "NVRM version: NVIDIA UNIX x86_64 Kernel Module  550.90.07  Fri May 31 09:35:42 UTC 2024"
    (tmp_path / "version").write_text(line + "\nGCC version: gcc 12.3.0\n")
    monkeypatch.setattr(contestant, "Path", lambda _: tmp_path / "version")
    assert contestant._driver() == {"driver": "550.90.07"}
    monkeypatch.setattr(contestant, "Path", lambda _: tmp_path / "none")
    assert contestant._driver() == {}


#: In a process of its own: that of the tests has gigabytes, of which a system may take some back.
PEAK = """
import numpy as np
from pytest_cpas.timing.contestant import PeakMemory
def held(megabytes):
    block = np.ones(megabytes * 2**17)
    return block[-1]
held(400)
peak = PeakMemory("cpu")
before = peak.peak()["host_bytes"]
held(200)
after = peak.peak()
print(after["host_bytes"] - before, after["host_source"], after["device_bytes"])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the mark is Linux's")
def test_peak_memory_is_that_since_it_was_asked_for():
    told = subprocess.run(
        [sys.executable, "-c", PEAK], capture_output=True, text=True, check=True
    ).stdout
    grown, source, device = told.split()
    if source == contestant.PROCESS:
        pytest.skip("this system does not let the high-water mark begin anew")
    assert 190 * 2**20 < int(grown) < 300 * 2**20
    assert (source, device) == ("predictions", "None")


def test_peak_of_the_process_where_there_is_no_mark(monkeypatch):
    def refused(self, text):
        raise PermissionError

    monkeypatch.setattr(Path, "write_text", refused)
    told = PeakMemory("cpu").peak()
    assert told["host_source"] == "process"
    assert told["host_bytes"] > 10 * 2**20


def test_the_clock_stands_still_while_others_have_the_core(monkeypatch, tmp_path):
    instants = iter([10.0, 11.0, 12.0])
    waited = iter([b"9 1000000000 1", b"9 3000000000 2", b"9 3000000000 3", b"9 3000000000 3"])
    monkeypatch.setattr(contestant.time, "perf_counter", lambda: next(instants))
    file = types.SimpleNamespace(read_bytes=lambda: next(waited))
    monkeypatch.setattr(contestant, "SCHEDSTAT", file)
    # it waited between the first two readings, so the instant between them is of no use
    assert contestant.now() == 11.0 - 3.0
    monkeypatch.setattr(contestant, "SCHEDSTAT", tmp_path / "none")
    assert contestant.now() == 12.0
    assert Contestant(Recorder(), [], 0, "cpu").facts()["clock"] == "wall clock"


def test_sleeping_counts():
    woken = threading.Event()
    assert contestant.seconds_of(lambda: woken.wait(0.02), lambda: None) > 0.015


def test_stages_cost_nothing_unless_somebody_listens():
    assert stages.stage("network") is stages.stage("other")
    with stages.stage("network"):
        pass
    times = iter(range(100))
    clock = stages.StageClock(lambda: float(next(times)), lambda: None)
    with clock.listening():
        with stages.stage("one"), stages.stage("inner"):
            pass
        for _ in range(2):
            with stages.stage("two"):
                pass
        with pytest.raises(KeyError), stages.stage("raises"):
            raise KeyError
        with pytest.raises(RuntimeError, match="already"), clock.listening():
            pass
    assert clock.seconds == {"one": 1.0, "two": 2.0, "raises": 1.0}
    with stages.stage("nobody"):
        pass
    assert "nobody" not in clock.seconds


def test_kernels_do_the_same_every_time():
    kernel = CpuKernel()
    assert kernel() == kernel() == CpuKernel()()
    pytest.importorskip("torch")
    same = TorchKernel("cpu")
    assert same() == same() == TorchKernel("cpu")()


def test_a_repeated_kernel_is_told_per_kernel():
    kernel = types.SimpleNamespace(name="k")
    done = []

    def timed(call):
        call()
        return 3.0

    class Kernel:
        name = "k"

        def __call__(self):
            done.append(1)
            return 0.0

    calibration = Calibration(Kernel(), timed)
    calibration.repeat(6)
    assert (calibration.run(0), len(done), calibration.name) == (0.5, 6, kernel.name)
