"""Opening files: regular ones alone, none that is larger than what its reader can need."""

from __future__ import annotations

import hashlib
import io
import os
import stat
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, BinaryIO, cast

from pytest_cpas.types import ContractError, DataError

#: Largest file that is read as a whole, bytes, unless its reader says otherwise.
LARGEST = 2**28

#: Characters of a line of a table.
LONGEST_LINE = 2**20

#: What some editors write before a text in UTF-8. It is no part of it.
BYTE_ORDER_MARK = b"\xef\xbb\xbf"

_KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
    stat.S_IFSOCK: "a socket",
}


class NoFileError(DataError, FileNotFoundError):
    """There is no file of this name."""


def regular(path: Path) -> Path:
    """``path`` if it is a file; opening a pipe would wait for ever, a device could do anything.

    Raises :class:`DataError`, of which :class:`NoFileError` says that there is nothing.
    """
    try:
        _check_kind(path, os.stat(path).st_mode)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise NoFileError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:  # a name that is too long, or has a NUL
        if isinstance(error, ContractError):
            raise
        raise DataError(f"{_short(path)}: cannot be read ({_reason(error)})") from error
    return path


@contextmanager
def opened(path: Path, limit: int = LARGEST) -> Generator[BinaryIO]:
    """The file, open for reading, if it is a regular one of at most ``limit`` bytes.

    Raises :class:`DataError`; reading it may raise OSError.
    """
    regular(path)
    try:
        # should a pipe have got its place meanwhile, opening it must not wait
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | _BINARY)
    except FileNotFoundError as error:
        raise NoFileError(f"{path}: no such file") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({_reason(error)})") from error
    with _Bounded(io.FileIO(descriptor, "rb")) as file:
        status = os.fstat(descriptor)
        _check_kind(path, status.st_mode)
        if status.st_size > limit:
            raise DataError(f"{path}: {status.st_size} bytes, at most {limit} are read")
        yield cast(BinaryIO, file)


class _Bounded(io.BufferedReader):
    """Reading sets aside as much memory as it is asked for, and damaged files make their readers
    ask for any: here, no more than is left of the file, and a little if it grows."""

    def read(self, size: int | None = -1, /) -> bytes:
        left = max(os.fstat(self.fileno()).st_size - self.tell(), 0) + 2**16
        return super().read(left if size is None or size < 0 else min(size, left))


_BINARY = getattr(os, "O_BINARY", 0)


def read_bytes(path: Path, limit: int = LARGEST) -> bytes:
    """The content of a regular file of at most ``limit`` bytes; else :class:`DataError`."""
    # in one piece unless it grows, so that no two copies of it are in memory
    return b"".join(_chunks(path, limit, -1))


def _chunks(path: Path, limit: int, each: int = 2**24) -> Iterator[bytes]:
    size = 0
    with opened(path, limit) as file:
        while True:
            try:
                chunk = file.read(each)
            except OSError as error:
                raise DataError(f"{path}: cannot be read ({_reason(error)})") from error
            if not chunk:
                return
            size += len(chunk)
            if size > limit:
                raise DataError(f"{path}: it grows, and at most {limit} bytes are read")
            yield chunk


def read_text(path: Path, limit: int = LARGEST, errors: str = "strict") -> str:
    """The text of a regular file in UTF-8, of at most ``limit`` bytes; else :class:`DataError`."""
    return decoded(path, read_bytes(path, limit), errors)


def decoded(path: Path, content: bytes, errors: str = "strict") -> str:
    """``content`` of ``path`` as text, without a byte order mark; :class:`DataError` says where it
    is not UTF-8."""
    content = content.removeprefix(BYTE_ORDER_MARK)
    try:
        return content.decode("utf-8", errors)
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise DataError(
            f"{path}, line {line}: not text in UTF-8 ({error.reason}); save it as UTF-8"
        ) from error


def sha256(path: Path, limit: int = 2**40) -> str:
    """The SHA-256 of a regular file, in hexadecimal; :class:`DataError` if it cannot be read."""
    digest = hashlib.sha256()
    for chunk in _chunks(path, limit):
        digest.update(chunk)
    return digest.hexdigest()


def lines_of(file: IO[str], where: str, longest: int = LONGEST_LINE) -> Iterator[str]:
    """The lines of an open text file, each of at most ``longest`` characters.

    Raises :class:`DataError` that begins with ``where`` for a line that is longer, or not text.
    """
    number = 0
    try:
        while line := file.readline(longest + 1):
            number += 1
            if len(line) > longest:
                raise DataError(
                    f"{where}, line {number}: more than {longest} characters, at most as many are"
                    " read"
                )
            yield line
    except UnicodeDecodeError as error:
        raise DataError(f"{where}, after line {number}: not text in UTF-8 ({error})") from error


def _check_kind(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "something else")
        raise DataError(f"{path}: not a regular file, but {kind}")


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def _short(path: Path) -> str:
    name = str(path).encode("utf-8", "backslashreplace").decode()
    return name if len(name) <= 300 else f"{name[:150]}...{name[-60:]}"
