"""Facts that moved without crossing a threshold: whether that is judged, and how.

**On the platform of the recording** a deterministic method gives the same answers: facts that moved
by more than a tolerance are a change of the method, whatever the thresholds say.

**Elsewhere** processors, libraries and devices round in other ways. Moves within the tolerance are
ties. Of the others the signs are looked at: where nothing changed, worse and better are as probable
in every scene (samples of one scene are alike, so the signs of a scene go together). The
probability of at least as many worse ones is exact, by convolution over the scenes. There is one
such question for every fact, direction, and category or all samples, and the level of the run is
shared out among them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from pytest_cpas.facts import fact
from pytest_cpas.golden.pairing import Pairing, SharedColumn
from pytest_cpas.golden.tables import RunTable, differences

__all__ = ["Drift", "drifts", "may_not_move"]

#: What of a table's provenance says nothing about the machine that it was made on.
_NOT_PLATFORM = (
    "code",
    "data_code",
    "conftest",
    "plugins",
    "revision",
    "deterministic",
    "weights_folder",
)


@dataclass(frozen=True)
class Drift:
    """How a fact moved in the samples of a category.

    ``moved``: name, before and after, of the samples whose fact moved by more than the tolerance;
    ``nets``: per scene how many more of them are worse than better.
    """

    fact: str
    moved: Sequence[tuple[str, float, float]]
    judged: int
    nets: Sequence[int]

    @property
    def worse(self) -> float:
        """The probability of as many worse ones where nothing changed."""
        return _tail(self.nets)

    @property
    def better(self) -> float:
        """The same of better ones."""
        return _tail([-net for net in self.nets])

    def summary(self) -> str:
        """In a few words: in how many samples."""
        return f"{self.fact} in {len(self.moved)} of {self.judged} samples"

    def told(self) -> str:
        """In words: how many samples, by how much, and the one that moved most."""
        made = fact(self.fact)
        name, before, after = max(self.moved, key=lambda entry: abs(entry[2] - entry[1]))
        shift = made.factor * median(now - then for _, then, now in self.moved)
        first, second = (
            made.pattern.format(f"{made.factor * value:.4g}") for value in (before, after)
        )
        return (
            f"{self.fact} moved in {len(self.moved)} of {self.judged} samples, median move"
            f" {made.pattern.format(f'{shift:+.2g}')}, most in {name}: {first} -> {second}"
        )


def drifts(
    pairing: Pairing,
    columns: Sequence[SharedColumn],
    names: Sequence[str],
    scenes: Mapping[str, str],
) -> Iterator[Drift]:
    """The facts of those ``names`` that moved in samples of which nothing flipped.

    ``columns``: those of both tables; ``scenes`` by sample, as far as they are known.
    """
    still = [
        sample
        for sample in pairing.both
        if all(
            pairing.old[sample].outcome[column.old] == pairing.new[sample].outcome[column.new]
            for column in columns
        )
    ]
    for name in names:
        made, moved, judged = fact(name), [], 0
        signs: dict[str, int] = {}
        for sample in still:
            old, new = pairing.old[sample].facts.get(name), pairing.new[sample].facts.get(name)
            # who did not answer is among the flips
            if old is None or new is None or not (math.isfinite(old) and math.isfinite(new)):
                continue
            judged += 1
            if made.is_close(old, new):
                continue
            moved.append((sample, old, new))
            sign = 1 if bool(new > old) == (made.better == "lower") else -1
            scene = scenes.get(sample, sample)
            signs[scene] = signs.get(scene, 0) + sign
        if moved:
            yield Drift(name, moved, judged, list(signs.values()))


def _tail(nets: Sequence[int]) -> float:
    """The probability of a sum of at least that of ``nets``, if the sign of each is a fair coin;
    exact."""
    sizes = [abs(net) for net in nets]
    total = sum(sizes)
    ways = np.zeros(2 * total + 1)
    ways[total] = 1.0
    for size in sizes:
        if size:
            ways = (np.roll(ways, size) + np.roll(ways, -size)) / 2
    return float(ways[total + sum(nets) :].sum())


def may_not_move(golden: RunTable, new: RunTable, category: str) -> bool:
    """Whether facts must be the same: a deterministic method, on a machine like that on which the
    category was recorded, as far as is told."""
    both = [table.provenance_of(category) for table in (golden, new)]
    then, now = (
        {key: told for key, told in provenance.items() if key not in _NOT_PLATFORM}
        for provenance in both
    )
    deterministic = all(provenance.get("deterministic") != "no" for provenance in both)
    return deterministic and not differences(then, now)
