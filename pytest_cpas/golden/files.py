"""Golden tables as files: found, read and checked, replaced as a whole."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import filelock

from pytest_cpas._files import cache_folder, check_no_link, sync_folder
from pytest_cpas.evaluation import RobustnessPoint
from pytest_cpas.golden.noise import Noise
from pytest_cpas.golden.older import OLDER_SAMPLES, OLDER_TABLE, parse_older
from pytest_cpas.golden.points import (
    ROBUSTNESS,
    Kept,
    joined_kept,
    kept_files,
    kept_tables,
    kept_texts,
    parse_kept,
)
from pytest_cpas.golden.tables import GoldenError, NewerError, RunTable
from pytest_cpas.golden.texts import RUN
from pytest_cpas.golden.waiting import LARGEST, digest_of, finish, is_of_table, put, waiting
from pytest_cpas.reading.files import NoFileError, decoded, read_bytes
from pytest_cpas.reading.paths import names
from pytest_cpas.types import ContractError, DataError
from pytest_cpas.types.names import checked_name

__all__ = [
    "find_golden",
    "is_recorded",
    "keep_noise",
    "left_over",
    "orphans",
    "read_golden",
    "read_tables",
    "record",
    "shipped_golden",
]

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
        for folder in _places(root, method, dataset):
            _check_folders(root, folder)
        if (table := _find(root, method, dataset)) is not None:
            return table
    return None


def _check_folders(root: Path, folder: Path) -> None:
    """Raise :class:`GoldenError` if something else stands where a folder is looked for."""
    for place in (*reversed(folder.relative_to(root).parents), folder.relative_to(root)):
        if os.path.lexists(root / place) and not os.path.isdir(root / place):
            raise GoldenError(f"{root / place}: no folder, so no golden table is found below it")


def _find(golden: Path, method: str, dataset: str) -> RunTable | None:
    """The table below a folder of golden tables, None if there is none."""
    own, folder = _places(golden, method, dataset)
    if own == folder:
        return read_golden(own) if is_recorded(own) else None
    # an update moves it from the one to the other, where it is if it has left the first by now
    there, error = None, None
    try:
        there = read_golden(own) if is_recorded(own) else None
    except GoldenError as told:
        error = told
    if is_recorded(folder) and dataset in (tables := read_tables(folder)):
        return tables[dataset]
    if error is not None:
        raise error
    return None if there is None else replace(there, misplaced=True)


def is_recorded(folder: Path) -> bool:
    """Whether a folder holds a golden table, or what is left of one. A first update that was killed
    before it had written one leaves none. Raises :class:`GoldenError` if it cannot be listed."""
    try:
        there = names(folder)
    except DataError as error:
        raise GoldenError(str(error)) from error
    return any(map(is_table_file, there))


def is_table_file(name: str) -> bool:
    """Whether a golden table has a file of this name, in its form of today or in an older one."""
    return name in (OLDER_TABLE, OLDER_SAMPLES) or is_of_table(name)


def record(golden: Path, table: RunTable) -> Path:
    """Write a run's table below ``golden``, as the golden one, and return its folder.

    The categories that it lacks are kept as they are, in the table that is there or else in the one
    that ships with the plugin. Two updates at once wait for each other, and whoever is killed at
    any step leaves either the old table or the new one. Raises :class:`GoldenError`, the old table
    intact, for a table that must not be recorded (see :meth:`RunTable.recordable`), a damaged old
    one, a disk that does not take it, or a link below ``golden``, which may lead elsewhere.
    """
    own, folder = _places(golden, table.method, table.dataset)
    try:
        check_no_link(golden, folder)
        check_no_link(golden, own)
        with _exclusive(folder, _PATIENCE):
            finish(folder)
            kept = _read_told(folder) if is_recorded(folder) else None
            previous = kept_tables(kept).get(table.dataset)
            if previous is None and own != folder and is_recorded(own):
                previous = read_golden(own)
            if previous is None:
                previous = _find(shipped_golden(), table.method, table.dataset)
            point = RobustnessPoint.named(table.dataset)
            kept = joined_kept(kept, table.recordable(previous), point)
            _write(golden, folder, table.method, kept)
            if own != folder:
                with suppress(OSError):  # what is left is told of by left_over
                    _remove_moved(own)
    except filelock.Timeout as error:
        raise GoldenError(f"{folder}: another update has held it for {_PATIENCE:g} s") from error
    except (OSError, DataError) as error:
        raise GoldenError(f"{folder}: the golden table cannot be written ({error})") from error
    return folder


def keep_noise(
    golden: Path, method: str, dataset: str, measure: Callable[[RunTable], Noise]
) -> Path:
    """Write what ``measure`` says of the table below ``golden`` into it, and return its folder.

    Raises :class:`GoldenError` as :func:`record`, and where there is no table of this form.
    """
    own, folder = _places(golden, method, dataset)
    if own != folder:
        raise GoldenError(
            f"{dataset} is a point of a robustness profile: noise is measured of data sets as they"
            " are"
        )
    if not is_recorded(folder):
        raise GoldenError(
            f"{folder}: there is no golden table; record one first (--snapshot-update)"
        )
    try:
        check_no_link(golden, folder)
        with _exclusive(folder, _PATIENCE):
            finish(folder)
            kept = _read_told(folder)
            table = kept_tables(kept)[dataset]
            if table.outdated:
                raise GoldenError(
                    f"{folder}: the golden table has an earlier form; record it anew first"
                    " (--snapshot-update)"
                )
            kept = joined_kept(kept, replace(table, noise=measure(table)), None)
            _write(golden, folder, method, kept)
    except filelock.Timeout as error:
        raise GoldenError(f"{folder}: another update has held it for {_PATIENCE:g} s") from error
    except (OSError, DataError) as error:
        raise GoldenError(f"{folder}: the golden table cannot be written ({error})") from error
    return folder


def left_over(golden: Path, method: str, dataset: str) -> Path | None:
    """The folder in which earlier versions kept the table of a point, if there still is one beside
    the table that is read: it was damaged, or could not be removed."""
    own, folder = _places(golden, method, dataset)
    moved = own != folder and is_recorded(own) and is_recorded(folder)
    return own if moved and dataset in read_tables(folder) else None


def orphans(golden: Path, methods: set[str]) -> list[Path]:
    """The folders of recorded tables below ``golden`` whose method is none of ``methods``."""
    folders = sorted(
        {path.parent for name in (RUN, OLDER_TABLE) for path in golden.glob(f"recorded/*/*/{name}")}
    )
    return [folder for folder in folders if folder.parent.name not in methods]


def _places(golden: Path, method: str, dataset: str) -> tuple[Path, Path]:
    """The folder that has the name of the data set, and the one in which its table is kept: another
    one for a point of a robustness profile, which had that of its name in earlier versions."""
    try:
        parts = checked_name("method", method), checked_name("data set", dataset)
    except ContractError as error:
        raise GoldenError(str(error)) from error
    own = golden.joinpath("recorded", *parts)
    point = RobustnessPoint.named(dataset)
    return own, own.with_name(f"{point.base}{ROBUSTNESS}") if point else own


def _exclusive(folder: Path, patience: float) -> filelock.BaseFileLock:
    """A lock on a folder. Its file is elsewhere: golden tables are kept under version control."""
    name = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()
    path = cache_folder() / "locks" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return filelock.FileLock(path, timeout=patience)


# -- writing ------------------------------------------------------------------------------------


def _write(golden: Path, folder: Path, method: str, kept: Kept) -> None:
    """Replace all files of a folder. Under its lock, and finished.

    All are complete on the disk, and have been read back, before any is replaced. They wait as of
    :mod:`pytest_cpas.golden.waiting`; replacing ``run.toml`` commits. From then on :func:`_read`
    takes the others from where they are still waiting, should the writer die before they have got
    their places.
    """
    written = kept_texts(kept)
    texts = {name: text.encode() for name, text in written.items()}
    run = texts.pop(RUN)
    digest = digest_of(run)
    _make(folder)
    attributes = golden / ".gitattributes"
    for path in (folder / name for name in written):
        check_no_link(golden, path)
    put_down: list[Path] = []
    try:
        if not attributes.exists():
            check_no_link(golden, attributes)
            put_down.append(put(folder, digest, attributes.name, _ATTRIBUTES))
            put_down[-1].replace(attributes)
            sync_folder(golden)
        for name, text in texts.items():
            if _content(folder / name) != text:
                put_down.append(put(folder, digest, name, text))
        unfinished = put(folder, digest, RUN, run)
        put_down.append(unfinished)
        _check_readable(folder, run, method, kept, written)
        sync_folder(folder)
        unfinished.replace(folder / RUN)
    except BaseException:
        for path in put_down:
            path.unlink(missing_ok=True)
        raise
    sync_folder(folder)
    finish(folder)


def _check_readable(
    folder: Path, run: bytes, method: str, kept: Kept, written: Mapping[str, str]
) -> None:
    """Read what is about to replace the old files; :class:`GoldenError` unless it is ``kept``, of
    which ``written`` are the texts."""
    try:
        texts = _read_texts(folder, run)
        again = kept_tables(parse_kept(method, folder.name, texts))
    except (OSError, DataError, GoldenError) as error:
        raise GoldenError(f"what would be recorded cannot be read back ({error})") from error
    samples = {name: table.samples for name, table in kept_tables(kept).items()}
    if texts != written or {name: table.samples for name, table in again.items()} != samples:
        raise GoldenError("what would be recorded is not what is read back")


def _remove_moved(own: Path) -> None:
    """Remove the table in the folder of a point's own, which is kept among the other points now.

    It is sound, or has been begun to be removed: its samples go first, and what names them last.
    What else is in the folder stays, and so does a table that was damaged otherwise.
    """
    if not own.is_dir():
        return
    with _exclusive(own, _PATIENCE):
        try:
            finish(own)
            if (own / RUN).exists():
                names = [*kept_files(_text(own / RUN, _bytes(own / RUN))), RUN]
            else:
                names = [OLDER_SAMPLES, OLDER_TABLE] if (own / OLDER_TABLE).exists() else []
            if names and (own / names[0]).exists():
                _read(own)
        except (OSError, DataError, GoldenError):
            return
        for name in names:
            (own / name).unlink(missing_ok=True)
        with suppress(OSError):  # something else is there
            own.rmdir()


def _make(folder: Path) -> None:
    """Make a folder and those above it, on the disk."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in missing:
        sync_folder(path.parent)


# -- reading ------------------------------------------------------------------------------------


def read_golden(folder: Path) -> RunTable:
    """Read the files of a table and check them against each other.

    Nothing is written or removed. Raises :class:`GoldenError` that names the file.
    """
    tables = read_tables(folder)
    if folder.name not in tables:
        raise GoldenError(
            f"{folder}: it holds the tables of {', '.join(tables)}; read_tables reads them"
        )
    return tables[folder.name]


def read_tables(folder: Path) -> dict[str, RunTable]:
    """All tables that are kept in a folder, by the names of their data sets, as
    :func:`read_golden`."""
    try:
        return kept_tables(_read(folder))
    except (OSError, ValueError, GoldenError):
        pass  # a writer may have come between the files
    try:
        with _exclusive(folder, _PATIENCE):
            return kept_tables(_read_told(folder))
    except filelock.Timeout as error:
        raise GoldenError(f"{folder}: an update has held it for {_PATIENCE:g} s") from error
    except OSError:  # nothing can be locked where nothing can be written
        return kept_tables(_read_told(folder))


def _read_told(folder: Path) -> Kept:
    """Read what nobody writes; :class:`GoldenError` says what to do if it is damaged."""
    try:
        return _read(folder)
    except NewerError as error:
        raise GoldenError(f"{folder}: {error}") from error
    except (OSError, DataError, GoldenError) as error:
        raise GoldenError(
            f"{folder}: {error}; it was damaged or edited by hand. Restore it from version"
            " control, or remove it and record it anew with --snapshot-update"
        ) from error


def _read(folder: Path) -> Kept:
    if not (folder / RUN).exists() and (folder / OLDER_TABLE).exists():
        older = (
            _text(folder / name, _bytes(folder / name)) for name in (OLDER_TABLE, OLDER_SAMPLES)
        )
        return parse_older(folder.parent.name, folder.name, *older)
    return parse_kept(folder.parent.name, folder.name, _read_texts(folder, _bytes(folder / RUN)))


def _read_texts(folder: Path, run: bytes) -> dict[str, str]:
    """The text of each file: of those that wait for this ``run.toml``, else of those in their
    places."""
    digest = digest_of(run)
    there = {w.name: w.path for w in waiting(folder) if w.run == digest and w.is_complete()}
    texts = {RUN: _text(folder / RUN, run)}
    for name in kept_files(texts[RUN]):
        texts[name] = _text(folder / name, _bytes(there.get(name, folder / name)))
    return texts


def _text(path: Path, content: bytes) -> str:
    """Text that may have been checked out with the line ends of Windows; what is recorded has no
    carriage return of its own."""
    return decoded(path, content.replace(b"\r\n", b"\n"))


def _bytes(path: Path) -> bytes:
    try:
        return read_bytes(path, LARGEST)
    except NoFileError as error:
        raise GoldenError(f"{path.name} is missing") from error


def _content(path: Path) -> bytes | None:
    return read_bytes(path, LARGEST) if path.exists() else None
