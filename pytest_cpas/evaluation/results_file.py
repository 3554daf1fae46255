"""The results file of a run that goes on: one writer at a time, a line for every row."""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any, cast

from pytest_cpas._files import LinkError, check_no_link
from pytest_cpas.evaluation.opened import differences
from pytest_cpas.evaluation.program import UNKNOWN
from pytest_cpas.evaluation.results import (
    FORMAT,
    Header,
    ResultsError,
    Shard,
    checksum_of,
    header_differences,
    is_torn_header,
    parse_results,
    program_differences,
    read_file,
)
from pytest_cpas.evaluation.rows import Row
from pytest_cpas.evaluation.runs import Run
from pytest_cpas.evaluation.surroundings import named

__all__ = ["ResultsFile"]


@dataclass(frozen=True)
class SetAside:
    """Rows that are not reused: how many, and in what the program differs that computed them, or
    why else."""

    rows: int
    differences: Sequence[str]
    why: str = ""

    def __str__(self) -> str:
        of = "" if self.why else " of another program"
        return f"not reused {self.rows}{of} ({self.why or '; '.join(self.differences)})"


class ResultsFile:
    """The results file of one run, which grows by a line per sample.

    Whoever runs the same command again finds the samples that are done in ``rows``, as long as it
    is the same program that would compute them.
    """

    def __init__(
        self,
        folder: Path,
        run: Run,
        shard: Shard,
        *,
        reuse_any: bool = False,
        opened: Callable[[], Collection[tuple[str, str]]] = tuple,
    ) -> None:
        """Read what is there. Raises :class:`ResultsError` if it is damaged or another run's.

        ``reuse_any``: rows of another program serve as well; ``opened``: names and digests of the
        files that the program has opened up to now, new ones behind the others.
        """
        self.path = folder / f"{shard.stem_of(run)}.jsonl"
        self.header = Header.of(run, shard)
        self._refs = {ref.id: astuple(ref) for ref in run.samples}
        self._info = run.info
        self._digests = run.digests_of_opened
        self._changed_meanwhile, self._told = run.changed_meanwhile, set[str]()
        self._opened, self._told_opened = opened, set[tuple[str, str]]()
        self._heard = 0
        self.rows: Mapping[str, Row] = {}
        #: The rows of an older file that are another program's.
        self.set_aside: SetAside | None = None
        self._contract: Mapping[str, Mapping[str, Any]] = {}
        self._size, self._last, self._read_last = 0, b"", b""
        #: Whether ``rows`` are another program's, and are reused on purpose.
        self.another_program = False
        self._file: io.RawIOBase | None = None
        try:
            check_no_link(folder, self.path)
        except LinkError as error:
            raise ResultsError(str(error)) from error
        self._stamp = _stamp(self.path)
        if self._stamp is not None:
            self._read(reuse_any)

    def _read(self, reuse_any: bool) -> None:
        content = read_file(self.path)
        if is_torn_header(content):
            return
        there = parse_results(self.path, content)
        if others := header_differences(there.header, self.header):
            raise ResultsError(
                f"{self.path} holds another run: {'; '.join(others)}. Remove it, or name"
                " another folder"
            )
        if strangers := sorted(there.refs.keys() - self._refs.keys()):
            raise ResultsError(
                f"{self.path} has {len(strangers)} samples that this run does not have, such as"
                f" {strangers[0]}. Remove it, or name another folder"
            )
        programs = program_differences(there.header, self.header)
        if there.changed:
            programs = [f"changed while it ran: {named(there.changed)}"]
        elif not programs:
            programs = differences(there.opened, self._digests(there.opened))
        programs += [
            f"the {whose} sources are in no file that was seen, so they may have changed"
            for key, whose in (("code", "method's"), ("data_code", "data set's"))
            if self.header.provenance.get(key) == UNKNOWN
        ]
        if programs and not reuse_any:
            self.set_aside = SetAside(len(there.rows), programs)
            return
        info, done = self._info, len(there.rows) + len(there.errors)
        if not (reuse_any or info is None or info.deterministic or done < there.header.selected):
            # nothing is left to be gone on with, and no judging again could tell a change
            why = "of a finished run, and the method is not deterministic"
            self.set_aside = SetAside(len(there.rows), [], why)
            return
        self.another_program = bool(programs)
        self.rows, self._contract = there.rows, there.contract
        self._size, self._last = there.size, there.last
        self._read_last = there.last
        self._told_opened |= there.opened.items()

    def check_free(self) -> None:
        """Raise :class:`ResultsError` if another run is writing the file, or nobody may."""
        if self._stamp is None:
            return
        try:
            with _opened(self.path, os.O_APPEND) as file:
                _lock(file, self.path)
        except OSError as error:
            raise self._unopened(error) from error

    def __enter__(self) -> ResultsFile:
        """Start writing: a new file with its header, or after the last whole line.

        Raises :class:`ResultsError` if another run writes the file, or has since it was read.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._open()
            if self._size == 0:
                self._write({"header": asdict(self.header), "format": FORMAT})
            elif self.another_program:
                told = {"program": self.header.provenance, "files": self.header.files}
                self._write({name: dict(facts) for name, facts in told.items()})
        except BaseException as error:
            self.__exit__()
            if isinstance(error, OSError):
                raise self._unopened(error) from error
            raise
        return self

    def _open(self) -> None:
        file = _opened(self.path, os.O_APPEND)
        self._file = file
        _lock(file, self.path)
        made = self._stamp is None and os.fstat(file.fileno()).st_size == 0
        if not made and _stamp(self.path) != self._stamp:
            raise ResultsError(
                f"{self.path}: another run has written it since this one began. Run the same"
                " command again"
            )
        if self.set_aside:
            # nothing is lost: the old rows stay beside the new ones
            self.path.rename(_free(self.path))
            file.close()
            self._file = file = _opened(self.path, os.O_EXCL)
            _lock(file, self.path)
        file.truncate(self._size)

    def _unopened(self, error: OSError) -> ResultsError:
        return ResultsError(f"{self.path}: cannot be written ({error}); name another folder")

    def __exit__(self, *exception: object) -> None:
        """End writing."""
        if self._file is not None:
            try:
                with contextlib.suppress(*() if exception[:1] == (None,) else (ResultsError,)):
                    self._tell_changes(thoroughly=True)
                    self._check()
            finally:
                with contextlib.suppress(OSError):  # somebody has closed its descriptor
                    self._file.close()
                self._file = None

    def add(self, row: Row) -> None:
        """Append a row."""
        # at once: whoever ends this run may do so any moment
        self._tell_changes()
        values = row.plain()
        del values["sample"], values["category"]
        self._write({"row": values, "ref": self._refs[row.sample]})

    def add_error(self, sample: str, message: str) -> None:
        """Append why a sample has no row; a later run tries it again."""
        self._write({"error": message, "ref": self._refs[sample]})

    def add_contract(self, result: Mapping[str, Any]) -> None:
        """Append what a check of the contract found, unless that is what an earlier run found."""
        if self._contract.get(result["check"]) != result:
            self._write({"contract": result})

    @property
    def choice(self) -> bytes:
        """What no one knows before the file is read, and every process of a run that reads it."""
        return self._read_last

    def _tell_opened(self) -> None:
        heard = self._opened()
        opened = {*itertools.islice(heard, self._heard, None)} - self._told_opened
        self._heard = len(heard)
        # one digest of each in a line: a file that has two was written while the program ran
        while opened:
            line = dict(sorted(opened))
            self._write({"opened": line})
            self._told_opened |= line.items()
            opened -= line.items()

    def _tell_changes(self, *, thoroughly: bool = False) -> None:
        if self._last:
            self._tell_opened()
        changed = self._changed_meanwhile(thoroughly=thoroughly).keys() - self._told
        if changed and self._last:
            self._write({"changed": sorted(changed)})
            self._told |= changed

    def _write(self, value: Mapping[str, Any]) -> None:
        if self._file is None:
            raise RuntimeError(f"{self.path} is not open")
        text = json.dumps(value, separators=(",", ":")).encode()
        checksum = checksum_of(self._last, text)
        rest = checksum + b" " + text + b"\n"
        if self._size:
            self._check()  # what is written behind a gap could not be gone on with
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            raise self._unwritten(error) from error
        self._size += len(checksum) + 1 + len(text) + 1
        self._last = checksum
        self._check()

    def _unwritten(self, error: OSError) -> ResultsError:
        return ResultsError(
            f"{self.path}: cannot be written ({error}); what it holds is good, so the same command"
            " goes on from there once it can"
        )

    def _check(self) -> None:
        """See that the file is there, and has what was written alone."""
        try:
            held = os.fstat(cast(io.FileIO, self._file).fileno())
        except OSError as error:  # somebody has closed it
            raise self._unwritten(error) from error
        there = None
        with contextlib.suppress(OSError):
            there = self.path.stat()
        if there is None or not os.path.samestat(there, held):
            raise ResultsError(
                f"{self.path} was removed or replaced while this run was writing it, so its rows"
                " are lost. Run the same command again"
            )
        if there.st_size < self._size:
            raise ResultsError(
                f"{self.path} was cut off at {there.st_size} bytes while this run was writing it:"
                f" it had {self._size}. The same command goes on from what is left"
            )
        if there.st_size != self._size:
            raise ResultsError(
                f"{self.path} has {there.st_size} bytes, and this run knows of {self._size}: a"
                " method, a plugin or another program has written into it. Remove it and run again"
            )


def _stamp(path: Path) -> tuple[int, ...] | None:
    """What changes when somebody writes a file; None if there is none."""
    try:
        seen = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise ResultsError(f"{path}: cannot be read ({error})") from error
    return seen.st_dev, seen.st_ino, seen.st_size, seen.st_mtime_ns


def _opened(path: Path, flag: int) -> io.FileIO:
    """A file to write to, made if it is not there; OSError for a link, wherever it leads to, and
    for a pipe, which would wait for ever."""
    flags = os.O_WRONLY | os.O_CREAT | flag
    for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY"):
        flags |= getattr(os, name, 0)
    return io.FileIO(os.open(path, flags, 0o666), "wb")


def _lock(file: io.FileIO, path: Path) -> None:
    """Keep other runs from writing a file until it is closed; :class:`ResultsError` if one does.

    Where the system has no such lock, the checksums tell afterwards that two runs wrote at once.
    """
    try:
        import fcntl
    except ImportError:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise ResultsError(
            f"{path}: another run is writing it. Wait until it is through, or name another folder"
        ) from error


def _free(path: Path) -> Path:
    """A name beside ``path`` that no file has, for what it holds now."""
    numbered = (path.with_suffix(f".{number}.old") for number in itertools.count(1))
    return next(name for name in numbered if not name.exists())
