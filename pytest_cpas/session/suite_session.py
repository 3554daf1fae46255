"""What every session of a run shares: its shipped test module, and what items send back."""

from __future__ import annotations

import sys
import warnings
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import pytest

from pytest_cpas.evaluation import Run
from pytest_cpas.reading.text import encodable_values, terminal_line, terminal_lines
from pytest_cpas.session.guard import only_shows
from pytest_cpas.session.options import Granularity
from pytest_cpas.session.shown import shown_parts
from pytest_cpas.types import ItemOutcome, SampleRef

#: Where an item keeps the exception by which it ends, of its own accord, though it did not pass.
_OWN_END = pytest.StashKey[BaseException]()


def known_failure(item: pytest.Item, message: str) -> NoReturn:
    """End an item as one that fails as is known; ``--runxfail``, which is about the marks of tests,
    does not make it red."""
    __tracebackhide__ = True
    item.stash[_OWN_END] = pytest.xfail.Exception(message)
    raise item.stash[_OWN_END]


def skip(item: pytest.Item, reason: str) -> NoReturn:
    """End an item as one that has nothing to judge. Nobody else skips it: a method or a plugin that
    does so makes it fail."""
    __tracebackhide__ = True
    item.stash[_OWN_END] = pytest.skip.Exception(reason)
    raise item.stash[_OWN_END]


class SuiteSession(ABC):
    """Collects one module of :mod:`pytest_cpas.suite`, and what its items found.

    The same object lives on the controller, which without xdist is the only process, and on every
    xdist worker. What an item found rides on its test report to the controller.
    """

    #: Whether all verdicts are told; where items are all there is, they are told with them.
    verdicts_told = True

    def __init__(self, config: pytest.Config, module: str, node: str) -> None:
        """Have ``suite/module`` collected under the node id ``node``.

        It is collected beside the tests named on the command line; without any, alone.
        """
        self.config = config
        self.is_controller = not hasattr(config, "workerinput")
        self._suite = Path(__file__).parents[1] / "suite" / module
        self.node = node
        here = str(config.invocation_params.dir)
        if here not in sys.path:  # package.module:Class is looked for where pytest was started
            sys.path.insert(0, here)
        others = [p for p in config.pluginmanager.get_plugins() if isinstance(p, SuiteSession)]
        named = config.args_source is pytest.Config.ArgsSource.ARGS
        config.args = [*(config.args if named or others else ()), str(self._suite)]

    @property
    def only_shows(self) -> bool:
        """Whether nothing is run that could be judged: ``--collect-only`` and such."""
        return only_shows(self.config.option)

    def has_nothing_to_tell(self, reporter: pytest.TerminalReporter) -> bool:
        """Whether the summary is no business of this process, or nothing was run; which is said."""
        if self.is_controller and self.only_shows:
            reporter.write_line(f"{self.node}: nothing was run, so no verdict is told")
        return self.only_shows or not self.is_controller

    @abstractmethod
    def item_content(self, item: pytest.Item) -> Any:
        """What an item of the suite found out, as plain values that xdist can send, or None."""

    @abstractmethod
    def collect(self, content: Any) -> None:
        """Take in, on the controller, what :meth:`item_content` gave for an item."""

    @pytest.hookimpl(tryfirst=True)
    def pytest_pycollect_makemodule(
        self, module_path: Path, parent: pytest.Collector
    ) -> pytest.Module | None:
        """Give the shipped suite short node ids that are the same wherever it is installed."""
        if module_path != self._suite:
            return None
        module: pytest.Module = pytest.Module.from_parent(
            parent, path=module_path, name=self.node, nodeid=self.node
        )
        return module

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Of no samples pytest makes one item, to be skipped: there is none."""
        of_nothing = {item for item in items if item.path == self._suite and _is_of_nothing(item)}
        items[:] = [item for item in items if item not in of_nothing]

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Put what an item of this suite found on its report, and whether it failed."""
        report = yield
        if item.path != self._suite:
            return report
        error, own = call.excinfo and call.excinfo.value, item.stash.get(_OWN_END, None)
        failed = error is not None and error is not own
        if isinstance(own, pytest.xfail.Exception) and error is own:
            report.outcome = "skipped"
            report.wasxfail = str(own)
        elif failed and not report.failed:
            report.outcome = "failed"
            report.longrepr = f"{item.nodeid} was skipped, but not by pytest-cpas: {error}"
            report.__dict__.pop("wasxfail", None)
        report.cpas_failed = failed  # type: ignore[attr-defined]
        if report.when == "call":
            content = encodable_values(self.item_content(item))
            report.cpas_content = (self.node, content)  # type: ignore[attr-defined]
        return shown_report(report)

    @pytest.hookimpl(tryfirst=True)
    def pytest_warning_recorded(
        self, warning_message: warnings.WarningMessage, nodeid: str
    ) -> None:
        """What a method warns of is text from outside, and so is where it says that it did; its
        category is not needed any more."""
        if nodeid.partition("::")[0] == self.node:
            warning_message.message = terminal_lines(str(warning_message.message))
            warning_message.filename = terminal_line(str(warning_message.filename))

    @pytest.hookimpl(tryfirst=True)
    def pytest_internalerror(self, excrepr: object) -> None:
        """So is what an error says that nobody caught."""
        shown_parts(excrepr)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """On the controller: collect."""
        node, content = getattr(report, "cpas_content", (None, None))
        if self.is_controller and node == self.node and content is not None:
            self.collect(content)
            # pytest keeps the reports of a run; the rows are kept already
            del report.cpas_content


def _is_of_nothing(item: pytest.Item) -> bool:
    """Whether an item stands for an empty list of parameters; names of ours have a dash."""
    callspec = getattr(item, "callspec", None)
    return callspec is not None and callspec.id == "NOTSET"


@contextmanager
def usage_errors(*kinds: type[Exception]) -> Iterator[None]:
    """Turn errors of these ``kinds`` into pytest's error about its command line."""
    told: tuple[type[Exception], ...] = (*kinds, pytest.UsageError)
    try:
        yield
    except told as error:
        raise pytest.UsageError(terminal_lines(str(error))) from error


def end_run(error: Exception) -> NoReturn:
    """End pytest, for a reason that is no fault of it."""
    pytest.exit(terminal_lines(str(error)))


def shown_report(report: pytest.TestReport) -> pytest.TestReport:
    """A report on something of ours as terminal, JUnit and other reporters may show it.

    Exceptions, reasons and what was printed come from methods and files.
    """
    report.longrepr = shown_parts(report.longrepr)
    report.sections = shown_parts(report.sections)
    if hasattr(report, "wasxfail"):
        report.wasxfail = terminal_lines(report.wasxfail)
    return report


def grouped(
    samples: Sequence[SampleRef], granularity: Granularity
) -> Iterable[tuple[str, list[SampleRef]]]:
    """Samples as (name, samples), one group per test item."""
    if granularity == "sample":
        return [(terminal_line(f"{ref.category}-{ref.id}"), [ref]) for ref in samples]
    groups: dict[str, list[SampleRef]] = defaultdict(list)
    for ref in samples:
        groups[terminal_line(ref.scene) if granularity == "scene" else "all"].append(ref)
    return groups.items()


def sample_items(node: str, run: Run, granularity: Granularity) -> dict[str, list[SampleRef]]:
    """The items of a run's samples, by node id."""
    items = {}
    for name, refs in grouped(run.samples, granularity):
        # as pytest writes what is not ASCII
        name = name.encode("unicode_escape").decode("ascii")
        items[f"{node}::test_sample[{run.method}-{run.dataset}-{name}]"] = refs
    return items


def report_outcome(
    session: pytest.Session,
    nodeid: str,
    outcome: ItemOutcome,
    message: str,
    *,
    known: bool = False,
) -> None:
    """Report what is judged after the last item as if it were one.

    Terminal, JUnit and exit code then agree. ``message``: why it did not pass. ``known``: what was
    skipped is an expected failure (pytest's xfailed).
    """
    nodeid = terminal_line(nodeid)
    longrepr: Any = None
    if outcome == "failed":
        longrepr = pytest.ExceptionInfo.from_exception(
            _raised(pytest.fail.Exception(message, pytrace=False))
        ).getrepr(style="value")
    elif outcome != "passed":
        longrepr = (nodeid.partition("::")[0], 0, message)
    location = (nodeid.partition("::")[0], None, nodeid.partition("::")[2])
    session.testscollected += 1
    hook = session.config.hook
    hook.pytest_runtest_logstart(nodeid=nodeid, location=location)
    for when in ("setup", "call", "teardown"):
        called = when == "call"
        report = pytest.TestReport(
            nodeid,
            location,
            keywords={},
            outcome=outcome if called else "passed",
            longrepr=longrepr if called else None,
            when=when,
        )
        if called and known:
            report.wasxfail = message
        report.cpas_failed = called and outcome == "failed"  # type: ignore[attr-defined]
        hook.pytest_runtest_logreport(report=shown_report(report))
    hook.pytest_runtest_logfinish(nodeid=nodeid, location=location)


def _raised(error: BaseException) -> BaseException:
    """The error with a traceback, which pytest needs to represent it."""
    try:
        raise error
    except BaseException as caught:
        return caught
