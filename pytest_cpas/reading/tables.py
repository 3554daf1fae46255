"""Tables with commas: of bounded lines and fields, their numbers checked."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from pytest_cpas.reading.files import LARGEST, lines_of, read_text
from pytest_cpas.reading.words import decimal
from pytest_cpas.types import DataError, shown

#: Fields of a line.
_MOST_FIELDS = 1000


def csv_lines(where: str, lines: Iterable[str]) -> Iterator[tuple[int, list[str]]]:
    """The fields of each line, and its number, from 1; of a quoted field with line ends, the last.

    Raises :class:`DataError` that begins with ``where`` and names the line.
    """
    table = csv.reader(lines, strict=True)
    try:
        for fields in table:
            if len(fields) > _MOST_FIELDS:
                raise DataError(
                    f"{where}, line {table.line_num}: {len(fields)} fields, at most {_MOST_FIELDS}"
                    " are read"
                )
            yield table.line_num, fields
    except csv.Error as error:
        raise DataError(
            f"{where}, line {table.line_num}: not a table with commas ({error})"
        ) from error


def csv_table(where: str, text: str) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The columns of a table, and number and values of each line that is not empty.

    Raises :class:`DataError` as :func:`csv_lines`, and for a column that is there twice.
    """
    lines = csv_lines(where, lines_of(io.StringIO(text, newline=""), where))
    _, columns = next(lines, (0, []))
    if twice := sorted({column for column in columns if columns.count(column) > 1}):
        raise DataError(f"{where}: column {', '.join(twice)} is there twice")
    return columns, [(number, values) for number, values in lines if values]


def by_column(where: str, columns: Sequence[str], values: Sequence[str]) -> dict[str, str]:
    """A line's values by column; :class:`DataError` unless there are as many."""
    if len(values) != len(columns):
        raise DataError(
            f"{where}: it has {len(values)} values, expected as many values as there"
            f" are columns, {len(columns)}"
        )
    return dict(zip(columns, values, strict=True))


def read_csv(path: Path, limit: int = LARGEST) -> list[dict[str, str]]:
    """The lines of a table in UTF-8 by column; :class:`DataError` naming the file and the line."""
    columns, lines = csv_table(f"{path}", read_text(path, limit))
    return [by_column(f"{path}, line {number}", columns, values) for number, values in lines]


def real(text: str, least: float = 0.0, most: float = math.inf) -> float:
    """The number that a field holds, from ``least`` to ``most``; ValueError for any other text.

    It is written in decimal digits of ASCII without blanks, or as inf or -inf, as Python does.
    """
    number = decimal(text)
    if number is None and text in ("inf", "-inf"):
        number = float(text)
    if number is None or not least <= number <= most:
        raise ValueError(f"{shown(text)}, expected a number from {least:g} to {most:g}")
    return number
