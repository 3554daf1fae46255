"""What changes of a program while it runs.

A program is identified when its run begins. Much of what it is made of is imported, or read, after
that: when the method is loaded, at some sample, in another process. So whoever keeps rows, or
records them, asks here whether the files are still those that were identified.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from pytest_cpas.evaluation.surroundings import digest_again, digest_of_start

__all__ = ["Meanwhile", "Seen", "seen", "stamp"]

Stamp = tuple[int, ...]

#: Share of the time of a run that is spent on looking.
_SHARE = 0.05


@dataclass(frozen=True)
class Seen:
    """A file as it was before it was read.

    ``stamp``: as of :func:`stamp`; ``digest``: that of its content, which may be written anew as it
    was; None where that may not be: by then, another content may have been there. ``told``: golden
    tables tell of its content. ``grows``: how many bytes it had, if what comes behind them
    may be somebody's output, even that of this run; None if it may not.
    """

    name: str
    stamp: Stamp | None
    digest: str | None = None
    told: bool = True
    grows: int | None = None


def stamp(path: Path) -> Stamp | None:
    """What changes when a file is written, moved or replaced, even by what was there before; None
    if there is none. The last number is when that was, nanoseconds since 1970."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


def seen(names: Mapping[Path, str]) -> dict[Path, Seen]:
    """Files that may not be written at all, by what they are called; before they are read."""
    return {path: Seen(name, stamp(path)) for path, name in names.items()}


class Meanwhile:
    """What has changed of the files of a program since they were seen."""

    def __init__(self, *files: Mapping[Path, Seen]) -> None:
        """All ``files`` are watched."""
        self._files = {path: file for some in files for path, file in some.items()}
        self._changed: dict[str, bool] = {}
        self._grown: set[str] = set()
        self._rests_until = 0.0

    @property
    def changed(self) -> Mapping[str, bool]:
        """Names of what has changed, and whether golden tables tell of it."""
        return self._changed

    def watch(self, files: Mapping[Path, Seen]) -> None:
        """Watch further files."""
        self._files |= files

    def since(self, when: int) -> None:
        """What may not be written at all, and was since ``when``, nanoseconds since 1970, has
        changed: it may have been imported before it was seen."""
        for file in self._files.values():
            if file.digest is None and file.stamp is not None and file.stamp[-1] > when:
                self.add([file.name], told=file.told)

    def add(self, names: Iterable[str], *, told: bool) -> None:
        """Take in what has changed."""
        for name in set(names) - self._grown:
            self._changed[name] = told or self._changed.get(name, False)

    def look(self) -> None:
        """Look at all files, unless that was done a moment ago."""
        began = time.monotonic()
        if began < self._rests_until:
            return
        for path, file in list(self._files.items()):
            now = stamp(path)
            if now == file.stamp:
                continue
            del self._files[path]
            if now is None:
                self.add([f"{file.name} (gone)"], told=file.told)
            elif file.digest is not None and file.digest == digest_again(path, file.digest):
                self._files[path] = replace(file, stamp=now)
            elif file.grows is not None and file.digest == digest_of_start(path, file.grows):
                self._files[path] = replace(file, stamp=now)
                self._grown.add(file.name)
            else:
                self._grown.discard(file.name)
                self.add([file.name], told=file.told)
        ended = time.monotonic()
        self._rests_until = ended + (ended - began) / _SHARE
