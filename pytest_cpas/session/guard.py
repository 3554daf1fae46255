"""What keeps a run that was asked for from ending with exit status 0 before its verdicts are told.

Two layers. :class:`Guard` is a plugin in pytest's process: it sees what other plugins and Python's
own ``sys.exit`` do to the end of a session. What it cannot see (``os._exit``, C's ``exit``, a
process that is replaced by another program) is seen from outside: :func:`hold` forks, pytest goes
on in the child, and the parent waits for it, with a page of memory that both share as the only
evidence. Nothing here is imported, and no process is made, for runs without ``--cpas-*``.
"""

from __future__ import annotations

import contextlib
import copy
import ctypes
import json
import mmap
import os
import shlex
import signal
import struct
import sys
import threading
import time
import warnings
from argparse import Namespace
from collections.abc import Generator
from pathlib import Path
from types import FrameType
from typing import NoReturn

import pytest

from pytest_cpas.session.seen_items import SeenItems, below

#: Options that make a run whose verdicts are owed, and those that only show something.
_ASK = (
    "cpas_method",
    "cpas_dataset",
    "cpas_predictions",
    "cpas_merge",
    "cpas_metrics",
    "cpas_check_dataset",
    "cpas_benchmark",
)
_SHOW = (
    "help",
    "version",
    "markers",
    "showfixtures",
    "show_fixtures_per_test",
    "cacheshow",
    "collectonly",
    "cpas_list",
)

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

#: Set by ``pytest-cpas``, which calls ``pytest.main`` and is a command of its own all the same.
is_command = False


class Record:
    """What is known of a run, in memory that outlives the process that writes it.

    A copy of the process, which a method may make, does not write.
    """

    def __init__(self) -> None:
        self._page = mmap.mmap(-1, 2 * mmap.PAGESIZE)
        #: Whether a parent waits for this process.
        self.held = False
        self.adopt()

    def adopt(self) -> None:
        """Make this process the one that writes."""
        self._writer = os.getpid()

    def begin(self, item: str) -> None:
        """Note that an item began."""
        content = item.encode("utf-8", "replace")[: mmap.PAGESIZE - 32] + b"\0"
        self._write(32, content)

    def expect(self, note: Path) -> None:
        """Note in which file it is said if the run is ended because its time is over."""
        self._write(mmap.PAGESIZE, os.fsencode(note) + b"\0")

    def interrupt(self) -> None:
        """Note that the run was interrupted, now."""
        self._write(8, struct.pack("d", time.monotonic()))

    def lose_output(self) -> None:
        """Note that what pytest prints may not arrive."""
        self._write(2, b"\1")

    def finish(self, status: int) -> None:
        """Note that the session is over, and pytest's exit status."""
        self._write(0, bytes([1, status & 0xFF]))

    def _write(self, start: int, content: bytes) -> None:
        if os.getpid() == self._writer:
            self._page[start : start + len(content)] = content

    @property
    def item(self) -> str:
        """The item that began last; empty before the first."""
        return self._page[32 : mmap.PAGESIZE].partition(b"\0")[0].decode("utf-8", "replace")

    @property
    def note(self) -> Path | None:
        """The file of :meth:`expect`, if it is there."""
        name = self._page[mmap.PAGESIZE :].partition(b"\0")[0]
        return Path(os.fsdecode(name)) if name and os.path.isfile(name) else None

    @property
    def interrupted(self) -> float:
        """When the run was interrupted, by the monotonic clock; 0 if it was not."""
        when: float = struct.unpack("d", self._page[8:16])[0]
        return when

    @property
    def output_lost(self) -> bool:
        """Whether what pytest printed may not have arrived."""
        return bool(self._page[2])

    @property
    def status(self) -> int | None:
        """The exit status of pytest; None if the session is not over."""
        return self._page[1] if self._page[0] else None


def asked(options: Namespace) -> bool:
    """Whether the options ask for verdicts."""
    asks, shows = (any(getattr(options, name, None) for name in names) for names in (_ASK, _SHOW))
    return asks and not shows


def guard(config: pytest.Config, parser: pytest.Parser) -> None:
    """Guard the run, if its arguments ask for one; as early as a plugin can."""
    words = [*config.invocation_params.args]
    words[:0] = shlex.split(os.environ.get("PYTEST_ADDOPTS", ""))
    try:
        words[:0] = config.getini("addopts")
        options = parser.parse_known_args(words, namespace=copy.copy(config.option))
    except (ValueError, AttributeError, pytest.UsageError):
        return  # pytest has no configuration yet, or says itself what is wrong with the arguments
    if asked(options):
        record = Record()
        if _may_fork():
            hold(record)
        watch(config, record)


def watch(config: pytest.Config, record: Record | None = None) -> None:
    """Guard the run inside this process, unless it is guarded or is a worker's."""
    if not config.pluginmanager.has_plugin("cpas-guard") and not hasattr(config, "workerinput"):
        items = SeenItems.register(config)
        config.pluginmanager.register(Guard(record or Record(), items), "cpas-guard")


class Guard:
    """What happens to the verdicts of a run, seen from outside all other plugins."""

    def __init__(self, record: Record, items: SeenItems) -> None:
        self.record, self._items = record, items
        self._status: int | None = None
        self._outputs = {_file_of(1), _file_of(2)} - {None}
        #: Where pytest keeps what it prints to while it captures what is printed.
        self._kept: dict[int, tuple[int, int] | None] = {}

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_load_initial_conftests(self) -> Generator[None, object, object]:
        """What a conftest.py does while it is imported is a usage error."""
        try:
            return (yield)
        except SystemExit as error:
            raise pytest.UsageError(f"sys.exit({error.code}) while a conftest.py was loaded") from (
                error
            )

    def pytest_sessionstart(self) -> None:
        """Capturing has begun."""
        files = {number: _file_of(number) for number in range(3, 100)}
        self._kept = {number: file for number, file in files.items() if file in self._outputs}

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """An item begins."""
        self._see_outputs()
        if not self.record.output_lost:  # else it is the last item that counts
            self.record.begin(nodeid)

    @pytest.hookimpl(tryfirst=True)
    def pytest_keyboard_interrupt(self) -> None:
        """Said to the parent, which may have been interrupted too."""
        self.record.interrupt()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> Generator[None, object, object]:
        """Everything is printed; the status is what it has to be."""
        self._see_outputs()
        result = yield
        self._status = int(session.exitstatus)
        session.exitstatus = self._status = self._held(session.config, self._status)
        self.record.finish(self._status)
        return result

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_cmdline_main(self, config: pytest.Config) -> Generator[None, object, object]:
        """The same where there was no session, or another status came after it."""
        try:
            status = int((yield) or 0)  # type: ignore[call-overload]
        except SystemExit as error:
            if error.code:
                raise
            status = self._status or 0
        finally:
            if self.record.held:
                with contextlib.suppress(OSError):  # should somebody have stopped the parent
                    os.kill(os.getppid(), signal.SIGCONT)
        status = self._held(config, status)
        self.record.finish(status)
        return status

    def _see_outputs(self) -> None:
        if any(_file_of(number) != file for number, file in self._kept.items()):
            self.record.lose_output()

    def _held(self, config: pytest.Config, status: int) -> int:
        """The status; 1 instead of 0 if that would be untrue, and why is said."""
        if status or hasattr(config, "workerinput") or not (problem := self._problem(config)):
            return status
        print(f"\nERROR: {problem}; the exit status is 1, not 0", file=sys.stderr)
        return int(pytest.ExitCode.TESTS_FAILED)

    def _problem(self, config: pytest.Config) -> str:
        # what has verdicts is a SuiteSession, which imports too much to be named here
        sessions = [p for p in config.pluginmanager.get_plugins() if hasattr(p, "verdicts_told")]
        nodes = {session.node for session in sessions}
        items = self._items
        undone = sorted(below(nodes, items.selected - items.ended))
        if self._status is None:
            return "pytest ended before its session was over, and told no verdict"
        if undone:
            return f"{len(undone)} items were collected and never ended, such as {undone[0]}"
        if not below(nodes, items.selected):
            return "no item of the run that was asked for was collected and selected"
        if not sessions or not all(session.verdicts_told for session in sessions):
            return "pytest ended and told no verdict"
        if failed := below(nodes, items.failed(nodes)):
            return f"{failed[0]} failed, and a plugin made that a success"
        return ""


def _file_of(number: int) -> tuple[int, int] | None:
    """Which file a descriptor is of; None if it is closed."""
    try:
        seen = os.fstat(number)
    except OSError:
        return None
    return seen.st_dev, seen.st_ino


# -- the parent -----------------------------------------------------------------------------------


def _may_fork() -> bool:
    """Whether this run is that of the command ``pytest`` or ``pytest-cpas``, with one thread.

    A program that calls ``pytest.main``, or a test that does, goes on after it and is not doubled.
    """
    global is_command
    if not hasattr(os, "fork") or threading.active_count() > 1:
        return False
    frame: FrameType | None = sys._getframe()
    while frame and not _is_of_pytest(frame, "main", "_main"):
        frame = frame.f_back
    command, is_command = is_command, False
    return command or bool(
        frame and frame.f_back and _is_of_pytest(frame.f_back, "console_main", "_console_main")
    )


def _is_of_pytest(frame: FrameType, *names: str) -> bool:
    return frame.f_globals.get("__name__") == "_pytest.config" and frame.f_code.co_name in names


def hold(record: Record) -> None:
    """Fork. Returns in the child alone; the parent waits for it and ends as it does, or with 1."""
    if sys.platform == "win32":
        return
    handed_on = {int(n) for n in signal.valid_signals() if _name(n) not in _OWN}
    sys.stdout.flush()
    sys.stderr.flush()
    parent = os.getpid()
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
    else:
        if pid:
            _wait(pid, record, handed_on)
        _die_with(parent)
        record.held = True
    record.adopt()
    if handler is not None:
        signal.signal(signal.SIGCHLD, handler)
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)


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
            _say("a time limit has ended pytest; no verdict was told; the exit status is 1")
            os._exit(int(pytest.ExitCode.TESTS_FAILED))
        if number == WATCHING_GONE:
            _say(
                "the process that watches the time of calls was ended, and pytest with it"
                f"{_where(record)}; no verdict was told. Something has killed it there: end only"
                " processes that you have started"
            )
        elif record.status is None:
            hint = " (out of memory?)" if number == signal.SIGKILL else ""
            _say(f"pytest was ended by {_name(number)}{hint}{_where(record)}; no verdict was told")
        _end_by(number)
    code = os.WEXITSTATUS(status)
    if record.output_lost and (code or record.status):
        _say(
            f"descriptors that pytest prints to were closed{_where(record)}, so what it printed may"
            " be lost. A method, a data set or a plugin is to close only what it has opened"
        )
    if record.status is None and (not code or record.item):
        _say(
            f"the process of pytest ended with exit status {code}{_where(record)}; no verdict was"
            " told. Something called os._exit, exit or exec there, or ended the session"
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
