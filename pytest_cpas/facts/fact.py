"""What a fact is: its name, meaning and needs, and how it is computed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.facts.answers import AnswerBatch
from pytest_cpas.types import Array, ContractError
from pytest_cpas.types.declarations import TOLERANCE

__all__ = ["SAME", "Fact", "FactError", "Facts", "Known", "Part"]

#: The facts of one answer by name; None is n/a.
Facts: TypeAlias = Mapping[str, float | None]

#: What a method must give for a fact to be known.
Part: TypeAlias = Literal["extents", "shape"]

#: What a data set must know of a sample for a fact to be known: the true shape, the camera.
Known: TypeAlias = Literal["shape", "camera"]


#: Values of a fact that differ by a smaller share are the same for people.
SAME = 1e-3

#: What those are called of which a limit tells less.
_NOUNS = {
    "position_m": "position error",
    "position_relative": "position error over the diagonal",
    "rotation_deg": "rotation error",
    "rotation_in_view_deg": "rotation error in view",
    "add_relative": "ADD over the diameter",
    "adds_relative": "ADD-S over the diameter",
    "add_or_adds_relative": "ADD(-S) over the diameter",
    "mssd_relative": "MSSD over the diameter",
}


class FactError(ContractError):
    """A name that no fact has."""


@dataclass(frozen=True, eq=False)
class Fact:
    """A number about one answer.

    ``definition``: the id of what it means; ``unit``: "m", "deg", "px" or "" (none); ``better``:
    which direction is the better one; ``needs``: what a method must give for it; ``knows``: what
    the data set must know; ``pattern``: a limit on it for people, of which ``factor`` times the
    limit is shown; ``compute``: of the answers of a batch, None where it is n/a; ``of_all``: it is
    about all hypotheses of an answer, not about the first alone.
    """

    name: str
    definition: str
    unit: Literal["m", "deg", "px", ""]
    better: Literal["lower", "higher"]
    pattern: str
    compute: Callable[[AnswerBatch], Sequence[float | None]]
    needs: frozenset[Part] = frozenset()
    knows: frozenset[Known] = frozenset()
    factor: float = 1.0
    of_all: bool = False

    @property
    def failed(self) -> float:
        """Of a sample without an answer: it meets no limit."""
        return -math.inf if self.better == "higher" else math.inf

    @property
    def finest(self) -> float:
        """What a method that declares no other tolerance may move a fact by: 1e-5 metres, as many
        radians, 0.001 pixels, 1e-5 of what has no unit."""
        return {"m": 1e-5, "deg": math.degrees(1e-5), "px": 1e-3, "": 1e-5}[self.unit]

    def is_close(self, one: float, other: float, tolerance: float = TOLERANCE) -> bool:
        """Whether two values differ by no more than :data:`SAME` of themselves, or by
        :attr:`finest`; ``tolerance``: the one that a method declares, metres and radians."""
        floor = self.finest * max(1.0, tolerance / TOLERANCE)
        return math.isclose(one, other, rel_tol=SAME, abs_tol=floor)

    @property
    def most(self) -> float:
        """The largest value that there is."""
        if self.unit == "deg":
            return 180.0
        return 1.0 if self.better == "higher" else math.inf

    def limit_label(self, limit: float) -> str:
        """A limit for people: ``10 deg``, ``2 cm``, ``IoU 0.5``."""
        return self.pattern.format(f"{self.factor * limit:.10g}")

    @property
    def title(self) -> str:
        """The fact itself for people, with the unit of its values: ``position error (m)``."""
        noun = _NOUNS.get(self.name) or " ".join(self.pattern.split("{}")[0].split())
        if self.of_all:
            noun = self.pattern.format("share").replace(" %", "")
        return f"{noun} ({self.unit})" if self.unit else noun

    def meets(self, values: Array, limit: float) -> NDArray[np.bool_]:
        """Which values are on the better side of a limit, or on it; NaN is not."""
        return values >= limit if self.better == "higher" else values <= limit
