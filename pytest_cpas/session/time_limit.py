"""``--cpas-timeout``, and what is told of a process that a time limit has ended."""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import pytest

from pytest_cpas.evaluation import Row, Watchdog, can_watch, parse_seconds
from pytest_cpas.session.collected import ItemResult
from pytest_cpas.session.guard import Guard
from pytest_cpas.session.holding import WATCHING_GONE

__all__ = ["TimeLimit", "sample_seconds", "time_limit"]

_PLUGIN = "cpas-time-limit"

#: How a worker of xdist is told where the controller looks for notes.
_FOLDER = "cpas_time_limit_notes"


def sample_seconds(config: pytest.Config) -> float | None:
    """How long a prediction may take per sample, None for any time; :class:`ValueError` for a limit
    that cannot be meant."""
    for name, given in (
        ("--cpas-timeout", config.option.cpas_timeout),
        ("cpas_timeout", config.getini("cpas_timeout")),
    ):
        if given:
            try:
                seconds = parse_seconds(given)
            except ValueError as error:
                raise ValueError(f"{name} is {error}") from None
            if not can_watch():
                raise ValueError(f"{name} needs signals of POSIX, which this system does not have")
            return seconds
    return None


def time_limit(config: pytest.Config) -> TimeLimit:
    """The one of this process."""
    limit = config.pluginmanager.get_plugin(_PLUGIN)
    if not isinstance(limit, TimeLimit):
        limit = TimeLimit(config)
        config.pluginmanager.register(limit, _PLUGIN)
    return limit


class TimeLimit:
    """The hooks around a :class:`Watchdog`, on the controller and on every worker.

    A process that its watchdog ends leaves a note: a worker for the controller, a run without
    workers for the parent that guards it.
    """

    def __init__(self, config: pytest.Config) -> None:
        self._folder: Path | None = None
        self._part: Path | None = None
        if hasattr(config, "workerinput"):
            note = Path(config.workerinput[_FOLDER], f"{config.workerinput['workerid']}.json")
            self._part = note.with_suffix(".rows")
            self.watchdog = Watchdog(note=note, gone=WATCHING_GONE)
            return
        guard = config.pluginmanager.get_plugin("cpas-guard")
        own = None
        if isinstance(guard, Guard) and guard.record.held:
            own = self._notes() / "run.json"
            guard.record.expect(own)
        # capturing has begun, but waits while plugins are configured: this is the terminal's
        self.watchdog = Watchdog(note=own, stderr=2, gone=WATCHING_GONE)

    def _notes(self) -> Path:
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="pytest-cpas-"))
        return self._folder

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: Any) -> None:
        """A worker is about to start."""
        node.workerinput[_FOLDER] = str(self._notes())

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """An item begins."""
        self.watchdog.about = {"item": item.nodeid}
        if self._part is not None:
            self._part.unlink(missing_ok=True)

    def keep(self, run: int, row: Row) -> None:
        """Keep a row of an item of a worker, which loses it if it is ended before the item does;
        ``run``: which run it is of."""
        if self._part is not None:
            with self._part.open("a", encoding="utf-8") as file:
                file.write(json.dumps([run, row.plain()]) + "\n")

    @pytest.hookimpl(optionalhook=True)
    def pytest_handlecrashitem(self, crashitem: str, report: pytest.TestReport) -> None:
        """A worker is gone: if it was ended for its time, that is the item's failure."""
        for path in self._notes().glob("*.json"):
            note = json.loads(path.read_text(encoding="utf-8"))
            if note.get("item") == crashitem:
                path.unlink()
                report.longrepr = note["text"]
                if "sample" in note:
                    problem = note["text"].partition("\n")[0]
                    found = ItemResult(errors=[(note["sample"], problem)])
                    found.rows += _rows_of(path.with_suffix(".rows"), note["run"])
                    node = crashitem.partition("::")[0]
                    report.cpas_content = (  # type: ignore[attr-defined]
                        node,
                        (note["run"], found.plain(), [], []),
                    )

    def pytest_unconfigure(self) -> None:
        """Watch no longer."""
        self.watchdog.close()
        if self._folder is not None:
            with contextlib.suppress(OSError):
                shutil.rmtree(self._folder)


def _rows_of(path: Path, run: int) -> list[Row]:
    """The rows that a worker has kept of the item at which it was ended; whole lines alone."""
    try:
        *lines, _ = path.read_text(encoding="utf-8").split("\n")
    except OSError:
        return []
    kept = [json.loads(line) for line in lines]
    return [Row.of(values) for index, values in kept if index == run]
