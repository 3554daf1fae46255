"""What keeps a run that was asked for from ending with exit status 0 before its verdicts are told.

Two layers. :class:`Guard` is a plugin in pytest's process: it sees what other plugins and Python's
own ``sys.exit`` do to the end of a session. What it cannot see (``os._exit``, C's ``exit``, a
process that is replaced by another program) is seen from outside:
:mod:`pytest_cpas.session.holding` forks, pytest goes on in the child, and the parent waits for it,
with a page of memory that both share as the only evidence. Nothing here is imported, and no process
is made, for runs without ``--cpas-*``.
"""

from __future__ import annotations

import contextlib
import copy
import os
import shlex
import signal
import sys
import threading
from argparse import Namespace
from collections.abc import Generator
from types import FrameType
from typing import Any

import pytest

from pytest_cpas.session.beginning import note
from pytest_cpas.session.holding import hold
from pytest_cpas.session.opened_files import listen
from pytest_cpas.session.run_record import Record
from pytest_cpas.session.seen_items import SeenItems, below

#: Options that make a run whose verdicts are owed, and those that only show something.
_ASK = (
    "cpas_method",
    "cpas_predictions",
    "cpas_merge",
    "cpas_metrics",
    "cpas_check_dataset",
)
_SHOW = (
    "help",
    "version",
    "markers",
    "showfixtures",
    "show_fixtures_per_test",
    "cacheshow",
    "collectonly",
    "setuponly",
    "setupplan",
    "cpas_list",
)

#: Set by ``pytest-cpas``, which calls ``pytest.main`` and is a command of its own all the same.
is_command = False


def asked(options: Namespace) -> bool:
    """Whether the options ask for verdicts."""
    return any(getattr(options, name, None) for name in _ASK) and not only_shows(options)


def only_shows(options: Namespace) -> bool:
    """Whether the options ask for something to be shown, for which nothing is run."""
    return any(getattr(options, name, None) for name in _SHOW)


def guard(config: pytest.Config, parser: pytest.Parser) -> None:
    """Guard the run, if its arguments ask for one; as early as a plugin can."""
    words = [*config.invocation_params.args]
    words[:0] = shlex.split(os.environ.get("PYTEST_ADDOPTS", ""))
    try:
        words[:0] = config.getini("addopts")
        options = parser.parse_known_args(words, namespace=copy.copy(config.option))
    except (ValueError, AttributeError, pytest.UsageError):
        return  # pytest has no configuration yet, or says itself what is wrong with the arguments
    if asked(options):
        if options.cpas_results:
            listen()
        record = Record()
        if _may_fork():
            hold(record)
        watch(config, record)


def watch(config: pytest.Config, record: Record | None = None) -> None:
    """Guard the run inside this process, unless it is guarded or is a worker's."""
    if not config.pluginmanager.has_plugin("cpas-guard") and not hasattr(config, "workerinput"):
        note(config)
        items = SeenItems.register(config)
        config.pluginmanager.register(Guard(config, record or Record(), items), "cpas-guard")


class Guard:
    """What happens to the verdicts of a run, seen from outside all other plugins."""

    def __init__(self, config: pytest.Config, record: Record, items: SeenItems) -> None:
        self._config, self.record, self._items = config, record, items
        self._status: int | None = None
        self._outputs = {_file_of(1), _file_of(2)} - {None}
        #: Where pytest keeps what it prints to while it captures what is printed.
        self._kept: dict[int, tuple[int, int] | None] = {}

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_load_initial_conftests(self) -> Generator[None, object, object]:
        """What a conftest.py does while it is imported is a usage error."""
        try:
            return (yield)
        except SystemExit as error:
            raise pytest.UsageError(f"sys.exit({error.code}) while a conftest.py was loaded") from (
                error
            )

    def pytest_sessionstart(self) -> None:
        """Capturing has begun."""
        files = {number: _file_of(number) for number in range(3, 100)}
        self._kept = {number: file for number, file in files.items() if file in self._outputs}

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """An item begins."""
        self._see_outputs()
        if not self.record.output_lost:  # else it is the last item that counts
            self.record.begin(nodeid)

    @pytest.hookimpl(trylast=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A verdict was told, if it was that of an item or of a golden table."""
        node = report.nodeid.partition("::")[0]
        sessions = [session for session in self._sessions() if session.node == node]
        if any(session.verdicts_told for session in sessions) or (
            sessions and report.nodeid.startswith(f"{node}::golden[")
        ):
            self.record.tell(1)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtestloop(self) -> Generator[None, object, object]:
        """All verdicts are told at the end, or it is known that they are not."""
        try:
            return (yield)
        finally:
            sessions = self._sessions()
            if sessions and all(session.verdicts_told for session in sessions):
                self.record.tell(2)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_keyboard_interrupt(self) -> Generator[None, object, object]:
        """Said to the parent, which may have been interrupted too."""
        self.record.interrupt()
        self._end_of_capturing()
        return (yield)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_internalerror(self, excrepr: object) -> Generator[None, object, object]:
        """Capturing ends here as well; what an error says that nobody caught is text from outside,
        however early it comes."""
        self._end_of_capturing()
        from pytest_cpas.session.shown import shown_parts

        shown_parts(excrepr)
        return (yield)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> Generator[None, object, object]:
        """Everything is printed; the status is what it has to be."""
        self._see_outputs()
        result = yield
        self._status = int(session.exitstatus)
        session.exitstatus = self._status = self._held(session.config, self._status)
        self.record.finish(self._status)
        return result

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_cmdline_main(self, config: pytest.Config) -> Generator[None, object, object]:
        """The same where there was no session, or another status came after it."""
        try:
            status = int((yield) or 0)  # type: ignore[call-overload]
        except SystemExit as error:
            if error.code:
                raise
            status = self._status or 0
        finally:
            if self.record.held:
                with contextlib.suppress(OSError):  # should somebody have stopped the parent
                    os.kill(os.getppid(), signal.SIGCONT)
        status = self._held(config, status)
        self.record.finish(status)
        return status

    def _see_outputs(self) -> None:
        if any(_file_of(number) != file for number, file in self._kept.items()):
            self.record.lose_output()

    def _end_of_capturing(self) -> None:
        """pytest is about to close its descriptors itself: what is closed from here on is right."""
        self._see_outputs()
        self._kept = {}

    def _held(self, config: pytest.Config, status: int) -> int:
        """The status; 1 instead of 0 if that would be untrue, and why is said."""
        if status or hasattr(config, "workerinput") or not (problem := self._problem()):
            return status
        print(f"\nERROR: {problem}; the exit status is 1, not 0", file=sys.stderr)
        return int(pytest.ExitCode.TESTS_FAILED)

    def _sessions(self) -> list[Any]:
        """What has verdicts: a SuiteSession, which imports too much to be named here."""
        return [p for p in self._config.pluginmanager.get_plugins() if hasattr(p, "verdicts_told")]

    def _problem(self) -> str:
        sessions = self._sessions()
        nodes = {session.node for session in sessions}
        items = self._items
        undone = sorted(below(nodes, items.selected - items.ended))
        if self._status is None:
            return f"pytest ended before its session was over; {self.record.told}"
        if undone:
            return f"{len(undone)} items were collected and never ended, such as {undone[0]}"
        if not below(nodes, items.selected):
            return "no item of the run that was asked for was collected and selected"
        if not sessions or not all(session.verdicts_told for session in sessions):
            return f"pytest ended; {self.record.told}"
        if failed := below(nodes, items.failed(nodes)):
            return f"{failed[0]} failed, and a plugin made that a success"
        return ""


def _file_of(number: int) -> tuple[int, int] | None:
    """Which file a descriptor is of; None if it is closed."""
    try:
        seen = os.fstat(number)
    except OSError:
        return None
    return seen.st_dev, seen.st_ino


def _may_fork() -> bool:
    """Whether this run is that of the command ``pytest`` or ``pytest-cpas``, with one thread.

    A program that calls ``pytest.main``, or a test that does, goes on after it and is not doubled.
    """
    global is_command
    if not hasattr(os, "fork") or threading.active_count() > 1:
        return False
    frame: FrameType | None = sys._getframe()
    while frame and not _is_of_pytest(frame, "main", "_main"):
        frame = frame.f_back
    command, is_command = is_command, False
    return command or bool(
        frame and frame.f_back and _is_of_pytest(frame.f_back, "console_main", "_console_main")
    )


def _is_of_pytest(frame: FrameType, *names: str) -> bool:
    return frame.f_globals.get("__name__") == "_pytest.config" and frame.f_code.co_name in names
