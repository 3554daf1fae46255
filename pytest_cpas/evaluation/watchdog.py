"""A time limit on calls of foreign code that holds whatever the code does.

Neither an exception in the calling thread nor another thread of the process ends a loop in compiled
code, a deadlock, or a regular expression that backtracks for years: they keep the interpreter's
lock, or wait for another one. So another process watches (:mod:`pytest_cpas.evaluation.watching`),
and the watched one is killed, after its stacks were dumped by a signal handler that needs no lock.

The timers of this process are left alone: ``faulthandler.dump_traceback_later``, of which there is
one that pytest's ``faulthandler_timeout`` uses, and SIGALRM, which others use.
"""

from __future__ import annotations

import contextlib
import faulthandler
import inspect
import json
import os
import secrets
import select
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_cpas.reading.text import terminal_lines
from pytest_cpas.remote import RemoteMethod
from pytest_cpas.types import ContractError, Method, Observation, Prediction

try:
    import fcntl
except ImportError:  # where nothing is watched either
    fcntl = None  # type: ignore[assignment]

__all__ = ["ChannelError", "Limit", "Limited", "Watchdog", "can_watch", "parse_seconds"]

#: Longest text of a call, characters: its line is written to a pipe as a whole.
_LONGEST = 1000


def can_watch() -> bool:
    """Whether this system has what is needed: signals that dump stacks."""
    return hasattr(faulthandler, "register") and os.name == "posix"


def parse_seconds(text: str) -> float:
    """A time limit in seconds; :class:`ValueError` unless it is a finite number above 0."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < float("inf"):
        raise ValueError(f"{text!r}, expected seconds: a finite number above 0, such as 60 or 2.5")
    return seconds


class ChannelError(ContractError):
    """Foreign code has cut the line to the process that watches its time."""


class _Descriptor:
    """A file descriptor, and which file it was made for: foreign code may have closed it, and
    another file may have its number since."""

    def __init__(self, number: int) -> None:
        self.number, self._file = number, _file_of(number)

    @property
    def whole(self) -> bool:
        """Whether it is still open, and of the same file."""
        return self._file is not None and _file_of(self.number) == self._file

    def close(self) -> None:
        """Close it, unless somebody has done so."""
        if self.whole:
            os.close(self.number)


def _file_of(number: int) -> tuple[int, int] | None:
    try:
        seen = os.fstat(number)
    except OSError:
        return None
    return seen.st_dev, seen.st_ino


class Watchdog:
    """Ends this process with SIGKILL when a call takes too long, and says where it was.

    ``note``: a file for what was found, for whoever looks after this
    process; ``stderr``: the file descriptor where it is said, None for nowhere. ``about``: what
    else goes into the note, plain values; whoever knows them sets them. ``gone``: the signal by
    which the kernel ends this process if the watching one is gone, where the kernel does that.
    """

    def __init__(
        self, *, note: Path | None = None, stderr: int | None = None, gone: int | None = None
    ) -> None:
        """Nothing is started before the first call."""
        self.about: Mapping[str, Any] = {}
        self._note, self._gone = note, gone
        self._stderr = None if stderr is None else _Descriptor(os.dup(stderr))
        self._owner = os.getpid()
        self._watching: _Watching | None = None
        self._number = _unused_signal()

    @contextlib.contextmanager
    def watch(
        self, what: str, seconds: float, *, hint: str = "", file: str = "", **about: Any
    ) -> Iterator[None]:
        """End this process if the block takes longer than ``seconds``.

        ``what``: the block, in words; ``hint``: what to do about it; ``file``: the source
        of the foreign code, so that its line is named; ``about``: more for the note. A copy of this
        process is not watched. Raises :class:`ChannelError` after a block that was not watched to
        its end.
        """
        if os.getpid() != self._owner:
            yield
            return
        call = {
            **self.about,
            **about,
            "what": terminal_lines(what)[:_LONGEST],
            "seconds": seconds,
            "thread": threading.get_ident(),
            "file": file,
            "hint": terminal_lines(hint)[:_LONGEST],
        }
        line = json.dumps(call)
        if self._watching is None or not self._watching.say(line, self._number):
            # between two calls nothing was watched that could be missed
            self._end()
            self._watching = self._started()
            if not self._watching.say(line, self._number):
                raise ChannelError("the process that watches its time has ended at once")
        try:
            yield
        finally:
            if not self._watching.say("", self._number):
                self._end()
                raise ChannelError(
                    f"{call['what']}: the process that watches its time was ended, or descriptors"
                    " that lead to it were closed, during the call; close and end only what you"
                    " have opened and started"
                )

    def close(self) -> None:
        """Watch no longer."""
        if os.getpid() == self._owner:
            self._end()
        if self._stderr is not None:
            self._stderr.close()
            self._stderr = None

    def _started(self) -> _Watching:
        stderr = self._stderr if self._stderr is not None and self._stderr.whole else None
        return _Watching(self._number, self._note, stderr, self._gone)

    def _end(self) -> None:
        watching, self._watching = self._watching, None
        if watching is not None:
            faulthandler.unregister(self._number)
            watching.end()


class _Watching:
    """The watching process, which is no child of this one: who waits for all children, or ends all
    of them, does not mean it. And the line to it."""

    def __init__(
        self, number: int, note: Path | None, stderr: _Descriptor | None, gone: int | None
    ) -> None:
        """Start it; raises :class:`OSError`."""
        dump, self._path = tempfile.mkstemp(prefix="pytest-cpas-stacks-")
        heard, line = os.pipe()
        alive, its_end = os.pipe()
        self._dump, self._line, self._alive = map(_Descriptor, (dump, line, alive))
        # no line of anybody else's is taken for one of these
        self._word = secrets.token_hex(8)
        command = [sys.executable, "-I", "-S", str(Path(__file__).with_name("watching.py"))]
        command += [str(os.getpid()), str(int(number)), self._path, self._word]
        command += [] if note is None else [str(note)]
        try:
            process = subprocess.Popen(  # noqa: S603 - our own file
                command,
                stdin=heard,
                stdout=its_end,
                stderr=subprocess.DEVNULL if stderr is None else stderr.number,
            )
        finally:
            os.close(heard)
            os.close(its_end)
        told = os.read(alive, 100)
        process.wait()
        if not told:
            raise OSError("the process that watches the time of calls cannot be started")
        self.pid = int(told)
        os.set_blocking(line, False)  # of a process that was stopped
        if gone is not None and hasattr(fcntl, "F_SETSIG"):
            # its end of this pipe is closed when it ends, however it does
            fcntl.fcntl(alive, fcntl.F_SETOWN, os.getpid())
            fcntl.fcntl(alive, fcntl.F_SETSIG, gone)
            fcntl.fcntl(alive, fcntl.F_SETFL, fcntl.fcntl(alive, fcntl.F_GETFL) | os.O_ASYNC)

    def say(self, line: str, number: int) -> bool:
        """Say that a call began, or that it ended; False if nobody hears it."""
        if not (self._line.whole and self._alive.whole and self._dump.whole):
            return False
        if line:
            # anew each time: foreign code may have taken the signal for itself
            faulthandler.register(number, file=self._dump.number, all_threads=True, chain=False)
        # what somebody else has begun to write ends before it
        data = f"\n{self._word}{line}\n".encode()
        try:
            return os.write(self._line.number, data) == len(data)
        except (BrokenPipeError, BlockingIOError):
            return False

    def end(self) -> None:
        """End it, unless it has ended."""
        over = self._alive.whole and bool(select.select([self._alive.number], [], [], 0)[0])
        for descriptor in (self._alive, self._line, self._dump):
            descriptor.close()
        with contextlib.suppress(OSError):
            if not over:  # it may have been stopped, and would hear nothing
                os.kill(self.pid, signal.SIGKILL)
            os.unlink(self._path)


@dataclass(frozen=True, kw_only=True)
class Limit:
    """How long a method may predict: ``seconds`` per sample of a batch.

    ``hint``: what to do about it; ``about``: what goes into the note of the watchdog.
    """

    watchdog: Watchdog
    seconds: float
    hint: str = ""
    about: Mapping[str, Any] = field(default_factory=dict)

    def predict(
        self, method: Method, batch: list[Observation], seed: int, what: str, **about: Any
    ) -> Sequence[Prediction]:
        """The method's answers; ``what``: the call, in words."""
        seconds = self.seconds * max(len(batch), 1)
        if isinstance(method, RemoteMethod):  # its worker is ended, not this process
            return method.predict_within(batch, seed, seconds)
        try:
            file = inspect.getfile(type(method))
        except (TypeError, OSError):
            file = ""
        about = {**self.about, **about}
        with self.watchdog.watch(what, seconds, hint=self.hint, file=file, **about):
            return method.predict(batch, seed)


class Limited:
    """A method that is like another one, but for a limit on the time of its predictions."""

    def __init__(self, method: Method, limit: Limit) -> None:
        self._method, self._limit = method, limit

    def __getattr__(self, name: str) -> Any:
        return getattr(self._method, name)

    def predict(self, batch: list[Observation], seed: int) -> Sequence[Prediction]:
        """The same answers."""
        count = "1 observation" if len(batch) == 1 else f"{len(batch)} observations"
        what = f"{self._method.info.name}: predict of {count} in a check of the contract"
        return self._limit.predict(self._method, batch, seed, what)


def _unused_signal() -> signal.Signals | int:
    """A signal that nobody handles: a real-time one, where there are such."""
    names = ("SIGUSR2", "SIGUSR1", "SIGPROF")
    numbers = [signal.SIGRTMAX - 1] if hasattr(signal, "SIGRTMAX") else []
    numbers += [getattr(signal, name) for name in names if hasattr(signal, name)]
    free = [number for number in numbers if signal.getsignal(number) == signal.SIG_DFL]
    return (free or numbers)[0]
