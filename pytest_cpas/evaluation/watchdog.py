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
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from pytest_cpas.reading.text import terminal_lines
from pytest_cpas.types import Method, Observation, Prediction

__all__ = ["Limit", "Limited", "Watchdog", "can_watch", "parse_seconds"]

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


class Watchdog:
    """Ends this process with SIGKILL when a call takes too long, and says where it was.

    ``note``: a file for what was found, for whoever looks after this
    process; ``stderr``: the file descriptor where it is said, None for nowhere. ``about``: what
    else goes into the note, plain values; whoever knows them sets them.
    """

    def __init__(self, *, note: Path | None = None, stderr: int | None = None) -> None:
        """Nothing is started before the first call."""
        self.about: Mapping[str, Any] = {}
        self._note = note
        self._stderr = None if stderr is None else os.dup(stderr)
        self._owner = os.getpid()
        self._process: subprocess.Popen[bytes] | None = None
        self._dump: IO[bytes] | None = None
        self._number = _unused_signal()

    @contextlib.contextmanager
    def watch(
        self, what: str, seconds: float, *, hint: str = "", file: str = "", **about: Any
    ) -> Iterator[None]:
        """End this process if the block takes longer than ``seconds``.

        ``what``: the block, in words; ``hint``: what to do about it; ``file``: the source
        of the foreign code, so that its line is named; ``about``: more for the note. A copy of this
        process is not watched.
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
        self._say(json.dumps(call))
        try:
            yield
        finally:
            self._say("")

    def close(self) -> None:
        """Watch no longer."""
        if self._process is not None and os.getpid() == self._owner:
            self._end()
        if self._stderr is not None:
            os.close(self._stderr)
            self._stderr = None

    def _say(self, line: str) -> None:
        data = line.encode() + b"\n"
        pipe = self._started()
        if line and self._dump is not None:
            # anew each time: foreign code may have taken the signal for itself
            faulthandler.register(self._number, file=self._dump, all_threads=True, chain=False)
        try:
            os.write(pipe, data)
        except BrokenPipeError:  # somebody has killed the watching process
            self._end()
            os.write(self._started(), data)

    def _started(self) -> int:
        if self._process is None:
            descriptor, dump = tempfile.mkstemp(prefix="pytest-cpas-stacks-")
            self._dump_path = Path(dump)
            self._dump = os.fdopen(descriptor, "wb", buffering=0)
            command = [sys.executable, "-I", "-S", str(Path(__file__).with_name("watching.py"))]
            command += [str(self._owner), str(int(self._number)), dump]
            command += [] if self._note is None else [str(self._note)]
            self._process = subprocess.Popen(  # noqa: S603 - our own file
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL if self._stderr is None else self._stderr,
            )
            faulthandler.register(self._number, file=self._dump, all_threads=True, chain=False)
        return self._process.stdin.fileno()  # type: ignore[union-attr]

    def _end(self) -> None:
        process, self._process = self._process, None
        dump, self._dump = self._dump, None
        faulthandler.unregister(self._number)
        if process is not None and process.stdin is not None:
            with contextlib.suppress(OSError):
                process.stdin.close()
            process.wait()
        if dump is not None:
            dump.close()
            # a watching process that was killed has left it
            self._dump_path.unlink(missing_ok=True)


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
        try:
            file = inspect.getfile(type(method))
        except (TypeError, OSError):
            file = ""
        seconds = self.seconds * max(len(batch), 1)
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
