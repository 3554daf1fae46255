"""What a property is, and how its body says what it expects."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from hypothesis import strategies as st

from pytest_cpas.checks.metrics.subject import Subject
from pytest_cpas.checks.outcome import Finding, Outcome

__all__ = ["PROPERTIES", "REFUSED", "Property", "close", "expect", "prop", "unless_refused"]

Body = Callable[..., None]
Case = Mapping[str, Any]
Corners = Callable[[], Iterable[Case]]


@dataclass(frozen=True)
class Property:
    """Something that every implementation of a metric must keep.

    ``name``: ``metric.property``. ``statement``: one line. ``reason``: why it must hold, or what
    it finds. ``given``: strategies of plain values (numbers, lists, strings), by the name of the
    body's arguments. ``applies``: whether it makes sense under the subject's definition.
    ``weight``: its share of examples, below 1 for what is slow. ``corners``: the cases that are
    tried first, whatever the seed is: what a fault is seen in that few random ones show.
    """

    name: str
    statement: str
    reason: str
    needs: tuple[str, ...]
    given: Mapping[str, st.SearchStrategy[Any]]
    body: Body
    applies: Callable[[Subject], bool] = lambda subject: True
    weight: float = 1.0
    corners: Corners = tuple

    def offered_by(self, subject: Subject) -> bool:
        """Whether the subject offers all that is needed, under a definition that fits."""
        return all(metric in subject.offers for metric in self.needs) and self.applies(subject)


#: All properties by name, in the order of the matrix.
PROPERTIES: dict[str, Property] = {}


def prop(
    *metrics: str,
    reason: str,
    given: Mapping[str, st.SearchStrategy[Any]],
    applies: Callable[[Subject], bool] = lambda subject: True,
    weight: float = 1.0,
    name: str = "",
    corners: Corners = tuple,
) -> Callable[[Body], Body]:
    """Register a body ``(subject, **given)`` as a property of the first of ``metrics``.

    The first line of its docstring is the statement.
    """

    def register(body: Body) -> Body:
        full = f"{metrics[0]}.{name or body.__name__}"
        if full in PROPERTIES:
            raise ValueError(f"two properties are called {full}")
        statement = (body.__doc__ or "").split("\n")[0].rstrip(".")
        PROPERTIES[full] = Property(
            full, statement, reason, metrics, given, body, applies, weight, corners
        )
        return body

    return register


def expect(holds: object, message: str) -> None:
    """Violate the property with ``message`` unless ``holds``."""
    if not holds:
        raise Finding(Outcome.VIOLATED, message)


#: What :func:`unless_refused` gives instead of a value.
REFUSED = object()


def unless_refused(subject: Subject, metric: str, *args: Any) -> Any:
    """The value of a metric, or :data:`REFUSED` if the implementation raises.

    For what an implementation may decline to judge, but must not judge otherwise.
    """
    try:
        return subject(metric, *args)
    except Finding as finding:
        if finding.outcome is Outcome.RAISED:
            return REFUSED
        raise


def close(value: float | None, expected: float, tolerance: float, what: str = "the value") -> None:
    """Expect ``value`` within ``tolerance`` (absolute) of ``expected``; NaN and None never are."""
    if value is None or not math.isfinite(value):
        expect(False, f"{what} is {value!r}, expected {expected!r} within {tolerance:.3g}")
    elif (error := abs(value - expected)) > tolerance:
        told = f"{what} is {value!r}, expected {expected!r} within {tolerance:.3g}"
        expect(False, f"{told}; it is off by {error:.2g}")
