"""Rows on disk, as they come: what lets a killed run go on, and shards be judged together.

A results file is append-only text, one JSON value per line, each line preceded by its CRC-32. The
first line says what run it belongs to, every other one holds a row, what went wrong with a sample,
or what a check of the contract found. A last line that was cut off when the writer was killed is
dropped; any other damage is an error.
"""

from __future__ import annotations

import io
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any

from pytest_cpas.evaluation.rows import Row
from pytest_cpas.evaluation.runs import Run
from pytest_cpas.types import SampleRef

__all__ = [
    "Header",
    "Results",
    "ResultsError",
    "ResultsFile",
    "Shard",
    "header_differences",
    "read_results",
]

FORMAT = 4


class ResultsError(Exception):
    """A results file that is damaged, or that belongs to another run."""


@dataclass(frozen=True)
class Shard:
    """The ``index``-th of ``count`` parts of a run, from 1: every ``count``-th sample."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """From ``i/n``; raises :class:`ValueError`."""
        match = re.fullmatch(r"(\d+)/(\d+)", text)
        if not match or not 1 <= int(match[1]) <= int(match[2]):
            raise ValueError(f"shard {text!r}: expected i/n with 1 <= i <= n, such as 2/4")
        return cls(int(match[1]), int(match[2]))

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"


@dataclass(frozen=True, kw_only=True)
class Header:
    """Which run a results file belongs to; ``selected`` counts the samples of this shard."""

    method: str
    dataset: str
    shard: str
    selected: int
    listed: Mapping[str, int]
    missing: Sequence[str]
    damaged: Sequence[str]
    identity: Mapping[str, str]
    provenance: Mapping[str, str]
    seeds: int
    under_contract: bool

    @classmethod
    def of(cls, run: Run, shard: Shard) -> Header:
        """The header of a run's results."""
        return cls(
            method=run.method,
            dataset=run.dataset,
            shard=str(shard),
            selected=len(run.samples),
            listed=dict(run.listed),
            missing=list(run.missing),
            damaged=list(run.damaged),
            identity=dict(run.identity),
            provenance=dict(run.provenance),
            seeds=run.seeds,
            under_contract=run.under_contract,
        )


@dataclass(frozen=True, kw_only=True)
class Results:
    """What a results file holds: rows by sample, and errors of samples without a row.

    ``refs`` has both kinds of samples; ``contract`` what each check of the contract found.
    """

    path: Path
    header: Header
    refs: Mapping[str, SampleRef]
    rows: Mapping[str, Row]
    errors: Mapping[str, str]
    contract: Mapping[str, Mapping[str, Any]]
    size: int  # bytes up to the end of the last whole line


def _line(kind: str, value: Any, **more: Any) -> str:
    text = json.dumps({kind: value, **more}, separators=(",", ":"))
    return f"{zlib.crc32(text.encode()):08x} {text}\n"


def read_results(path: Path) -> Results:
    """Read a results file; :class:`ResultsError` names the line that is damaged."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ResultsError(f"{path}: cannot be read ({error})") from error
    header: Header | None = None
    refs: dict[str, SampleRef] = {}
    rows: dict[str, Row] = {}
    errors: dict[str, str] = {}
    contract: dict[str, Mapping[str, Any]] = {}
    size = 0
    for number, line in enumerate(content.split(b"\n")[:-1], 1):  # the rest was cut off
        crc, _, text = line.partition(b" ")
        if crc != b"%08x" % zlib.crc32(text):
            raise ResultsError(
                f"{path}, line {number}: its checksum is wrong, so the file was damaged or edited;"
                " remove it and run again"
            )
        size += len(line) + 1
        try:
            value = json.loads(text)
            if header is None:
                if value["format"] != FORMAT:
                    raise ValueError(f"format {value['format']}, this version reads {FORMAT}")
                header = Header(**value["header"])
                continue
            if "contract" in value:
                contract[value["contract"]["check"]] = value["contract"]
                continue
            name, category, scene, model = value["ref"]
            ref = SampleRef(id=name, category=category, scene=scene, model=model)
            refs[ref.id] = ref
            if "row" in value:
                rows[ref.id] = Row(sample=ref.id, category=ref.category, **value["row"])
                errors.pop(ref.id, None)
            else:
                errors[ref.id] = value["error"]
        except (ValueError, TypeError, KeyError) as error:
            raise ResultsError(
                f"{path}, line {number}: --cpas-results of this version did not write it ({error})"
            ) from error
    if header is None:
        raise ResultsError(f"{path}: does not begin with the header of a results file")
    return Results(
        path=path, header=header, refs=refs, rows=rows, errors=errors, contract=contract, size=size
    )


class ResultsFile:
    """The results file of one run, which grows by a line per sample.

    Whoever runs the same command again finds the samples that are done in ``rows``.
    """

    def __init__(self, folder: Path, run: Run, shard: Shard) -> None:
        """Read what is there. Raises :class:`ResultsError` if it is damaged or another run's."""
        part = "" if shard.count == 1 else f"-{shard.index}-of-{shard.count}"
        self.path = folder / f"{run.method}-{run.dataset}{part}.jsonl"
        self.header = Header.of(run, shard)
        self._refs = {ref.id: astuple(ref) for ref in run.samples}
        self.rows: Mapping[str, Row] = {}
        self._contract: Mapping[str, Mapping[str, Any]] = {}
        self._size = 0
        self._file: io.RawIOBase | None = None
        if self.path.exists():
            found = read_results(self.path)
            differences = header_differences(found.header, self.header)
            if differences:
                raise ResultsError(
                    f"{self.path} holds another run: {'; '.join(differences)}. Remove it, or name"
                    " another folder"
                )
            self.rows, self._contract, self._size = found.rows, found.contract, found.size

    def __enter__(self) -> ResultsFile:
        """Start writing: a new file with its header, or after the last whole line."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("ab", buffering=0)
            self._file.truncate(self._size)
            if self._size == 0:
                self._write(_line("header", asdict(self.header), format=FORMAT))
        except OSError as error:
            raise ResultsError(f"{self.path}: cannot be written ({error})") from error
        return self

    def __exit__(self, *exception: object) -> None:
        """End writing."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def add(self, row: Row) -> None:
        """Append a row."""
        values = asdict(row)
        del values["sample"], values["category"]
        self._write(_line("row", values, ref=self._refs[row.sample]))

    def add_error(self, sample: str, message: str) -> None:
        """Append why a sample has no row; a later run tries it again."""
        self._write(_line("error", message, ref=self._refs[sample]))

    def add_contract(self, result: Mapping[str, Any]) -> None:
        """Append what a check of the contract found, unless that is what an earlier run found."""
        if self._contract.get(result["check"]) != result:
            self._write(_line("contract", result))

    def _write(self, line: str) -> None:
        if self._file is None:
            raise RuntimeError(f"{self.path} is not open")
        rest = line.encode()
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            raise ResultsError(
                f"{self.path}: cannot be written ({error}); what it holds is good, so the same"
                " command goes on from there once it can"
            ) from error


def header_differences(found: Header, expected: Header) -> list[str]:
    """In what the runs differ that two results files belong to; empty for the same run."""
    old, new = asdict(found), asdict(expected)
    lines = []
    for key in old:
        before, now = old[key], new[key]
        if before != now and isinstance(before, dict):
            parts = sorted(k for k in {*before, *now} if before.get(k) != now.get(k))
            lines += [f"{k} was {before.get(k)}, now {now.get(k)}" for k in parts]
        elif before != now:
            lines.append(f"{key} was {before}, now {now}")
    return lines
