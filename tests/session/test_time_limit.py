"""A prediction that takes too long ends the run, says where it was, and the run can go on."""

import contextlib
import json
import os
import signal
import sys
import time
from pathlib import Path

import pytest

from pytest_cpas.evaluation import Watchdog, parse_seconds
from pytest_cpas.evaluation.watchdog import ChannelError
from pytest_cpas.evaluation.watching import Watch, foreign, where
from pytest_cpas.session import metrics_session

pytestmark = pytest.mark.skipif(os.name != "posix", reason="there are signals on POSIX only")

METHOD = """import os, re, threading, time
from tiny import *

def sleeps():
    time.sleep(60)

def computes():
    while True:
        np.linalg.eigvals(np.random.default_rng(0).random((400, 400)))

def backtracks():
    re.match(r"(a+)+$", "a" * 60 + "b")

def deadlocks():
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()

class Slow(Perfect):
    def predict(self, batch, seed):
        time.sleep(float(os.environ.get("EACH", 0)) * len(batch))
        return super().predict(batch, seed)

    def answer(self, index):
        if str(index) == os.environ.get("AT"):
            globals()[os.environ["CPAS_HOW"]]()
        return super().answer(index)
"""

HOWS = ("sleeps", "computes", "backtracks", "deadlocks")

#: Where each of them waits: the last line of its function.
LINE = {
    how: 1 + METHOD[: METHOD.index("\n\n", METHOD.index(f"def {how}"))].count("\n") for how in HOWS
}


@pytest.fixture
def slow(cpas, pytester, monkeypatch):
    """Run a method that hangs ``how`` at a sample."""
    pytester.makepyfile(slow=METHOD)

    def run(*args, how="", at=5, limit="1", each="0"):
        monkeypatch.setenv("AT", str(at) if how else "")
        monkeypatch.setenv("CPAS_HOW", how)
        monkeypatch.setenv("EACH", each)
        names = ("--cpas-method=slow:Slow", "--cpas-dataset=tiny:Tiny", "-pno:dash")
        return pytester.runpytest_subprocess(
            *names, "-pno:cacheprovider", *([f"--cpas-timeout={limit}"] if limit else []), *args
        )

    return run


def kept(folder: Path) -> list[str]:
    (path,) = folder.glob("*.jsonl")
    lines = [json.loads(line.split(" ", 1)[1]) for line in path.read_text().splitlines()]
    return [line["ref"][0] for line in lines if "row" in line]


@pytest.mark.parametrize("how", HOWS)
def test_run_is_ended_and_goes_on(slow, pytester, how):
    result = slow("--cpas-results=out", *(["-s"] if how == "sleeps" else []), how=how)
    assert result.ret == 1
    result.stderr.fnmatch_lines(
        [
            "ERROR: perfect on tiny, sample scene_1/0005 (mug): predict took longer than 1 s; the"
            f" method was in *slow.py:* ({how})*",
            "The rows that came before are kept in *out: the same command goes on from there.*",
            "Stacks of all threads:",
            "*Current thread*",
            f'*slow.py", line {LINE[how]} in {how}' if how != "computes" else f"*in {how}",
            "ERROR: a time limit has ended pytest; no verdict was told; the exit status is 1",
        ]
    )
    text = result.stderr.str()
    assert f"slow.py:{LINE[how]} ({how})" in text or how == "computes"
    assert "out of memory" not in text
    assert "pluggy" not in text
    before = kept(pytester.path / "out")
    assert 0 < len(before) < 12
    assert "scene_1/0005" not in before
    again = slow("--cpas-results=out")
    assert again.ret == 0
    again.stdout.fnmatch_lines([f"rows: computed {12 - len(before)}, reused {len(before)} from*"])


def test_worker_is_ended_and_the_others_go_on(slow, pytester):
    result = slow("-n2", "--cpas-results=out", how="backtracks")
    assert result.ret == 1
    result.stdout.fnmatch_lines(
        [
            "perfect on tiny, sample scene_1/0005 (mug): predict took longer than 1 s; the method"
            f" was in *, called from *slow.py:{LINE['backtracks']} (backtracks).",
            "Other samples go on in other processes. *",
            "11 of 12 samples judged",
            "FAILED cpas::test_sample*scene_1/0005*",
        ]
    )
    assert len(kept(pytester.path / "out")) == 11
    assert slow("-n2", "--cpas-results=out").ret == 0


@pytest.mark.parametrize("workers", [(), ("-n2",)], ids=["", "-n2"])
def test_rows_of_the_item_that_is_ended_are_kept(slow, pytester, workers):
    """Five samples of the one item come before the one that hangs."""
    options = ("--cpas-results=out", "--cpas-granularity=dataset", "-k", "test_sample", *workers)
    assert slow(*options, how="sleeps").ret == 1
    assert kept(pytester.path / "out") == [f"scene_{i // 4}/{i:04d}" for i in range(5)]
    again = slow(*options)
    again.stdout.fnmatch_lines(["rows: computed 7, reused 5 from*"])


def test_without_results_it_is_said_what_keeps_rows(slow):
    result = slow("-o", "cpas_timeout=1", how="sleeps", limit="")
    assert result.ret == 1
    result.stderr.fnmatch_lines(["No row is kept without --cpas-results DIR; *"])


def test_checks_of_the_contract_are_limited(slow):
    result = slow(how="sleeps", at=3)
    assert result.ret == 1
    result.stderr.fnmatch_lines(["ERROR: perfect: predict of 1 observation in a check of the *"])


def test_below_the_limit_nothing_is_said_and_a_batch_has_more_time(slow):
    # a batch of four takes twice the limit of one
    result = slow("-k", "batch or fresh", limit="1", each="0.5")
    assert result.ret == 0
    assert not result.stderr.str().strip()


def test_without_the_option_nothing_is_started(cpas, monkeypatch):
    monkeypatch.setattr(Watchdog, "__init__", None)
    assert cpas("Perfect").ret == 0


def test_timer_of_pytest_goes_off_meanwhile(slow):
    result = slow("-o", "faulthandler_timeout=1", "-k", "0005", limit="4", how="sleeps")
    text = result.stderr.str()
    assert 0 <= text.index("Timeout (0:00:01)!") < text.index("predict took longer than 4 s")


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "1e999", "soon", "1,5"])
def test_values_that_cannot_be_meant(cpas, text):
    with pytest.raises(ValueError, match="expected seconds: a finite number above 0"):
        parse_seconds(text)
    result = cpas("Perfect", f"--cpas-timeout={text}")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines([f"ERROR: --cpas-timeout is '{text}', expected seconds: *"])


def test_needs_a_method(pytester):
    result = pytester.runpytest_inprocess("-pno:dash", "--cpas-timeout=3")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["ERROR: --cpas-timeout does nothing without --cpas-method; *"])


#: What foreign code can do to the line to the watching process during a call.
CUTS = {
    "kill": lambda watching: os.kill(watching.pid, signal.SIGKILL),
    "close": lambda watching: [os.close(each.number) for each in _descriptors(watching)],
    "close one": lambda watching: os.close(watching._line.number),
    "other files": lambda watching: [
        os.dup2(os.open(os.devnull, os.O_RDWR), each.number) for each in _descriptors(watching)
    ],
}


def _descriptors(watching):
    return watching._line, watching._alive, watching._dump


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("cut", CUTS)
def test_line_that_was_cut_during_a_call_is_told_and_made_anew(cut):
    watchdog = Watchdog()
    with watchdog.watch("a call", 30):
        first = watchdog._watching

    def cut_during_a_call() -> None:
        with watchdog.watch("a call", 30):
            CUTS[cut](first)
            if cut == "kill":
                _until_gone(first.pid)

    with pytest.raises(ChannelError, match="a call: the process that watches its time was ended"):
        cut_during_a_call()
    for descriptor in _descriptors(first) if cut == "other files" else ():
        os.close(descriptor.number)  # they are somebody else's, and still open
    with watchdog.watch("a call", 30):
        second = watchdog._watching
    assert second.pid != first.pid
    watchdog.close()
    for pid in (first.pid, second.pid):
        _until_gone(pid)


def test_line_that_was_cut_between_calls_is_made_anew():
    watchdog = Watchdog()
    with watchdog.watch("a call", 30):
        first = watchdog._watching
    CUTS["close"](first)
    with watchdog.watch("a call", 30):
        assert watchdog._watching.pid != first.pid
    watchdog.close()


def test_process_that_was_stopped_is_ended():
    watchdog = Watchdog()
    with watchdog.watch("a call", 30):
        os.kill(watchdog._watching.pid, signal.SIGSTOP)
    pid = watchdog._watching.pid
    watchdog.close()
    _until_gone(pid)


def test_process_is_nobodys_child():
    watchdog = Watchdog()
    with watchdog.watch("a call", 30), pytest.raises(ChildProcessError):
        os.waitpid(watchdog._watching.pid, os.WNOHANG)
    watchdog.close()


def test_what_others_write_is_no_call():
    """A line of theirs does not end a call, and half a line does not swallow one of ours."""
    heard, line = os.pipe()
    watch = Watch(os.getpid(), 0, Path("dump"), "word", None)
    watch._inputs = [heard]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pytest_cpas.evaluation.watching.INPUT", heard)
        for written, seconds in (
            (b'\nword{"seconds": 1}\n', 1),
            (b"\n\ngarbage\n{}\nhalf", 1),
            (b'\nword{"seconds": 2}\n', 2),
            (b"\nwo", 2),
            (b"rd\n", None),
        ):
            os.write(line, written)
            watch.read(1)
            assert (watch.call or {}).get("seconds") == seconds
    os.close(heard)
    os.close(line)


def _until_gone(pid: int) -> None:
    for _ in range(200):
        stat = Path(f"/proc/{pid}/stat")
        with contextlib.suppress(OSError):
            if stat.read_text().rpartition(")")[2].split()[0] != "Z":
                time.sleep(0.05)
                continue
        return
    raise AssertionError("it runs")


ENDED = """
import os, signal, sys, time
from pathlib import Path
from pytest_cpas.evaluation import Watchdog
gone = getattr(signal, "SIGRTMAX", 2) - 2
watchdog = Watchdog(note=Path(sys.argv[1]), stderr=2, gone=gone)
watchdog.about = {"item": "an item"}
signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals() - {gone})
with watchdog.watch("a call", float(sys.argv[2]), hint="wait"):
    exec(sys.argv[4])
    print("begun", watchdog._watching.pid, flush=True)
    time.sleep(float(sys.argv[3]))
"""


@pytest.mark.parametrize(
    "code",
    [
        "",
        "os.closerange(3, 256)",
        "os.closerange(3, 256); files = [open(os.devnull) for _ in range(9)]",
        "for number in range(3, 256):\n  try: os.write(number, b'x\\n\\nx')\n  except OSError: 0",
        "os.unlink(watchdog._watching._path)",
        "import shutil; shutil.rmtree(Path(sys.argv[1]).parent)",
    ],
    ids=["signals", "closed", "other files", "written to", "no dump", "no note"],
)
def test_process_is_ended_whatever_it_does_to_its_descriptors(pytester, code):
    (pytester.path / "notes").mkdir()
    note = pytester.path / "notes" / "note.json"
    result = pytester.run(sys.executable, "-c", ENDED, note, "0.2", "60", code)
    assert result.ret == -signal.SIGKILL
    result.stderr.fnmatch_lines(["ERROR: a call took longer than 0.2 s; *"])
    if "rmtree" not in code:
        told = json.loads(note.read_text())
        assert (told["item"], told["what"], told["hint"]) == ("an item", "a call", "wait")
        assert told["said"]
    if not code:
        result.stderr.fnmatch_lines(["ERROR: * s; it cannot be told where *"])


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process of such a death")
def test_process_whose_watching_process_is_killed_is_ended(pytester):
    code = "os.kill(watchdog._watching.pid, signal.SIGKILL)"
    result = pytester.run(sys.executable, "-c", ENDED, "note.json", "60", "60", code)
    assert result.ret == -(signal.SIGRTMAX - 2)


def test_time_in_which_a_run_is_stopped_does_not_count(pytester):
    with pytester.popen([sys.executable, "-c", ENDED, "note.json", "3", "1.5", ""]) as process:
        begun, watching = process.stdout.readline().split()
        assert begun == b"begun"
        group = [process.pid, int(watching)]
        for number, seconds in ((signal.SIGSTOP, 4.0), (signal.SIGCONT, 0.0)):
            for pid in group:
                os.kill(pid, number)
            time.sleep(seconds)
        assert process.wait(60) == 0
    assert not (pytester.path / "note.json").exists()


def test_words_of_a_dump():
    stacks = (
        "Thread 0x000000000000000b (most recent call first):\n"
        '  File "/other.py", line 3 in wait\n\n'
        "Current thread 0x000000000000000a (most recent call first):\n"
        '  File "/lib.py", line ??? in inner\n  File "/m.py", line 7 in predict\n'
    )
    call = {"thread": 10, "file": "/m.py"}
    assert where(stacks, call) == (
        "the method was in /lib.py:??? (inner), called from /m.py:7 (predict)"
    )
    assert where(stacks, {"thread": 11, "file": "/m.py"}) == "the method was in /other.py:3 (wait)"
    assert where("", call) == "it cannot be told where the method was"
    assert foreign(stacks) == stacks.rstrip("\n")


HANGS = """
import re
from pytest_cpas.checks.metrics import offer

def rotation_error(first, second):
    re.match(r"(a+)+$", "a" * 60 + "b")

METRICS = {"rotation_error": offer(rotation_error)}
"""

PLANTED = f"import {metrics_session.__name__} as planted\nplanted.LONGEST = 1.0"


def test_metric_that_hangs_in_compiled_code_ends_the_run(pytester):
    pytester.makepyfile(hangs=HANGS, planted=PLANTED)
    result = pytester.runpytest_subprocess(
        "-pno:dash", "-pplanted", "--cpas-metrics=hangs:METRICS", "-pno:cacheprovider"
    )
    assert result.ret == 1
    result.stderr.fnmatch_lines(
        ["ERROR: hangs:METRICS: rotation_error* took longer than 1 s; *", "It was in compiled *"]
    )
