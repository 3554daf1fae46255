"""The samples of a golden table and of a run side by side: what changed, in words."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

from pytest_cpas.golden.noise import Noise
from pytest_cpas.golden.tables import RunTable, TableSample
from pytest_cpas.protocols import Column, CountColumn
from pytest_cpas.types import shortened
from pytest_cpas.types.samples import ALL

__all__ = [
    "Flips",
    "Pairing",
    "SharedColumn",
    "first_few",
    "mean_the_same",
    "shared_columns",
    "shared_facts",
]

_T = TypeVar("_T")

#: Facts that are told of a sample, and characters of its words, such as why there is no answer.
_FACTS_TOLD, _LONGEST = 6, 200

#: Samples or detections that a message names before it only counts the rest.
_NAMED = 8


def first_few(names: Sequence[_T], told: Callable[[_T], str] = str) -> str:
    """The first names in words, and how many more there are."""
    rest = len(names) - _NAMED
    return "; ".join(map(told, names[:_NAMED])) + (f"; and {rest} more" if rest > 0 else "")


@dataclass(frozen=True)
class SharedColumn:
    """A column that two tables have, and which character of an outcome is its own in each."""

    column: CountColumn
    old: int
    new: int

    @property
    def label(self) -> str:
        """For people."""
        return self.column.label


def shared_columns(golden: RunTable, new: RunTable) -> list[SharedColumn]:
    """The columns that mean the same in both tables, in the order of the new one."""
    old = {column.key: (index, column) for index, column in enumerate(golden.columns)}
    return [
        SharedColumn(column, old[column.key][0], index)
        for index, column in enumerate(new.columns)
        if column.key in old and mean_the_same(golden, new, old[column.key][1], column)
    ]


def shared_facts(golden: RunTable, new: RunTable) -> list[str]:
    """What both tables know of samples, under one definition."""
    then, now = golden.definitions, new.definitions
    return [name for name in new.facts if then.get(name) == now.get(name) is not None]


def mean_the_same(golden: RunTable, new: RunTable, then: Column, now: Column) -> bool:
    """Whether a column of either table judges alike, by facts of the same definition."""
    return then.meaning == now.meaning and all(
        golden.definitions.get(made.name) == new.definitions.get(made.name) for made in now.facts
    )


@dataclass(frozen=True)
class Pairing:
    """The samples of a category, or of all of them, in both tables.

    ``old`` and ``new`` hold all samples; ``both`` names those of the category that both tables
    have, ``extra`` those that only the new one has.
    """

    category: str
    old: Mapping[str, TableSample]
    new: Mapping[str, TableSample]
    both: Sequence[str]
    extra: Sequence[str]
    recorded: int
    listed: int

    @classmethod
    def of(cls, golden: RunTable, new: RunTable, category: str | None) -> Pairing:
        """Of one category; of all if it is None."""

        def is_meant(sample: TableSample | None) -> bool:
            return sample is not None and category in (None, sample.category)

        old = golden.samples
        judged = sorted(name for name, sample in new.samples.items() if is_meant(sample))
        return cls(
            category or ALL,
            old,
            new.samples,
            both=[name for name in judged if is_meant(old.get(name))],
            extra=[name for name in judged if not is_meant(old.get(name))],
            recorded=sum(map(is_meant, old.values())),
            listed=sum(n for k, n in new.listed.items() if category in (None, k)),
        )

    def flips(self, shared: SharedColumn) -> Flips:
        """What changed in a column."""
        names: dict[str, list[str]] = {"10": [], "01": [], "-": []}
        seen: Counter[str] = Counter()
        for name in self.both:
            pair = self.old[name].outcome[shared.old] + self.new[name].outcome[shared.new]
            seen[pair] += 1
            if pair[0] != pair[1]:
                names["-" if "-" in pair else pair].append(name)
        before, after = (
            _Share(
                sum(n for pair, n in seen.items() if pair[which] == "1"),
                sum(n for pair, n in seen.items() if pair[which] != "-"),
            )
            for which in (0, 1)
        )
        return Flips(
            before=before,
            after=after,
            lost=names["10"],
            gained=names["01"],
            not_applicable=names["-"],
        )

    @property
    def answered(self) -> Flips:
        """Which samples are answered in one table, and not under all seeds of the other.

        No flips are told where the recorded seeds of a sample disagree about that: failures that
        come and go are judged by the ranks of facts.
        """
        answered = {
            name: tuple(
                [answer.failure is None for answer in table[name].answers]
                for table in (self.old, self.new)
            )
            for name in self.both
        }
        before, after = (
            _Share(sum(all(seeds[which]) for seeds in answered.values()), len(answered))
            for which in (0, 1)
        )
        agree = all(all(old) or not any(old) for old, _ in answered.values())
        told = answered if agree else {}
        return Flips(
            before=before,
            after=after,
            lost=[name for name, (old, new) in told.items() if all(old) and not all(new)],
            gained=[name for name, (old, new) in told.items() if not any(old) and all(new)],
            not_applicable=[],
        )

    def without_ties(self, shared: SharedColumn, flips: Flips, noise: Noise) -> Flips:
        """The flips of samples of which a fact moved by more than its tolerance, and than ``noise``
        explains."""

        def moved(name: str) -> bool:
            old, new = self.old[name].facts, self.new[name].facts
            pairs = [(made, old[made.name], new[made.name]) for made in shared.column.facts]
            return not all(
                a is not None and b is not None and noise.explains(made, a, b)
                for made, a, b in pairs
            )

        return replace(
            flips,
            lost=list(filter(moved, flips.lost)),
            gained=list(filter(moved, flips.gained)),
        )

    def told(self, shared: SharedColumn | None, flips: Flips, remark: str = "") -> list[str]:
        """The flips in a column in words, the samples named; without one, those of
        :attr:`answered`."""
        head = f"{shared.label}: {flips.counts} correct" if shared else f"answered: {flips.counts}"
        lines = [f"{head}{remark}"]
        for what, names in (
            ("lost", flips.lost),
            ("gained", flips.gained),
            ("n/a changed", flips.not_applicable),
        ):
            if names:
                described = functools.partial(self._described, shared)
                lines.append(f"    {what}: {first_few(names, described)}")
        return lines

    def _described(self, shared: SharedColumn | None, name: str) -> str:
        """A sample in both tables in words, with what a column is judged by, and little more."""
        own = [made.name for made in shared.column.facts] if shared else []
        told = list(dict.fromkeys([*own, *self.new[name].facts]))[:_FACTS_TOLD]
        old, new = (shortened(t[name].describe(told), _LONGEST) for t in (self.old, self.new))
        return f"{name} ({old} -> {new})"

    @property
    def other_samples(self) -> list[str]:
        """How the samples themselves differ: a run that shrank, or that grew."""
        lines = []
        if self.listed < self.recorded:
            lines.append(
                f"the data set and the method have {self.listed} samples in common, the golden"
                f" table has {self.recorded}"
            )
        if self.extra:
            first = self.extra[0]
            lines.append(f"{len(self.extra)} samples are not in the golden table, first {first}")
        return lines

    @property
    def total(self) -> int:
        """The samples that there are, or were."""
        return max(self.recorded, self.listed)


class _Share(NamedTuple):
    """``correct`` of the ``judged`` samples; n/a is not judged."""

    correct: int
    judged: int


@dataclass(frozen=True)
class Flips:
    """Counts of correct samples in both tables, and the samples that differ."""

    before: _Share
    after: _Share
    lost: Sequence[str]
    gained: Sequence[str]
    not_applicable: Sequence[str]

    def __bool__(self) -> bool:
        return bool(self.lost or self.gained or self.not_applicable)

    @property
    def counts(self) -> str:
        """Correct before and after, of those that the tables' cells count."""
        before, after = self.before, self.after
        of = "" if before.judged == after.judged else f" of {before.judged}"
        return f"{before.correct}{of} -> {after.correct} of {after.judged}"

    @property
    def net(self) -> int:
        """How many more were gained than lost."""
        return len(self.gained) - len(self.lost)
