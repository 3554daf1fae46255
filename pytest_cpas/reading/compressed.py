"""Compressed files, read from their beginning on in bounded memory, to a bounded size."""

from __future__ import annotations

import bz2
import lzma
import zlib
from collections.abc import Callable, Mapping
from typing import IO, Protocol

from pytest_cpas.types import DataError

#: A file may become at most so many times as large (text compresses to a tenth), or
#: :data:`SMALL` bytes.
MAX_RATIO = 100
SMALL = 2**20

#: Bytes that are read at once, and that come out at once.
_CHUNK, _PIECE = 2**14, 2**18

#: Memory of a decompressor, bytes; ``xz -9`` needs a quarter.
_MEMORY = 2**28

#: Programs that compress in parallel write one part after the other; so many may hold nothing.
_MOST_EMPTY = 100

#: What decompressors raise.
_DAMAGE = (OSError, EOFError, ValueError, zlib.error, lzma.LZMAError)


class _Engine(Protocol):
    """A decompressor, as bz2 and lzma have them."""

    @property
    def eof(self) -> bool: ...
    @property
    def needs_input(self) -> bool: ...
    @property
    def unused_data(self) -> bytes: ...
    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


class _Deflate:
    """That of gzip."""

    def __init__(self) -> None:
        self._engine = zlib.decompressobj(31)

    @property
    def eof(self) -> bool:
        return self._engine.eof

    @property
    def needs_input(self) -> bool:
        return not self._engine.unconsumed_tail

    @property
    def unused_data(self) -> bytes:
        return self._engine.unused_data

    def decompress(self, data: bytes, max_length: int = -1) -> bytes:
        return self._engine.decompress(self._engine.unconsumed_tail + data, max_length)


#: How compressed files begin, and what decompresses them.
_ENGINES: Mapping[bytes, Callable[[], _Engine]] = {
    b"\x1f\x8b": _Deflate,
    b"BZh": bz2.BZ2Decompressor,
    b"\xfd7zXZ\0": lambda: lzma.LZMADecompressor(lzma.FORMAT_XZ, _MEMORY),
}


def decompressed(where: str, file: IO[bytes]) -> Decompressed | None:
    """What an open file holds that gzip, bzip2 or xz has compressed; None if none of them has.

    It is read from where ``file`` stands. Messages begin with ``where``.
    """
    at = file.tell()
    start = file.read(6)
    file.seek(at)
    for magic, engine in _ENGINES.items():
        if start.startswith(magic):
            return Decompressed(where, file, engine)
    return None


class Decompressed:
    """The content of a compressed file, of which no more is made than its size can account for."""

    def __init__(self, where: str, file: IO[bytes], new: Callable[[], _Engine]) -> None:
        """``new`` makes a decompressor, of which each part of the file needs one."""
        self._where, self._file, self._new = where, file, new
        self._engine = new()
        self._taken = self._made = self._before = self._empty = 0

    def read(self, size: int) -> bytes:
        """So many of the next bytes, fewer only at the end; :class:`DataError` for damage."""
        pieces = []
        while size > 0 and (piece := self._piece(min(size, _PIECE))):
            pieces.append(piece)
            size -= len(piece)
        return b"".join(pieces)

    def _piece(self, most: int) -> bytes:
        """At least a byte, or nothing at the end."""
        while True:
            data = self._next_part() if self._engine.eof else self._more()
            if data is None:
                return b""
            try:
                piece = self._engine.decompress(data, most)
            except _DAMAGE as error:
                raise DataError(
                    f"{self._where}: not a readable archive ({error}); is it truncated, or a web"
                    " page?"
                ) from error
            self._made += len(piece)
            limit = MAX_RATIO * self._taken + SMALL
            if self._made > limit:
                raise DataError(
                    f"{self._where}: its first {self._taken} bytes become more than {limit}; a"
                    " bomb?"
                )
            if piece:
                return piece
            if not data and self._engine.needs_input and not self._engine.eof:
                raise DataError(
                    f"{self._where}: not a readable archive (its end is missing); is it truncated?"
                )

    def _more(self) -> bytes:
        if not self._engine.needs_input:
            return b""
        data = self._file.read(_CHUNK)
        self._taken += len(data)
        return data

    def _next_part(self) -> bytes | None:
        """What a further part begins with, if there is one; zeros may fill the file up."""
        data = self._engine.unused_data.lstrip(b"\0")
        while not data:
            chunk = self._file.read(_CHUNK)
            self._taken += len(chunk)
            if not chunk:
                return None
            data = chunk.lstrip(b"\0")
        self._empty += self._made == self._before
        if self._empty > _MOST_EMPTY:
            raise DataError(f"{self._where}: more than {_MOST_EMPTY} of its parts hold nothing")
        self._engine, self._before = self._new(), self._made
        return data
