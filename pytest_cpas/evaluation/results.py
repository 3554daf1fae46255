"""Rows on disk, as they come: what lets a killed run go on, and shards be judged together.

A results file is append-only text, one JSON value per line, each line preceded by a checksum of
itself and of all lines before it. The first line says what run the file belongs to, every other one
holds a row, what went wrong with a sample, what a check of the contract found, by which other
program the rows that follow were computed, which files it has read, or what has changed of it while
it ran. A last
line that was cut off when the writer was killed is dropped; any other damage, and a line that was
written by another run, is an error.
"""

from __future__ import annotations

import hashlib
import re
import secrets
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pytest_cpas.evaluation import result_lines
from pytest_cpas.evaluation.opened import OWN, other_names
from pytest_cpas.evaluation.rows import Row
from pytest_cpas.evaluation.runs import Run
from pytest_cpas.evaluation.surroundings import changes
from pytest_cpas.reading.files import read_bytes
from pytest_cpas.reading.structured import LARGEST_JSON, json_value
from pytest_cpas.types import DataError, SampleRef, ToldError, shown

__all__ = [
    "Header",
    "Results",
    "ResultsError",
    "Shard",
    "header_differences",
    "program_differences",
    "read_results",
    "together",
]

FORMAT = 9

#: Largest file, bytes: a million rows have two thirds of it.
LARGEST = 2**29

#: Names of files that the programs of one file may have read.
_MOST_OPENED = 100_000

#: Characters of a checksum.
_CHECKSUM = 16

#: Code that changed while it ran, in provenance.
CHANGING = "changed while it ran"

#: What is told of a program, but does not tell one from another.
_ONLY_TOLD = ("revision",)


class ResultsError(ToldError):
    """A results file that is damaged, or that belongs to another run."""


@dataclass(frozen=True)
class Shard:
    """The ``index``-th of ``count`` parts of a run, from 1: every ``count``-th sample."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """From ``i/n``; raises :class:`ValueError`."""
        match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if not match or not 1 <= int(match[1]) <= int(match[2]):
            raise ValueError(f"shard {shown(text)}: expected i/n with 1 <= i <= n, such as 2/4")
        return cls(int(match[1]), int(match[2]))

    def stem_of(self, run: Run) -> str:
        """What the files of this part of a run are called, without their extension."""
        part = "" if self.count == 1 else f"-{self.index}-of-{self.count}"
        return f"{run.method}-{run.dataset}{part}"

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"


@dataclass(frozen=True, kw_only=True)
class Header:
    """Which run a results file belongs to; ``selected`` counts the samples of this shard.

    ``nonce``: a random word, so that no line of one file fits into another one.
    """

    method: str
    dataset: str
    shard: str
    selected: int
    listed: Mapping[str, int]
    missing: Sequence[str]
    derived: str
    damaged: Sequence[str]
    identity: Mapping[str, str]
    definitions: Mapping[str, str]
    provenance: Mapping[str, str]
    files: Mapping[str, str]
    seeds: int
    under_contract: bool
    nonce: str

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
            derived=run.derived,
            damaged=list(run.damaged),
            identity=dict(run.identity),
            definitions=dict(run.definitions),
            provenance=dict(run.provenance),
            files=dict(run.files),
            seeds=run.seeds,
            under_contract=run.under_contract,
            nonce=secrets.token_hex(8),
        )


@dataclass(frozen=True, kw_only=True)
class Results:
    """What a results file holds: rows by sample, and errors of samples without a row.

    ``refs`` has both kinds of samples; ``contract`` what each check of the contract found. The
    provenance of the ``header`` names every program that computed rows; ``changed``: what has
    changed of one while it did, so that nobody knows which rows are whose; ``opened``: a digest of
    each file that was seen when one opened it. ``size``: bytes up to
    the end of the last whole line, whose checksum is ``last``.
    """

    path: Path
    header: Header
    refs: Mapping[str, SampleRef]
    rows: Mapping[str, Row]
    errors: Mapping[str, str]
    contract: Mapping[str, Mapping[str, Any]]
    changed: Sequence[str]
    opened: Mapping[str, str]
    size: int
    last: bytes


def checksum_of(last: bytes, text: bytes) -> bytes:
    """Of a line whose predecessor has the checksum ``last``; the first line has b"" before it."""
    return hashlib.sha256(last + text).hexdigest()[:_CHECKSUM].encode()


def read_results(path: Path) -> Results:
    """Read a results file; :class:`ResultsError` names the line that is damaged."""
    return parse_results(path, read_file(path))


def read_file(path: Path) -> bytes:
    """The content of a results file; :class:`ResultsError` if it cannot be read."""
    try:
        return read_bytes(path, LARGEST)
    except DataError as error:
        raise ResultsError(str(error)) from error


def parse_results(path: Path, content: bytes) -> Results:
    """As :func:`read_results`, from the content of ``path``."""
    header: Header | None = None
    refs: dict[str, SampleRef] = {}
    rows: dict[str, Row] = {}
    errors: dict[str, str] = {}
    contract: dict[str, Mapping[str, Any]] = {}
    changed: list[str] = []
    opened: dict[str, str] = {}
    size, last = 0, b""
    for number, line in enumerate(_whole_lines(content), 1):
        seen, _, text = line.partition(b" ")
        expected = checksum_of(last, text)
        if seen != expected:
            raise ResultsError(f"{path}, line {number}: {_why_wrong(line, header)}")
        size, last = size + len(line) + 1, expected
        try:
            value = result_lines.line(json_value("its JSON", text), first=header is None)
            if header is None:
                if value["format"] != FORMAT:
                    told = shown(value["format"])
                    raise ValueError(f"format {told}, this version reads {FORMAT}")
                header = Header(**result_lines.header(value["header"]))
            elif "contract" in value:
                found = result_lines.contract(value["contract"])
                contract[found["check"]] = found
            elif "changed" in value:
                changed += result_lines.several_texts("changed", value["changed"])
            elif "opened" in value:
                files = result_lines.texts("opened", value["opened"])
                changed += other_names(opened, files)
                opened |= {n: told for n, told in files.items() if opened.get(n) != OWN}
                if len(opened) > _MOST_OPENED:
                    raise ValueError(f"more than {_MOST_OPENED} files were opened")
            elif "program" in value:
                program = result_lines.texts("program", value["program"])
                files = result_lines.texts("files", value["files"])
                header = replace(
                    header,
                    provenance=together(header.provenance, program),
                    files=together(header.files, files),
                )
            else:
                ref = result_lines.ref(value["ref"])
                if ref.id in rows:
                    raise ValueError(f"sample {ref.id} has a row already")
                refs[ref.id] = ref
                if "row" in value:
                    rows[ref.id] = result_lines.row(ref, value["row"])
                    first = next(iter(rows.values()))
                    result_lines.check_row(
                        rows[ref.id], first, header.seeds, header.definitions.keys()
                    )
                    errors.pop(ref.id, None)
                else:
                    errors[ref.id] = result_lines.text("error", value["error"])
        except ValueError as error:
            raise ResultsError(
                f"{path}, line {number}: --cpas-results of this version did not write it ({error})"
            ) from error
    if len(content) - size > LARGEST_JSON:
        raise ResultsError(
            f"{path}: its last line was cut off after {len(content) - size} bytes, and no run"
            f" writes one of more than {LARGEST_JSON}; remove the file and run again"
        )
    if header is None:
        raise ResultsError(f"{path}: does not begin with the header of a results file")
    _check_counts(path, header, refs.values())
    if changed:
        header = replace(header, provenance=together(header.provenance, {"code": CHANGING}))
    return Results(
        path=path,
        header=header,
        refs=refs,
        rows=rows,
        errors=errors,
        contract=contract,
        changed=changed,
        opened=opened,
        size=size,
        last=last,
    )


def _why_wrong(line: bytes, header: Header | None) -> str:
    """What is told by a line without the checksum that it should have."""
    if header is None and line.lstrip()[:1] in (b"{", b"["):
        return (
            "this is JSON without checksums, and no results file; a file of predictions is judged"
            " with --cpas-predictions=FILE, and a report.json is compared with --cpas-against=FILE"
        )
    if line.endswith(b"\r"):
        return (
            "its line ends were changed to CRLF, as by a checkout or an editor, so its checksums"
            " are wrong; take the file as it was written"
        )
    return (
        "its checksum is wrong, so the file was damaged or edited, or the line was written by"
        " another run; remove the file and run again"
    )


def _whole_lines(content: bytes) -> Iterator[bytes]:
    """The lines of a file, but for a last one that was cut off, one at a time."""
    start = 0
    while (end := content.find(b"\n", start)) >= 0:
        yield content[start:end]
        start = end + 1


def together(one: Mapping[str, str], other: Mapping[str, str]) -> Mapping[str, str]:
    """The facts, or the files, of two programs that have both computed some of the rows."""
    both = {}
    for key in sorted({*one, *other}):
        facts = [part.get(key, "unknown").split(" and ") for part in (one, other)]
        both[key] = " and ".join(dict.fromkeys([*facts[0], *facts[1]]))
    return both


def _check_counts(path: Path, header: Header, refs: Collection[SampleRef]) -> None:
    """:class:`ResultsError` for more samples than the header says that there are."""
    counts = Counter(ref.category for ref in refs)
    told = [
        f"{category} has {count}, and its header lists {header.listed.get(category, 0)}"
        for category, count in sorted(counts.items())
        if count > header.listed.get(category, 0)
    ]
    listed = sum(header.listed.values())
    if header.selected > listed:
        told.append(f"its header selects {header.selected} of the {listed} that it lists")
    if len(refs) > header.selected:
        told.append(f"it has {len(refs)}, and its header selects {header.selected}")
    if told:
        raise ResultsError(
            f"{path}: samples that no run writes: {'; '.join(told)}. Remove the file and run again"
        )


def is_torn_header(content: bytes) -> bool:
    """Whether it is the beginning of a first line, or nothing: a disk was full, or a writer killed,
    before there was anything to lose."""
    checksum, rest = content[:_CHECKSUM], content[_CHECKSUM:]
    start = b' {"header":'
    return (
        b"\n" not in content
        and all(byte in b"0123456789abcdef" for byte in checksum)
        and (rest.startswith(start) or start.startswith(rest))
    )


def program_differences(found: Header, expected: Header) -> list[str]:
    """In what the programs differ that two results files hold rows of; empty for the same one."""
    return [
        *_differences(found.provenance, expected.provenance),
        *changes(found.files, expected.files),
    ]


def header_differences(found: Header, expected: Header) -> list[str]:
    """In what the runs differ that two results files belong to, whichever program computed them;
    empty for the same run."""
    old, new = asdict(found), asdict(expected)
    lines = []
    for key in old.keys() - {"provenance", "files", "nonce"}:
        before, now = old[key], new[key]
        if before != now and isinstance(before, dict):
            lines += _differences(before, now)
        elif before != now:
            lines.append(f"{key} was {before}, now {now}")
    return sorted(lines)


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    parts = sorted({*before, *now} - {*_ONLY_TOLD})
    return [
        f"{k} was {before.get(k)}, now {now.get(k)}" for k in parts if before.get(k) != now.get(k)
    ]
