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
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import Any

from pytest_cpas.evaluation.rows import Row
from pytest_cpas.evaluation.runs import Run, SampleError, has_quick_truth, read_truth
from pytest_cpas.types import Dataset, GroundTruth, SampleRef

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
            differences = _differences(found.header, self.header)
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


def _differences(found: Header, expected: Header) -> list[str]:
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


class MergedRun(Run):
    """The results of all shards of a run, judged as one."""

    def __init__(self, parts: Sequence[Results]) -> None:
        """Put results together that :func:`merge` has checked."""
        header = parts[0].header
        self._rows = {sample: row for part in parts for sample, row in part.rows.items()}
        self._errors = {sample: text for part in parts for sample, text in part.errors.items()}
        refs = [ref for part in parts for ref in part.refs.values()]
        samples = sorted(refs, key=lambda ref: ref.id)
        super().__init__(
            header.method,
            header.dataset,
            samples,
            missing=header.missing,
            damaged=header.damaged,
            identity=header.identity,
        )
        self.listed = Counter(header.listed)
        self.provenance = header.provenance
        self.seeds = header.seeds
        self.under_contract = header.under_contract
        #: What the checks of the contract found, shard by shard.
        self.contract = [part.contract for part in parts]
        #: The data set that was judged, if it is at hand.
        self.images: Dataset | None = None

    def take_images(self, dataset: Dataset) -> None:
        """Have the samples themselves, for pictures; :class:`ResultsError` if the data differs."""
        if dataset.digest != self.identity.get("data"):
            raise ResultsError(
                f"{self.method} on {self.dataset} was judged on other data:"
                f" {self.identity.get('data')}, now {dataset.digest}; leave out --cpas-dataset"
            )
        self.images, self.quick_truth = dataset, has_quick_truth(dataset)

    def truth(self, ref: SampleRef) -> GroundTruth | None:
        """The truth about one sample, if the data set is at hand."""
        return None if self.images is None else read_truth(self.images, ref)

    def judge(self, ref: SampleRef) -> Row:
        """The stored row; raises the stored error."""
        if ref.id in self._errors:
            raise SampleError(self._errors[ref.id])
        return self._rows[ref.id]


def merge(paths: Sequence[Path], *, allow_gaps: bool = False) -> list[MergedRun]:
    """The runs whose shards are in ``paths``, one per method and data set.

    Raises :class:`ResultsError` for shards of different runs or conditions, for samples that are
    in two files and, unless ``allow_gaps``, for shards or samples that are in none.
    """
    groups: dict[tuple[str, str], list[Results]] = {}
    for path in paths:
        results = read_results(path)
        groups.setdefault((results.header.method, results.header.dataset), []).append(results)
    for parts in groups.values():
        _check_shards(parts, allow_gaps)
    return [MergedRun(parts) for parts in groups.values()]


def _check_shards(parts: Sequence[Results], allow_gaps: bool) -> None:
    first = parts[0]
    seen: dict[str, Path] = {}
    shards: dict[int, Path] = {}
    for part in parts:
        shard, count = Shard.parse(part.header.shard), Shard.parse(first.header.shard).count
        same = replace(part.header, shard=first.header.shard, selected=first.header.selected)
        differences = _differences(first.header, same)
        if shard.count != count:
            differences.append(f"shards are {count}, now {shard.count}")
        if differences:
            raise ResultsError(
                f"{first.path} and {part.path} are of different runs: {'; '.join(differences)}"
            )
        if shard.index in shards:
            raise ResultsError(f"{shards[shard.index]} and {part.path} are both shard {shard}")
        shards[shard.index] = part.path
        for sample in (*part.rows, *part.errors):
            if sample in seen:
                raise ResultsError(f"sample {sample} is in {seen[sample]} and in {part.path}")
            seen[sample] = part.path
    gaps = [f"shard {i}/{count} is missing" for i in range(1, count + 1) if i not in shards]
    for part in parts:
        done = len(part.rows) + len(part.errors)
        if done < part.header.selected:
            gaps.append(f"{part.path} has {done} of its {part.header.selected} samples")
    if gaps and not allow_gaps:
        raise ResultsError(f"{'; '.join(gaps)}. Run what is missing, or pass --cpas-allow-gaps")
