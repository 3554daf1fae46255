"""What comes back from the items of a run: rows, errors, the contract, speed and parity."""

from __future__ import annotations

import functools
import hashlib
import itertools
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pytest_cpas.checks.contract import CONTRACT, ContractResult
from pytest_cpas.documents import ParityDocument, SpeedDocument
from pytest_cpas.evaluation import MergedRun, ResultsFile, Row, Run, named
from pytest_cpas.report.panels import ValuePictures

__all__ = ["CollectedRun", "ItemResult"]

#: Reused rows that are judged again: of each category so many, and at most so many in all.
_AGAIN_OF_EACH, _AGAIN = 2, 24


@dataclass
class ItemResult:
    """What an item found out: the rows of its samples, and (sample, message) of those that could
    not be judged; or what a check of the contract found."""

    rows: list[Row] = field(default_factory=list)
    errors: list[tuple[str, str]] = field(default_factory=list)
    contract: ContractResult | None = None

    def plain(self) -> dict[str, Any]:
        """As values that xdist can send; :meth:`of` reads them."""
        return {
            "rows": [row.plain() for row in self.rows],
            "errors": self.errors,
            "contract": self.contract and self.contract.plain(),
        }

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> ItemResult:
        """From :meth:`plain`, in this process or another one."""
        return cls(
            [_row(row) for row in values["rows"]],
            [(sample, message) for sample, message in values["errors"]],
            values["contract"] and ContractResult(**values["contract"]),
        )


def _row(values: dict[str, Any]) -> Row:
    # one object each, which the samples' references have already
    shared = {name: sys.intern(values[name]) for name in ("sample", "category")}
    return Row.of({**values, **shared})


def _drawn(choice: bytes, sample: str) -> bytes:
    return hashlib.sha256(choice + sample.encode(errors="surrogateescape")).digest()


class CollectedRun:
    """All that has come back of one run; while it is open (``with``), also on disk if asked for.

    ``parity``: the verdict beside a reference, and ``value_pictures`` of where the two part.
    """

    def __init__(self, run: Run, file: ResultsFile | None = None) -> None:
        """Nothing yet, but for the rows that the results file has of a run that was killed."""
        self.run = run
        self._file = file
        self._rows: dict[str, Row] = {} if file is None else dict(file.rows)
        self._kept = set(self._rows)
        self._errors: dict[str, str] = {}
        self._contract: dict[str, ContractResult] = {}
        self._speed: SpeedDocument | None = None
        self.parity: ParityDocument | None = None
        self.value_pictures: ValuePictures | None = None
        self._named: frozenset[str] = frozenset()
        self._deselected: frozenset[str] = frozenset()
        self._refused = ""

    @property
    def rows(self) -> Mapping[str, Row]:
        """The rows by sample, as they came."""
        return self._rows

    @functools.cached_property
    def judged_again(self) -> Mapping[str, Row]:
        """Of a deterministic method reused rows of two samples of each category, to be compared
        with what the program answers now: what it depends on is never known in full.

        Which samples follows from what the file holds, so it is the same in all processes, and
        another choice whenever rows have come to it.
        """
        info, file = self.run.info, self._file
        if info is None or not info.deterministic or file is None or file.another_program:
            return {}
        drawn: dict[str, list[str]] = {}
        for sample in sorted(file.rows, key=functools.partial(_drawn, file.choice)):
            drawn.setdefault(file.rows[sample].category, []).append(sample)
        # first one of each category, however many there are
        rounds = itertools.zip_longest(*(some[:_AGAIN_OF_EACH] for some in drawn.values()))
        again = [sample for some in rounds for sample in some if sample is not None]
        return {sample: file.rows[sample] for sample in again[:_AGAIN]}

    def contradiction(self, row: Row, kept: Row) -> str:
        """What to say where a reused row is not what the program answers now; empty if it is."""
        info, file = self.run.info, self._file
        told = "" if info is None else row.difference(kept, info.tolerance)
        if file is None or not told:
            return ""
        return (
            f"{row.sample}: its row is reused from {file.path}, and is not what the method answers"
            f" now ({told}): something changed that is not seen. Name another folder with"
            " --cpas-results, so that all is computed again"
        )

    def refuse_reused(self, reason: str) -> None:
        """What was reused is not what the program answers: a verdict on it would be on another."""
        self._refused = reason

    @property
    def ordered_rows(self) -> list[Row]:
        """The rows that are judged, in the data set's order, however they came."""
        reused = self._file.rows if self._file is not None and self._refused else {}
        there = self._rows.keys() - reused.keys()
        return [self._rows[ref.id] for ref in self.run.samples if ref.id in there]

    @property
    def errors(self) -> Mapping[str, str]:
        """Per sample why it has no row."""
        return self._errors

    @property
    def contract(self) -> Mapping[str, ContractResult]:
        """What each check of the contract found."""
        return self._contract

    @property
    def breaks_smoke(self) -> bool:
        """Whether the method breaks a check without which no sample is judged."""
        return any(
            result.wrong and not result.known and CONTRACT[check].smoke
            for check, result in self._contract.items()
        )

    @property
    def speed(self) -> SpeedDocument | None:
        """What was measured of the method's speed, None if nothing was."""
        return self._speed

    def excluded(self, categories: Iterable[str]) -> set[str]:
        """Those of some categories that were not asked for, as a whole."""
        return {
            category
            for category in categories
            if category in self._deselected or (self._named and category not in self._named)
        }

    def exclude(self, *, named: Iterable[str], deselected: Iterable[str]) -> None:
        """Take in what was asked for: the categories that were ``named`` (all if none was), but for
        those whose items were all ``deselected``."""
        self._named, self._deselected = frozenset(named), frozenset(deselected)

    @property
    def origin(self) -> str:
        """Where the rows come from, in words: computed now, kept from an earlier run, merged."""
        reused = 0 if self._file is None else len(self._file.rows)
        new = len(self._rows.keys() - self._file.rows.keys()) if self._file else len(self._rows)
        parts = []
        if isinstance(self.run, MergedRun):
            of = " of several programs" if self.run.several_programs else ""
            parts.append(f"merged {new}{of}")
        elif new or not reused:
            parts.append(f"computed {new}{self._meanwhile}" if new else "computed 0")
        if self._file is not None and reused:
            of = " of another program" if self._file.another_program else ""
            word = f"left out ({self._refused})" if self._refused else "reused"
            parts.append(f"{word} {reused}{of} from {self._file.path}")
        if self._file is not None and self._file.set_aside and self._file.set_aside.rows:
            parts.append(str(self._file.set_aside))
        if excluded := self.excluded(self.run.listed):
            parts.append(f"not asked for {' '.join(sorted(excluded))}")
        return ", ".join(parts)

    @property
    def _meanwhile(self) -> str:
        changed = self.run.changed_meanwhile()
        # where no row is kept, what a golden table would not tell of either is nobody's concern
        names = [name for name, told in changed.items() if told or self._file is not None]
        return f" while {named(names)} changed" if names else ""

    def add(self, result: ItemResult) -> None:
        """Take in what an item found; :class:`pytest_cpas.evaluation.ResultsError` if the disk does
        not take it."""
        self._rows |= {row.sample: row for row in result.rows}
        self._errors |= dict(result.errors)
        if self._file is not None and any(name in self._file.rows for name, _ in result.errors):
            self.refuse_reused("not what the method answers now")
        if result.contract:
            self._contract[result.contract.check] = result.contract
        if self._file is None:
            return
        for row in result.rows:
            self.keep(row)
        for sample, message in result.errors:
            if sample not in self._kept:
                self._file.add_error(sample, message)
        if result.contract:
            self._file.add_contract(result.contract.plain())

    def keep(self, row: Row) -> None:
        """Have a row on disk, if asked for: at once, whatever becomes of its item."""
        if self._file is not None and row.sample not in self._kept:
            self._file.add(row)
            self._kept.add(row.sample)

    def add_speed(self, document: SpeedDocument) -> None:
        """Take in what was measured of the method's speed."""
        self._speed = document

    def __enter__(self) -> CollectedRun:
        """Begin to write the results file, if there is one."""
        if self._file is not None:
            self._file.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        """End writing."""
        if self._file is not None:
            self._file.__exit__(*exception)
