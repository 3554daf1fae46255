"""Files that an update of a golden table has written, and that have not got their places yet.

Their names hold two digests: of the ``run.toml`` that they belong to, and their own. So whoever
comes later can tell what an update that was killed has left from what anybody else keeps in the
folder, and touches nothing else.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pytest_cpas._files import sync_folder, write_through
from pytest_cpas.golden.older import OLDER_SAMPLES, OLDER_TABLE, belong_together
from pytest_cpas.golden.tables import GoldenError
from pytest_cpas.golden.texts import DETECTIONS, FACTS, RUN
from pytest_cpas.reading.files import read_bytes
from pytest_cpas.reading.paths import names

__all__ = ["LARGEST", "Waiting", "digest_of", "finish", "is_of_table", "put", "waiting"]

#: Largest file of a table, bytes: that of more than a million samples.
LARGEST = 2**28

_FORM = re.compile(r"\.waiting-([0-9a-f]{32})-([0-9a-f]{32})-([a-z.][a-z0-9.-]{0,99})")


def digest_of(content: bytes) -> str:
    """What stands for a content in a name."""
    return hashlib.sha256(content).hexdigest()[:32]


@dataclass(frozen=True)
class Waiting:
    """A file that is to be called ``name``, for the ``run.toml`` of the digest ``run``."""

    path: Path
    run: str
    own: str
    name: str

    def is_complete(self) -> bool:
        """Whether it has the content that its name tells, so that an update wrote it."""
        return _has_digest(self.path, self.own)


def waiting(folder: Path) -> Iterator[Waiting]:
    """The files of a folder with such a name, whoever wrote them."""
    for name in sorted(names(folder)):
        if match := _FORM.fullmatch(name):
            yield Waiting(folder / name, *match.groups())


def put(folder: Path, run: str, name: str, content: bytes) -> Path:
    """Write a file that waits, and return its path.

    What an earlier update has left of the same file is replaced: it is the beginning of the same
    content. :class:`GoldenError` if something else is there.
    """
    path = folder / f".waiting-{run}-{digest_of(content)}-{name}"
    if path.is_symlink() or path.exists():
        if path.is_symlink() or not content.startswith(read_bytes(path, LARGEST)):
            raise GoldenError(f"{path} is there, and no update has written it; remove it")
        path.unlink()
    try:
        write_through(path, content)
    except FileExistsError:  # somebody else's, since just now
        raise
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return path


def finish(folder: Path) -> None:
    """Finish what an update that was killed has left. Under the lock of the folder.

    Files that the table waits for get their places, those of an update that was not committed go,
    and so does a table of an older form that a newer one has replaced. A file that is neither empty
    nor what its name tells is left alone.
    """
    run = folder / RUN
    committed = digest_of(read_bytes(run, LARGEST)) if run.exists() else ""
    _set_older_aside(folder)
    placed = False
    gone = []
    for each in waiting(folder):
        if not each.is_complete():
            if _has_digest(each.path, digest_of(b"")):
                gone.append(each.path)
        elif each.run == committed and each.name != RUN and is_of_table(each.name):
            each.path.replace(folder / each.name)
            placed = True
        else:
            gone.append(each.path)
    if placed:
        sync_folder(folder)
    for path in gone:
        path.unlink(missing_ok=True)


def is_of_table(name: str) -> bool:
    """Whether a file of a table, in its present form, may be called so."""
    return name in (RUN, FACTS, DETECTIONS) or bool(re.fullmatch(r"[a-z][a-z0-9-]*\.toml", name))


def _set_older_aside(folder: Path) -> None:
    """A table of an older form beside a newer one is done with: its samples become a file that
    waits for nothing, and it goes. At every step what is left proves what it is, for it names the
    digest of its samples."""
    table, samples = folder / OLDER_TABLE, folder / OLDER_SAMPLES
    if not (folder / RUN).exists() or not _is_own(table):
        return
    aside = [each for each in waiting(folder) if each.name == OLDER_SAMPLES and each.is_complete()]
    for path in (samples, *(each.path for each in aside)):
        if _is_own(path) and belong_together(*(read_bytes(p, LARGEST) for p in (table, path))):
            if path == samples:
                own = digest_of(read_bytes(path, LARGEST))
                path.replace(folder / f".waiting-{own}-{own}-{OLDER_SAMPLES}")
                sync_folder(folder)
            table.unlink()
            return


def _is_own(path: Path) -> bool:
    """Whether there is a file that is no link."""
    return path.is_file() and not path.is_symlink()


def _has_digest(path: Path, digest: str) -> bool:
    return _is_own(path) and digest_of(read_bytes(path, LARGEST)) == digest
