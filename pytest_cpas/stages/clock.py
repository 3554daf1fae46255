"""Naming the stages of a prediction, for an adapter that wants them timed.

``with stage("network"):`` costs next to nothing unless ``--cpas-benchmark`` or ``--cpas-trace``
listens. The names that the field uses are pre-processing, network and post-processing; any other
will do as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Protocol


class Timed(Protocol):
    """Who listens to stages."""

    def timed(self, name: str) -> AbstractContextManager[None]:
        """Enter a stage, and leave it."""


class StageClock:
    """Adds up the ``seconds`` of every stage while it listens.

    ``now`` is the clock, in seconds. ``synchronise`` waits for what the device still computes; it
    is called on both sides of a stage. A stage within a stage counts as a part of the outer one.
    """

    def __init__(self, now: Callable[[], float], synchronise: Callable[[], None]) -> None:
        self._now = now
        self.seconds: dict[str, float] = {}
        self._synchronise = synchronise
        self._inside = False

    def listening(self) -> AbstractContextManager[None]:
        """Time the stages of this block; one clock at a time."""
        return listening(self)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add this block to a stage."""
        if self._inside:
            yield
            return
        self._inside = True
        self._synchronise()
        start = self._now()
        try:
            yield
        finally:
            self._synchronise()
            self.seconds[name] = self.seconds.get(name, 0.0) + self._now() - start
            self._inside = False


_listener: Timed | None = None
_NOBODY = nullcontext()


@contextmanager
def listening(listener: Timed) -> Iterator[None]:
    """Tell ``listener`` of the stages of this block; one at a time."""
    global _listener
    if _listener is not None:
        raise RuntimeError("stages are being timed already")
    _listener = listener
    try:
        yield
    finally:
        _listener = None


def stage(name: str) -> AbstractContextManager[None]:
    """This block is a stage of the prediction, such as ``network``."""
    return _NOBODY if _listener is None else _listener.timed(name)


def listener() -> StageClock | None:
    """Who times stages now, for a method that is told of its stages by another process."""
    return _listener if isinstance(_listener, StageClock) else None
