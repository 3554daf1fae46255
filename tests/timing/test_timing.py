"""Verdicts on speed in whole runs of pytest, with clocks of our own."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest
from harness import RUN
from report_schema import follow_schema

from pytest_cpas.timing import contestant, machine, running
from pytest_cpas.timing.intervals import (
    LOOKS,
    Interval,
)
from pytest_cpas.timing.records import RecordError, SpeedRecord, read_record

# -- runs with a clock of our own --------------------------------------------------------------

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


@pytest.mark.minutes
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


@pytest.mark.minutes
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
        lambda text: text.replace("lower = 0.9", "lower = 1.2"),
        lambda text: text.replace("upper = 1.1", "upper = 0.95"),
        lambda text: text.replace("confidence = 0.99", "confidence = 7"),
        lambda text: text.replace("confidence = 0.99", ""),
        lambda text: text.replace("= 1.5", '= "1_5"'),
        lambda text: text.replace("= 1.5", "= true"),
        lambda text: text.replace("= 1.5", "= nan"),
        lambda text: text.replace('"scene_0/0000" = 1.5', ""),
        lambda text: text.replace('= "d"', "= 1"),
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
    assert (pytester.path / "golden" / "recorded" / "perfect" / "tiny" / "run.toml").exists()
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


# -- usage -------------------------------------------------------------------------------------


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
    result.stderr.fnmatch_lines(["ERROR: --cpas-benchmark does nothing without --cpas-method*"])


def test_what_it_needs_is_named(cpas, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    result = cpas("Perfect", "--cpas-benchmark", "-p", "no:benchmark")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["ERROR: *not installed: pip install 'pytest-cpas[[]benchmark]'*"])
