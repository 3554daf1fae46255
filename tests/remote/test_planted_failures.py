"""Whatever goes wrong on the other side: its own sentence, the other samples, no process left."""

import os
import re
import shutil
import sys
import time
from pathlib import Path

import many_samples
import planted_methods
import pytest
import tiny
import workers

from pytest_cpas.evaluation import Limit, MethodError, MethodRun, Row, SampleError, Watchdog
from pytest_cpas.remote import RaisedThereError, WorkerError, process, remote_method
from pytest_cpas.remote import worker as worker_file
from pytest_cpas.types import DeclarationError

pytestmark = pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="processes are in /proc")

#: What a method raises that is waited for, seconds.
SHORT = 0.4

SH = shutil.which("sh") or "sh"


def _started(*command: str, **changes: object) -> object:
    return workers.spec(command=command, seconds_to_start=SHORT, **changes)


STARTS = {
    "no such command": (
        _started("no-such-interpreter-3.6"),
        "cannot be started: .*No such file.*no-such-interpreter",
    ),
    "no program": (_started(str(workers.HERE)), "cannot be started: .*Permission denied"),
    "ends at once": (
        _started("false"),
        r"the worker died \(the command ended with exit status 1\), and printed nothing",
    ),
    "says why": (
        _started(SH, "-c", "echo EnvironmentNameNotFound: sgpa >&2; exit 7"),
        r"exit status 7\); it printed last:\n    EnvironmentNameNotFound: sgpa",
    ),
    "killed": (_started(SH, "-c", "kill -9 $$"), "ended with signal 9, SIGKILL"),
    "silent": (
        _started(SH, "-c", "sleep 60"),
        "the worker to start took longer than 0.4 s, so the worker was ended$",
    ),
    "silent after a greeting": (
        _started(SH, "-c", "echo Welcome to host; sleep 60"),
        "took longer than 0.4 s, so the worker was ended; it printed last:\n    Welcome to host$",
    ),
    "says why to those who listen": (
        _started(SH, "-c", "echo EnvironmentNameNotFound: sgpa; exit 7"),
        r"exit status 7\); it printed last:\n    EnvironmentNameNotFound: sgpa",
    ),
    "noise without end": (
        workers.spec(command=(SH, "-c", "yes banner")),
        "somebody else has written into its pipe, and no answer came; it printed last:\n"
        "    banner\n    banner",
    ),
    "errors without end": (
        _started(SH, "-c", "yes banner >&2"),
        "took longer than 0.4 s, so the worker was ended; it printed last:\n    (banner|ba?n?n?e?)",
    ),
    "echo": (
        workers.spec(command=(SH, "-c", "cat")),
        "the command sends back what it is told: it is no interpreter",
    ),
    "no shell": (
        workers.spec(shell=True),
        r"exit status 0\), and printed nothing\nis it an interpreter\? shell = true is for",
    ),
    "no interpreter": (_started("cat"), "exit status 1"),
    "no numpy": (
        workers.spec(command=(sys.executable, "-S")),
        "class planted_methods:Good cannot be loaded there: ModuleNotFoundError: No module named"
        rf" 'numpy'; the worker needs numpy in {re.escape(sys.executable)} \(of .*\)$",
    ),
    "no module": (
        workers.spec("nowhere:Good"),
        r"class nowhere:Good cannot be loaded there: ModuleNotFoundError: No module named 'nowhere'"
        rf" \(CPython 3\S*, {re.escape(sys.executable)}\)",
    ),
    "no class": (
        workers.spec("planted_methods:Godo"),
        "there: module planted_methods is .*planted_methods.py, and has no Godo$",
    ),
    "called as one of Python's": (
        workers.spec("json:Godo"),
        "cannot be loaded there: module json is .*json/__init__.py, and has no Godo$",
    ),
    "no info": (
        workers.spec("planted_methods:NoInfo"),
        "there: planted_methods:NoInfo has no info, no load, no predict; a method is a class with",
    ),
    "no predict": (
        workers.spec("planted_declarations:NoPredict"),
        "there: planted_declarations:NoPredict has no predict; a method is a class with a",
    ),
    "a list for info": (
        workers.spec("planted_declarations:ListForInfo"),
        "planted_declarations:ListForInfo has no dictionary info; a method is a class",
    ),
    "a long licence": (
        workers.spec("planted_declarations:LongLicence"),
        r"there: an answer of 50000\d* bytes of names, texts and places of arrays, at most 4194304",
    ),
    "no folder": (workers.spec(path=("/nowhere",)), "path: there is no /nowhere on the other side"),
    "a file for a folder": (workers.spec(path=(__file__,)), f"path: {__file__} is no folder"),
    "no folder there": (
        workers.spec(paths={"/nowhere": workers.HERE}),
        "paths: there is no /nowhere on the other side",
    ),
    "no folder here": (
        workers.spec(paths={"/": Path("/nowhere")}),
        "paths: there is no /nowhere here, which is / there",
    ),
    "import raises": (
        workers.spec("planted_import:Good", env={"PLANTED": "raises"}),
        "(?s)ImportError: libcudart.so.9.0: cannot open.*planted_import.py.*line 8",
    ),
    "import exits": (
        workers.spec("planted_import:Good", env={"PLANTED": "exits"}),
        "cannot be loaded there: SystemExit: 3",
    ),
    "import dies": (
        workers.spec("planted_import:Good", env={"PLANTED": "dies"}),
        r"loading the class planted_import:Good: the worker died \(exit status 3\)",
    ),
}


@pytest.mark.parametrize(("asked", "sentence"), STARTS.values(), ids=list(STARTS))
def test_what_cannot_be_started_is_told(asked, sentence):
    with pytest.raises((WorkerError, RaisedThereError, DeclarationError), match=sentence):
        remote_method(asked)
    assert workers.left_of(asked) == []


def test_a_command_that_may_not_be_ended_is_not_waited_for(monkeypatch):
    """Such as sudo's, of another user."""

    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(process, "_GRACE", 0.2)
    monkeypatch.setattr(process.os, "killpg", refuse)
    asked = _started(SH, "-c", "sleep 4 >&2")
    start = time.monotonic()
    with pytest.raises(WorkerError, match="so the worker was ended"):
        remote_method(asked)
    assert time.monotonic() - start < 3
    [left] = process._left
    process._left.clear()
    assert left.wait() == 0


def test_another_version_of_the_protocol(tmp_path):
    text = Path(worker_file.__file__).read_text(encoding="utf-8")
    copied = tmp_path / "worker.py"
    copied.write_text(text.replace("PROTOCOL = 1", "PROTOCOL = 0"), encoding="utf-8")
    asked = workers.spec(worker=str(copied))
    with pytest.raises(WorkerError, match="speaks version 0 of the protocol, this pytest-cpas ver"):
        remote_method(asked)
    copied.write_text(text, encoding="utf-8")
    method = remote_method(asked)
    assert method.info.name == "good"
    method.remote.close()
    assert workers.left_of(asked) == []


LOADS = {
    "LoadRaises": r"cannot be loaded: ValueError: w.pt is truncated \(CPython(?s:.*)in load",
    "LoadDies": r"cannot be loaded: load: the worker died \(signal 9, SIGKILL\), and printed"
    " nothing$",
    "LoadSleeps": "cannot be loaded: load took longer than 0.4 s, so the worker was ended(?s:.*)"
    "in load$",
}


@pytest.mark.parametrize(("name", "sentence"), LOADS.items(), ids=list(LOADS))
def test_what_cannot_be_loaded_is_told(name, sentence):
    asked = workers.spec(f"planted_methods:{name}")
    method = remote_method(asked)
    if name == "LoadSleeps":  # and is imported in a moment
        object.__setattr__(asked, "seconds_to_load", SHORT)
    with pytest.raises(MethodError, match=sentence):
        MethodRun(method(), tiny.Tiny(None)).loaded()
    method.remote.close()
    assert workers.left_of(asked) == []


#: What is said of a fault that a worker survives; None if it is no fault of the answer.
SURVIVED = {
    "Raises": r"the method raised RuntimeError: the network exploded \(CPython 3(?s:.*)in fault",
    "Exits": "the method raised SystemExit: 5",
    "Interrupts": "the method raised KeyboardInterrupt",
    "Huge": "the answer breaks the contract: answer 0, hypothesis 0: points take 25769803776 bytes",
    "LongReason": None,
    "LongMessage": r"the method raised RuntimeError: xxx.*\[100000000 characters\](?s:.*)in fault",
    "WrongShape": r"breaks the contract: rotation: shape is \(2, 2\), expected \(3, 3\)",
    "Skewed": "breaks the contract: rotation: not orthonormal",
    "NotFinite": "breaks the contract: translation",
    "Objects": "breaks the contract: answer 0, hypothesis 0: points is of type object, expected",
    "UnknownKey": "breaks the contract: answer 0, hypothesis 0 has R, expected some of rotation",
    "NoRotation": "breaks the contract: hypothesis: no rotation",
    "Text": "breaks the contract: answer 0 is a str, expected a dictionary such as",
    "HalfMesh": "breaks the contract: hypothesis: a mesh is both vertices and triangles",
    "TwoScores": r"breaks the contract: score: an array of shape \(2,\), expected a number",
    "TooMany": "breaks the contract: predict: 2 answers to a batch of 1, expected one for each",
    "Prints": None,
    "Floods": None,
    "WritesEverywhere": None,
    "ReadsInput": None,
    "Daemon": None,
    "LeavesProgram": None,
    "ManyHypotheses": "the answer breaks the contract: an answer of 40000 arrays, at most 10000",
    "NoReason": 'answer 0 has no hypothesis and no reason; say why with {"failed": "why"}$',
    "ClosesOutput": None,
    "PutsOutputAway": None,
    "ClosesStreams": None,
    "ClosesAll": None,
    "ForgetsNumpy": None,
    "Patches": None,
}


@pytest.fixture(scope="module")
def survived():
    """What became of each of those samples; no process is left when all are judged."""
    asked = workers.spec("planted_methods:OneAfterTheOther")
    method = remote_method(asked)
    run = MethodRun(method(), many_samples.Many(None))
    run.limit = Limit(watchdog=Watchdog(), seconds=20.0)
    found = [_judged(run, ref) for ref in run.samples]
    assert method.remote.life == 1
    method.remote.close()
    assert workers.left_of(asked) == []
    return found


def test_a_sample_without_a_fault_is_judged_whatever_was_before(survived):
    assert [type(each) for each in survived[::2]] == [Row] * len(planted_methods.SURVIVED)


@pytest.mark.parametrize("number", range(len(SURVIVED)), ids=[*SURVIVED])
def test_what_a_worker_survives_is_told(survived, number):
    kind, found = planted_methods.SURVIVED[number], survived[2 * number + 1]
    sentence = SURVIVED[kind.__name__]
    if sentence is None:
        assert isinstance(found, Row)
    else:
        told = str(found)
        assert told.startswith(f"good on tiny, sample s/{2 * number + 1:04d} (mug): ")
        assert re.search(sentence, told), told


#: What is said behind it.
AGAIN = r"\n\s*it is started again for what comes next \(1 of 3 times\)$"

DIES = {
    "Dies": rf"predict: the worker died \(exit status 9\), and printed nothing{AGAIN}",
    "Crashes": r"died \(signal 11, SIGSEGV\); it printed last:\n    CUDA error: an illegal memory"
    rf" access(?s:.*)Fatal Python error(?s:.*)in fault(?s:.*){AGAIN}",
    "Sleeps": rf"took longer than 0.4 s, so the worker was ended; (?s:.*)in fault(?s:.*){AGAIN}",
    "HoldsTheLock": "predict took longer than 0.4 s(?s:.*)in fault",
    "IgnoresSignals": "predict took longer than 0.4 s(?s:.*)in fault",
    "ClosesEverything": r"predict: the worker died \(exit status 1\); it printed last:\n    the"
    " method has closed file descriptors that it did not open, and with them the line to pytest-c",
    "ForkKeepsPipe": rf"predict: the worker died \(exit status 4\), and printed nothing{AGAIN}",
    "LeavesThread": None,
    "LooksAtStreams": None,
}

#: Those that end by a limit, which the others would only be delayed by.
LIMITED = {"Sleeps", "HoldsTheLock", "IgnoresSignals"}


@pytest.mark.parametrize(("name", "sentence"), DIES.items(), ids=list(DIES))
def test_one_sample_ends_the_worker_and_the_others_are_judged(name, sentence):
    asked = workers.spec(f"planted_methods:{name}")
    method = remote_method(asked)
    run = MethodRun(method(), tiny.Tiny(None))
    seconds = SHORT if name in LIMITED else 20.0
    run.limit = Limit(watchdog=Watchdog(), seconds=seconds)
    found = [_judged(run, ref) for ref in run.samples[:4]]
    failed = [index for index, each in enumerate(found) if isinstance(each, SampleError)]
    assert failed == ([] if sentence is None else [1]), found
    if sentence is not None:
        assert f"{method.info.name} on tiny, sample scene_0/0001 (mug): " in str(found[1])
        assert re.search(sentence, str(found[1])), found[1]
    method.remote.close()
    assert workers.left_of(asked) == []


def _judged(run: MethodRun, ref: object) -> Row | SampleError:
    try:
        return run.judge(ref)
    except SampleError as error:
        return error


def test_worker_that_always_dies_is_started_three_times_more():
    asked = workers.spec("planted_methods:DiesAlways")
    method = remote_method(asked)
    run = MethodRun(method(), tiny.Tiny(None))
    told = [str(_judged(run, ref)) for ref in run.samples[:6]]
    for number, sentence in enumerate(told[:3], start=1):
        assert sentence.endswith(f"it is started again for what comes next ({number} of 3 times)")
    assert told[3].endswith("it has ended 4 times and is not started again")
    for sentence in told[4:]:
        assert "the worker of planted_methods:DiesAlways has ended 4 times and is not" in sentence
    assert workers.left_of(asked) == []
