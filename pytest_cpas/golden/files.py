"""Golden tables as files: found, read and checked, replaced as a whole."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import filelock

from pytest_cpas._files import cache_folder, sync_folder, write_through
from pytest_cpas.golden.tables import GoldenError, RunTable, parse_golden, parse_samples
from pytest_cpas.reading.files import (
    NoFileError,
    decoded,
    lines_of,
    opened,
    read_bytes,
    read_text,
    sha256,
)
from pytest_cpas.reading.structured import LARGEST_TOML
from pytest_cpas.types import ContractError, DataError
from pytest_cpas.types.names import checked_name

__all__ = ["find_golden", "is_recorded", "orphans", "read_golden", "record", "shipped_golden"]


#: The two files of a table.
_TABLE, _SAMPLES = "table.toml", "samples.csv"

#: Largest ``samples.csv``, bytes: that of ten million samples.
_LARGEST = 2**30

#: How the name of a file ends that is not complete.
_PART = ".part"

#: Seconds to wait for another update of the same folder.
_PATIENCE = 60.0

#: A checkout must not change the line ends: the table names the digest of the samples.
_ATTRIBUTES = b"recorded/** text eol=lf\n"


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
        _tidy(folder)
        if is_recorded(folder):
            return read_golden(folder)
    return None


def is_recorded(folder: Path) -> bool:
    """Whether a folder holds a golden table, sound or not: a first update that was killed before
    it had written one leaves none."""
    return any((folder / name).exists() for name in (_TABLE, _SAMPLES))


def record(golden: Path, table: RunTable) -> Path:
    """Write a run's table below ``golden``, as the golden one, and return its folder.

    The categories that it lacks are kept as they are, in the table that is there or else in the one
    that ships with the plugin. Two updates at once wait for each other, and whoever is killed at
    any step leaves either the old table or the new one. Raises :class:`GoldenError`, the old table
    intact, for a table that must not be recorded (see :meth:`RunTable.recordable`), a damaged old
    one, or a disk that does not take it.
    """
    folder = _folder(golden, table.method, table.dataset)
    try:
        with _exclusive(folder, _PATIENCE):
            _settle(folder)
            there = next((f for f in _places(golden, table) if is_recorded(f)), None)
            previous = None if there is None else _read_told(there)
            _write(folder, table.recordable(previous))
    except filelock.Timeout as error:
        raise GoldenError(f"{folder}: another update has held it for {_PATIENCE:g} s") from error
    except (OSError, DataError) as error:
        raise GoldenError(f"{folder}: the golden table cannot be written ({error})") from error
    return folder


def orphans(golden: Path, methods: set[str]) -> list[Path]:
    """The folders of recorded tables below ``golden`` whose method is none of ``methods``."""
    folders = sorted(path.parent for path in golden.glob("recorded/*/*/table.toml"))
    return [folder for folder in folders if folder.parent.name not in methods]


def _folder(golden: Path, method: str, dataset: str) -> Path:
    """Where a table is: below ``golden``, whatever the names are."""
    try:
        names = checked_name("method", method), checked_name("data set", dataset)
    except ContractError as error:
        raise GoldenError(str(error)) from error
    return golden.joinpath("recorded", *names)


def _places(golden: Path, table: RunTable) -> Iterator[Path]:
    for root in (golden, shipped_golden()):
        yield _folder(root, table.method, table.dataset)


def _exclusive(folder: Path, patience: float) -> filelock.BaseFileLock:
    """A lock on a folder. Its file is elsewhere: golden tables are kept under version control."""
    name = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()
    path = cache_folder() / "locks" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return filelock.FileLock(path, timeout=patience)


# -- writing ------------------------------------------------------------------------------------


def _write(folder: Path, table: RunTable) -> None:
    """Replace both files. Under the lock of the folder, and settled.

    Both are complete on the disk, and have been read back, before either is replaced. Replacing
    the table commits: from then on :func:`_read` takes the samples that it names from the file that
    is still waiting, should the writer die before that has got its place.
    """
    samples = table.samples_csv().encode()
    cells = table.table_toml(samples.decode()).encode()
    digest = hashlib.sha256(samples).hexdigest()
    _make(folder)
    attributes = folder.parents[2] / ".gitattributes"
    try:
        if not attributes.exists():
            write_through(folder / f".attributes{_PART}", _ATTRIBUTES)
            (folder / f".attributes{_PART}").replace(attributes)
            sync_folder(attributes.parent)
        if _file_digest(folder / _SAMPLES) != digest:
            write_through(folder / f".samples{_PART}", samples)
            (folder / f".samples{_PART}").replace(_waiting(folder, digest))
        write_through(folder / f".table{_PART}", cells)
        _check_readable(folder, digest, table)
        sync_folder(folder)
        (folder / f".table{_PART}").replace(folder / _TABLE)
        sync_folder(folder)
    except BaseException:
        _settle(folder)
        raise
    _settle(folder)


def _check_readable(folder: Path, digest: str, table: RunTable) -> None:
    """Read what is about to replace the old table; :class:`GoldenError` unless it is ``table``."""
    waiting = _waiting(folder, digest)
    samples = waiting if waiting.exists() else folder / _SAMPLES
    try:
        again = _read_files(folder, folder / f".table{_PART}", samples)
    except (OSError, DataError, GoldenError) as error:
        raise GoldenError(f"what would be recorded cannot be read back ({error})") from error
    if again.samples_csv() != table.samples_csv() or again.table != table.table:
        raise GoldenError("what would be recorded is not what is read back")


def _make(folder: Path) -> None:
    """Make a folder and those above it, on the disk."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in missing:
        sync_folder(path.parent)


def _settle(folder: Path) -> None:
    """Finish what an update that was killed left: samples that a table waits for get their place,
    what no table names goes. Under the lock of the folder."""
    leftovers = _leftovers(folder)
    if not leftovers:
        return
    waiting = _waiting(folder, _named_digest(folder))
    if waiting in leftovers and _file_digest(folder / _SAMPLES) != _named_digest(folder):
        waiting.replace(folder / _SAMPLES)
        leftovers.remove(waiting)
        sync_folder(folder)
    for path in leftovers:
        path.unlink(missing_ok=True)


def _tidy(folder: Path) -> None:
    """The same for readers, who leave it to a writer at work, or do without where nothing can be
    written: :func:`_read` takes a table that was committed from wherever it is."""
    if _leftovers(folder):
        with suppress(OSError, filelock.Timeout), _exclusive(folder, 0):
            _settle(folder)


def _leftovers(folder: Path) -> list[Path]:
    return [*folder.glob(_waiting(folder, "*").name), *folder.glob(f".*{_PART}")]


def _waiting(folder: Path, digest: str) -> Path:
    """Samples, complete, that wait for the table that names them to be in its place."""
    return folder / f".samples-{digest}.csv"


# -- reading ------------------------------------------------------------------------------------


def read_golden(folder: Path) -> RunTable:
    """Read ``table.toml`` and ``samples.csv`` and check them against each other.

    Raises :class:`GoldenError` that names the file.
    """
    _tidy(folder)
    try:
        return _read(folder)
    except (OSError, ValueError, GoldenError):
        pass  # a writer may have come between the two files
    try:
        with _exclusive(folder, _PATIENCE):
            return _read_told(folder)
    except filelock.Timeout as error:
        raise GoldenError(f"{folder}: an update has held it for {_PATIENCE:g} s") from error


def _read_told(folder: Path) -> RunTable:
    """Read a table that nobody writes; :class:`GoldenError` says what to do if it is damaged."""
    try:
        return _read(folder)
    except (OSError, DataError, GoldenError) as error:
        raise GoldenError(
            f"{folder}: {error}; it was damaged or edited by hand. Restore it from version"
            " control, or remove it and record it anew with --snapshot-update"
        ) from error


def _read(folder: Path) -> RunTable:
    """The samples are those that the table names: in their place, or waiting for it."""
    digest = _named_digest(folder)
    waiting = _waiting(folder, digest)
    if waiting.exists() and _file_digest(folder / _SAMPLES) != digest:
        return _read_files(folder, folder / _TABLE, waiting)
    return _read_files(folder, folder / _TABLE, folder / _SAMPLES)


def _read_files(folder: Path, table: Path, samples: Path) -> RunTable:
    text = read_text(table, LARGEST_TOML)
    digest = _file_digest(samples)
    names = folder.parent.name, folder.name
    if digest != _named(text) and b"\r\n" in (content := read_bytes(samples, _LARGEST)):
        # checked out with the line ends of Windows; what is recorded has no \r of its own
        content = content.replace(b"\r\n", b"\n")
        return parse_golden(*names, text, decoded(samples, content))
    with opened(samples, _LARGEST) as samples_csv:  # which can be large
        file = io.TextIOWrapper(samples_csv, encoding="utf-8", newline="")
        return parse_samples(*names, text, lines_of(file, _SAMPLES), digest)


def _named_digest(folder: Path) -> str:
    """The digest of the samples that the table of a folder names, or "" without a table."""
    path = folder / _TABLE
    return _named(read_text(path, LARGEST_TOML, "replace")) if path.exists() else ""


def _named(table_toml: str) -> str:
    named = re.search(r'^samples_sha256 = "(\w+)"\r?$', table_toml, re.MULTILINE)
    return named[1] if named else ""


def _file_digest(path: Path) -> str:
    """The SHA-256 of a file; "" if there is none."""
    try:
        return sha256(path, _LARGEST)
    except NoFileError:
        return ""
