"""Which samples a method is asked about at once, and that xdist leaves them together."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pytest

from pytest_cpas.evaluation import MethodRun, batches_of
from pytest_cpas.session.collected import CollectedRun
from pytest_cpas.types import SampleRef

__all__ = ["plan_batches", "scheduling"]

#: The samples of each item, by node id.
Items = Mapping[str, Sequence[SampleRef]]


def plan_batches(
    collected: CollectedRun, run: MethodRun, items: Items, order: Iterable[str], workers: int
) -> list[list[SampleRef]]:
    """The batches of a run whose ``items`` come in ``order``: of its own size, or of less where
    ``workers`` would have nothing to do."""
    there = [items[name] for name in order if name in items]
    done = collected.rows.keys() - collected.judged_again.keys()
    to_do = sum(ref.id not in done for refs in there for ref in refs)
    size = min(run.batch, max(math.ceil(to_do / workers), 1))
    return batches_of(there, size, done)


def scheduling(
    config: pytest.Config, log: Any, runs: Sequence[tuple[CollectedRun, MethodRun, Items]]
) -> Any:
    """A scheduler of xdist that gives the items of a batch to one worker."""
    from xdist.scheduler import LoadScopeScheduling

    class BatchScheduling(LoadScopeScheduling):  # type: ignore[misc]
        """As xdist distributes files with ``--dist loadfile``, in the order of the items."""

        _scopes: Mapping[str, str] | None = None

        def _split_scope(self, nodeid: str) -> str:
            if self._scopes is None:
                order, workers = list(self.collection or ()), len(self.nodes)
                self._scopes = {
                    name: batch[0].id + run.dataset + run.method
                    for collected, run, items in runs
                    for batch in plan_batches(collected, run, items, order, workers)
                    for name in _names(items, batch)
                }
            return self._scopes.get(nodeid, nodeid)

        def remove_node(self, node: Any) -> str | None:
            """As of the usual distribution: an item that ends its worker is not given to another
            one, and on which the next would end as well."""
            work = {
                key: unit
                for key, unit in self.assigned_work[node].items()
                if not all(unit.values())
            }
            self.assigned_work[node] = work
            pending = (name for unit in work.values() for name in unit if not unit[name])
            crashed = next(pending, None)
            if crashed is not None:
                unit = work[self._split_scope(crashed)]
                unit[crashed] = True
                if all(unit.values()):
                    work.pop(self._split_scope(crashed))
            super().remove_node(node)
            return crashed

    # larger batches first is no order for anybody who looks
    config.option.loadscopereorder = False
    return BatchScheduling(config, log)


def _names(items: Items, batch: Sequence[SampleRef]) -> list[str]:
    wanted = {ref.id for ref in batch}
    return [name for name, refs in items.items() if any(ref.id in wanted for ref in refs)]
