"""Progress of long runs: figures under a clock of ours, and a terminal that is one."""

import os
import pty
import re
import subprocess
import sys

import pytest
from harness import RUN
from tables import REFS, Fixed, a_run, rows

from pytest_cpas.report import progress
from pytest_cpas.report.progress import FIRST, INTERVAL, Progress


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def told():
    return []


def test_line_counts_and_estimates(told):
    clock, run, judged = Clock(), a_run(), rows(s_01=30.0, s_02=30.0)
    seen = Progress(10, {run: judged[:2]}, told.append, clock=clock)
    assert seen.line() == "cpas: 2 of 10 samples"
    clock.now += 60  # loading, and the first sample
    seen.add(run, [judged[2]], 0)
    assert seen.line() == "cpas: 3 of 10 samples; m on d: 1/3 (33.3 %) correct at 10 deg, 2 cm"
    clock.now += 8
    seen.add(run, judged[3:6], 1)
    # four in eight seconds; three more to come
    assert seen.line() == (
        "cpas: 7 of 10 samples, 2 s each, 6 s left; m on d: 4/6 (66.7 %) correct at 10 deg, 2 cm"
    )
    clock.now += 8
    seen.add(run, judged[6:9], 0)
    assert "10 of 10 samples, 2.3 s each; m on d: 7/9" in seen.line()


def test_first_batch_is_not_counted_for_the_rate(told):
    clock, run, judged = Clock(), a_run(), rows()
    seen = Progress(None, {run: []}, told.append, clock=clock)
    seen.add(run, judged[:5], 0)
    clock.now += 2
    seen.add(run, judged[5:], 0)
    assert seen.line().startswith("cpas: 10 samples, 2.5/s; m on d: 10/10")


def test_precision_is_that_of_the_latest_run(told):
    first, second = a_run(), Fixed("n", "e", REFS, identity={})
    seen = Progress(20, {}, told.append, clock=Clock())
    seen.add(first, rows(), 0)
    seen.add(second, rows(s_00=90.0)[:2], 0)
    assert seen.line() == "cpas: 12 of 20 samples; n on e: 1/2 (50.0 %) correct at 10 deg, 2 cm"
    seen.add(first, [], 0)  # an item of which nothing was left to judge
    assert "n on e" in seen.line()


def test_lines_come_at_intervals_and_only_when_there_is_something(told):
    clock, run = Clock(), a_run()
    seen = Progress(10, {run: []}, told.append, clock=clock)
    clock.now += 5 * FIRST
    seen.pytest_runtest_logfinish()
    assert told == []
    for step in range(100):  # one second each
        seen.add(run, rows()[:1], 0)
        seen.pytest_runtest_logfinish()
        assert len(told) == 1 + int(step / INTERVAL)
        clock.now += 1


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (59.4, "59 s"), (59.6, "1 min 0 s"), (3599, "59 min 59 s"), (7260, "2 h 1 min")],
)
def test_durations(seconds, words):
    assert progress._duration(seconds) == words


def in_terminal(folder, *args, **env):
    """What a terminal shows of a run in which progress is told after every item."""
    (folder / "conftest.py").write_text(
        "from pytest_cpas.report import progress\nprogress.FIRST = progress.INTERVAL = 0\n"
    )
    ours, theirs = pty.openpty()
    names = ("--cpas-method=tiny:Perfect", "--cpas-dataset=tiny:Tiny")
    clean = {k: v for k, v in os.environ.items() if k not in ("CI", "BUILD_NUMBER", "NO_COLOR")}
    with subprocess.Popen(
        [sys.executable, "-m", "pytest", *RUN, *names, "--color=no", *args],
        cwd=folder,
        stdout=theirs,
        stderr=theirs,
        env=clean | env | {"COLUMNS": "80"},
    ) as process:
        os.close(theirs)
        text = b""
        try:
            while part := os.read(ours, 4096):
                text += part
        except OSError:  # the other end is closed
            pass
    os.close(ours)
    assert process.returncode == 0, text.decode()
    return text.decode().replace("\r\n", "\n")


@pytest.mark.parametrize("how", [(), ("-v",), ("-n2",)], ids=" ".join)
def test_lines_stand_alone_in_a_terminal(cpas, pytester, how):
    cpas("Perfect", "--snapshot-update", "-q")
    shown = in_terminal(pytester.path, *how)
    lines = shown.splitlines()
    counts = [int(n) for n in re.findall(r"^cpas: (\d+) of 12 samples", shown, re.M)]
    assert counts == sorted(counts)
    assert counts[0] < 12  # with workers several may come at once
    assert counts[-1] == 12
    assert all(line.startswith("cpas: ") for line in lines if "cpas: " in line)
    pattern = r"cpas: \d+ of 12 samples(, \S+( s each)?(, \d+ s left)?)?; perfect on tiny: .* 2 cm"
    assert all(re.fullmatch(pattern, line) for line in lines if line.startswith("cpas: "))
    assert "\x1b" not in shown
    assert "12 of 12 samples judged" in shown


@pytest.mark.parametrize(("args", "env"), [(("-q",), {}), ((), {"CI": "true"})])
def test_quiet_where_nobody_waits(cpas, pytester, args, env):
    assert "cpas: " not in in_terminal(pytester.path, *args, **env)


def test_quiet_in_a_file(cpas, pytester, monkeypatch):
    monkeypatch.setattr(progress, "FIRST", 0)
    assert "cpas: " not in cpas("Perfect").stdout.str()
