"""Average precision as the literature prints it, beside a run: to be looked at."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from pytest_cpas.documents import Document, LiteratureDocument, RunDocument
from pytest_cpas.golden.literature import (
    LEGACY,
    literature,
    literature_columns,
    literature_datasets,
)
from pytest_cpas.protocols import Protocol, RankingColumn
from pytest_cpas.types.samples import ALL

#: What a reader has to know of the figures.
REMARK = (
    "Printed figures are rounded and of the detections of each paper, and what they call IoU is"
    " none: to look at, no verdict is made of them"
)


def literature_documents(
    runs: Iterable[RunDocument], protocols: Iterable[Protocol]
) -> dict[str, list[LiteratureDocument]]:
    """What is printed of the data sets of runs; empty unless they are judged as it was made."""
    if LEGACY not in {protocol.name for protocol in protocols}:
        return {}
    known = {_dataset(run) for run in runs}
    return {name: printed(name) for name in literature_datasets() if name in known}


def printed(dataset: str) -> list[LiteratureDocument]:
    """What is printed of a data set."""
    return [
        {
            "method": row.method,
            "paper": row.paper,
            "read_in": row.read_in,
            "also_in": row.also_in,
            "note": row.note,
            "percent": {
                _label(column): row.percent[column.id]
                for column in literature_columns()
                if column.id in row.percent
            },
        }
        for row in literature(dataset)
    ]


def printed_beside(run: RunDocument) -> list[LiteratureDocument]:
    """What is printed of the data set of a run."""
    return printed(_dataset(run))


def printed_rows(run: RunDocument, document: Document) -> list[LiteratureDocument]:
    """What a document has of the literature on the data set of a run."""
    return document.get("literature", {}).get(_dataset(run), [])


def nearest(
    run: RunDocument, rows: Sequence[LiteratureDocument], most: int
) -> list[LiteratureDocument]:
    """At most so many rows, those first whose figures differ least from a run's, on average over
    what both have; none where nothing of the run is known."""
    own = _own(run)

    def distance(row: LiteratureDocument) -> float:
        differences = [
            abs(own_value - row["percent"][label])
            for label, own_value in own.items()
            if own_value is not None and label in row["percent"]
        ]
        return sum(differences) / len(differences) if differences else math.inf

    near = sorted(rows, key=distance)
    return [row for row in near if math.isfinite(distance(row))][:most]


@dataclass(frozen=True)
class LiteratureTable:
    """A run's average precision in percent, and below it lines as they are printed."""

    columns: Sequence[str]
    own: Sequence[str]
    lines: Sequence[tuple[LiteratureDocument, Sequence[str]]]


def literature_table(
    run: RunDocument, rows: Sequence[LiteratureDocument]
) -> LiteratureTable | None:
    """The table; None without ``rows``."""
    if not rows:
        return None
    own = _own(run)
    return LiteratureTable(
        # what AP is of the protocol stands in the head
        [column.label.removeprefix("AP ") for column in literature_columns()],
        ["n/a" if value is None else f"{value:.1f}" for value in own.values()],
        [
            (
                row,
                [
                    f"{row['percent'][label]:.1f}" if label in row["percent"] else ""
                    for label in own
                ],
            )
            for row in rows
        ],
    )


def _dataset(run: RunDocument) -> str:
    return run["published_as"] or run["dataset"]


def _own(run: RunDocument) -> dict[str, float | None]:
    """The run's average precision over all categories in percent, by the label of a column; None
    where it is n/a."""
    measured = {s["score"]: s["measured"] for s in run["scores"] if s["category"] == ALL}
    shares = {label: measured.get(label) for label in map(_label, literature_columns())}
    return {label: None if share is None else 100 * share for label, share in shares.items()}


def _label(column: RankingColumn) -> str:
    """As :func:`pytest_cpas.report.document.label` has it."""
    return f"{column.protocol}: {column.label}"
