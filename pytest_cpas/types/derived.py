"""What the reader of a data set makes of the rest, and what that cannot be held against."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

__all__ = ["Derived", "Part", "derived_note", "itself"]

#: What a sample's truth and observation have that a data set may not publish.
Part = Literal["pose", "extents", "symmetry", "mask", "2-D box"]


@dataclass(frozen=True, kw_only=True)
class Derived:
    """A part of samples that is not published, and that the data set's reader makes of the rest.

    ``made_of``: what it is made of, such as "mesh", "pose" or "depth": it is never held against
    these alone. ``how`` says it to people. ``samples``: ids; None for all samples.
    """

    part: Part
    made_of: frozenset[str]
    how: str
    samples: frozenset[str] | None = None

    def covers(self, sample: str) -> bool:
        """Whether it is about the sample of this id."""
        return self.samples is None or sample in self.samples


def derived_note(derived: Sequence[Derived], samples: Collection[str]) -> str:
    """One line about all that is derived of the ``samples`` of a data set; empty for nothing."""
    parts = []
    for each in derived:
        count = sum(map(each.covers, samples))
        whose = "" if count == len(samples) else f" of {count} of {len(samples)} samples"
        if count:
            parts.append(f"{each.part}{whose} ({each.how})")
    return f"not published, but made by the reader: {'; '.join(parts)}" if parts else ""


def itself(derived: Sequence[Derived], sample: str, part: Part, others: Collection[str]) -> bool:
    """Whether a part of a sample, held against ``others``, is held against what it is made of."""
    return any(
        each.part == part and each.made_of <= {*others} and each.covers(sample) for each in derived
    )
