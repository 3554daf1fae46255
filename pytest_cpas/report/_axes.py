"""The axes of a chart, as SVG."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from pytest_cpas.report._html import Element, element

#: Grid lines per axis beside the one at 0.
_STEPS = 5


@dataclass(frozen=True)
class Axes:
    """Two axes that begin at 0 and end at ``largest``, across and up.

    ``width`` and ``height`` are those of the SVG, in its units; the margins are inside.
    """

    width: int
    height: int
    largest: tuple[float, float]
    left: int = 44
    margin: int = 14
    foot: int = 40

    @property
    def right(self) -> float:
        """Where the axis across ends."""
        return self.width - self.margin

    @property
    def bottom(self) -> float:
        """Where the axis up begins."""
        return self.height - self.foot

    def across(self, value: float) -> float:
        """Where a value is, counted from the left."""
        return round(self.left + (self.right - self.left) * value / self.largest[0], 1)

    def up(self, value: float) -> float:
        """Where a value is, counted from the top."""
        return round(self.bottom - (self.bottom - self.margin) * value / self.largest[1], 1)

    def grid(
        self, across: Callable[[float], str], up: Callable[[float], str], title: str
    ) -> Iterator[Element]:
        """Lines with their values as text, and the title below."""
        for step in range(_STEPS + 1):
            value_across, value_up = (limit * step / _STEPS for limit in self.largest)
            x, y = self.across(value_across), self.up(value_up)
            yield element("line", x1=self.left, x2=self.right, y1=y, y2=y, class_="grid")
            yield element("line", x1=x, x2=x, y1=self.margin, y2=self.bottom, class_="grid")
            yield element("text", up(value_up), x=self.left - 5, y=y + 3.5, text_anchor="end")
            at = {"x": x, "y": self.bottom + 15}
            yield element("text", across(value_across), **at, text_anchor="middle")
        middle = (self.left + self.right) / 2
        yield element("text", title, x=middle, y=self.height - 6, text_anchor="middle")
