"""Opening zip archives, whose lists of members can be larger than what any reader has time for."""

from __future__ import annotations

import zipfile
from typing import IO, Any, cast

from pytest_cpas.types import DataError

#: Bytes of an entry of the list, on the average over all: its name, and what else is told of it.
_LONGEST_ENTRY = 400

#: How an entry begins.
_ENTRY = b"PK\1\2"


def open_zip(where: str, file: IO[bytes], most: int) -> zipfile.ZipFile:
    """The archive in an open file, if it lists at most ``most`` members; ``file`` stays open.

    The entries are counted before zipfile parses them, which takes hundreds of times as long.
    Raises :class:`DataError` that begins with ``where`` for an archive that lists more, and what
    zipfile raises for one that is damaged.
    """
    listing = _Listing(where, file, most)
    archive = zipfile.ZipFile(cast(IO[bytes], listing))
    listing.opening = False
    return archive


class _Listing:
    """The bytes of an archive; those of the list are looked at while it is being opened."""

    def __init__(self, where: str, file: IO[bytes], most: int) -> None:
        self._where, self._file, self._most = where, file, most
        self.opening = True

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def read(self, size: int = -1) -> bytes:
        """As of the file."""
        if not self.opening:
            return self._file.read(size)
        limit = 2**17 + self._most * _LONGEST_ENTRY
        if size > limit:
            raise DataError(
                f"{self._where}: a list of members of {size} bytes, at most {limit} are read, for"
                f" {self._most} members; a bomb?"
            )
        content = self._file.read(size)
        if (seen := content.count(_ENTRY)) > self._most:
            raise DataError(
                f"{self._where}: {seen} members, at most {self._most} are read; a bomb?"
            )
        return content
