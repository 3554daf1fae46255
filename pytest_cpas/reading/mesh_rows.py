"""Rows of numbers in the text of a mesh, and the triangles that they make."""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.types import Array, DataError

Indices = NDArray[np.int64]

#: Vertices and triangles of a mesh. The largest that the field has are scans of two million.
MOST_ELEMENTS = 4_000_000

#: Bytes of a line: a polygon of 100,000 corners has two thirds of it.
LONGEST_LINE = 2**20

#: Numbers in all rows of a kind, as many as that many vertices and triangles have.
MOST_NUMBERS = 2**24

#: Bytes of rows that are turned into numbers together.
_TOGETHER = 2**21


def lines_of(content: bytes) -> Iterator[tuple[int, bytes]]:
    """The lines of a text that have anything before a ``#``, with their numbers."""
    for number, line in enumerate(io.BytesIO(content), start=1):
        if len(line) > LONGEST_LINE:
            raise DataError(f"line {number} has {len(line)} bytes, at most {LONGEST_LINE} are read")
        text = line.partition(b"#")[0].strip()
        if text:
            yield number, text


class Rows:
    """Rows of numbers, which may differ in length."""

    def __init__(self, what: str, lengths: tuple[int, ...] = (), most: int = MOST_ELEMENTS) -> None:
        """``what`` a row is, for messages; ``lengths`` that it may have, any of at least 1 if none
        is given; ``most`` rows are read."""
        self._what = what
        self._lengths = lengths
        self._most = most
        self._lines: list[bytes] = []
        self._numbers: list[int] = []
        self._values: list[Array] = []
        self._counts: list[Indices] = []
        self._size = 0
        self._total = 0
        self.count = 0

    def add(self, number: int, text: bytes) -> None:
        """A row, from line ``number``; :class:`DataError` if there are too many."""
        if self.count == self._most:
            raise DataError(f"it has more than {self._most} rows of {self._what}, the most read")
        self.count += 1
        self._lines.append(text)
        self._numbers.append(number)
        self._size += len(text) + 1
        if self._size > _TOGETHER:
            self._convert()

    def values(self) -> tuple[Array, Indices]:
        """All numbers one after the other, and how many each row has."""
        self._convert()
        self._values, self._counts = (
            [np.concatenate(self._values)],
            [np.concatenate(self._counts)],
        )
        return self._values[0], self._counts[0]

    def columns(self, count: int) -> Array:
        """The first so many numbers of each row, which has as many."""
        values, counts = self.values()
        starts = np.cumsum(counts) - counts
        columns: Array = values[starts[:, None] + np.arange(count)]
        return columns

    def _convert(self) -> None:
        rows = [line.split() for line in self._lines]
        try:
            if any(b"_" in line for line in self._lines):  # which Python allows in numbers
                raise ValueError
            made = np.array([float(word) for row in rows for word in row], float)
        except ValueError:
            number, word = next(
                (number, word)
                for number, row in zip(self._numbers, rows, strict=True)
                for word in row
                if not _is_number(word)
            )
            raise DataError(
                f"line {number}: {shown(word)} in {self._what}, expected a number"
            ) from None
        counts = np.array([len(row) for row in rows], np.int64)
        fits = np.isin(counts, self._lengths) if self._lengths else counts > 0
        if not fits.all():
            first = int(np.flatnonzero(~fits)[0])
            expected = " or ".join(map(str, self._lengths)) or "at least one"
            raise DataError(
                f"line {self._numbers[first]}: {counts[first]} numbers for {self._what}, expected"
                f" {expected}"
            )
        self._values.append(made)
        self._counts.append(counts)
        self._lines, self._numbers, self._size = [], [], 0
        self._total += len(made)
        if self._total > MOST_NUMBERS:
            raise DataError(
                f"its rows of {self._what} have more than {MOST_NUMBERS} numbers, the most read"
            )


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return b"_" not in word


def shown(text: bytes) -> str:
    """The beginning of what was seen, for a message."""
    return repr(text[:40].decode("latin-1"))


def corners(values: Array, what: str, low: int, high: int, vertices: int) -> Indices:
    """Numbers as indices of so many ``vertices``, of ``low`` to ``high``; else a DataError."""
    if not (values == np.floor(values)).all():
        bad = values[values != np.floor(values)][0]
        raise DataError(f"{what} names its corners by what are no integers, such as {bad:g}")
    wrong = values[(values < low) | (values > high)]
    if len(wrong):
        first = "the first is 0" if low == 0 else "the first is 1"
        raise DataError(f"{what} names vertex {wrong[0]:.0f}, but there are {vertices}, {first}")
    return values.astype(np.int64)


def fans(indices: Indices, counts: Indices) -> Indices:
    """The triangles (F, 3) of polygons, which have ``counts`` corners, one after the other."""
    if len(counts) and counts.min() < 3:
        raise DataError(f"a face has {counts.min()} corners, expected at least 3")
    made = counts - 2
    total = int(made.sum())
    if total > MOST_ELEMENTS:
        raise DataError(f"it has {total} triangles, at most {MOST_ELEMENTS} are read")
    first = np.repeat(np.cumsum(counts) - counts, made)
    step = np.arange(total) - np.repeat(np.cumsum(made) - made, made) + 1
    triangles: Indices = indices[np.stack([first, first + step, first + step + 1], axis=1)]
    return triangles
