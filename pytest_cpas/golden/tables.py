"""What a run gave, sample by sample, and its text in two files."""

from __future__ import annotations

import csv
import functools
import hashlib
import io
import math
import re
import sys
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from pytest_cpas._files import toml_string
from pytest_cpas.evaluation import THRESHOLDS, Row, Run, Table, outcomes, precision_table
from pytest_cpas.metrics.precision import Count, Errors
from pytest_cpas.reading.structured import parse_toml
from pytest_cpas.reading.tables import csv_lines, real
from pytest_cpas.types import DataError

__all__ = ["FORMAT", "GoldenError", "RunTable", "TableSample", "differences", "parse_golden"]


FORMAT = 2

#: Characters of a reason that are kept.
_LONGEST_REASON = 2000

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

_OUTCOME = re.compile(f"[01-]{{{len(THRESHOLDS)}}}")


class GoldenError(Exception):
    """A golden table that cannot be read, or not be written."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TableSample:
    """A line of ``samples.csv``.

    ``outcome`` as of :func:`outcomes`; ``repeats`` the outcomes under the further seeds of
    ``--cpas-jitter``, empty if all are like the first; ``errors`` in the order of the columns,
    metres and degrees, None is n/a; ``failure`` why there is no answer, or "".
    """

    category: str
    outcome: str
    repeats: tuple[str, ...]
    errors: tuple[float, float, float | None, float | None]
    failure: str

    def describe(self) -> str:
        """The errors in words."""
        if self.failure:
            return f"failed: {self.failure}"
        translation, rotation, _, fscore = self.errors
        text = f"{translation * 100:.3g} cm, {rotation:.3g} deg"
        return text if fscore is None else f"{text}, F {fscore:.3g}"


@dataclass(frozen=True, kw_only=True)
class RunTable:
    """What a run gave, sample by sample; recorded, it is a golden table.

    ``identity`` must agree for two tables to be comparable, ``provenance`` need not. ``listed``
    counts per category the samples that there are, judged or not; ``seeds`` how often each
    sample was judged.
    """

    method: str
    dataset: str
    identity: Mapping[str, str]
    provenance: Mapping[str, str]
    samples: Mapping[str, TableSample]
    listed: Mapping[str, int]
    seeds: int = 1

    @classmethod
    def of(cls, run: Run, rows: Sequence[Row] | None = None) -> RunTable:
        """The table of a run's rows; without them, every sample is judged first."""
        if rows is None:
            rows = [run.judge(ref) for ref in run.samples]
        return cls(
            method=run.method,
            dataset=run.dataset,
            identity=run.identity,
            provenance=run.provenance,
            samples=_table_samples(rows),
            listed=run.listed,
            seeds=run.seeds,
        )

    @functools.cached_property
    def table(self) -> Table:
        """The counts, of the first seed."""
        return precision_table((s.category, s.outcome) for s in self.samples.values())

    @property
    def errors(self) -> Errors:
        """The errors of the samples by metric, of the first seed."""
        metrics = ("position_m", "rotation_deg", "iou", "fscore")
        samples = self.samples.values()
        return Errors({m: [sample.errors[i] for sample in samples] for i, m in enumerate(metrics)})

    def without(self, categories: Collection[str]) -> RunTable:
        """This table without some categories, as if they were not there."""
        return replace(
            self,
            samples={k: s for k, s in self.samples.items() if s.category not in categories},
            listed={k: n for k, n in self.listed.items() if k not in categories},
        )

    def recordable(self, previous: RunTable | None) -> RunTable:
        """This table with the categories of ``previous`` that it does not hold itself.

        Raises :class:`GoldenError` unless every category that it holds is complete, or if what is
        kept was made under other conditions.
        """
        counts = Counter(sample.category for sample in self.samples.values())
        partial = [f"{k} {n} of {self.listed[k]}" for k, n in counts.items() if n < self.listed[k]]
        if partial or not counts:
            raise GoldenError(
                f"not every sample was judged ({', '.join(partial) or 'none was'}); a golden table"
                " is recorded from complete categories only"
            )
        if previous is None:
            return self
        if previous.seeds > self.seeds:
            raise GoldenError(
                f"the golden table allows for the spread of {previous.seeds} seeds, and this run"
                f" has {self.seeds}: pass --cpas-jitter {previous.seeds}, or remove the table first"
            )
        kept = {
            name: sample
            for name, sample in previous.samples.items()
            if sample.category not in counts and sample.category in self.listed
        }
        if kept and (differences(previous.identity, self.identity) or previous.seeds != self.seeds):
            raise GoldenError(
                "the cells of the other categories were made under other conditions; record all"
                " categories together"
            )
        return replace(self, samples=kept | dict(self.samples))

    # -- text -------------------------------------------------------------------------------

    def samples_csv(self) -> str:
        """The text of ``samples.csv``."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for name, sample in sorted(self.samples.items()):
            repeats = " ".join(sample.repeats)
            errors = ("" if error is None else f"{error:.6g}" for error in sample.errors)
            writer.writerow(
                (name, sample.category, sample.outcome, repeats, *errors, sample.failure)
            )
        return text.getvalue()

    def table_toml(self, samples_csv: str) -> str:
        """The text of ``table.toml``; it names the digest of ``samples.csv``."""
        lines = [
            "# Recorded by pytest-cpas; --snapshot-update records it anew.",
            f"format = {FORMAT}",
            f"samples_sha256 = {toml_string(_digest(samples_csv))}",
            f"seeds = {self.seeds}",
        ]
        for title, values in (("identity", self.identity), ("provenance", self.provenance)):
            lines += ["", f"[{title}]"]
            lines += [f"{key} = {toml_string(value)}" for key, value in sorted(values.items())]
        lines += ["", "[cells]", *_cell_lines(self.table)]
        return "\n".join(lines) + "\n"


def differences(golden: Mapping[str, str], run: Mapping[str, str]) -> list[str]:
    """What differs between two identities, or two provenances, in words."""
    return [
        f"{key} was {golden.get(key, 'not recorded')}, now {run.get(key, 'not given')}"
        for key in sorted({*golden, *run})
        if golden.get(key) != run.get(key)
    ]


def _table_samples(rows: Sequence[Row]) -> dict[str, TableSample]:
    return {
        row.sample: TableSample(
            category=row.category,
            outcome=outcome,
            repeats=tuple(row.repeats.split()) if set(row.repeats.split()) - {outcome} else (),
            errors=(row.translation_error, row.rotation_error, row.iou, row.fscore_1cm),
            failure=_recordable_text(row.failure or ""),
        )
        for row, outcome in zip(rows, outcomes(rows), strict=True)
    }


def _recordable_text(text: str) -> str:
    """A reason as a table keeps it: not endless, and of characters that every reader takes."""
    if len(text) > _LONGEST_REASON:
        text = f"{text[:_LONGEST_REASON]}... ({len(text)} characters)"
    return re.sub(
        r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]",
        lambda match: match[0].encode("unicode_escape").decode("ascii"),
        text,
    )


def _cell_lines(table: Table) -> list[str]:
    return [
        f"{toml_string(f'{category} | {label}')} = {toml_string(_cell(cell))}"
        for category, cells in sorted(table.items())
        for label, cell in sorted(cells.items())
    ]


def _cell(cell: Count | None) -> str:
    return "n/a" if cell is None else f"{cell.correct}/{cell.total}"


def _digest(samples: str) -> str:
    return hashlib.sha256(samples.encode()).hexdigest()


def parse_golden(method: str, dataset: str, toml: str, samples_csv: str) -> RunTable:
    """A table from the texts of its two files.

    Raises :class:`GoldenError` if they are not, or do not belong together.
    """
    lines = io.StringIO(samples_csv, newline="")
    return parse_samples(method, dataset, toml, lines, _digest(samples_csv))


def parse_samples(
    method: str, dataset: str, toml: str, samples_csv: Iterable[str], digest: str
) -> RunTable:
    """The same from the lines of ``samples.csv`` and their SHA-256."""
    try:
        content = parse_toml("table.toml", toml)
    except DataError as error:
        raise GoldenError(str(error)) from error
    if content.get("format") != FORMAT:
        raise GoldenError(f"format is {content.get('format')!r}, this version reads {FORMAT}")
    seeds = content.get("seeds")
    if not isinstance(seeds, int) or isinstance(seeds, bool) or not 1 <= seeds < 2**31:
        raise GoldenError(f"table.toml: seeds is {seeds!r}, expected at least 1")
    sections = [content.get(name, 0) for name in ("identity", "provenance", "cells")]
    for section in sections:
        if not isinstance(section, dict) or not all(isinstance(v, str) for v in section.values()):
            raise GoldenError("table.toml: [identity], [provenance], [cells] must hold strings")
    identity, provenance, cells = sections
    if content.get("samples_sha256") != digest:
        raise GoldenError("samples.csv is not the file that table.toml was made with")
    samples = _samples(samples_csv, seeds)
    listed = Counter(sample.category for sample in samples.values())
    table = RunTable(
        method=method,
        dataset=dataset,
        identity=identity,
        provenance=provenance,
        samples=samples,
        listed=listed,
        seeds=seeds,
    )
    if [f"{toml_string(k)} = {toml_string(v)}" for k, v in cells.items()] != _cell_lines(
        table.table
    ):
        raise GoldenError("the cells of table.toml are not the sums of samples.csv")
    return table


def _samples(samples_csv: Iterable[str], seeds: int) -> dict[str, TableSample]:
    """The lines of ``samples.csv``; :class:`GoldenError` names the one that is none."""
    samples: dict[str, TableSample] = {}
    number = 1
    try:
        lines = csv_lines("samples.csv", samples_csv)
        if tuple(next(lines, (0, ()))[1]) != _COLUMNS:
            raise ValueError(f"expected the columns {', '.join(_COLUMNS)}")
        for number, line in lines:  # noqa: B007 - told if the line is wrong
            sample = _sample(line)
            told = [sample.outcome, *sample.repeats]
            if len(told) not in (1, seeds) or not all(_OUTCOME.fullmatch(text) for text in told):
                raise ValueError(f"outcomes {' '.join(told)[:80]!r}")
            if line[0] in samples:
                raise ValueError(f"sample {line[0]} is there twice")
            samples[sys.intern(line[0])] = sample
    except DataError as error:
        raise GoldenError(str(error)) from error
    except ValueError as error:
        raise GoldenError(f"samples.csv, line {number}: {error}") from error
    return samples


def _sample(line: Sequence[str]) -> TableSample:
    _, category, outcome, repeats, translation, rotation, iou, fscore, failure = line
    return TableSample(
        category=sys.intern(category),
        outcome=sys.intern(outcome),
        repeats=tuple(repeats.split()),
        errors=(
            real(translation),
            real(rotation),
            real(iou, -math.inf, 1.01) if iou else None,
            real(fscore, -math.inf, 1.01) if fscore else None,
        ),
        failure=failure,
    )
