"""Run times: the statistics against independent truths, verdicts with clocks of our own."""

import gc
import json
import math
import shutil
import subprocess
import sys
import threading
import types
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
from harness import RUN
from report_schema import follow_schema

from pytest_cpas import stages
from pytest_cpas.timing import contestant, machine, running
from pytest_cpas.timing.calibration import Calibration, CpuKernel, TorchKernel
from pytest_cpas.timing.contestant import Contestant, PeakMemory
from pytest_cpas.timing.intervals import (
    ERROR,
    LOOK_CONFIDENCE,
    LOOKS,
    Interval,
    decide,
    median_interval,
    quotient,
    relative_to_others,
)
from pytest_cpas.timing.measuring import SAMPLES, Rounds, timed_samples
from pytest_cpas.timing.records import RecordError, SpeedRecord, read_record
from pytest_cpas.timing.verdicts import parse_limit
from pytest_cpas.timing.workers import Adapter, TimingError, Worker
from pytest_cpas.types import ContractError, SampleRef

# -- statistics ---------------------------------------------------------------------------------


@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.99, LOOK_CONFIDENCE])
def test_interval_is_made_of_the_order_statistics_that_the_binomial_gives(confidence):
    for count in range(12, 120):
        found = median_interval([float(i) for i in range(count)], confidence)
        lower, upper = int(found.lower), int(found.upper)
        assert upper == count - 1 - lower
        # the chance that no more than `lower` of the values lie below the median, on both sides
        assert 2 * scipy.stats.binom.cdf(lower, count, 0.5) <= 1 - confidence + 1e-12
        assert 2 * scipy.stats.binom.cdf(lower + 1, count, 0.5) > 1 - confidence
        assert found.median == np.median(range(count))


def test_interval_needs_enough_values():
    assert median_interval([3.0, 1.0, 2.0, 5.0, 4.0], 0.93).lower == 1.0
    with pytest.raises(ValueError, match=r"5 values hold their median with less than 0\.95"):
        median_interval([1.0, 2.0, 3.0, 4.0, 5.0], 0.95)


@pytest.mark.parametrize("count", [12, 24, 48])
@pytest.mark.parametrize("distribution", ["lognormal", "cauchy", "bimodal"])
def test_interval_holds_the_true_median_as_often_as_it_says(count, distribution):
    generator = np.random.default_rng(count)
    draws = {
        "lognormal": lambda: generator.lognormal(0, 1, count),
        "cauchy": lambda: 1 + generator.standard_cauchy(count),
        # the median is where there is nearly nothing
        "bimodal": lambda: 1 + generator.choice([-3, 3], count) + generator.normal(0, 1, count),
    }
    trials, confidence = 3000, 0.95
    held = 0
    for _ in range(trials):
        found = median_interval(draws[distribution]().tolist(), confidence)
        held += found.lower <= 1 <= found.upper
    assert scipy.stats.binomtest(held, trials, confidence, "less").pvalue > 1e-4


def test_looking_several_times_is_paid_for():
    """At the limit itself, SLOWER at any look is wrong; its share of the error is one half."""
    generator = np.random.default_rng(0)
    trials, wrong = 4000, 0
    for ratios in 1.2 * generator.lognormal(0, 0.3, (trials, LOOKS[-1])):
        found = "undecided"
        for look in LOOKS:
            if found == "undecided":
                found = decide(median_interval(ratios[:look].tolist(), LOOK_CONFIDENCE), 1.2)
        wrong += found == "slower"
    assert scipy.stats.binomtest(wrong, trials, ERROR / 2, "greater").pvalue > 1e-4


def test_decisions():
    def of(lower, upper):
        return decide(Interval(1.0, lower, upper, 0.99), 1.2)

    assert of(1.21, 1.5) == "slower"
    assert of(1.2, 1.5) == of(1.0, 1.21) == "undecided"
    assert of(0.5, 1.2) == of(0.9, 1.1) == "not slower"
    assert of(0.5, 0.83) == "faster"


def test_quotient_covers_the_worst_of_both():
    over, under = Interval(3.0, 2.0, 4.0, 0.99), Interval(1.5, 1.0, 2.0, 0.98)
    found = quotient(over, under)
    assert (found.median, found.lower, found.upper) == (2.0, 1.0, 4.0)
    assert found.confidence == pytest.approx(0.97)


def test_relative_to_others_leaves_a_value_out_of_its_own_measure():
    found = relative_to_others([[2.0, 4.0], [5.0, 1.0, 2.0]])
    assert found == pytest.approx([0.5, 2.0, 5.0 / 1.5, 1 / 3.5, 2 / 3])


@pytest.mark.parametrize("planted", [1.0, 1.3])
def test_a_record_and_a_run_of_it_hold_the_slowdown(planted):
    """Samples differ by a factor of ten; how often the interval misses the planted slow-down."""
    generator = np.random.default_rng(7)
    trials, held = 300, 0
    for _ in range(trials):
        level = generator.uniform(1, 10, 12)
        names = [f"s{i}" for i in range(12)]
        before = [(level[i] * generator.lognormal(0, 0.1, 4)).tolist() for i in range(12)]
        record = SpeedRecord.of(names, before, {}, {})
        now = planted * level * generator.lognormal(0, 0.1, 12)
        found = record.slowdown(list(zip(names, now.tolist(), strict=True)))
        held += found.lower <= planted <= found.upper
    assert scipy.stats.binomtest(held, trials, 1 - ERROR, "less").pvalue > 1e-3


@pytest.mark.parametrize(
    ("text", "factor"), [("20%", 1.2), ("0.2", 1.2), (" 5 %", 1.05), ("150%", 2.5), ("1e-2", 1.01)]
)
def test_limit(text, factor):
    assert parse_limit(text) == pytest.approx(factor)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("much", "expected by how much longer is too much, such as 20% or 0.2"),
        ("", "is '', expected"),
        ("%", "is '%', expected"),
        ("-20%", "expected"),
        ("0", "expected"),
        ("nan", "expected"),
        ("inf", "expected"),
        ("20", "which is 2000 %: write 20%, or 2000% if that is meant"),
    ],
)
def test_limit_that_is_none(text, message):
    with pytest.raises(ValueError, match=message):
        parse_limit(text)


# -- rounds -------------------------------------------------------------------------------------


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


# -- one process --------------------------------------------------------------------------------


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


@pytest.mark.skipif(sys.platform != "linux", reason="the mark is Linux's")
def test_peak_memory_is_that_since_it_was_asked_for():
    def held(megabytes):
        block = np.ones(megabytes * 2**17)
        return block[-1]

    held(400)
    peak = PeakMemory("cpu")
    if peak._source == contestant.PROCESS:
        pytest.skip("this system does not let the high-water mark begin anew")
    before = peak.peak()["host_bytes"]
    held(200)
    after = peak.peak()
    assert 190 * 2**20 < after["host_bytes"] - before < 300 * 2**20
    assert (after["host_source"], after["device_bytes"]) == ("predictions", None)


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


# -- runs with a clock of our own ---------------------------------------------------------------

CLOCKED = """
import itertools, random
from tiny import *
from pytest_cpas.stages import stage

SECONDS = [0.0]
NOISE = random.Random(3)
SPREAD = 0.02

def pass_time(seconds):
    SECONDS[0] += seconds * NOISE.lognormvariate(0, SPREAD)

class Clocked(Perfect):
    takes = 0.1

    def predict(self, batch, seed):
        for seen in batch:
            with stage("pre-processing"):
                pass_time(0.25 * self.takes)
            with stage("network"):
                pass_time(0.75 * self.takes)
        return super().predict(batch, seed)

class Slow(Clocked):
    takes = 0.13

class Quick(Clocked):
    takes = 0.05

class Border(Clocked):
    takes = 0.12

class OnlyTimedOnce(Clocked):
    calls = 0
    def predict(self, batch, seed):
        OnlyTimedOnce.calls += 1
        if OnlyTimedOnce.calls > 20:
            raise RuntimeError("the network exploded")
        return super().predict(batch, seed)

class Wrong(Clocked):
    def answer(self, index):
        (best,) = super().answer(index).hypotheses
        return Prediction((replace(best, translation=1000 * best.translation),))
"""


@pytest.fixture
def clocked(cpas, pytester, monkeypatch):
    """Run a method of CLOCKED, timed; time is what it says."""
    monkeypatch.delitem(sys.modules, "clocked", raising=False)
    (pytester.path / "clocked.py").write_text(CLOCKED)

    def time_of_module():
        return sys.modules["clocked"].SECONDS[0]

    class Kernel:
        name = "fake-1"

        def __call__(self):
            sys.modules["clocked"].pass_time(0.01)
            return 0.0

    monkeypatch.setattr(contestant, "now", time_of_module)
    monkeypatch.setattr(running, "kernel_for", lambda device: Kernel())
    monkeypatch.setattr(machine, "_cpu", lambda: "Some CPU @ 3 GHz")

    def run(method, *args):
        names = (f"--cpas-method=clocked:{method}", "--cpas-dataset=tiny:Tiny")
        asked = ("--cpas-benchmark", "--cpas-report=out", "-k", "test_speed")
        result = pytester.runpytest_inprocess(*RUN, *names, *asked, *args)
        report = pytester.path / "out" / "report.json"
        content = json.loads(report.read_text()) if report.exists() else None
        report.unlink(missing_ok=True)
        if content is not None:
            follow_schema(content)
            run.speed = content["runs"][0]["speed"]
            run.outcome = content["runs"][0]["outcome"]
        return result

    return run


RECORD = "golden/speed/perfect/tiny/some-cpu-3-ghz.toml"


def test_a_recorded_ratio_judges_later_runs(clocked, pytester):
    result = clocked("Clocked", "--snapshot-update")
    assert result.ret == 0
    result.stdout.fnmatch_lines(["*speed: RECORDED: *some-cpu-3-ghz.toml"])
    # the golden table is recorded by a run of samples
    assert not (pytester.path / "golden" / "recorded").exists()
    record = read_record(pytester.path / RECORD)
    assert record.ratios == pytest.approx(dict.fromkeys(record.ratios, 10.0), rel=0.05)
    assert len(record.ratios) == 12

    assert clocked("Clocked", "--cpas-benchmark-fail=20%").ret == 0
    assert clocked.speed["verdict"]["word"] == "NOT SLOWER"
    assert clocked.speed["verdict"]["limit"] == 1.2
    assert clocked.speed["slowdown"]["median"] == pytest.approx(1, rel=0.02)
    assert clocked.speed["rounds"] == 2 * LOOKS[0]

    result = clocked("Slow", "--cpas-benchmark-fail=20%", "--junitxml=junit.xml")
    assert result.ret == 1
    assert (clocked.speed["verdict"]["word"], clocked.outcome) == ("SLOWER", "failed")
    result.stdout.fnmatch_lines(
        [
            "SLOWER: 1.3 times the recorded time, relative to the calibration kernel*allowed*1.2*",
            "*speed: SLOWER: *",
        ]
    )
    assert 'failures="1"' in (pytester.path / "junit.xml").read_text()

    assert clocked("Quick", "--cpas-benchmark-fail=20%").ret == 0
    assert clocked.speed["verdict"]["word"] == "FASTER"
    assert clocked("Slow").ret == 0
    assert clocked.speed["verdict"]["word"] == "MEASURED"


def test_between_the_limits_is_undecided(clocked):
    clocked("Clocked", "--snapshot-update")
    result = clocked("Border", "--cpas-benchmark-fail=0.2")
    assert (result.ret, clocked.speed["verdict"]["word"]) == (0, "UNDECIDED")
    assert clocked.speed["rounds"] == 2 * LOOKS[-1]
    result.assert_outcomes(skipped=2, deselected=result.parseoutcomes()["deselected"])
    assert clocked("Border", "--cpas-benchmark-fail=0.2", "--cpas-require-golden").ret == 1
    assert clocked.speed["verdict"]["outcome"] == "failed"


def test_a_ratio_of_another_machine_is_not_compared(clocked, pytester, monkeypatch):
    clocked("Clocked", "--snapshot-update")
    monkeypatch.setattr(machine, "_cpu", lambda: "Other CPU")
    result = clocked("Slow", "--cpas-benchmark-fail=20%")
    assert (result.ret, clocked.speed["verdict"]["word"]) == (0, "NOT COMPARED")
    assert clocked.speed["slowdown"] is None
    result.stdout.fnmatch_lines(["*only on some-cpu-3-ghz; for this one, other-cpu, record it*"])
    assert clocked("Slow", "--cpas-benchmark-fail=20%", "--cpas-require-golden").ret == 1
    assert clocked.speed["verdict"]["outcome"] == "failed"
    monkeypatch.setattr(machine, "_cpu", lambda: "Some CPU @ 3 GHz")
    monkeypatch.setattr(machine, "_cores", lambda: 64)
    result = clocked("Slow", "--cpas-benchmark-fail=20%", "--cpas-seed=7")
    assert (result.ret, clocked.speed["verdict"]["word"]) == (0, "NOT COMPARED")
    result.stdout.fnmatch_lines(
        ["*under other conditions: cores was *, now 64; seed was 0, now 7*"]
    )


def test_a_part_of_the_recorded_samples_will_do_and_others_will_not(clocked):
    clocked("Clocked", "--snapshot-update", "--cpas-category=mug")
    assert clocked("Slow", "--cpas-benchmark-fail=20%", "--cpas-category=mug").ret == 1
    result = clocked("Slow", "--cpas-benchmark-fail=20%")
    assert clocked.speed["verdict"]["word"] == "NOT COMPARED"
    result.stdout.fnmatch_lines(["*6 of 12 samples are others, such as scene_0/0000*"])


def test_a_library_that_only_one_run_has_loaded_is_no_difference(clocked, pytester):
    clocked("Clocked", "--snapshot-update")
    path = pytester.path / RECORD
    more = '"threads of other" = "9"\n[provenance]'
    path.write_text(path.read_text().replace("[provenance]", more))
    assert clocked("Slow", "--cpas-benchmark-fail=20%").ret == 1


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace("format = 1", "format = 2"),
        lambda text: text.replace('"scene_0/0000" = 1', '"scene_0/0000" = -1'),
        lambda text: text.replace("[ratios]", "[other]"),
        lambda text: "ratios = 3",
    ],
)
def test_a_damaged_record_is_named(tmp_path, spoil):
    spread = Interval(1.0, 0.9, 1.1, 0.99)
    text = SpeedRecord({"data": "d"}, {}, {"scene_0/0000": 1.5}, spread).toml()
    path = tmp_path / "cpu.toml"
    path.write_text(text)
    assert read_record(path).toml() == text
    path.write_text(spoil(text))
    with pytest.raises(RecordError, match=r"cpu\.toml: .*damaged or edited by hand"):
        read_record(path)


def test_a_record_that_cannot_be_read_or_written_fails(clocked, pytester, monkeypatch):
    clocked("Clocked", "--snapshot-update")
    path = pytester.path / RECORD
    before = path.read_text()
    replace = Path.replace

    def full(self, target):
        if str(target).endswith(".toml"):
            raise OSError(28, "No space left on device")
        return replace(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        result = clocked("Slow", "--snapshot-update")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*the ratio cannot be recorded*No space left*"])
    assert path.read_text() == before
    assert [other.name for other in path.parent.iterdir()] == [path.name]
    path.write_text("format = ")
    result = clocked("Clocked", "--cpas-benchmark-fail=20%")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*some-cpu-3-ghz.toml: *was damaged or edited by hand*"])


def test_what_is_measured_is_in_both_documents(clocked, pytester):
    assert clocked("Clocked", "--benchmark-json=speed.json").ret == 0
    speed = clocked.speed
    (bench,) = json.loads((pytester.path / "speed.json").read_text())["benchmarks"]
    assert bench["extra_info"]["cpas"] == speed
    assert bench["fullname"] == "cpas-speed::test_speed[perfect-tiny]"
    assert len(bench["stats"]["data"]) == speed["rounds"] == 2 * LOOKS[0]
    assert bench["stats"]["mean"] == pytest.approx(speed["mean_seconds"])
    assert bench["stats"]["median"] == pytest.approx(speed["seconds"]["median"])
    assert speed["seconds"]["median"] == pytest.approx(0.1, rel=0.02)
    assert speed["reference"]["name"] == "fake-1"
    assert speed["reference"]["seconds"]["median"] == pytest.approx(0.01, rel=0.02)
    assert speed["ratio"]["median"] == pytest.approx(10, rel=0.02)
    assert [stage["name"] for stage in speed["stages"]] == ["pre-processing", "network"]
    seconds = [stage["seconds"] for stage in speed["stages"]]
    assert seconds == pytest.approx([0.025, 0.075], rel=0.03)
    assert [stage["share"] for stage in speed["stages"]] == pytest.approx([0.25, 0.75], rel=0.03)
    assert (speed["machine"]["cpu"], speed["published"]) == ("Some CPU @ 3 GHz", None)
    assert speed["memory"]["host_bytes"] > 10 * 2**20


def test_the_paper_stands_beside_and_judges_nothing(clocked, pytester):
    with (pytester.path / "clocked.py").open("a") as file:
        file.write("\nclass Spd(Slow):\n    info = replace(Perfect.info, name='spd')\n")
    result = clocked("Spd", "--cpas-benchmark-fail=20%")
    assert result.ret == 0
    result.stdout.fnmatch_lines(["*the paper: 227 ms (mean) per sample of redwood75, on *TITAN X*"])
    assert clocked.speed["published"]["mean_seconds"] == 0.227


def test_the_samples_are_judged_as_well_and_come_first(clocked, pytester):
    result = clocked("Clocked", "-k", "", "-v", "--snapshot-update")
    assert result.ret == 0
    assert (pytester.path / RECORD).exists()
    assert (pytester.path / "golden" / "recorded" / "perfect" / "tiny" / "table.toml").exists()
    lines = [line for line in result.outlines if "cpas" in line and "PASSED" in line]
    assert "test_speed" in lines[-2]
    assert "golden[" in lines[-1]


def test_a_method_that_raises_fails(clocked):
    result = clocked("OnlyTimedOnce")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*RuntimeError: the network exploded"])


def test_a_wrong_adapter_is_not_timed(clocked):
    result = clocked("Wrong", "-k", "test_speed or metric_units")
    assert clocked.speed is None
    result.stdout.fnmatch_lines(["*metric_units*"])
    assert result.parseoutcomes()["skipped"] >= 1


# -- usage --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("-n1",), "--cpas-benchmark under xdist: *(or give -n 0)"),
        (("--dist=load", "--tx=popen"), "--cpas-benchmark under xdist: *"),
        (("--benchmark-disable",), "--cpas-benchmark and --benchmark-disable: nothing would be*"),
        (("--benchmark-skip",), "--cpas-benchmark and --benchmark-skip: nothing would be timed*"),
        (
            ("--benchmark-cprofile=tottime",),
            "*--benchmark-cprofile: a profiler changes every time*",
        ),
        (("-p", "no:benchmark"), "*leave out -p no:benchmark*"),
        (("--cpas-benchmark-fail=lots",), "--cpas-benchmark-fail is 'lots', expected by how much*"),
        (("--cpas-benchmark-against=nothing",), "unknown method 'nothing'*"),
        (("--cpas-benchmark-against=git:",), "*expected such as git:HEAD~1"),
        (("--cpas-benchmark-against=git:HEAD",), "git:HEAD: no such revision of *tiny.py*"),
        (("--cpas-benchmark-against=tiny:NoInfo",), "*has no attribute info*"),
        (
            ("--cpas-benchmark-against=tiny:Perfect", "--snapshot-update"),
            "--snapshot-update records the ratio to the calibration kernel*",
        ),
    ],
)
def test_what_would_time_nothing_or_wrongly_is_a_mistake(cpas, args, message):
    result = cpas("Perfect", "--cpas-benchmark", "--cpas-benchmark-fail=20%", *args)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines([f"ERROR: {message}"])


def test_options_need_each_other(pytester, cpas):
    for option in ("--cpas-benchmark-fail=20%", "--cpas-benchmark-against=icp"):
        result = cpas("Perfect", option)
        assert result.ret == pytest.ExitCode.USAGE_ERROR
        result.stderr.fnmatch_lines(["ERROR: *does nothing without --cpas-benchmark*"])
    result = pytester.runpytest_inprocess(*RUN, "--cpas-benchmark")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["ERROR: --cpas-benchmark times methods, and there is none*"])


# -- workers ------------------------------------------------------------------------------------

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
    contestant.write_observations(file, [])
    adapter = Adapter("json", "JSONDecoder", tree=tmp_path, first=(tmp_path,))
    with pytest.raises(TimingError, match=r"json was imported from .*, not from the revision in"):
        Worker("git:HEAD", adapter, file, weights=None, seed=0, device="cpu")


def test_observations_survive_the_way_to_a_worker(tmp_path, cpas, pytester, monkeypatch):
    monkeypatch.syspath_prepend(pytester.path)
    import tiny

    dataset = tiny.Tiny(None)
    seen = [dataset.load(ref).observation for ref in dataset.samples[:3]]
    contestant.write_observations(tmp_path / "o.npz", seen)
    for before, after in zip(seen, contestant._read_observations(tmp_path / "o.npz"), strict=True):
        assert (before.category, before.camera) == (after.category, after.camera)
        for part in ("rgb", "depth", "mask"):
            assert np.array_equal(getattr(before, part), getattr(after, part))
