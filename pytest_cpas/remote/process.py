"""One life of a worker: the process, the pipes to it, and what becomes of both.

Everything is read and written in one loop that also sees the worker's error stream, its end and the
clock, so that nothing here waits for ever for a worker that does not.
"""

from __future__ import annotations

import atexit
import base64
import contextlib
import os
import re
import secrets
import select
import signal
import subprocess
import sys
import time
import weakref
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from pytest_cpas.reading.files import read_bytes
from pytest_cpas.reading.text import terminal_lines
from pytest_cpas.remote import worker as _worker
from pytest_cpas.remote.frames import FrameError, arrays_of, encoded, header_of, sizes_of
from pytest_cpas.remote.worker import LENGTHS, PROTOCOL
from pytest_cpas.types import ToldError, shortened

try:
    import fcntl
except ImportError:  # where no worker is started either
    fcntl = None  # type: ignore[assignment]

__all__ = ["WorkerError", "WorkerProcess", "close_all", "indented"]

#: Bytes of the error stream that are kept, and lines of it that are told.
_KEPT, _LINES = 2**16, 20

#: Bytes that others may print before the worker answers, or between its answers.
_MOST_NOISE = 2**20

#: Reads of the error stream, one after the other, before anything else is looked at.
_MOST_READS = 64

#: Seconds for a worker to end by itself, and between two looks at whether it has.
_GRACE, _GRACE_AT_START, _LOOK = 3.0, 0.2, 0.5

_PIPE_SIZE = 2**20
_CHUNK = 2**20

_alive: weakref.WeakSet[WorkerProcess] = weakref.WeakSet()

#: Commands that did not end when they were killed; nobody waits for them.
_left: list[subprocess.Popen[bytes]] = []


class WorkerError(ToldError):
    """A worker that cannot be started, died, fell silent, or answered what is no answer.

    ``again``: whether it is started again if anything comes next, in words, or "".
    """

    again = ""


class WorkerProcess:
    """A worker that has been started: requests in turn, until it is closed or ends."""

    def __init__(
        self,
        command: Sequence[str],
        *,
        shell: bool,
        copy: str | None,
        environment: Mapping[str, str],
        seconds: float,
    ) -> None:
        """Start ``command`` and wait until the worker in it answers; :class:`WorkerError`.

        ``shell``: the command hands its words to a shell, as ssh does; ``copy``: where the worker
        lies on the other side, None to send it; ``seconds``: for the answer.
        """
        self._token = secrets.token_hex(8)
        self._errors = bytearray()
        self._waiting = bytearray()  # of the answers, what has been read and not been taken
        self._owner = os.getpid()
        self.hello: Mapping[str, Any] = {}
        self._process: subprocess.Popen[bytes] | None = None
        words, first = _started_with(self._token, shell=shell, copy=copy)
        if not hasattr(select, "poll") or fcntl is None:
            raise WorkerError("methods in another interpreter need pipes of POSIX")
        try:
            self._process = subprocess.Popen(  # noqa: S603 - as it was asked for
                [*command, *words],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env={**os.environ, **environment},
                bufsize=0,
                # neither Ctrl-C nor a question for a password gets there
                start_new_session=True,
            )
        except (OSError, ValueError) as error:
            raise WorkerError(f"the command cannot be started: {error}") from None
        _alive.add(self)
        self._in, self._out, self._err = (
            stream.fileno()
            for stream in (self._process.stdin, self._process.stdout, self._process.stderr)
            if stream is not None
        )
        for number in (self._in, self._out, self._err):
            os.set_blocking(number, False)
            with contextlib.suppress(OSError, AttributeError):
                fcntl.fcntl(number, fcntl.F_SETPIPE_SZ, _PIPE_SIZE)
        self._first = first
        try:
            self.hello, _ = self._exchange([first], seconds, "the worker to start")
        except BaseException:
            self.close()
            raise
        if self.hello.get("protocol") != PROTOCOL:
            self.close()
            raise WorkerError(
                f"it speaks version {self.hello.get('protocol')!s:.50} of the protocol, this"
                f" pytest-cpas version {PROTOCOL}; copy {_worker.__file__} there anew"
            )

    def ask(
        self,
        request: Mapping[str, Any],
        arrays: Sequence[NDArray[Any]] = (),
        *,
        seconds: float | None,
        what: str,
    ) -> tuple[dict[str, Any], list[NDArray[Any]]]:
        """The answer to a request and its arrays, read-only.

        Raises :class:`WorkerError` if none comes within ``seconds``, or ever; it is ended then.
        """
        try:
            return self._exchange(encoded(self._token.encode(), request, arrays), seconds, what)
        except BaseException:
            self.close()
            raise

    @property
    def ended(self) -> bool:
        """Whether it was closed, or has ended."""
        return self._process is None or self._process.poll() is not None

    def close(self) -> None:
        """Cut the line, upon which the worker ends, and end what is left of it."""
        process, self._process = self._process, None
        if process is None or os.getpid() != self._owner:
            return
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                stream.close()
        # before it has answered there is nobody on the other side who would tidy up
        until = time.monotonic() + (_GRACE if self.hello else _GRACE_AT_START)
        while process.poll() is None and time.monotonic() < until:
            self._read_errors(0.02)
        with contextlib.suppress(OSError):
            os.killpg(process.pid, signal.SIGKILL)
        try:
            process.wait(_GRACE)
        except subprocess.TimeoutExpired:  # it may not be killed, or the system holds it
            _left.append(process)
        self._read_errors(0)
        self.show()
        if process.stderr is not None:
            process.stderr.close()
        _alive.discard(self)

    def show(self) -> None:
        """Hand on what the method has printed, as if that had been here."""
        if self._errors:
            text = self._errors.decode("utf-8", "replace").replace("\r\n", "\n")
            sys.stderr.write(terminal_lines(re.sub(rf"\n?{self._token} .*\n?", "", text)))
            self._told = bytes(self._errors[-_KEPT:])
            self._errors.clear()

    _told = b""

    def last_words(self, noise: bytes = b"") -> str:
        """The last lines of the error stream, and of what came in place of an answer, for a
        message."""
        printed = self._told + bytes(self._errors) + noise[-_KEPT:]
        text = printed.decode("utf-8", "replace")
        own = re.compile(rf'\s*$|.*{self._token}|  File "(cpas_worker\.py|<string>)", line \d+ in ')
        lines = [line for line in text.splitlines() if not own.match(line)]
        return terminal_lines("\n".join(lines[-_LINES:]))

    # -- the loop ---------------------------------------------------------------------------

    def _exchange(
        self, pieces: list[Any], seconds: float | None, what: str
    ) -> tuple[dict[str, Any], list[NDArray[Any]]]:
        """Write a request and read the answer."""
        until = None if seconds is None else time.monotonic() + seconds
        reading = _Reading(self._token.encode(), self._waiting)
        writing = [memoryview(piece).cast("B") for piece in pieces]
        try:
            while not reading.whole:
                self._step(reading, writing, until, seconds, what)
        except FrameError as error:
            raise WorkerError(f"{what}: {error}{self._printed(reading)}") from None
        self._waiting = reading.rest
        self.show()
        return reading.header, reading.arrays

    def _step(
        self,
        reading: _Reading,
        writing: list[memoryview],
        until: float | None,
        seconds: float | None,
        what: str,
    ) -> None:
        poller = select.poll()
        poller.register(self._out, select.POLLIN)
        poller.register(self._err, select.POLLIN)
        if writing:
            poller.register(self._in, select.POLLOUT)
        left = _LOOK if until is None else min(max(until - time.monotonic(), 0), _LOOK)
        events = dict(poller.poll(1000 * left))
        if self._err in events:
            self._read_errors(0)
        if self._in in events:
            try:
                _advance(writing, os.writev(self._in, writing[:64]))
            except BlockingIOError:
                pass
            except OSError:
                writing.clear()  # why nobody reads it is seen at the other pipe
        if self._out in events:
            with contextlib.suppress(BlockingIOError):
                if not reading.read_from(self._out):
                    raise self._death(what, reading)
                if not self.hello and reading.rest.startswith(self._first[:60] or b"\0"):
                    raise FrameError("the command sends back what it is told: it is no interpreter")
        elif self.ended:  # somebody else holds its end of the pipe
            raise self._death(what, reading)
        elif until is not None and time.monotonic() >= until:
            self.close()
            raise WorkerError(
                f"{what} took longer than {seconds:g} s, so the worker was ended"
                f"{self._printed(reading)}"
            )

    def _printed(self, reading: _Reading) -> str:
        """The last lines, in words; "" for none."""
        words = self.last_words(reading.noise)
        return f"; it printed last:\n{indented(words)}" if words else ""

    def _read_errors(self, seconds: float) -> None:
        """Take in what the error stream has, waiting for so long; all that is told of it counts."""
        poller = select.poll()
        poller.register(self._err, select.POLLIN)
        for _ in range(_MOST_READS):  # somebody may write without end
            if not poller.poll(1000 * seconds):
                return
            try:
                content = os.read(self._err, _KEPT)
            except BlockingIOError:
                return
            if not content:
                time.sleep(seconds)
                return
            self._errors += content
            del self._errors[: -4 * _KEPT]

    def _death(self, what: str, reading: _Reading) -> WorkerError:
        """That it died, how, and what it printed."""
        process = self._process
        until = time.monotonic() + _GRACE
        while process is not None and process.poll() is None and time.monotonic() < until:
            self._read_errors(0.02)
        self._read_errors(0)
        told = re.search(rb"\n" + self._token.encode() + rb" (signal|status) (\d+)\n", self._errors)
        if told:
            how = _ended(told[1] == b"signal", int(told[2]))
        elif process is None or (status := process.poll()) is None:
            how = "the line to it was closed"
        else:
            how = f"the command ended with {_ended(status < 0, abs(status))}"
        self.close()
        printed = self._printed(reading) or ", and printed nothing"
        if not self.hello and how.endswith("exit status 0"):
            printed += (
                "\nis it an interpreter? shell = true is for a command that hands its words to a"
                " shell, as ssh does, and for no other one"
            )
        return WorkerError(f"{what}: the worker died ({how}){printed}")


class _Reading:
    """An answer, as far as it has come."""

    def __init__(self, token: bytes, rest: bytearray) -> None:
        self.header: dict[str, Any] = {}
        self.arrays: list[NDArray[Any]] = []
        self.rest = rest
        self.whole = False
        self._token, self._body, self._filled = token, bytearray(), 0
        self._in_body = False
        self._advance()

    @property
    def noise(self) -> bytes:
        """What somebody else has written, while no answer has begun."""
        return b"" if self._in_body else bytes(self.rest)

    def read_from(self, number: int) -> bool:
        """Read once; False at the end."""
        if self._in_body and self._filled < len(self._body):
            count = os.readv(number, [memoryview(self._body)[self._filled :]])
            self._filled += count
        else:
            content = os.read(number, _CHUNK)
            count = len(content)
            self.rest += content
        self._advance()
        return count > 0

    def _advance(self) -> None:
        if not self._in_body:
            start = self.rest.find(self._token)
            if start < 0:
                if len(self.rest) > _MOST_NOISE:
                    raise FrameError("somebody else has written into its pipe, and no answer came")
                return
            head = start + len(self._token) + LENGTHS.size
            if len(self.rest) < head:
                return
            size, body = sizes_of(bytes(self.rest[head - LENGTHS.size : head]))
            if len(self.rest) < head + size:
                return
            self.header = header_of(bytes(self.rest[head : head + size]))
            there = self.rest[head + size : head + size + body]
            self.rest = self.rest[head + size + body :]
            self._body, self._filled, self._in_body = bytearray(body), len(there), True
            self._body[: len(there)] = there
        if self._filled == len(self._body) and len(self.rest) >= len(self._token):
            if not self.rest.startswith(self._token):
                raise FrameError("an answer that does not end where it says: is somebody else"
                                 " writing into its pipe?")  # fmt: skip
            self.rest = self.rest[len(self._token) :]
            self.arrays, self.whole = arrays_of(self.header, self._body), True
            for array in self.arrays:
                array.flags.writeable = False


def _advance(pieces: list[memoryview], count: int) -> None:
    """Drop what has been written."""
    while count and pieces:
        if count < len(pieces[0]):
            pieces[0] = pieces[0][count:]
            return
        count -= len(pieces.pop(0))


def _started_with(token: str, *, shell: bool, copy: str | None) -> tuple[list[str], bytes]:
    """The words behind a command that ends with an interpreter, and what it is told first."""
    if copy is not None:
        return [copy, token], b""
    content = base64.b64encode(zlib.compress(read_bytes(Path(_worker.__file__)), 9)).decode()
    # what lies in its folder, and is called as a module of Python's, is not imported for that one
    line = (
        "import sys;p=sys.path[:];sys.path[:]=[f for f in p if f];import types,zlib,base64;"
        'm=types.ModuleType("cpas_worker");sys.modules[m.__name__]=m;'
        f'exec(compile(zlib.decompress(base64.b64decode("{content}")),"cpas_worker.py","exec"),'
        f'm.__dict__);m.here[:]=[f for f in p if not f];m.main("{token}")\n'
    )
    program = "exec(input())"
    return ["-c", f"'{program}'" if shell else program], line.encode()


def _ended(by_signal: bool, number: int) -> str:
    if not by_signal:
        return f"exit status {number}"
    with contextlib.suppress(ValueError):
        return f"signal {number}, {signal.Signals(number).name}"
    return f"signal {number}"


def indented(text: str) -> str:
    """Lines from outside, told apart from ours."""
    return "\n".join(f"    {line}" for line in shortened(text, 1500).splitlines())


def close_all() -> None:
    """End all workers that this process has started."""
    for process in list(_alive):
        process.close()


atexit.register(close_all)
