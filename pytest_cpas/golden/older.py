"""Golden tables in the form of version 1, which knew four columns: ``table.toml`` with the cells
and ``samples.csv`` with the outcomes at those and the errors under the first seed.

They are judged as far as they go, and named as ones to record anew.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from pytest_cpas.evaluation import Answer
from pytest_cpas.facts import fact
from pytest_cpas.golden.parsing import checked_fact
from pytest_cpas.golden.tables import GoldenError, RunTable, TableSample
from pytest_cpas.protocols import (
    PAPER,
    CountColumn,
    Protocol,
    count_columns,
    judge_outcomes,
    shipped_protocol,
)
from pytest_cpas.reading.files import lines_of
from pytest_cpas.reading.structured import parse_toml
from pytest_cpas.reading.tables import csv_lines
from pytest_cpas.types import DataError, SampleRef, shown

__all__ = ["OLDER_SAMPLES", "OLDER_TABLE", "belong_together", "parse_older"]

OLDER_TABLE, OLDER_SAMPLES = "table.toml", "samples.csv"

_FORMAT = 2

#: Seeds that are believed: where all agree, the table has one outcome for them.
_MOST_SEEDS = 1000

_COLUMNS = (
    "sample",
    "category",
    "outcome",
    "repeats",
    "translation_error_m",
    "rotation_error_deg",
    "iou",
    "fscore_1cm",
    "failure",
)

#: What the errors are called now, in their order, and how their definitions were.
_FACTS = {
    "position_m": "translation_error",
    "rotation_deg": "rotation_error",
    "iou": "iou",
    "fscore_1cm": "fscore_1cm",
}

#: The columns that have outcomes, in the order of their characters.
_JUDGED = ("10deg_2cm", "10deg_2cm_f60", "5deg_1cm", "5deg_1cm_f80")


def parse_older(method: str, dataset: str, table_toml: str, samples_csv: str) -> RunTable:
    """A table from the texts of its two files; :class:`GoldenError` if they are none."""
    try:
        content = parse_toml(OLDER_TABLE, table_toml)
    except DataError as error:
        raise GoldenError(str(error)) from error
    if content.get("format") != _FORMAT:
        raise GoldenError(
            f"{OLDER_TABLE}: format is {shown(content.get('format'))}, expected {_FORMAT}"
        )
    seeds = content.get("seeds")
    if type(seeds) is not int or not 1 <= seeds <= _MOST_SEEDS:
        raise GoldenError(f"{OLDER_TABLE}: seeds is {shown(seeds)}, expected 1 to {_MOST_SEEDS}")
    sections = [content.get(name, 0) for name in ("identity", "provenance", "cells")]
    for section in sections:
        if not isinstance(section, dict) or not all(isinstance(v, str) for v in section.values()):
            raise GoldenError(f"{OLDER_TABLE}: [identity], [provenance], [cells] must hold strings")
    identity, provenance, cells = sections
    if content.get("samples_sha256") != hashlib.sha256(samples_csv.encode()).hexdigest():
        raise GoldenError(f"{OLDER_SAMPLES} is not the file that {OLDER_TABLE} was made with")
    read = _samples(samples_csv, seeds)
    only_first = any(sample.wavers for sample in read.values())
    protocol = _protocol(only_first)
    names = {then: now for now, then in _FACTS.items()}
    samples = read if only_first else _judged(protocol, read, seeds)
    table = RunTable(
        method=method,
        dataset=dataset,
        identity={key: value for key, value in identity.items() if key not in names},
        definitions={now: identity[then] for then, now in names.items() if then in identity},
        provenance=provenance,
        protocols=(protocol,),
        samples=samples,
        listed=Counter(sample.category for sample in samples.values()),
        seeds=seeds,
        outdated=True,
    )
    if cells != _cells(table):
        raise GoldenError(f"the cells of {OLDER_TABLE} are not the sums of {OLDER_SAMPLES}")
    return table


def belong_together(table_toml: bytes, samples_csv: bytes) -> bool:
    """Whether these are the two files of one table: the first names the digest of the second."""
    try:
        content = parse_toml(OLDER_TABLE, table_toml.decode())
    except ValueError:
        return False
    samples = samples_csv.replace(b"\r\n", b"\n")
    digest = hashlib.sha256(samples).hexdigest()
    return content.get("format") == _FORMAT and content.get("samples_sha256") == digest


def _samples(samples_csv: str, seeds: int) -> dict[str, TableSample]:
    """The lines of ``samples.csv``; :class:`GoldenError` names the one that is none."""
    samples: dict[str, TableSample] = {}
    number = 1
    try:
        lines = csv_lines(
            OLDER_SAMPLES, lines_of(io.StringIO(samples_csv, newline=""), OLDER_SAMPLES)
        )
        if tuple(next(lines, (0, ()))[1]) != _COLUMNS:
            raise ValueError(f"expected the columns {', '.join(_COLUMNS)}")
        for number, line in lines:  # noqa: B007 - told if the line is wrong
            if len(line) != len(_COLUMNS):
                raise ValueError(f"{len(line)} fields, expected {len(_COLUMNS)}")
            if line[0] in samples:
                raise ValueError(f"sample {line[0]} is there twice")
            samples[line[0]] = _sample(line, seeds)
    except DataError as error:
        raise GoldenError(str(error)) from error
    except ValueError as error:
        raise GoldenError(f"{OLDER_SAMPLES}, line {number}: {error}") from error
    return samples


def _sample(line: Sequence[str], seeds: int) -> TableSample:
    name, category, outcome, repeats, translation, rotation, iou, fscore, failure = line
    outcomes = (outcome, *repeats.split())
    if len(outcomes) not in (1, seeds) or any(
        not re.fullmatch(r"[01-]{4}", each) for each in outcomes
    ):
        raise ValueError(f"outcomes {' '.join(outcomes)[:80]!r}")
    SampleRef(id=name, category=category, scene="")  # checks both
    errors = [
        checked_fact(text, fact(now), failed=bool(failure))
        for now, text in zip(_FACTS, (translation, rotation, iou, fscore), strict=True)
    ]
    if None in errors[:2]:
        raise ValueError("a translation or a rotation error is missing")
    return TableSample(
        category=category,
        answers=(Answer(facts=dict(zip(_FACTS, errors, strict=True)), failure=failure or None),),
        outcomes=outcomes if len(outcomes) == seeds else (outcome,) * seeds,
    )


def _protocol(only_first: bool) -> Protocol:
    """What of the default protocol these tables can be judged by.

    Where seeds disagree, the errors of only one are known: what they do not decide is left out.
    """
    protocol = shipped_protocol(PAPER)
    columns: list[CountColumn] = []
    for column in protocol.counts:
        known = {made.name for made in column.facts} <= _FACTS.keys()
        if column.id in _JUDGED or (known and not only_first):
            columns.append(column)
    return replace(protocol, columns=columns)


def _judged(
    protocol: Protocol, samples: dict[str, TableSample], seeds: int
) -> dict[str, TableSample]:
    """The samples with outcomes at all columns: those that were recorded, then the others."""
    columns = count_columns([protocol])
    outcomes = judge_outcomes(columns, [sample.facts for sample in samples.values()])
    return {
        name: replace(sample, outcomes=(sample.outcome + outcome[len(_JUDGED) :],) * seeds)
        for (name, sample), outcome in zip(samples.items(), outcomes, strict=True)
    }


def _cells(table: RunTable) -> dict[str, str]:
    told = {}
    for category, counts in table.table.items():
        for column in table.columns:
            if column.id in _JUDGED:
                count = counts[column.key]
                cell = "n/a" if count is None else f"{count.correct}/{count.total}"
                told[f"{category} | {_label(column)}"] = cell
    return told


def _label(column: CountColumn) -> str:
    return ", ".join(fact(name).limit_label(limit) for name, limit in column.limits.items())
