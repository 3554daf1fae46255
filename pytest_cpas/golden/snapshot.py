"""Golden tables in tests of one's own: ``assert table == cpas_golden``.

A syrupy extension with the comparison and the files of the verdict at the end of a run: the same
tables, the same words, the same ``--snapshot-update``.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from syrupy.assertion import SnapshotAssertion
from syrupy.data import SnapshotCollection, SnapshotCollections
from syrupy.extensions.base import AbstractSyrupyExtension
from syrupy.location import PyTestLocation
from syrupy.types import SerializedData, SnapshotIndex

from pytest_cpas.golden.comparison import compare
from pytest_cpas.golden.files import find_golden, record
from pytest_cpas.golden.jitter import parse_alarm
from pytest_cpas.golden.parsing import parse_table
from pytest_cpas.golden.spread import ALARM
from pytest_cpas.golden.tables import RunTable
from pytest_cpas.golden.texts import table_texts
from pytest_cpas.reading.text import terminal_line, terminal_lines
from pytest_cpas.types import Required, Verdict, shown


def golden_folder(config: pytest.Config) -> Path:
    """Where golden tables are read first and written.

    The default is in the root directory if that is the project's. Without a configuration file
    pytest may take the folder behind ``--cpas-data DIR`` for it, so then it is where pytest was
    started.
    """
    here = config.invocation_params.dir
    named: str | None = config.option.cpas_golden
    if named:
        return here / named
    ini = str(config.getini("cpas_golden") or "golden")
    if "\0" in ini:
        raise pytest.UsageError(
            f"cpas_golden is {shown(ini)}, expected a folder; no name has a NUL"
        )
    is_project = config.inipath is not None and here.is_relative_to(config.rootpath)
    return (config.rootpath if is_project else here) / ini


def alarm_level(config: pytest.Config) -> float:
    """The probability of a false alarm in a run, as asked for.

    Raises :class:`pytest.UsageError` if it is none.
    """
    for name, given in (
        ("--cpas-alarm", config.option.cpas_alarm),
        ("cpas_alarm", config.getini("cpas_alarm")),
    ):
        if given:
            try:
                return parse_alarm(given)
            except ValueError as error:
                raise pytest.UsageError(f"{name} is {error}") from None
    return ALARM


class GoldenExtension(AbstractSyrupyExtension):
    """Keeps a :class:`RunTable` as golden table of its method and data set.

    syrupy compares serialised data; here that is the text of the table's files. ``alarm`` and
    ``required`` as of :meth:`of`.
    """

    write_immediately = True
    alarm = ALARM
    required: Required = True

    @classmethod
    def of(cls, config: pytest.Config) -> type[GoldenExtension]:
        """The extension with the options of a run: an assertion needs a golden table anyway."""
        strict = config.option.cpas_require_golden == "strict"
        settings = {"alarm": alarm_level(config), "required": "strict" if strict else True}
        return type(cls.__name__, (cls,), settings)

    @classmethod
    def get_location(cls, *, test_location: PyTestLocation, index: SnapshotIndex) -> str:
        """The folder ``METHOD/DATASET``, which is the assertion's ``index``."""
        return str(golden_folder(test_location.item.config) / "recorded" / str(index))

    @classmethod
    def matches_test_location(
        cls, *, test_location: PyTestLocation, snapshot_location: str
    ) -> bool:
        """A golden table belongs to its method and data set, whichever test asks for it."""
        return True

    def discover_snapshots(
        self, *, test_location: PyTestLocation, ignore_extensions: list[str] | None = None
    ) -> SnapshotCollections:
        """None: a table that no test asked for is not unused, and must not be deleted."""
        return SnapshotCollections()

    def serialize(self, data: Any, **_: Any) -> str:
        """The text of a table; :class:`TypeError` for anything else."""
        if not isinstance(data, RunTable):
            raise TypeError(
                f"cpas_golden is compared with a {type(data).__name__}, expected a"
                " pytest_cpas.golden.RunTable, as RunTable.of(run) gives it"
            )
        return json.dumps(
            {
                "method": data.method,
                "dataset": data.dataset,
                "listed": dict(data.listed),
                "texts": table_texts(data),
            }
        )

    def read_snapshot_data_from_location(
        self, *, snapshot_location: str, snapshot_name: str, session_id: str
    ) -> SerializedData | None:
        """The golden table in the same form, or the one that ships with the plugin."""
        folder = Path(snapshot_location)
        golden = find_golden(folder.parents[2], folder.parent.name, folder.name)
        return None if golden is None else self.serialize(golden)

    def matches(self, *, serialized_data: SerializedData, snapshot_data: SerializedData) -> bool:
        """Whether no verdict fails; what is doubtful is warned of."""
        verdicts = self._verdicts(serialized_data, snapshot_data)
        if any(self._fails(verdict) for verdict in verdicts):
            return False
        for verdict in verdicts:
            if not verdict.passed:
                warning = pytest.PytestWarning(terminal_lines(str(verdict)))
                warnings.warn(warning, stacklevel=2)
        return True

    def diff_lines(
        self, serialized_data: SerializedData, snapshot_data: SerializedData
    ) -> Iterator[str]:
        """The verdicts that fail, in words."""
        if snapshot_data:
            for verdict in self._verdicts(serialized_data, snapshot_data):
                if self._fails(verdict):
                    yield from map(terminal_line, str(verdict).splitlines())

    def _fails(self, verdict: Verdict) -> bool:
        return verdict.outcome(self.required) == "failed"

    def _verdicts(self, new: SerializedData, golden: SerializedData) -> list[Verdict]:
        return compare(_parse(str(golden)), _parse(str(new)), alarm=self.alarm)

    @classmethod
    def write_snapshot_collection(
        cls, *, snapshot_collection: SnapshotCollection, **_: Any
    ) -> None:
        """Record the table; :class:`GoldenError` unless it is complete."""
        for snapshot in snapshot_collection:
            golden = Path(snapshot_collection.location).parents[2]
            record(golden, _parse(str(snapshot.data)))

    def read_snapshot_collection(self, *, snapshot_location: str) -> SnapshotCollection:
        """Never asked for, since none is discovered."""
        raise NotImplementedError

    def delete_snapshots(self, *, snapshot_location: str, snapshot_names: set[str]) -> None:
        """Never asked for, since none is discovered."""
        raise NotImplementedError


def _parse(text: str) -> RunTable:
    content = json.loads(text)
    table = parse_table(content["method"], content["dataset"], content["texts"])
    return replace(table, listed=content["listed"])


class GoldenAssertion(SnapshotAssertion):
    """A snapshot whose name is the method and the data set of the table it is compared with."""

    def __eq__(self, other: object) -> bool:
        if isinstance(other, RunTable):
            self(name=f"{other.method}/{other.dataset}")
        return bool(super().__eq__(other))

    __hash__ = None  # type: ignore[assignment]
