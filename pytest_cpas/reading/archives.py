"""Unpacking archives that strangers made: nothing gets outside of the folder, or out of hand."""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from pytest_cpas.reading.compressed import MAX_RATIO, SMALL, decompressed
from pytest_cpas.reading.files import opened
from pytest_cpas.reading.tars import Stream, tar_members
from pytest_cpas.reading.zips import open_zip
from pytest_cpas.types import DataError, ToldError, shown

#: Largest archive, bytes.
_LARGEST = 2**40

#: Longest path, characters, and longest name of a file or folder, bytes, that any system takes.
_LONGEST_PATH, _LONGEST_NAME = 1000, 255

#: Folders within each other, in an archive.
_DEEPEST = 32

#: An archive may hold so many files, and one more for so many bytes of its own: those of data sets
#: have images of many thousands.
_FEW, _BYTES_EACH = 10_000, 1000


class ArchiveError(ToldError, ValueError):
    """An archive is damaged, or would do harm."""


@dataclass(frozen=True)
class _File:
    """A member: where it goes, how many bytes it declares, and what it is read from, before the
    next one is."""

    path: PurePosixPath
    size: int
    open: Callable[[], AbstractContextManager[Stream]]


def unpack(archive: Path, folder: Path) -> int:
    """Unpack a zip or tar archive into ``folder``, and return how many files it held.

    Everything is checked before the first file is written, and written beside its place before the
    first file is moved there. Raises :class:`ArchiveError`; then ``folder`` holds what it held.
    """
    folder.mkdir(parents=True, exist_ok=True)
    folder = folder.resolve()
    try:
        with ExitStack() as stack:
            members = _members(archive, stack)
            files = _checked_files(archive, members())
            staging = Path(tempfile.mkdtemp(prefix=".unpacking-", dir=folder))
            stack.callback(shutil.rmtree, staging, ignore_errors=True)
            for file in members():
                _write(file, staging / file.path)
            _move(files, staging, folder)
            return len(files)
    except ArchiveError as error:
        raise ArchiveError(f"{archive}: {error}") from None
    except DataError as error:
        raise ArchiveError(str(error)) from None
    except OSError as error:
        if error.errno not in (None, errno.EINVAL):  # of the disk, not of a place before the file
            raise
        raise ArchiveError(f"{archive}: not a readable archive ({error})") from error
    except _DAMAGE as error:
        raise ArchiveError(
            f"{archive}: not a readable archive ({error}); is it truncated, or a web page?"
        ) from error


#: What zipfile raises on archives that are truncated or made up.
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    NotImplementedError,  # what is encrypted in another way
    ValueError,
    struct.error,
    ArithmeticError,
    LookupError,
)


def _most(size: int) -> int:
    """Files that an archive of ``size`` bytes may hold."""
    return _FEW + size // _BYTES_EACH


def _members(archive: Path, stack: ExitStack) -> Callable[[], Iterator[_File]]:
    """What gives the members of an archive, in the order in which they are read."""
    file = stack.enter_context(opened(archive, _LARGEST))
    size = file.seek(0, os.SEEK_END)
    if zipfile.is_zipfile(file):
        listed = stack.enter_context(open_zip(f"{archive}", file, _most(size)))
        return lambda: _zip_members(listed, size)
    return lambda: _tar_members(f"{archive}", file, size)


def _checked_files(archive: Path, members: Iterator[_File]) -> list[_File]:
    size = archive.stat().st_size
    limit, most = max(MAX_RATIO * size, SMALL), _most(size)
    files: list[_File] = []
    total = 0
    for member in members:
        files.append(member)
        total += member.size
        if total > limit or len(files) > most:
            raise ArchiveError(
                f"it would unpack to more than {limit} bytes or {most} files, from {size} bytes; a"
                " bomb?"
            )
    free = shutil.disk_usage(archive.parent).free
    if total > free:
        raise ArchiveError(f"it would unpack to {total} bytes, {free} are free")
    if not files:
        raise ArchiveError("it holds no files")
    _check_unique(files)
    return files


def _zip_members(archive: zipfile.ZipFile, size: int) -> Iterator[_File]:
    """Of an archive of ``size`` bytes."""
    if sum(info.compress_size for info in archive.infolist()) > size:
        raise ArchiveError("its members overlap; a bomb?")
    for info in archive.infolist():
        if info.header_offset < 0:
            raise ArchiveError(f"{shown(info.filename)} begins before the archive does")
        kind = stat.S_IFMT(info.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise ArchiveError(f"{shown(info.filename)} is a link or a device, expected files only")
        if info.flag_bits & 1:
            raise ArchiveError(f"{shown(info.filename)} is encrypted")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ArchiveError(
                f"{shown(info.filename)} is compressed by method {info.compress_type}, expected"
                " 0 or 8 (stored or deflated); unpack it by hand"
            )
        path = _checked(info.orig_filename)
        if not info.is_dir():
            yield _File(path, info.file_size, lambda info=info: archive.open(info))  # type: ignore[misc]


def _tar_members(where: str, file: BinaryIO, size: int) -> Iterator[_File]:
    # the content is written by us, so that owners and modes never matter
    file.seek(0)
    for member in tar_members(where, decompressed(where, file) or file, _most(size)):
        if member.is_folder and member.name in (".", "./"):
            continue
        path = _checked(member.name)
        if not member.is_folder:
            yield _File(path, member.size, lambda member=member: nullcontext(member))  # type: ignore[misc]


#: The folder in which downloads are kept until they are unpacked, beside what came of them.
KEPT = ".fetched"


#: What ends lines, moves the cursor or turns the direction of writing.
_INVISIBLE = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")


def _checked(name: str) -> PurePosixPath:
    """The path that a member names, if it stays within the folder on every system."""
    path = PurePosixPath(name)
    if (
        not path.parts
        or path.is_absolute()
        or ".." in path.parts
        or re.search(r"[\\\0]", name)
        or re.match(r"[A-Za-z]:", name)
    ):
        raise ArchiveError(f"{shown(name)} leads out of the folder")
    if _INVISIBLE.search(name):
        raise ArchiveError(f"{shown(name)} has control characters, which no path of a data set has")
    if path.parts[0] == KEPT:
        raise ArchiveError(f"{shown(name)} is where downloads are kept, which no archive holds")
    if len(name) > _LONGEST_PATH or any(len(os.fsencode(p)) > _LONGEST_NAME for p in path.parts):
        raise ArchiveError(
            f"{shown(name)} has {len(name)} characters; a path may have {_LONGEST_PATH}, and"
            f" each name in it {_LONGEST_NAME} bytes"
        )
    if len(path.parts) > _DEEPEST:
        raise ArchiveError(
            f"{shown(name)} lies in {len(path.parts) - 1} folders, at most {_DEEPEST - 1} are made"
        )
    return path


def _check_unique(files: Sequence[_File]) -> None:
    """No file twice, also where case does not count, and none that is a folder as well."""
    seen: set[str] = set()
    for file in files:
        key = str(file.path).casefold()
        if key in seen:
            raise ArchiveError(f"{shown(str(file.path))} occurs twice")
        seen.add(key)
    for file in files:
        for parent in file.path.parents:
            if str(parent).casefold() in seen:
                raise ArchiveError(f"{shown(str(parent))} is a file and a folder")


def _write(file: _File, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    with file.open() as content, target.open("xb") as output:
        while chunk := content.read(2**20):
            written += len(chunk)
            if written > file.size:
                break
            output.write(chunk)
    if written != file.size:
        raise ArchiveError(f"{shown(str(file.path))} declares {file.size} bytes and has others")


def _move(files: Sequence[_File], staging: Path, folder: Path) -> None:
    """Move the files into place; a link that lies in the folder already is not followed."""
    places = {folder / file.path: staging / file.path for file in files}
    for parent in {parent for place in places for parent in place.relative_to(folder).parents}:
        place = folder / parent
        if place.is_symlink() or (place.exists() and not place.is_dir()):
            raise ArchiveError(f"{place} is a link or a file, expected a folder; move it away")
    for place, staged in places.items():
        if place.is_symlink() or place.is_dir():
            raise ArchiveError(f"{place} is a link or a folder, expected a file; move it away")
        place.parent.mkdir(parents=True, exist_ok=True)
        os.replace(staged, place)
