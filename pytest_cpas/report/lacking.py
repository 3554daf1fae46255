"""Columns that are n/a for every sample, and why: said once for a run."""

from __future__ import annotations

from collections.abc import Sequence

from pytest_cpas.facts import Fact
from pytest_cpas.golden import RunTable
from pytest_cpas.protocols import Column, asked_for, count_columns, score_columns

__all__ = ["lacking"]

#: Columns, or facts, that a line names before it only counts the rest.
_NAMED = 6


def lacking(table: RunTable) -> list[str]:
    """The columns in which no sample could be judged, and why; a line for each reason."""
    answers = [sample.facts for sample in table.samples.values()]
    # for each reason the columns and the facts that it is about, each once
    unknown: dict[str, tuple[dict[str, Column], dict[str, None]]] = {}
    columns: tuple[Column, ...] = count_columns(table.protocols) + score_columns(table.protocols)
    for column in columns:
        for made in column.facts:
            if answers and all(facts.get(made.name) is None for facts in answers):
                named, needed = unknown.setdefault(_reason(table, made, column), ({}, {}))
                named[column.key] = column
                needed[made.name] = None
    lines = [
        f"{_named(list(named))} {'needs' if len(named) == 1 else 'need'} the"
        f" fact{'s' * (len(needed) > 1)} {_named(list(needed))}{reason}"
        for reason, (named, needed) in unknown.items()
    ]
    if table.ranking is None and table.ranking_columns:
        keys = [column.key for column in table.ranking_columns]
        lines.append(
            f"{_named(keys)} rank all detections of the images by their scores, and need those of"
            " all samples: from a file in which every answer has a score (--cpas-predictions), or"
            " from a detector (--cpas-detections)"
        )
    return lines


def _reason(table: RunTable, made: Fact, column: Column) -> str:
    """Why a fact that a column needs is known of no sample."""
    if made.name not in table.definitions:
        return ", which these rows do not have: run again with " + asked_for([column.protocol])
    who = "the method, or the data set," if made.needs else "the data set"
    parts = " and no ".join(sorted(made.needs | made.knows)) or "pose"
    return f": {who} has no {parts}"


def _named(names: Sequence[str]) -> str:
    """Some of the names, and how many more."""
    rest = len(names) - _NAMED
    named = ", ".join(names[: _NAMED if rest > 1 else None])
    return f"{named} and {rest} more" if rest > 1 else named
