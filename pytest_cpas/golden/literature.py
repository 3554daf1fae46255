"""Average precision as the literature prints it, to be looked at: no verdict is made of it.

It is rounded, of the detections of each paper, and by an "IoU" that is none;
``golden/published/README.md`` says what it is, and the file where each figure was read.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from pytest_cpas.golden.files import shipped_golden
from pytest_cpas.protocols import RankingColumn, shipped_protocol
from pytest_cpas.reading.tables import read_csv, real

#: The protocol by which the literature's figures were made.
LEGACY: Final = "nocs-legacy"


@dataclass(frozen=True, kw_only=True)
class LiteratureRow:
    """What is printed of a method on a data set.

    ``paper``: where the method is from; ``read_in``: where the figures were read; ``also_in``:
    where they stand too, "" if nowhere was found; ``percent``: by the id of a column of
    :data:`LEGACY`, without what is not printed there; ``note``: what differs between the places.
    """

    method: str
    paper: str
    read_in: str
    also_in: str
    percent: Mapping[str, float]
    note: str


def literature(dataset: str) -> list[LiteratureRow]:
    """What is printed of a data set, in the order of the years; empty if nothing is known."""
    return [
        LiteratureRow(
            method=line["method"],
            paper=line["paper"],
            read_in=line["read_in"],
            also_in=line["also_in"],
            percent={
                column.id: real(line[column.id], 0, 100)
                for column in literature_columns()
                if line[column.id]
            },
            note=line["note"],
        )
        for line in _lines()
        if line["dataset"] == dataset
    ]


def literature_columns() -> tuple[RankingColumn, ...]:
    """The columns of :data:`LEGACY`."""
    return tuple(shipped_protocol(LEGACY).rankings)


def literature_datasets() -> list[str]:
    """The data sets of which something is printed."""
    return sorted({line["dataset"] for line in _lines()})


@functools.cache
def _lines() -> list[dict[str, str]]:
    return read_csv(shipped_golden() / "published" / "average_precision.csv")
