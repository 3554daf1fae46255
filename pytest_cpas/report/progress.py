"""How far a long run is, in the terminal of somebody who waits for it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence

import pytest

from pytest_cpas.evaluation import Row, Run
from pytest_cpas.protocols import count_columns, judge_outcomes
from pytest_cpas.report.terminal import Terminal

#: Seconds until the first line, and from one to the next.
FIRST, INTERVAL = 10.0, 30.0


class Progress:
    """Counts what comes back from the items, and says so from time to time.

    It is only for the process that rows come back to, with xdist the controller.
    """

    def __init__(
        self,
        total: int | None,
        done: Mapping[Run, Sequence[Row]],
        write: Callable[[str], None],
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``total`` samples are to be judged, if that is known; the rows in ``done`` are judged."""
        self._total, self._write, self._clock = total, write, clock
        self._correct: dict[Run, int] = {}
        self._judged: dict[Run, int] = {}
        self._done = self._first = self._new = 0
        self._run: Run | None = None
        for run, rows in done.items():
            self._count(run, rows)
        self._start = clock()
        self._due = self._start + FIRST

    def add(self, run: Run, rows: Sequence[Row], errors: int) -> None:
        """Some samples of a run were judged, and some could not be."""
        if not rows and not errors:
            return
        if not self._new:
            # what came before, such as loading the method, does not tell how long others take
            self._start, self._first = self._clock(), len(rows) + errors
        self._count(run, rows)
        self._done += errors
        self._new += len(rows) + errors
        self._run = run

    def _count(self, run: Run, rows: Sequence[Row]) -> None:
        self._done += len(rows)
        self._judged[run] = self._judged.get(run, 0) + len(rows)
        first = count_columns(run.protocols)[:1]
        outcomes = judge_outcomes(first, [row.facts for row in rows])
        correct = sum(outcome == "1" for outcome in outcomes)
        self._correct[run] = self._correct.get(run, 0) + correct

    @pytest.hookimpl(trylast=True)
    def pytest_runtest_logfinish(self) -> None:
        """After pytest has written what it has to say of an item."""
        now = self._clock()
        if now >= self._due and self._run is not None:
            self._due = now + INTERVAL
            self._write(self.line())

    def line(self) -> str:
        """How many samples are done, how quickly, what remains, and the precision so far."""
        of = "" if self._total is None else f" of {self._total}"
        parts = [f"cpas: {self._done}{of} samples"]
        elapsed = self._clock() - self._start
        if self._new > self._first and elapsed > 0:
            rate = (self._new - self._first) / elapsed
            parts.append(f"{rate:.2g}/s" if rate >= 1 else f"{1 / rate:.2g} s each")
            if self._total is not None and self._total > self._done:
                parts.append(f"{_duration((self._total - self._done) / rate)} left")
        text = ", ".join(parts)
        columns = count_columns(self._run.protocols) if self._run else ()
        if self._run is not None and columns and (judged := self._judged[self._run]):
            correct = self._correct[self._run]
            text += (
                f"; {self._run.method} on {self._run.dataset}: {correct}/{judged}"
                f" ({100 * correct / judged:.1f} %) correct at {columns[0].label}"
            )
        return text


def _duration(seconds: float) -> str:
    """A time to wait, in two units at most."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def watch(
    config: pytest.Config, runs: Sequence[Run], rows: Mapping[Run, Mapping[str, Row]]
) -> Progress | None:
    """The progress of a session, or None where nobody looks: in CI, under -q, in a file."""
    terminal = config.pluginmanager.get_plugin("terminalreporter")
    in_ci = any(os.environ.get(name) for name in ("CI", "BUILD_NUMBER"))
    if hasattr(config, "workerinput") or terminal is None or config.get_verbosity() < 0 or in_ci:
        return None
    if not terminal.isatty or config.option.collectonly:
        return None

    progress = Progress(
        None if config.option.keyword else sum(len(run.samples) for run in runs),
        {run: list(judged.values()) for run, judged in rows.items()},
        Terminal(terminal).interject,
    )
    config.pluginmanager.register(progress, "cpas-progress")
    return progress
