"""What the controller sees of all items of a run, whichever process runs them."""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterable, Sequence

import pytest

__all__ = ["SeenItems", "below", "seen_items"]

_NAME = "cpas-items"


class SeenItems:
    """Which items were selected, which ended, and which of those failed.

    An item of a shipped suite says itself whether it failed (``cpas_failed`` on its reports), so
    whoever overwrites the outcome of a report, or makes another one, hides nothing.
    """

    def __init__(self) -> None:
        #: Node ids of what is to be run, by workers or here.
        self.selected: set[str] = set()
        #: Node ids of what has ended.
        self.ended: set[str] = set()
        # by node id and phase, of which the last try counts; None: it does not say, and passed
        self._failed: dict[tuple[str, str | None], bool | None] = {}

    @classmethod
    def register(cls, config: pytest.Config) -> SeenItems:
        """See the items of this run from now on."""
        seen = cls()
        config.pluginmanager.register(seen, _NAME)
        return seen

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids: Sequence[str]) -> None:
        """What a worker is to run."""
        self.selected.update(ids)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> Generator[None, object, object]:
        """What is to be run without workers."""
        self.selected.update(item.nodeid for item in session.items)
        return (yield)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """An item ends, or fails."""
        failed = report.failed or getattr(report, "cpas_failed", None)
        self._failed[report.nodeid, report.when] = failed
        if failed or report.when == "teardown":
            self.ended.add(report.nodeid)

    def failed(self, nodes: Collection[str]) -> list[str]:
        """Node ids of what failed, in order; below the ``nodes`` of shipped suites, also of what
        does not say that it did not."""
        return list(
            dict.fromkeys(
                nodeid
                for (nodeid, _), failed in self._failed.items()
                if failed or (failed is None and below(nodes, [nodeid]))
            )
        )


def below(nodes: Collection[str], nodeids: Iterable[str]) -> list[str]:
    """Those node ids that are of the suites ``nodes``."""
    return [nodeid for nodeid in nodeids if nodeid.partition("::")[0] in nodes]


def seen_items(config: pytest.Config) -> SeenItems:
    """What is seen of the items of a run that asks for verdicts; on the controller."""
    seen = config.pluginmanager.get_plugin(_NAME)
    if not isinstance(seen, SeenItems):
        raise RuntimeError(f"the plugin {_NAME} was unregistered")
    return seen
