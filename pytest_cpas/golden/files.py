"""Golden tables as files: found, read and checked, replaced as a whole."""

from __future__ import annotations

import hashlib
import io
import re
from pathlib import Path

import filelock

from pytest_cpas._files import cache_folder, write_through
from pytest_cpas.golden.tables import GoldenError, RunTable, _digest, _parse

__all__ = ["find_golden", "orphans", "read_golden", "record", "shipped_golden"]


#: Seconds to wait for another update of the same folder.
_PATIENCE = 60.0


def shipped_golden() -> Path:
    """The golden tables that ship with the plugin; never written to when installed."""
    package = Path(__file__).parents[1]
    installed = package / "shipped_golden"
    return installed if installed.is_dir() else package.parent / "golden"


def find_golden(golden: Path, method: str, dataset: str) -> RunTable | None:
    """The table below ``golden``, else the one that ships with the plugin, else None.

    Raises :class:`GoldenError` for a table that is damaged.
    """
    for root in (golden, shipped_golden()):
        folder = _folder(root, method, dataset)
        if folder.is_dir():
            return read_golden(folder)
    return None


def record(golden: Path, table: RunTable) -> Path:
    """Write a run's table below ``golden``, as the golden one, and return its folder.

    The categories that it lacks are kept as they are. Two updates at once wait for each other,
    and whoever is killed half-way leaves either the old table or the new one. Raises
    :class:`GoldenError`, the old table intact, for a table that must not be recorded (see
    :meth:`RunTable.recordable`), a damaged old one, or a disk that does not take it.
    """
    folder = _folder(golden, table.method, table.dataset)
    try:
        with _exclusive(folder):
            previous = read_golden(folder) if folder.is_dir() else None
            _write(folder, table.recordable(previous))
    except filelock.Timeout as error:
        raise GoldenError(f"{folder}: another update has held it for {_PATIENCE:g} s") from error
    return folder


def orphans(golden: Path, methods: set[str]) -> list[Path]:
    """The folders of recorded tables below ``golden`` whose method is none of ``methods``."""
    folders = sorted(path.parent for path in golden.glob("recorded/*/*/table.toml"))
    return [folder for folder in folders if folder.parent.name not in methods]


def _folder(golden: Path, method: str, dataset: str) -> Path:
    return golden / "recorded" / method / dataset


def _exclusive(folder: Path) -> filelock.BaseFileLock:
    """A lock on a folder. Its file is elsewhere: golden tables are kept under version control."""
    name = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()
    path = cache_folder() / "locks" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return filelock.FileLock(path, timeout=_PATIENCE)


def _write(folder: Path, table: RunTable) -> None:
    """Both files are complete on the disk before either is replaced.

    Replacing the table commits: from then on :func:`read_golden` takes the samples that it names
    from the file that is still waiting, should the writer die before that has got its place.
    """
    samples = table.samples_csv()
    cells = table.table_toml(samples)
    waiting, new = _waiting(folder, _digest(samples)), folder / ".table.toml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            write_through(waiting, samples.encode())
            write_through(new, cells.encode())
            new.replace(folder / "table.toml")
        except BaseException:
            waiting.unlink(missing_ok=True)
            new.unlink(missing_ok=True)
            raise
        waiting.replace(folder / "samples.csv")
        for path in folder.glob(_waiting(folder, "*").name):
            path.unlink()
    except OSError as error:
        raise GoldenError(f"{folder}: the golden table cannot be written ({error})") from error


def _waiting(folder: Path, digest: str) -> Path:
    return folder / f".samples-{digest}.csv"


def read_golden(folder: Path) -> RunTable:
    """Read ``table.toml`` and ``samples.csv`` and check them against each other.

    Raises :class:`GoldenError` that names the file.
    """
    try:
        try:
            return _read(folder)
        except (OSError, GoldenError):
            with _exclusive(folder):  # a writer may have come between the two files
                return _read(folder)
    except (OSError, UnicodeDecodeError, GoldenError, filelock.Timeout) as error:
        raise GoldenError(
            f"{folder}: {error}; it was damaged or edited by hand. Restore it from version"
            " control, or remove it and record it anew with --snapshot-update"
        ) from error


def _read(folder: Path) -> RunTable:
    toml = (folder / "table.toml").read_bytes().decode("utf-8")
    named = re.search(r'^samples_sha256 = "(\w+)"$', toml, re.MULTILINE)
    waiting = _waiting(folder, named[1] if named else "")
    path = waiting if waiting.exists() else folder / "samples.csv"
    with path.open("rb") as samples_csv:  # which can be large
        digest = hashlib.file_digest(samples_csv, "sha256").hexdigest()
        samples_csv.seek(0)
        lines = io.TextIOWrapper(samples_csv, encoding="utf-8", newline="")
        return _parse(folder.parent.name, folder.name, toml, lines, digest)
