"""What the pictures of a value are, and their colours; they are drawn by
:mod:`pytest_cpas.report.value_pictures`, which needs Pillow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

__all__ = ["RAMPS", "Panel", "Scale", "ValuePictures"]

Ramp = Literal["values", "sizes", "differences"]

#: From low to high, at equal steps, linear between them. Differences are grey where there is none.
RAMPS: Mapping[Ramp, Sequence[tuple[int, int, int]]] = {
    "values": [(0, 0, 0), (255, 255, 255)],
    "sizes": [(110, 115, 120), (230, 120, 0), (255, 235, 130)],
    "differences": [(0, 200, 255), (40, 90, 200), (45, 45, 45), (215, 60, 20), (255, 200, 60)],
}


@dataclass(frozen=True, kw_only=True)
class Scale:
    """What the colours between ``low`` and ``high`` are: of a ramp of :data:`RAMPS`."""

    ramp: Ramp
    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class Panel:
    """A picture under its title: a WebP as base64, with its scale, if it has one."""

    title: str
    image: str
    width: int
    height: int
    scale: Scale | None = None


@dataclass(frozen=True, kw_only=True)
class ValuePictures:
    """Rows of pictures, each below words that say what it shows, and ``remarks`` on all."""

    rows: list[tuple[str, list[Panel]]]
    remarks: list[str]

    def plain(self) -> dict[str, Any]:
        """As plain values, which travel on test reports."""
        return asdict(self)

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> ValuePictures:
        """The inverse of :meth:`plain`."""
        rows = [(words, [_panel(each) for each in panels]) for words, panels in plain["rows"]]
        return cls(rows=rows, remarks=list(plain["remarks"]))


def _panel(plain: Mapping[str, Any]) -> Panel:
    scale = plain["scale"]
    return Panel(**{**plain, "scale": scale and Scale(**scale)})
