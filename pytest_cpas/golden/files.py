"""Golden tables as files: found, read and checked, replaced as a whole."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import filelock

from pytest_cpas._files import cache_folder, sync_folder, write_through
from pytest_cpas.golden.older import OLDER_SAMPLES, OLDER_TABLE, parse_older
from pytest_cpas.golden.tables import GoldenError, RunTable
from pytest_cpas.golden.texts import (
    RUN,
    file_names,
    parse_table,
    table_texts,
)
from pytest_cpas.reading.files import NoFileError, decoded, read_bytes
from pytest_cpas.types import ContractError, DataError
from pytest_cpas.types.names import checked_name

__all__ = ["find_golden", "is_recorded", "orphans", "read_golden", "record", "shipped_golden"]


#: Largest file of a table, bytes: that of some million samples.
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
    return any((folder / name).exists() for name in (RUN, OLDER_TABLE, OLDER_SAMPLES))


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
    folders = sorted(
        {path.parent for name in (RUN, OLDER_TABLE) for path in golden.glob(f"recorded/*/*/{name}")}
    )
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
    """Replace all files of a table. Under the lock of the folder, and settled.

    All are complete on the disk, and have been read back, before any is replaced. They wait under
    names that hold the digest of ``run.toml``; replacing that one commits. From then on
    :func:`_read` takes the others from where they are still waiting, should the writer die before
    they have got their places.
    """
    written = table_texts(table)
    texts = {name: text.encode() for name, text in written.items()}
    run = texts.pop(RUN)
    digest = hashlib.sha256(run).hexdigest()
    _make(folder)
    attributes = folder.parents[2] / ".gitattributes"
    unfinished = folder / f".run{_PART}"
    try:
        if not attributes.exists():
            write_through(folder / f".attributes{_PART}", _ATTRIBUTES)
            (folder / f".attributes{_PART}").replace(attributes)
            sync_folder(attributes.parent)
        for name, text in texts.items():
            if _content(folder / name) != text:
                write_through(folder / f".file{_PART}", text)
                (folder / f".file{_PART}").replace(_waiting(folder, digest, name))
        write_through(unfinished, run)
        _check_readable(folder, unfinished, table, written)
        sync_folder(folder)
        unfinished.replace(folder / RUN)
        sync_folder(folder)
    except BaseException:
        _settle(folder)
        raise
    _settle(folder)


def _check_readable(folder: Path, run: Path, table: RunTable, written: Mapping[str, str]) -> None:
    """Read what is about to replace the old table; :class:`GoldenError` unless it is ``table``, of
    which ``written`` are the texts."""
    try:
        texts = _read_texts(folder, _bytes(run))
        again = parse_table(table.method, table.dataset, texts)
    except (OSError, DataError, GoldenError) as error:
        raise GoldenError(f"what would be recorded cannot be read back ({error})") from error
    if texts != written or again.samples != table.samples:
        raise GoldenError("what would be recorded is not what is read back")


def _make(folder: Path) -> None:
    """Make a folder and those above it, on the disk."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in missing:
        sync_folder(path.parent)


def _settle(folder: Path) -> None:
    """Finish what an update that was killed left: files that a table waits for get their places,
    what no table names goes. Under the lock of the folder."""
    leftovers = _leftovers(folder)
    if not leftovers:
        return
    digest = _digest(folder / RUN)
    own = _waiting(folder, digest, "").name
    waiting = [path for path in leftovers if digest and path.name.startswith(own)]
    for path in waiting:
        path.replace(folder / path.name.removeprefix(own))
    if waiting:
        sync_folder(folder)
    for path in leftovers:
        if path not in waiting:
            path.unlink(missing_ok=True)


def _tidy(folder: Path) -> None:
    """The same for readers, who leave it to a writer at work, or do without where nothing can be
    written: :func:`_read` takes a table that was committed from wherever it is."""
    if _leftovers(folder):
        with suppress(OSError, filelock.Timeout), _exclusive(folder, 0):
            _settle(folder)


def _leftovers(folder: Path) -> list[Path]:
    """Files that are not where they belong: unfinished, waiting, or of an older form that a newer
    table has replaced."""
    older = [folder / name for name in (OLDER_TABLE, OLDER_SAMPLES)]
    return [
        *folder.glob(_waiting(folder, "*", "*").name),
        *folder.glob(f".*{_PART}"),
        *(path for path in older if (folder / RUN).exists() and path.exists()),
    ]


def _waiting(folder: Path, digest: str, name: str) -> Path:
    """A file, complete, that waits for the ``run.toml`` of a digest to be in its place."""
    return folder / f".waiting-{digest}-{name}"


# -- reading ------------------------------------------------------------------------------------


def read_golden(folder: Path) -> RunTable:
    """Read the files of a table and check them against each other.

    Raises :class:`GoldenError` that names the file.
    """
    _tidy(folder)
    try:
        return _read(folder)
    except (OSError, ValueError, GoldenError):
        pass  # a writer may have come between the files
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
    if not (folder / RUN).exists() and (folder / OLDER_TABLE).exists():
        older = (
            _text(folder / name, _bytes(folder / name)) for name in (OLDER_TABLE, OLDER_SAMPLES)
        )
        return parse_older(folder.parent.name, folder.name, *older)
    return parse_table(folder.parent.name, folder.name, _read_texts(folder, _bytes(folder / RUN)))


def _read_texts(folder: Path, run: bytes) -> dict[str, str]:
    """The text of each file: of those that wait for this ``run.toml``, else of those in their
    places."""
    digest = hashlib.sha256(run).hexdigest()
    texts = {RUN: _text(folder / RUN, run)}
    for name in file_names(texts[RUN]):
        waiting = _waiting(folder, digest, name)
        path = waiting if waiting.exists() else folder / name
        texts[name] = _text(folder / name, _bytes(path))
    return texts


def _text(path: Path, content: bytes) -> str:
    """Text that may have been checked out with the line ends of Windows; what is recorded has no
    carriage return of its own."""
    return decoded(path, content).replace("\r\n", "\n")


def _bytes(path: Path) -> bytes:
    try:
        return read_bytes(path, _LARGEST)
    except NoFileError as error:
        raise GoldenError(f"{path.name} is missing") from error


def _content(path: Path) -> bytes | None:
    return read_bytes(path, _LARGEST) if path.exists() else None


def _digest(path: Path) -> str:
    """The SHA-256 of a file; "" if there is none."""
    content = _content(path)
    return "" if content is None else hashlib.sha256(content).hexdigest()
