"""Rows on disk, as they come: what lets a killed run go on, and shards be judged together.

A results file is append-only text, one JSON value per line, each line preceded by a checksum of
itself and of all lines before it. The first line says what run the file belongs to, every other one
holds a row, what went wrong with a sample, what a check of the contract found, or by which other
program the rows that follow were computed. A last line that was cut off when the writer was killed
is dropped; any other damage, and a line that was written by another run, is an error.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import os
import re
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import Any

from pytest_cpas.evaluation.program import UNKNOWN
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
    "program_differences",
    "read_results",
]

FORMAT = 5

#: Characters of a checksum.
_CHECKSUM = 16

#: What is told of a program, but does not tell one from another.
_ONLY_TOLD = ("revision",)


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
    """Which run a results file belongs to; ``selected`` counts the samples of this shard.

    ``nonce``: a random word, so that no line of one file fits into another one.
    """

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
            damaged=list(run.damaged),
            identity=dict(run.identity),
            provenance=dict(run.provenance),
            seeds=run.seeds,
            under_contract=run.under_contract,
            nonce=secrets.token_hex(8),
        )


@dataclass(frozen=True, kw_only=True)
class Results:
    """What a results file holds: rows by sample, and errors of samples without a row.

    ``refs`` has both kinds of samples; ``contract`` what each check of the contract found. The
    provenance of the ``header`` names every program that computed rows. ``size``: bytes up to the
    end of the last whole line, whose checksum is ``last``.
    """

    path: Path
    header: Header
    refs: Mapping[str, SampleRef]
    rows: Mapping[str, Row]
    errors: Mapping[str, str]
    contract: Mapping[str, Mapping[str, Any]]
    size: int
    last: bytes


def _checksum(last: bytes, text: bytes) -> bytes:
    """Of a line whose predecessor has the checksum ``last``; the first line has b"" before it."""
    return hashlib.sha256(last + text).hexdigest()[:_CHECKSUM].encode()


def read_results(path: Path) -> Results:
    """Read a results file; :class:`ResultsError` names the line that is damaged."""
    return _parse(path, _read_bytes(path))


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ResultsError(f"{path}: cannot be read ({error})") from error


def _parse(path: Path, content: bytes) -> Results:
    header: Header | None = None
    refs: dict[str, SampleRef] = {}
    rows: dict[str, Row] = {}
    errors: dict[str, str] = {}
    contract: dict[str, Mapping[str, Any]] = {}
    size, last = 0, b""
    for number, line in enumerate(content.split(b"\n")[:-1], 1):  # the rest was cut off
        seen, _, text = line.partition(b" ")
        expected = _checksum(last, text)
        if seen != expected:
            raise ResultsError(
                f"{path}, line {number}: its checksum is wrong, so the file was damaged or edited,"
                " or the line was written by another run; remove the file and run again"
            )
        size, last = size + len(line) + 1, expected
        try:
            value = json.loads(text)
            if header is None:
                if value["format"] != FORMAT:
                    raise ValueError(f"format {value['format']}, this version reads {FORMAT}")
                header = Header(**value["header"])
            elif "contract" in value:
                contract[value["contract"]["check"]] = value["contract"]
            elif "program" in value:
                header = replace(header, provenance=_both(header.provenance, value["program"]))
            else:
                name, category, scene, model = value["ref"]
                ref = SampleRef(id=name, category=category, scene=scene, model=model)
                if ref.id in rows:
                    raise ValueError(f"sample {ref.id} has a row already")
                refs[ref.id] = ref
                if "row" in value:
                    rows[ref.id] = Row(sample=ref.id, category=ref.category, **value["row"])
                    errors.pop(ref.id, None)
                else:
                    errors[ref.id] = value["error"]
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise ResultsError(
                f"{path}, line {number}: --cpas-results of this version did not write it ({error})"
            ) from error
    if header is None:
        raise ResultsError(f"{path}: does not begin with the header of a results file")
    return Results(
        path=path,
        header=header,
        refs=refs,
        rows=rows,
        errors=errors,
        contract=contract,
        size=size,
        last=last,
    )


def _both(one: Mapping[str, str], other: Mapping[str, str]) -> Mapping[str, str]:
    """The provenance of rows of which two programs have computed some."""
    both = {}
    for key in sorted({*one, *other}):
        facts = [*one.get(key, "unknown").split(" and "), other.get(key, "unknown")]
        both[key] = " and ".join(dict.fromkeys(facts))
    return both


def _is_torn_header(content: bytes) -> bool:
    """Whether it is the beginning of a first line, or nothing: a disk was full, or a writer killed,
    before there was anything to lose."""
    checksum, rest = content[:_CHECKSUM], content[_CHECKSUM:]
    start = b' {"header":'
    return (
        b"\n" not in content
        and all(byte in b"0123456789abcdef" for byte in checksum)
        and (rest.startswith(start) or start.startswith(rest))
    )


class ResultsFile:
    """The results file of one run, which grows by a line per sample.

    Whoever runs the same command again finds the samples that are done in ``rows``, as long as it
    is the same program that would compute them.
    """

    def __init__(self, folder: Path, run: Run, shard: Shard, *, reuse_any: bool = False) -> None:
        """Read what is there. Raises :class:`ResultsError` if it is damaged or another run's.

        ``reuse_any``: rows of another program serve as well.
        """
        part = "" if shard.count == 1 else f"-{shard.index}-of-{shard.count}"
        self.path = folder / f"{run.method}-{run.dataset}{part}.jsonl"
        self.header = Header.of(run, shard)
        self._refs = {ref.id: astuple(ref) for ref in run.samples}
        self.rows: Mapping[str, Row] = {}
        #: Why the rows of an older file are not reused, and how many there are: another program's.
        self.not_reused: Sequence[str] = ()
        self.rows_not_reused = 0
        self._contract: Mapping[str, Mapping[str, Any]] = {}
        self._size, self._last = 0, b""
        self._another_program = False
        self._file: io.RawIOBase | None = None
        self._stamp = _stamp(self.path)
        if self._stamp is not None:
            self._read(reuse_any)

    def _read(self, reuse_any: bool) -> None:
        content = _read_bytes(self.path)
        if _is_torn_header(content):
            return
        there = _parse(self.path, content)
        if differences := header_differences(there.header, self.header):
            raise ResultsError(
                f"{self.path} holds another run: {'; '.join(differences)}. Remove it, or name"
                " another folder"
            )
        if strangers := sorted(there.refs.keys() - self._refs.keys()):
            raise ResultsError(
                f"{self.path} has {len(strangers)} samples that this run does not have, such as"
                f" {strangers[0]}. Remove it, or name another folder"
            )
        programs = program_differences(there.header, self.header)
        if self.header.provenance.get("code") == UNKNOWN:
            programs.append("the method's sources are in no file, so they may have changed")
        if programs and not reuse_any:
            self.not_reused, self.rows_not_reused = programs, len(there.rows)
            return
        self._another_program = bool(programs)
        self.rows, self._contract = there.rows, there.contract
        self._size, self._last = there.size, there.last

    def __enter__(self) -> ResultsFile:
        """Start writing: a new file with its header, or after the last whole line.

        Raises :class:`ResultsError` if another run writes the file, or has since it was read.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._open()
            if self._size == 0:
                self._write({"header": asdict(self.header), "format": FORMAT})
            elif self._another_program:
                self._write({"program": dict(self.header.provenance)})
        except BaseException as error:
            self.__exit__()
            if isinstance(error, OSError):
                raise ResultsError(f"{self.path}: cannot be written ({error})") from error
            raise
        return self

    def _open(self) -> None:
        file = self.path.open("ab", buffering=0)
        self._file = file
        if not _lock(file):
            raise ResultsError(
                f"{self.path}: another run is writing it. Wait until it is through, or name another"
                " folder"
            )
        made = self._stamp is None and os.fstat(file.fileno()).st_size == 0
        if not made and _stamp(self.path) != self._stamp:
            raise ResultsError(
                f"{self.path}: another run has written it since this one began. Run the same"
                " command again"
            )
        if self.not_reused:
            # nothing is lost: the old rows stay beside the new ones
            self.path.rename(_free(self.path))
            file.close()
            self._file = file = self.path.open("xb", buffering=0)
            _lock(file)
        file.truncate(self._size)

    def __exit__(self, *exception: object) -> None:
        """End writing."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def add(self, row: Row) -> None:
        """Append a row."""
        values = asdict(row)
        del values["sample"], values["category"]
        self._write({"row": values, "ref": self._refs[row.sample]})

    def add_error(self, sample: str, message: str) -> None:
        """Append why a sample has no row; a later run tries it again."""
        self._write({"error": message, "ref": self._refs[sample]})

    def add_contract(self, result: Mapping[str, Any]) -> None:
        """Append what a check of the contract found, unless that is what an earlier run found."""
        if self._contract.get(result["check"]) != result:
            self._write({"contract": result})

    def _write(self, value: Mapping[str, Any]) -> None:
        if self._file is None:
            raise RuntimeError(f"{self.path} is not open")
        text = json.dumps(value, separators=(",", ":")).encode()
        checksum = _checksum(self._last, text)
        rest = checksum + b" " + text + b"\n"
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
            there = self.path.stat()
        except FileNotFoundError:
            there = None
        except OSError as error:
            raise ResultsError(
                f"{self.path}: cannot be written ({error}); what it holds is good, so the same"
                " command goes on from there once it can"
            ) from error
        if there is None or not os.path.samestat(there, os.fstat(self._file.fileno())):
            raise ResultsError(
                f"{self.path} was removed or replaced while this run was writing it, so its rows"
                " are lost. Run the same command again"
            )
        self._last = checksum


def _stamp(path: Path) -> tuple[int, ...] | None:
    """What changes when somebody writes a file; None if there is none."""
    try:
        seen = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise ResultsError(f"{path}: cannot be read ({error})") from error
    return seen.st_dev, seen.st_ino, seen.st_size, seen.st_mtime_ns


def _lock(file: io.FileIO) -> bool:
    """Keep other runs from writing a file until it is closed; False if another one does.

    Where the system has no such lock, the checksums tell afterwards that two runs wrote at once.
    """
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _free(path: Path) -> Path:
    """A name beside ``path`` that no file has, for what it holds now."""
    numbered = (path.with_suffix(f".{number}.old") for number in itertools.count(1))
    return next(name for name in numbered if not name.exists())


def program_differences(found: Header, expected: Header) -> list[str]:
    """In what the programs differ that two results files hold rows of; empty for the same one."""
    return _differences(found.provenance, expected.provenance)


def header_differences(found: Header, expected: Header) -> list[str]:
    """In what the runs differ that two results files belong to, whichever program computed them;
    empty for the same run."""
    old, new = asdict(found), asdict(expected)
    lines = []
    for key in old.keys() - {"provenance", "nonce"}:
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
