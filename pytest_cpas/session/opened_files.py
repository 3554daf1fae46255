"""Files that a method opens, or a plugin beside it: what no text names is seen when it is read.

Python tells of every file that its code opens, of every library that it loads and of every process
that it starts (audit events, PEP 578). What is read by other code than the harness belongs to the
program that answers. What compiled code opens by itself, and other processes, is not told.
"""

from __future__ import annotations

import importlib.util
import itertools
import os
import stat
import sys
import sysconfig
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

__all__ = ["OpenedFiles", "listen", "opened_files"]

#: Modules that read for the harness or for pytest, unless other code asks them to.
_OURS = frozenset(
    {
        *("__main__", "_pytest", "pytest", "pluggy", "iniconfig", "xdist", "execnet", "syrupy"),
        *("pytest_cpas", "hypothesis", "numpy", "scipy", "numba", "llvmlite", "PIL", "trimesh"),
        *("open3d", "torch", "platformdirs", "requests", "h5py", "coverage", "pytest_cov"),
    }
)

#: Files that are remembered: a method with more has them in a folder of data.
_MOST = 2000

#: What is listened to, and which of its arguments names a file.
_EVENTS = {"open": 0, "subprocess.Popen": 1, "import": 1, "ctypes.dlopen": 0}

#: Folders that tools keep for themselves.
_CACHES = frozenset({"__pycache__", ".pytest_cache", ".hypothesis", ".git"})

_NO_FILES = ("/proc/", "/sys/", "/dev/")

_Stamp = tuple[int, ...]

#: Of a file that is not there.
_GONE: _Stamp = (0, 0, 0, 0, 0)


class OpenedFiles:
    """What is read of files from now on, in this process, by code that is not the harness's.

    A file that this process has changed itself, or that was made in the folder of temporary files
    since, is its own output.
    """

    def __init__(self) -> None:
        self._began = time.time_ns()
        self._read: dict[str, _Stamp] = {}
        #: Opened to be written; opened to be read and written, which may leave it as it is.
        self._written: set[str] = set()
        self._both: set[str] = set()
        #: What is told of; those of it that were opened to be written; and what is no part of the
        #: program, whenever it is read.
        self._settled: dict[str, _Stamp] = {}
        self._own: set[str] = set()
        self._others: set[str] = set()
        #: In the order in which it was told.
        self._told: dict[tuple[str, str], None] = {}
        self._handed_on = 0
        self._temporary = os.path.realpath(tempfile.gettempdir()) + os.sep
        places = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib")}
        package = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
        self._elsewhere = (*_NO_FILES, *(place + os.sep for place in [*places, package]))

    def started(self, name: Any, frame: FrameType) -> None:
        """The code of a frame hands a word to another process, or to the loader of libraries; it
        may name a file."""
        if isinstance(name, (str, bytes, os.PathLike)) and os.path.isfile(name):
            self.opened(name, os.O_RDONLY, frame)

    def opened(self, name: Any, flags: int, frame: FrameType) -> None:
        """The code of a frame opens a file, or tries to."""
        if isinstance(name, int):
            return
        path = os.path.abspath(os.fsdecode(name))
        if path.startswith(self._elsewhere):
            return
        if flags & (os.O_WRONLY | os.O_RDWR) and path in self._settled:
            self._own.add(path)
        if flags & (os.O_WRONLY | os.O_TRUNC):
            self._written.add(path)
            return
        if flags & os.O_RDWR:
            self._both.add(path)
        path = _source_of(path)
        if path in self._others or path in self._written:
            return
        if _is_asked_by_others(frame):
            found = _stamp(path)
            if found is not None and self._settled.get(path) != found:
                # what was read first counts, until it is settled
                self._read.setdefault(path, found)

    def take(self, told: Iterable[tuple[str, str]]) -> None:
        """Take in what was heard in another process of the same run."""
        self._told |= dict.fromkeys(told)

    def news(self) -> list[tuple[str, str]]:
        """What :meth:`told` tells, but for what this has told already."""
        new = [*itertools.islice(self.told(), self._handed_on, None)]
        self._handed_on += len(new)
        return new

    def told(self) -> Collection[tuple[str, str]]:
        """Names and digests of the files that were read up to now. One that was read twice, and
        written by somebody in between, has two digests; one that this process has written has that
        for a digest. What is new stands behind what is not."""
        from pytest_cpas.evaluation import (
            OWN,
            digest_of_opened,
            is_installed,
            is_left_out,
            opened_name,
        )

        for path in self._own:
            if _stamp(path) != self._settled[path]:
                self._told[opened_name(Path(path)), OWN] = None
        while self._read:
            path, before = self._read.popitem()
            if (
                not _CACHES.isdisjoint(path.split(os.sep))
                or is_installed(Path(path))
                or is_left_out(Path(path))
            ):
                self._others.add(path)
                continue
            if (
                len(self._settled) >= _MOST
                or path in self._written
                or (path in self._both and _stamp(path) != before)
                or (before[-1] >= self._began and path.startswith(self._temporary))
            ):
                continue
            self._settled[path] = before
            if path in self._both:
                self._own.add(path)
            name = opened_name(Path(path))
            digest = digest_of_opened(name)
            self._told[name, digest if _stamp(path) == before else f"{digest} at last"] = None
        return self._told.keys()


def _is_asked_by_others(frame: FrameType | None) -> bool:
    return any(
        name not in _OURS and name not in sys.stdlib_module_names for name in _modules(frame)
    )


def _modules(frame: FrameType | None) -> Iterator[str]:
    """The outermost package of each function that is being called, innermost first."""
    # whoever has called pytest is not the code that is judged
    while frame is not None and frame.f_code is not pytest.main.__code__:
        yield str(frame.f_globals.get("__name__", "?")).partition(".")[0]
        frame = frame.f_back


def _source_of(path: str) -> str:
    """Of what Python has compiled: the source, if that is there."""
    if not path.endswith(".pyc"):
        return path
    try:
        source = importlib.util.source_from_cache(path)
    except ValueError:
        return path
    return source if os.path.isfile(source) else path


def _stamp(path: str) -> _Stamp | None:
    """What changes when a file is written or made; None for what is none."""
    try:
        found = os.stat(path)
    except OSError:
        return _GONE
    if not stat.S_ISREG(found.st_mode):
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


#: Of the run in this process; the only one that hears, since no hook of this kind can be removed.
_opened: OpenedFiles | None = None
_hears = False


def listen() -> None:
    """Begin to listen for a run."""
    global _opened, _hears
    _opened = OpenedFiles()
    if not _hears:
        sys.addaudithook(_heard)
        _hears = True


def _heard(event: str, arguments: tuple[Any, ...]) -> None:
    """An audit event; raises nothing, since that would reach whoever opens the file."""
    if event not in _EVENTS or _opened is None:
        return
    try:
        frame = sys._getframe(1)
        if event == "open":
            _opened.opened(arguments[0], arguments[2], frame)
        elif event == "subprocess.Popen":
            words = arguments[1]
            for word in [words] if isinstance(words, (str, bytes, os.PathLike)) else words:
                _opened.started(word, frame)
        else:
            _opened.started(arguments[_EVENTS[event]], frame)
    except (TypeError, ValueError, OSError):  # no name, as whoever opens it will find
        return


def opened_files() -> OpenedFiles:
    """What has been heard in this process; nothing unless somebody listens."""
    return _opened or OpenedFiles()
