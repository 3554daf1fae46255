"""Golden tables: what a run was when somebody looked at it and found it right.

``recorded/METHOD/DATASET/table.toml`` holds one cell per line, exact counts, and where they come
from; ``samples.csv`` beside it one line per sample: which thresholds it met (see
:func:`pytest_cpas.evaluation.outcomes`) and its errors, rounded, for people. The outcomes decide;
the counts are checked against them on reading.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from pytest_cpas.evaluation import THRESHOLDS, Row, Run, Table, outcomes, precision_table
from pytest_cpas.metrics.precision import Count

FORMAT = 1

_COLUMNS = (
    "sample",
    "category",
    "outcome",
    "translation_error_m",
    "rotation_error_deg",
    "iou",
    "fscore_1cm",
    "failure",
)

#: Samples that a message names before it only counts the rest.
_NAMED = 8


class GoldenError(Exception):
    """A golden table that cannot be read, or not be written."""


class Word(Enum):
    """The verdict on one category of a run."""

    MATCHES = "MATCHES"
    AGREES = "AGREES WITH THE PAPER"
    ABOVE = "ABOVE THE PAPER"
    REGRESSED = "REGRESSED"
    IMPROVED = "IMPROVED"
    CHANGED = "CHANGED"
    STALE = "STALE"
    DAMAGED = "DAMAGED"
    NOT_CHECKED = "NOT CHECKED"
    RECORDED = "RECORDED"
    NOT_RECORDED = "NOT RECORDED"


#: Verdicts that pass without reserve.
GOOD = (Word.MATCHES, Word.AGREES, Word.ABOVE, Word.RECORDED)


@dataclass(frozen=True)
class Verdict:
    """The comparison of one category with its golden cells; ``details`` is for people."""

    word: Word
    category: str
    details: str

    @property
    def failed(self) -> bool:
        """Whether it fails the run. (NOT CHECKED fails it under --cpas-require-golden only.)"""
        return self.word not in (*GOOD, Word.NOT_CHECKED)

    def __str__(self) -> str:
        subject = "" if self.category == "all" else f" {self.category}"
        return f"{self.word.value}{subject}: {self.details}"


@dataclass(frozen=True)
class GoldenSample:
    """A line of ``samples.csv``: ``outcome`` as of :func:`outcomes`, errors as printed."""

    category: str
    outcome: str
    errors: tuple[str, ...]

    def describe(self) -> str:
        """The errors in words."""
        translation, rotation, _, fscore, failure = self.errors
        if failure:
            return f"failed: {failure}"
        text = f"{float(translation) * 100:.3g} cm, {float(rotation):.3g} deg"
        return f"{text}, F {float(fscore):.3g}" if fscore else text


@dataclass(frozen=True)
class GoldenTable:
    """A recorded run: ``identity`` must agree with a run's to compare, ``provenance`` need not."""

    method: str
    dataset: str
    identity: Mapping[str, str]
    provenance: Mapping[str, str]
    samples: Mapping[str, GoldenSample]

    @classmethod
    def of(cls, run: Run, rows: Sequence[Row], previous: GoldenTable | None = None) -> GoldenTable:
        """The table of a run's rows; other categories of the ``previous`` table are kept.

        Raises :class:`GoldenError` unless every category in ``rows`` is complete, or if what is
        kept was made under other conditions.
        """
        counts = Counter(row.category for row in rows)
        partial = [f"{k} {n} of {run.listed[k]}" for k, n in counts.items() if n < run.listed[k]]
        if partial or not rows:
            raise GoldenError(
                f"not every sample was judged ({', '.join(partial) or 'none was'}); a golden table"
                " is recorded from complete categories only"
            )
        kept = {
            name: sample
            for name, sample in (previous.samples.items() if previous else ())
            if sample.category not in counts and sample.category in run.listed
        }
        if previous and kept and _differences(previous.identity, run.identity):
            raise GoldenError(
                "the cells of the other categories were made under other conditions; record all"
                " categories together"
            )
        samples = kept | _golden_samples(rows)
        return cls(run.method, run.dataset, run.identity, run.provenance, samples)

    @property
    def table(self) -> Table:
        """The counts."""
        return precision_table((s.category, s.outcome) for s in self.samples.values())

    # -- files ------------------------------------------------------------------------------

    def write(self, golden: Path) -> Path:
        """Write below ``golden`` and return the folder.

        Each file appears whole or not at all. The table names the digest of its samples, so a
        pair that was torn apart by a crash is refused on reading instead of being compared.
        """
        folder = golden / "recorded" / self.method / self.dataset
        samples = self._samples_csv()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            _replace(folder / "samples.csv", samples)
            _replace(folder / "table.toml", self._table_toml(samples))
        except OSError as error:
            raise GoldenError(f"{folder}: the golden table cannot be written ({error})") from error
        return folder

    def _samples_csv(self) -> str:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for name, sample in sorted(self.samples.items()):
            writer.writerow((name, sample.category, sample.outcome, *sample.errors))
        return text.getvalue()

    def _table_toml(self, samples: str) -> str:
        lines = [
            "# Recorded by pytest-cpas; --snapshot-update records it anew.",
            f"format = {FORMAT}",
            f"samples_sha256 = {_quoted(hashlib.sha256(samples.encode()).hexdigest())}",
        ]
        for title, values in (("identity", self.identity), ("provenance", self.provenance)):
            lines += ["", f"[{title}]"]
            lines += [f"{key} = {_quoted(value)}" for key, value in sorted(values.items())]
        lines += ["", "[cells]", *_cell_lines(self.table)]
        return "\n".join(lines) + "\n"


def _golden_samples(rows: Sequence[Row]) -> dict[str, GoldenSample]:
    def text(value: float | None) -> str:
        return "" if value is None else f"{value:.6g}"

    return {
        row.sample: GoldenSample(
            row.category,
            outcome,
            (
                text(row.translation_error),
                text(row.rotation_error),
                text(row.iou),
                text(row.fscore_1cm),
                row.failure or "",
            ),
        )
        for row, outcome in zip(rows, outcomes(rows), strict=True)
    }


def _cell_lines(table: Table) -> list[str]:
    return [
        f"{_quoted(f'{category} | {label}')} = {_quoted(_cell(cell))}"
        for category, cells in sorted(table.items())
        for label, cell in sorted(cells.items())
    ]


def _cell(cell: Count | None) -> str:
    return "n/a" if cell is None else f"{cell.correct}/{cell.total}"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)  # a JSON string is a TOML basic string


def _replace(path: Path, text: str) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("w", encoding="utf-8", newline="") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def shipped_golden() -> Path:
    """The golden tables that ship with the plugin; never written to when installed."""
    package = Path(__file__).parent
    installed = package / "golden"
    return installed if installed.is_dir() else package.parent / "golden"


def find_golden(golden: Path, method: str, dataset: str) -> GoldenTable | None:
    """The table below ``golden``, else the one that ships with the plugin, else None.

    Raises :class:`GoldenError` for a table that is damaged.
    """
    return recorded_golden(golden, method, dataset) or recorded_golden(
        shipped_golden(), method, dataset
    )


def recorded_golden(golden: Path, method: str, dataset: str) -> GoldenTable | None:
    """The table below ``golden``, None if there is none; :class:`GoldenError` if damaged."""
    folder = golden / "recorded" / method / dataset
    return read_golden(folder) if folder.is_dir() else None


def read_golden(folder: Path) -> GoldenTable:
    """Read ``table.toml`` and ``samples.csv`` and check them against each other.

    Raises :class:`GoldenError` that names the file.
    """
    try:
        text = (folder / "samples.csv").read_bytes().decode("utf-8")
        content: dict[str, Any] = tomllib.loads((folder / "table.toml").read_text("utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise _damaged(folder, str(error)) from error
    if content.get("format") != FORMAT:
        raise _damaged(folder, f"format is {content.get('format')!r}, this version reads {FORMAT}")
    sections = [content.get(name, 0) for name in ("identity", "provenance", "cells")]
    for section in sections:
        if not isinstance(section, dict) or not all(isinstance(v, str) for v in section.values()):
            raise _damaged(
                folder, "table.toml: [identity], [provenance], [cells] must hold strings"
            )
    identity, provenance, cells = sections
    if content.get("samples_sha256") != hashlib.sha256(text.encode()).hexdigest():
        raise _damaged(folder, "samples.csv is not the file that table.toml was made with")
    lines = list(csv.reader(io.StringIO(text, newline="")))
    if not lines or tuple(lines[0]) != _COLUMNS or any(len(x) != len(_COLUMNS) for x in lines):
        raise _damaged(folder, f"samples.csv: expected the columns {', '.join(_COLUMNS)}")
    samples = {x[0]: GoldenSample(x[1], x[2], tuple(x[3:])) for x in lines[1:]}
    golden = GoldenTable(
        folder.parent.name,
        folder.name,
        identity,
        provenance,
        samples,
    )
    stored = [f"{_quoted(k)} = {_quoted(v)}" for k, v in cells.items()]
    valid = all(re.fullmatch(f"[01-]{{{len(THRESHOLDS)}}}", s.outcome) for s in samples.values())
    if not valid or stored != _cell_lines(golden.table):
        raise _damaged(folder, "the cells of table.toml are not the sums of samples.csv")
    return golden


def _damaged(folder: Path, what: str) -> GoldenError:
    return GoldenError(
        f"{folder}: {what}; it was damaged or edited by hand. Restore it from version control, or"
        " record it anew with --snapshot-update"
    )


def compare(golden: GoldenTable | None, rows: Sequence[Row], run: Run) -> list[Verdict]:
    """Compare rows with a golden table, sample by sample; one verdict per category.

    Pure: nothing is read or written. Every sample whose outcome differs is a difference: a
    method that is deterministic has none on the platform where its table was recorded.
    """
    if golden is None:
        return [
            Verdict(
                Word.NOT_CHECKED,
                "all",
                f"there is no golden table of {run.method} on {run.dataset}; if these results are"
                " right, record them with --snapshot-update",
            )
        ]
    stale = _differences(golden.identity, run.identity)
    if stale:
        return [
            Verdict(
                Word.STALE,
                "all",
                f"the golden table was made under other conditions: {'; '.join(stale)}. Restore"
                " them, or record it anew with --snapshot-update",
            )
        ]
    new = _golden_samples(rows)
    categories = sorted({s.category for s in golden.samples.values()} | set(run.listed))
    elsewhere = _differences(golden.provenance, run.provenance)
    return [_compare_category(category, golden, new, run, elsewhere) for category in categories]


def _differences(golden: Mapping[str, str], run: Mapping[str, str]) -> list[str]:
    return [
        f"{key} was {golden.get(key, 'not recorded')}, now {run.get(key, 'not given')}"
        for key in sorted({*golden, *run})
        if golden.get(key) != run.get(key)
    ]


def _compare_category(
    category: str,
    golden: GoldenTable,
    new: Mapping[str, GoldenSample],
    run: Run,
    elsewhere: Sequence[str],
) -> Verdict:
    old = {k: s for k, s in golden.samples.items() if s.category == category}
    judged = {k: s for k, s in new.items() if s.category == category}
    total = max(len(old), run.listed.get(category, 0))
    both = sorted(old.keys() & judged.keys())
    extra = sorted(judged.keys() - old.keys())
    changes: list[tuple[int, list[str]]] = []  # net gain, and what to say
    only_gains = not extra
    for index, threshold in enumerate(THRESHOLDS):
        pairs = [(k, old[k].outcome[index] + judged[k].outcome[index]) for k in both]
        before = sum(pair[0] == "1" for _, pair in pairs)
        after = sum(pair[1] == "1" for _, pair in pairs)
        changed = {
            "lost": [k for k, pair in pairs if pair == "10"],
            "gained": [k for k, pair in pairs if pair == "01"],
            "n/a changed": [k for k, pair in pairs if pair[0] != pair[1] and "-" in pair],
        }
        if not any(changed.values()):
            continue
        only_gains &= not changed["lost"] and not changed["n/a changed"]
        told = [f"{threshold.label}: {before} -> {after} of {len(both)} correct"]
        told += [f"    {what}: {_named(k, old, judged)}" for what, k in changed.items() if k]
        changes.append((len(changed["gained"]) - len(changed["lost"]), told))
    changes.sort(key=lambda change: change[0])  # what fell most stands first
    lines = [line for _, told in changes for line in told]
    if extra:
        lines.append(f"{len(extra)} samples are not in the golden table, first {extra[0]}")
    if lines:
        fell = bool(changes) and changes[0][0] < 0
        word = Word.REGRESSED if fell else Word.IMPROVED if only_gains else Word.CHANGED
        if word is not Word.REGRESSED:
            lines.append("if this is right, record it with --snapshot-update")
        lines += [f"note: {difference}" for difference in elsewhere]
        return Verdict(word, category, "\n  ".join(lines))
    if len(both) < total:
        agreement = f"; the {len(both)} judged agree with the golden table" if both else ""
        return Verdict(Word.NOT_CHECKED, category, f"{len(both)} of {total} judged{agreement}")
    return Verdict(Word.MATCHES, category, f"all {total} samples agree with the golden table")


def _named(
    names: Sequence[str], old: Mapping[str, GoldenSample], new: Mapping[str, GoldenSample]
) -> str:
    told = [f"{name} ({old[name].describe()} -> {new[name].describe()})" for name in names[:_NAMED]]
    rest = len(names) - len(told)
    return "; ".join(told) + (f"; and {rest} more" if rest else "")
