"""Unpacking archives that strangers made: nothing gets outside of the folder, or out of hand."""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
import re
import shutil
import stat
import struct
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, cast

from pytest_cpas.reading.files import opened
from pytest_cpas.reading.zips import open_zip
from pytest_cpas.types import DataError, ToldError

#: An archive may unpack to at most that many times its size (text compresses to a tenth), or to
#: :data:`_SMALL` bytes.
MAX_RATIO = 100
_SMALL = 2**20

#: Largest archive, bytes.
_LARGEST = 2**40

#: Longest path, characters, and longest name of a file or folder, bytes, that any system takes.
_LONGEST_PATH, _LONGEST_NAME = 1000, 255

#: An archive may hold so many files, and one more for so many bytes of its own: those of data sets
#: have images of many thousands.
_FEW, _BYTES_EACH = 10_000, 1000


class ArchiveError(ToldError, ValueError):
    """An archive is damaged, or would do harm."""


@dataclass(frozen=True)
class _File:
    """A member: where it goes, how many bytes it declares, and how it is read."""

    path: PurePosixPath
    size: int
    open: Callable[[], IO[bytes] | None]


def unpack(archive: Path, folder: Path) -> int:
    """Unpack a zip or tar archive into ``folder``, and return how many files it held.

    Everything is checked before the first file is written, and written beside its place before the
    first file is moved there. Raises :class:`ArchiveError`; then ``folder`` holds what it held.
    """
    folder.mkdir(parents=True, exist_ok=True)
    folder = folder.resolve()
    try:
        with ExitStack() as stack:
            files = _members(archive, stack)
            staging = Path(tempfile.mkdtemp(prefix=".unpacking-", dir=folder))
            stack.callback(shutil.rmtree, staging, ignore_errors=True)
            for file in files:
                _write(file, staging / file.path)
            _move(files, staging, folder)
            return len(files)
    except ArchiveError as error:
        raise ArchiveError(f"{archive}: {error}") from None
    except DataError as error:
        raise ArchiveError(str(error)) from None
    except OSError as error:
        if error.errno is not None:  # of the disk
            raise
        raise ArchiveError(f"{archive}: not a readable archive ({error})") from error
    except _DAMAGE as error:
        raise ArchiveError(
            f"{archive}: not a readable archive ({error}); is it truncated, or a web page?"
        ) from error


#: What the libraries raise on archives that are truncated or made up.
_DAMAGE = (
    zipfile.BadZipFile,
    tarfile.TarError,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    NotImplementedError,  # a compression that Python lacks
    UnicodeError,
    ValueError,
    struct.error,
    OverflowError,
    IndexError,
    gzip.BadGzipFile,
)


def _members(archive: Path, stack: ExitStack) -> list[_File]:
    file = stack.enter_context(opened(archive, _LARGEST))
    size = file.seek(0, os.SEEK_END)
    limit, most = max(MAX_RATIO * size, _SMALL), _FEW + size // _BYTES_EACH
    if zipfile.is_zipfile(file):
        members = _zip_members(stack.enter_context(open_zip(f"{archive}", file, most)), size)
    else:
        members = _tar_members(_tar(archive, stack))
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


#: How compressed files begin, and what opens them.
_COMPRESSED: Mapping[bytes, Callable[[IO[bytes]], IO[bytes]]] = {
    b"\x1f\x8b": lambda file: cast(IO[bytes], gzip.GzipFile(fileobj=file)),
    b"BZh": lambda file: cast(IO[bytes], bz2.BZ2File(file)),
    b"\xfd7zXZ\0": lambda file: cast(IO[bytes], lzma.LZMAFile(file)),  # noqa: SIM115
}

#: Bytes of a header of a tar archive: long names, and what else pax tells of a file.
_LONGEST_HEADER = 2**20


class _Careful:
    """A tar archive's bytes, of which no header is read that is longer than any true one is."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.seek, self.tell = file.seek, file.tell

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= _LONGEST_HEADER:
            raise ArchiveError(f"a header of {size} bytes; a bomb?")
        return self._file.read(size)


def _tar(archive: Path, stack: ExitStack) -> tarfile.TarFile:
    file: IO[bytes] = stack.enter_context(opened(archive, _LARGEST))
    start = file.read(6)
    file.seek(0)
    for magic, uncompressed in _COMPRESSED.items():
        if start.startswith(magic):
            file = stack.enter_context(uncompressed(file))
    careful = cast(IO[bytes], _Careful(file))
    return stack.enter_context(tarfile.open(fileobj=careful, mode="r:"))


def _zip_members(archive: zipfile.ZipFile, size: int) -> Iterator[_File]:
    """Of an archive of ``size`` bytes."""
    if sum(info.compress_size for info in archive.infolist()) > size:
        raise ArchiveError("its members overlap; a bomb?")
    for info in archive.infolist():
        if info.header_offset < 0:
            raise ArchiveError(f"{info.filename[:80]!r} begins before the archive does")
        kind = stat.S_IFMT(info.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise ArchiveError(f"{info.filename!r} is a link or a device, expected files only")
        if info.flag_bits & 1:
            raise ArchiveError(f"{info.filename!r} is encrypted")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ArchiveError(
                f"{info.filename!r} is compressed by method {info.compress_type}, expected 0 or 8"
                " (stored or deflated); unpack it by hand"
            )
        path = _checked(info.orig_filename)
        if not info.is_dir():
            yield _File(path, info.file_size, lambda info=info: archive.open(info))  # type: ignore[misc]


def _tar_members(archive: tarfile.TarFile) -> Iterator[_File]:
    # stricter than tarfile's filter "data", which lets some links pass; the content is written by
    # us, so that owners and modes never matter
    for info in archive:
        if not (info.isreg() or info.isdir()):
            raise ArchiveError(f"{info.name!r} is a link or a device, expected files only")
        if info.isdir() and info.name in (".", "./"):
            continue
        path = _checked(info.name)
        if info.isreg():
            yield _File(path, info.size, lambda info=info: archive.extractfile(info))  # type: ignore[misc]


#: The folder in which downloads are kept until they are unpacked, beside what came of them.
KEPT = ".fetched"


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
        raise ArchiveError(f"{name[:200]!r} leads out of the folder")
    if path.parts[0] == KEPT:
        raise ArchiveError(f"{name[:200]!r} is where downloads are kept, which no archive holds")
    if len(name) > _LONGEST_PATH or any(len(os.fsencode(p)) > _LONGEST_NAME for p in path.parts):
        raise ArchiveError(
            f"{name[:80]!r}... has {len(name)} characters; a path may have {_LONGEST_PATH}, and"
            f" each name in it {_LONGEST_NAME} bytes"
        )
    return path


def _check_unique(files: Sequence[_File]) -> None:
    """No file twice, also where case does not count, and none that is a folder as well."""
    seen: set[str] = set()
    for file in files:
        key = str(file.path).casefold()
        if key in seen:
            raise ArchiveError(f"{str(file.path)!r} occurs twice")
        seen.add(key)
    for file in files:
        for parent in file.path.parents:
            if str(parent).casefold() in seen:
                raise ArchiveError(f"{str(parent)!r} is a file and a folder")


def _write(file: _File, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    content = file.open()
    if content is None:
        raise ArchiveError(f"{str(file.path)!r} has no content")
    written = 0
    with content, target.open("xb") as output:
        while chunk := content.read(2**20):
            written += len(chunk)
            if written > file.size:
                break
            output.write(chunk)
    if written != file.size:
        raise ArchiveError(f"{str(file.path)!r} declares {file.size} bytes and has others")


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
