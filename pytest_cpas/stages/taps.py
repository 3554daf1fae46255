"""Naming the values of a prediction, so that two codes can be compared value by value.

``tap("encoder.features", x)`` and ``draw("choose", x)`` cost one look at a global variable unless
``--cpas-trace`` or ``--cpas-parity`` listens. Nothing is copied then either.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

ValueT = TypeVar("ValueT")


class Listener(Protocol):
    """Who hears of values."""

    #: Whether networks are to compute in float64, where they can.
    wide: bool
    #: What is to be handed out in place of what is drawn, by name and call.
    replay: Mapping[tuple[str, int], Any]

    def tapped(self, name: str, value: object) -> None:
        """A value has been computed; it may be changed in place later."""

    def drawn(self, name: str, value: ValueT) -> ValueT:
        """A value has been drawn at random; what is returned is used in its place."""

    def widened(self, name: str, problem: str) -> None:
        """A network computes in float64, or why it cannot."""


_listener: Listener | None = None


def tap(name: str, value: ValueT) -> ValueT:
    """This is ``value``, an array or tensor, or a tuple, list or dict of such; it is returned.

    A name that is given again is the next call of it. Dots group names: ``encoder.features``.
    """
    if _listener is not None:
        _listener.tapped(name, value)
    return value


def draw(name: str, value: ValueT) -> ValueT:
    """As :func:`tap`, of what was drawn at random: chosen points, samples, masks.

    What is returned is to be used: it is ``value``, or what another code has drawn under this name.
    """
    return value if _listener is None else _listener.drawn(name, value)


def heard_by() -> Listener | None:
    """Who hears of values now."""
    return _listener


@contextmanager
def hearing(listener: Listener | None) -> Iterator[None]:
    """Tell ``listener`` of the values of this block; None: nobody, whoever heard of them before."""
    global _listener
    before, _listener = _listener, listener
    try:
        yield
    finally:
        _listener = before
