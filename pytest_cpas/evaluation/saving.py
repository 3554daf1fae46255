"""The answers of a run on their way into a file of predictions.

Every process appends its answers, one line each, to a part of its own beside the file, named
``FILE.unfinished`` and, of a worker, ``FILE.unfinished-NAME``. In the end the lines are put in the
data set's order into the file, as a whole or not at all, and the parts are removed. So no answer is
kept in memory, and a run that is killed leaves what was there, and parts by which the same command
goes on if its rows are kept too.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO, NamedTuple

from pytest_cpas._files import replaced
from pytest_cpas.evaluation.estimates import encode_estimate
from pytest_cpas.evaluation.results import ResultsError
from pytest_cpas.evaluation.rows import Row
from pytest_cpas.evaluation.runs import Run
from pytest_cpas.reading.files import opened
from pytest_cpas.reading.structured import json_value
from pytest_cpas.submissions import Given, Header, answer_line
from pytest_cpas.types import ContractError, DataError, Hypothesis, SampleRef

__all__ = ["SavedAnswers"]

#: Largest file of answers that is read again, bytes.
_LARGEST = 2**34

#: How a line begins that we have written.
_SAMPLE = re.compile(rb'\{"sample":("(?:[^"\\]|\\.)*+")')


class _Line(NamedTuple):
    """Where a line is."""

    file: Path
    offset: int
    length: int


class SavedAnswers:
    """The answers of a run, in a process of it; ``target``: the file that they are for."""

    def __init__(self, target: Path, run: Run, worker: str = "") -> None:
        """Nothing is written yet. ``worker``: the name of the process, unless it is the only one,
        or the one that puts the parts together."""
        self.target, self._run = target, run
        name = f"{target.name}.unfinished"
        self._first = target.with_name(name)
        self._own = target.with_name(f"{name}-{worker}") if worker else self._first
        #: What has become of the file, in words.
        self.told = f"predictions: unfinished, {target} is as it was"

    def add(self, ref: SampleRef, image: str, answer: Given, others: Sequence[Given] = ()) -> None:
        """Take in an answer in the standard frames; :class:`ResultsError` if no disk takes it.

        ``image``: that it is about, as the data set names it; ``others``: detections in it that are
        ranked with the sample, and are no answer about one.
        """
        line = answer_line(image, ref.id, answer, self._run.answers_give, others)
        rest = line.encode() + b"\n"
        try:
            self._own.parent.mkdir(parents=True, exist_ok=True)
            # unbuffered and closed: whoever ends this process may do so any moment
            with self._own.open("ab", buffering=0) as file:
                while rest:
                    rest = rest[file.write(rest) :]
        except OSError as error:
            raise ResultsError(f"{self._own}: cannot be written ({error})") from error

    def check(self, rows: Mapping[str, Row], results: Path) -> None:
        """See that the answers of rows are there which are not computed again.

        ``results``: their file. Raises :class:`ResultsError` that says what to type.
        """
        lacking = rows.keys() - self._kept(rows).keys()
        if lacking:
            raise ResultsError(
                f"--cpas-save-predictions: {len(rows)} rows are reused from {results}, and the"
                f" answers of {len(lacking)} of them, such as {min(lacking)}, are not in"
                f" {self.target}: name another folder with --cpas-results, so that all is computed"
                " again, or leave --cpas-save-predictions out"
            )

    def begin(self, rows: Mapping[str, Row]) -> None:
        """Keep the answers of ``rows``, which are not computed again, and no other parts."""
        kept = self._kept(rows)
        parts = self._parts()
        try:
            if kept:
                with replaced(self._first) as file:
                    self._copy(kept.values(), file)
            for part in parts:
                if not kept or part != self._first:
                    part.unlink(missing_ok=True)
        except OSError as error:
            raise ResultsError(f"{self._first}: cannot be written ({error})") from error

    def finish(self, rows: Collection[str]) -> None:
        """Write the file of the answers for the samples that have ``rows``.

        Raises :class:`ResultsError`, and leaves what was there, if a disk does not take it, or
        answers are lost.
        """
        order = [ref.id for ref in self._run.samples if ref.id in rows]
        if not order:
            self.told = f"predictions: no answers, so nothing was written to {self.target}"
            return
        lines = {sample: line for part in self._parts() for sample, line in _samples(part)}
        if lost := [sample for sample in order if sample not in lines]:
            raise ResultsError(
                f"{self.target}: not written, as the answers of {len(lost)} samples, such as"
                f" {lost[0]}, are gone from {self._first}; run the same command again"
            )
        try:
            with replaced(self.target) as file:
                file.write(self._header().line().encode() + b"\n")
                self._copy([lines[sample] for sample in order], file)
            for part in self._parts():
                part.unlink(missing_ok=True)
        except OSError as error:
            raise ResultsError(f"{self.target}: cannot be written ({error})") from error
        of = f" of {len(self._run.samples)}" if len(order) < len(self._run.samples) else ""
        seeds = f", those of seed {self._seed}," if self._run.seeds > 1 else ""
        self.told = f"predictions: {len(order)}{of} answers{seeds} in {self.target}"

    @property
    def _seed(self) -> str:
        return f"{self._run.identity.get('seed')}, the first of {self._run.seeds}"

    def _header(self) -> Header:
        run = self._run
        seeds = {"answers": f"of seed {self._seed}"} if run.seeds > 1 else {}
        return Header(
            object_frame="shapenet",
            gives=run.answers_give,
            classes=list(dict.fromkeys((*run.classes, *(ref.category for ref in run.samples)))),
            method=run.method,
            dataset=run.dataset,
            samples=len(run.samples),
            provenance={**run.provenance, **run.identity, **seeds},
        )

    def _parts(self) -> list[Path]:
        """The parts of all processes, those that were kept first."""
        start = f"{self._first.name}-"
        folder = self._first.parent
        there = sorted(folder.iterdir()) if folder.is_dir() else []
        return [p for p in there if p == self._first or p.name.startswith(start)]

    def _kept(self, rows: Mapping[str, Row]) -> dict[str, _Line]:
        """Where the answers of some rows are, in the file or its parts."""
        found: dict[str, _Line] = {}
        if not rows:
            return found
        for file in (self.target, *self._parts()):
            for sample, line in _samples(file):
                if sample in rows and sample not in found and _is_of(line, rows[sample]):
                    found[sample] = line
        return found

    def _copy(self, lines: Collection[_Line], target: BinaryIO) -> None:
        with ExitStack() as files:
            sources = {
                file: files.enter_context(opened(file, _LARGEST))
                for file in dict.fromkeys(line.file for line in lines)
            }
            for line in lines:
                sources[line.file].seek(line.offset)
                target.write(sources[line.file].read(line.length))


def _samples(file: Path) -> Iterator[tuple[str, _Line]]:
    """The whole lines of a file that we have written, by their samples."""
    offset = 0
    try:
        with opened(file, _LARGEST) as content:
            for line in content:
                if (found := _SAMPLE.match(line)) and line.endswith(b"\n"):
                    yield json_value(f"{file}", found[1]), _Line(file, offset, len(line))
                offset += len(line)
    except (DataError, OSError):  # not there, or not ours: without lines
        return


def _is_of(line: _Line, row: Row) -> bool:
    """Whether a line has the answer of a row."""
    with opened(line.file, _LARGEST) as file:
        file.seek(line.offset)
        try:
            told = json_value(f"{line.file}", file.read(line.length))
            if row.failure is not None or "failure" in told:
                return bool(told.get("failure") == row.failure)
            best = told["hypotheses"][0]
            parts = {key: best.get(key) for key in ("rotation", "translation", "extents")}
            return encode_estimate(Hypothesis(**parts)) == row.estimate
        except (ContractError, LookupError, TypeError, AttributeError):
            return False
