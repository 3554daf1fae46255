"""Tar archives, read member by member from their beginning on: files and folders, nothing else.

Python's tarfile follows what a header says to wherever it leads: back to before the header, through
a chain of headers of any length, into regular expressions that take for ever. Here a header is 512
bytes with a right checksum; long names and pax records before it are taken for its name and size.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from pytest_cpas.types import DataError, shown

_BLOCK = 512

#: Bytes of a long name, or of the pax records of a member.
_LONGEST_HEADER = 2**20

#: Headers of long names and records before that of a member.
_MOST_BEFORE = 8

#: Headers and records for each member that an archive may have.
_HEADERS_EACH = 10

_FILES, _FOLDER = (b"0", b"\0", b"7"), b"5"
_LONG_NAME, _LONG_LINK, _RECORDS, _RECORDS_OF_ALL = b"L", b"K", (b"x", b"X"), b"g"


class Stream(Protocol):
    """What is read: the archive, or what becomes of it."""

    def read(self, size: int, /) -> bytes:
        """So many bytes, fewer only at the end."""


@dataclass(frozen=True)
class TarMember:
    """``read`` gives so many of the next bytes of its content, until the next member is asked
    for."""

    name: str
    size: int
    is_folder: bool
    read: Callable[[int], bytes]


def tar_members(where: str, stream: Stream, most: int) -> Iterator[TarMember]:
    """The members of an archive, which is meant to have at most ``most`` files.

    Raises :class:`DataError` that begins with ``where`` for anything that is no file and no folder,
    for damage, and for more than ten headers for each of ``most`` files.
    """
    return _Tar(where, stream, most).members()


class _Tar:
    def __init__(self, where: str, stream: Stream, most: int) -> None:
        self._where, self._stream = where, stream
        self._most, self._seen = most * _HEADERS_EACH, 0
        self._left = 0  # of the content of a member

    def _fail(self, told: str) -> DataError:
        return DataError(f"{self._where}: {told}")

    def members(self) -> Iterator[TarMember]:
        before = 0
        name, size = "", -1  # as long names and records say, of the next member
        while (header := self._header()) is not None:
            kind = header[156:157]
            own = _number(header[124:136])
            if own is None:
                raise self._fail(f"a member of {shown(header[124:136])} bytes, expected a size")
            special = kind in (_LONG_NAME, _LONG_LINK, *_RECORDS, _RECORDS_OF_ALL)
            if special:
                before += 1
                if before > _MOST_BEFORE:
                    raise self._fail(f"more than {_MOST_BEFORE} headers before one member")
                body = self._body(own)
                if kind == _LONG_NAME:
                    name = _text(body)
                elif kind != _LONG_LINK:
                    records = self._records(body)
                    if kind == _RECORDS_OF_ALL and records:
                        raise self._fail(f"it has one {' and '.join(records)} for all its members")
                    name = records.get("path", name)
                    if "size" in records:
                        size = self._size(records["size"])
                continue
            told = name or _name(header)
            folder = kind == _FOLDER or (kind == b"\0" and told.endswith("/"))
            if not folder and kind not in _FILES:
                raise self._fail(
                    f"{shown(told)} is a link or a device, or sparse, expected plain files and"
                    " folders only"
                )
            length = own if size < 0 else size
            self._left = length
            yield TarMember(told, length, folder, self._read)
            while self._left:
                if not self._read(min(self._left, 2**20)):
                    raise self._fail(
                        f"it ends within {shown(told)}; is it truncated? Fetch it again"
                    )
            self._stream.read(-length % _BLOCK)
            before, name, size = 0, "", -1

    def _header(self) -> bytes | None:
        """The next header; None at the end, which is a block of zeros."""
        self._count()
        block = self._stream.read(_BLOCK)
        if len(block) < _BLOCK:
            raise self._fail(
                "not a readable archive (its end is missing); is it truncated, or a web page?"
            )
        if not block.strip(b"\0"):
            return None
        checksum = sum(block) - sum(block[148:156]) + 8 * ord(" ")
        if _number(block[148:156]) != checksum:
            raise self._fail(
                "not a readable archive (a header has another checksum than it says); is it"
                " truncated, or a web page?"
            )
        return block

    def _count(self) -> None:
        self._seen += 1
        if self._seen > self._most:
            raise self._fail(f"more than {self._most} headers; a bomb?")

    def _read(self, size: int) -> bytes:
        content = self._stream.read(min(size, self._left))
        self._left -= len(content)
        return content

    def _body(self, size: int) -> bytes:
        if size > _LONGEST_HEADER:
            raise self._fail(f"a header of {size} bytes, at most {_LONGEST_HEADER} are read")
        body = self._stream.read(size)
        self._stream.read(-size % _BLOCK)
        if len(body) < size:
            raise self._fail("it ends within a header; is it truncated? Fetch it again")
        return body

    def _records(self, body: bytes) -> dict[str, str]:
        """Name and size in pax records, each of which is ``LENGTH KEY=VALUE`` and a line end."""
        found: dict[str, str] = {}
        at, end = 0, len(body.rstrip(b"\0"))
        while at < end:
            self._count()
            length = re.compile(rb"([1-9][0-9]{0,6}) ").match(body, at)
            stop = at + int(length[1]) if length else 0
            key, equals, value = body[length.end() if length else 0 : stop].partition(b"=")
            if length is None or stop > end or not equals or body[stop - 1 : stop] != b"\n":
                raise self._fail(
                    f"{shown(body[at : at + 40])}, expected a length, a key and a value of a"
                    " header; is it damaged? Fetch it again"
                )
            if key.startswith(b"GNU.sparse."):
                raise self._fail("a sparse file, expected plain files and folders only")
            if key in (b"path", b"size"):
                found[key.decode()] = _text(value[:-1], whole=True)
            at = stop
        return found

    def _size(self, text: str) -> int:
        if not re.fullmatch("[0-9]{1,18}", text):
            raise self._fail(f"a member of {shown(text)} bytes, expected a size")
        return int(text)


def _number(field: bytes) -> int | None:
    """A number from 0 in octal digits, or in bytes of which the first one is 128."""
    if field[0] == 0x80:
        return int.from_bytes(field[1:], "big")
    digits = field.partition(b"\0")[0].strip(b" ")
    return int(digits or b"0", 8) if re.fullmatch(rb"[0-7]*", digits) else None


def _text(name: bytes, *, whole: bool = False) -> str:
    return os.fsdecode(name if whole else name.partition(b"\0")[0])


def _name(header: bytes) -> str:
    name = _text(header[:100])
    prefix = _text(header[345:500]) if header[257:263] == b"ustar\0" else ""
    return f"{prefix}/{name}" if prefix else name
