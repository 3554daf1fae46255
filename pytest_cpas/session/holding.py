"""The parent of a run: it waits for the process of pytest, and ends as that does, or with 1.

Python's standard library alone; nothing here runs in the child but the end of :func:`hold`.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import sys
import time
import warnings
from collections.abc import Sequence
from typing import NoReturn

import pytest

from pytest_cpas.session.run_record import Record

__all__ = ["WATCHING_GONE", "hold"]

#: What a terminal sends to all processes of a job; the child has it when the parent does.
_OF_TERMINALS = {"SIGINT", "SIGQUIT", "SIGTSTP", "SIGHUP"}

#: What is not for the parent to hand on: what cannot be caught, what stops, resumes or resizes, and
#: what says that the parent itself is at fault.
_OWN = {
    *("SIGKILL", "SIGSTOP", "SIGCONT", "SIGTTIN", "SIGTTOU", "SIGWINCH", "SIGURG", "SIGPIPE"),
    *("SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL", "SIGTRAP", "SIGSYS", "SIGCHLD"),
}

#: How long the child may take to say that it was interrupted, before it is interrupted once more.
_GRACE = 0.25  # seconds

#: The signal by which the kernel ends a process whose watching process is gone; one that nobody
#: handles, and whose default is to end a process. None where there is none such.
WATCHING_GONE = signal.SIGRTMAX - 2 if hasattr(signal, "SIGRTMAX") else None

_PDEATHSIG = 1  # prctl's PR_SET_PDEATHSIG


def hold(record: Record) -> None:
    """Fork. Returns in the child alone; the parent waits for it and ends as it does, or with 1."""
    if sys.platform == "win32":
        return
    handed_on = {int(n) for n in signal.valid_signals() if _name(n) not in _OWN}
    sys.stdout.flush()
    sys.stderr.flush()
    parent = os.getpid()
    ends = _resuming_pipe()
    # nothing may come between: neither a signal nor the end of the child is lost
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, handed_on | {signal.SIGCHLD})
    handler = signal.signal(signal.SIGCHLD, lambda *_: None)  # ignored ones would not be waited for
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python counts the threads of libraries, too
            pid = os.fork()
    except OSError as error:
        print(f"pytest-cpas: no process to guard the run ({error})", file=sys.stderr)
        pid = 0
        _close(ends)
    else:
        if pid:
            _close(ends[1:])
            _wait(pid, record, handed_on)
        _close(ends[:1])
        _die_with(parent)
        record.held = True
    record.adopt()
    if handler is not None:
        signal.signal(signal.SIGCHLD, handler)
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _resuming_pipe() -> Sequence[int]:
    """The reading and the writing end of a pipe. The first is for the parent, the second for the
    child: when that ends, the kernel has the parent go on, should somebody have stopped it. Nothing
    where no kernel does that."""
    import fcntl

    if not hasattr(fcntl, "F_SETSIG"):
        return ()
    reading, writing = os.pipe()
    fcntl.fcntl(reading, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(reading, fcntl.F_SETSIG, signal.SIGCONT)
    fcntl.fcntl(reading, fcntl.F_SETFL, fcntl.fcntl(reading, fcntl.F_GETFL) | os.O_ASYNC)
    return reading, writing


def _close(ends: Sequence[int]) -> None:
    for end in ends:
        os.close(end)


def _die_with(parent: int) -> None:
    """Be killed when the parent is, where the system can."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:
            os.kill(os.getpid(), signal.SIGKILL)


def _wait(pid: int, record: Record, handed_on: set[int]) -> None:
    """Hand on signals until the child ends, and end in the same way; never returns."""
    while True:
        number, from_terminal = _next_signal(handed_on | {signal.SIGCHLD})
        if number == signal.SIGCHLD:
            ended, status = os.waitpid(pid, os.WNOHANG | os.WUNTRACED)
            if ended and not os.WIFSTOPPED(status):
                _end(status, record)
            if ended:
                _stop_too(pid, os.WSTOPSIG(status))
        elif not from_terminal and not (number == signal.SIGINT and _was_interrupted(record)):
            os.kill(pid, number)


def _next_signal(numbers: set[int]) -> tuple[int, bool]:
    """The next signal, and whether a terminal sent it, which has sent it to the child as well."""
    if hasattr(signal, "sigwaitinfo"):
        info = signal.sigwaitinfo(numbers)
        return info.si_signo, info.si_code > 0 and _name(info.si_signo) in _OF_TERMINALS
    return signal.sigwait(numbers), False


def _was_interrupted(record: Record) -> bool:
    """Whether what interrupted the parent has interrupted the child as well: a whole group was."""
    now = time.monotonic()
    while time.monotonic() < now + _GRACE:
        if record.interrupted >= now - _GRACE:
            return True
        time.sleep(0.01)
    return False


def _stop_too(pid: int, number: int) -> None:
    """Stop as the child has, so that a shell sees its job stopped; go on together."""
    if _name(number) in ("SIGTSTP", "SIGTTIN", "SIGTTOU"):
        # it comes when it is let through: here
        os.kill(os.getpid(), number)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {number})
        signal.pthread_sigmask(signal.SIG_BLOCK, {number})
        os.kill(pid, signal.SIGCONT)


def _end(status: int, record: Record) -> NoReturn:
    """End as the child did, but not with 0 if that would be untrue; say what is known of it."""
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        if number == signal.SIGKILL and (note := record.note):
            with contextlib.suppress(OSError, ValueError):
                told = json.loads(note.read_text(encoding="utf-8"))
                if not told["said"]:
                    _say(told["text"])
                note.unlink()
                note.parent.rmdir()
            _say(f"a time limit has ended pytest; {record.told}; the exit status is 1")
            os._exit(int(pytest.ExitCode.TESTS_FAILED))
        if number == WATCHING_GONE:
            _say(
                "the process that watches the time of calls was ended, and pytest with it"
                f"{_where(record)}; {record.told}. Something has killed it there: end only"
                " processes that you have started"
            )
        elif record.status is None:
            hint = " (out of memory?)" if number == signal.SIGKILL else ""
            _say(f"pytest was ended by {_name(number)}{hint}{_where(record)}; {record.told}")
        _end_by(number)
    code = os.WEXITSTATUS(status)
    if record.output_lost and (code or record.status):
        _say(
            f"descriptors that pytest prints to were closed{_where(record)}, so what it printed may"
            " be lost. A method, a data set or a plugin is to close only what it has opened"
        )
    if record.status is None and (not code or record.item):
        _say(
            f"the process of pytest ended with exit status {code}{_where(record)};"
            f" {record.told}. Something called os._exit, exit or exec there, or ended the session"
            + ("" if code else "; the exit status is 1, not 0")
        )
        code = code or int(pytest.ExitCode.TESTS_FAILED)
    elif record.status is not None and code != record.status:
        _say(
            f"the process of pytest ended with exit status {code} after pytest had given"
            f" {record.status}"
        )
        code = code or record.status
    os._exit(code)


def _end_by(number: int) -> NoReturn:
    import resource

    # the child has left a core already, if one was wanted
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    if _name(number) not in ("SIGKILL", "SIGSTOP"):
        signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {number})
    os._exit(128 + number)  # the first process of a container is not ended by a signal


def _where(record: Record) -> str:
    return f" after {record.item} had begun" if record.item else " before any item had begun"


def _say(message: str) -> None:
    with contextlib.suppress(OSError):
        os.write(2, f"\nERROR: {message}\n".encode("utf-8", "backslashreplace"))


def _name(number: int) -> str:
    """The name of a signal; its number if it has none."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
