"""How far other platforms move the facts of one program: measured, kept with a golden table, and
which flips that explains.

Processors and libraries round in other ways, and what iterates may end elsewhere. The sizes of the
moves between a recording and runs of the same program on other platforms say how far each fact may
lie from a threshold and still fall on its other side, and how probable that is.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pytest_cpas.facts import Fact, Facts, fact, in_order
from pytest_cpas.protocols import CountColumn

__all__ = ["FactNoise", "Noise", "at_least"]


@dataclass(frozen=True)
class FactNoise:
    """``compared`` moves of a fact were looked at; ``sizes`` are those of the largest of them, of
    the 2nd, the 4th, the 8th and so on, as far as they are beyond its tolerance."""

    compared: int
    sizes: tuple[float, ...]

    @classmethod
    def of(cls, made: Fact, moves: Iterable[tuple[float, float]]) -> FactNoise:
        """From values before and after."""
        pairs = list(moves)
        beyond = sorted(
            (abs(after - before) for before, after in pairs if not made.is_close(before, after)),
            reverse=True,
        )
        ranks = [2**i for i in range(len(beyond).bit_length())]
        return cls(len(pairs), tuple(beyond[rank - 1] for rank in ranks))

    @property
    def largest(self) -> float:
        """No move was larger."""
        return self.sizes[0] if self.sizes else 0.0

    def share(self, size: float) -> float:
        """Which share of the moves is at least of a ``size``, at the most."""
        first_smaller = bisect.bisect_right([-each for each in self.sizes], -size)
        fewer_than = 2**first_smaller
        return (fewer_than - 1) / self.compared if self.compared else 0.0


@dataclass(frozen=True)
class Noise:
    """``platforms``: on what it was measured, in words; ``facts``: by name."""

    platforms: tuple[str, ...] = ()
    facts: Mapping[str, FactNoise] = field(default_factory=dict)

    @classmethod
    def measured(
        cls, recorded: Mapping[str, Facts], runs: Mapping[str, Mapping[str, Facts]]
    ) -> Noise:
        """From the facts of samples by name, as recorded and by platform; what is not finite in
        both is left out."""
        names = dict.fromkeys(name for facts in recorded.values() for name in facts)
        made = {}
        for name in names:
            pairs = [
                (before, after)
                for run in runs.values()
                for sample, facts in run.items()
                if sample in recorded
                and (before := recorded[sample].get(name)) is not None
                and (after := facts.get(name)) is not None
                and math.isfinite(before)
                and math.isfinite(after)
            ]
            if pairs:
                made[name] = FactNoise.of(fact(name), pairs)
        return cls(tuple(runs), made)

    def told(self) -> Iterator[str]:
        """A line for each fact that moved beyond its tolerance: how often, and how far."""
        for name in in_order(self.facts):
            measured, made = self.facts[name], fact(name)
            if measured.sizes:
                most = made.pattern.format(f"{made.factor * measured.largest:.3g}")
                yield (
                    f"  {name}: less than {2 ** len(measured.sizes)} of {measured.compared} moved"
                    f" beyond the tolerance, by {most} at most"
                )
        if not any(measured.sizes for measured in self.facts.values()):
            yield "  nothing moved beyond its tolerance"

    def explains(self, made: Fact, before: float, after: float) -> bool:
        """Whether a move is none, or none that is larger than all that were measured."""
        if made.is_close(before, after):
            return True
        measured = self.facts.get(made.name)
        return measured is not None and abs(after - before) <= measured.largest

    def risk(self, facts: Facts, columns: Sequence[CountColumn]) -> float:
        """How probable it is, at the most, that a sample which meets ``columns`` falls out of one
        of them: half of the moves that are as large as the way to a limit lead there."""
        nearest: dict[str, float] = {}
        for column in columns:
            for made, limit in column.conditions:
                value = facts.get(made.name)
                if value is not None and math.isfinite(value):
                    chance = self._chance(made, value, limit)
                    nearest[made.name] = max(nearest.get(made.name, 0.0), chance)
        return min(1.0, sum(nearest.values())) / 2

    def _chance(self, made: Fact, value: float, limit: float) -> float:
        if made.is_close(value, limit):
            return 1.0
        measured = self.facts.get(made.name)
        return 0.0 if measured is None else min(1.0, measured.share(abs(limit - value)))


def at_least(count: int, chances: Iterable[float]) -> float:
    """The probability of at least ``count`` of independent events; exact, by convolution."""
    ways = np.ones(1)
    for chance in chances:
        if chance:
            ways = np.convolve(ways, (1 - chance, chance))
    return float(min(1.0, ways[count:].sum()))
