"""Columns that are n/a for every sample, and why: said once for a run."""

from __future__ import annotations

from collections.abc import Sequence

from pytest_cpas.facts import Fact, fact
from pytest_cpas.golden import RunTable
from pytest_cpas.protocols import Column, count_columns, score_columns

__all__ = ["lacking"]

#: Columns that a line names before it only counts the rest.
_NAMED = 6


def lacking(table: RunTable) -> list[str]:
    """The columns in which no sample could be judged, and why; a line for each fact that lacks."""
    answers = [sample.facts for sample in table.samples.values()]
    unknown: dict[str, list[Column]] = {}
    columns: tuple[Column, ...] = count_columns(table.protocols) + score_columns(table.protocols)
    for column in columns:
        for made in column.facts:
            if answers and all(facts.get(made.name) is None for facts in answers):
                unknown.setdefault(made.name, []).append(column)
    lines = [_lacking(table, fact(name), columns) for name, columns in unknown.items()]
    if table.ranking is None and table.ranking_columns:
        lines.append(
            f"{_named(table.ranking_columns)} rank all detections of an image, which only stored"
            " predictions can have (--cpas-predictions)"
        )
    return lines


def _lacking(table: RunTable, made: Fact, columns: Sequence[Column]) -> str:
    keys = _named(columns)
    verb = "needs" if len(columns) == 1 else "need"
    if made.name not in table.definitions:
        again = " ".join(f"--cpas-protocol {n}" for n in dict.fromkeys(c.protocol for c in columns))
        return (
            f"{keys} {verb} the fact {made.name}, which these rows do not have: run again with"
            f" {again}"
        )
    who = "the method, or the data set," if made.needs else "the data set"
    parts = " and no ".join(sorted(made.needs | made.knows)) or "pose"
    return f"{keys} {verb} the fact {made.name}: {who} has no {parts}"


def _named(columns: Sequence[Column]) -> str:
    """Some columns by their keys, and how many more."""
    rest = len(columns) - _NAMED
    named = ", ".join(column.key for column in columns[: _NAMED if rest > 1 else None])
    return f"{named} and {rest} more" if rest > 1 else named
