"""The verdict on a run: its table against a golden one, sample by sample.

A table of a single seed allows no flip: a method that is deterministic has none on the platform
where it was recorded. Where ``--cpas-jitter`` saw the seeds disagree, the recorded seeds say how
often a sample is correct, and a run is worse only if its losses are more than their spread
explains (:mod:`pytest_cpas.golden.spread`).

Everything here is pure: tables in, verdicts out.
"""

from __future__ import annotations

import bisect
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.evaluation import THRESHOLDS
from pytest_cpas.golden.spread import FALSE_ALARMS, detectable_loss, fewer, more
from pytest_cpas.golden.tables import RunTable, TableSample, differences
from pytest_cpas.types import Verdict, VerdictWord
from pytest_cpas.types.samples import ALL

#: Samples that a message names before it only counts the rest.
_NAMED = 8

#: The errors of a sample, in the order of ``samples.csv``: name, factor and unit for people.
_MOVING = (
    ("the position error", 100, " cm"),
    ("the rotation error", 1, " deg"),
    ("the IoU", 1, ""),
    ("the F-score", 1, ""),
)

#: Errors that differ by less, relatively or absolutely, are those of another machine's arithmetic.
_SAME_RELATIVE, _SAME_ABSOLUTE = 1e-3, 1e-4

#: With this probability a part of the samples shows a change of the size that it states.
CONFIDENCE = 0.95


class Word(VerdictWord):
    """The verdict on one category of a run."""

    #: Every sample meets the same thresholds as when the table was recorded; of a table that was
    #: recorded under several seeds, as many as their spread allows.
    MATCHES = "MATCHES", "passed"
    #: There is no recorded table, and the exact binomial interval of each count holds what the
    #: paper prints for this method and data set.
    AGREES = "AGREES WITH THE PAPER", "passed"
    #: The same, and an interval lies above what the paper prints.
    ABOVE = "ABOVE THE PAPER", "passed"
    #: At some threshold more samples were lost than gained; they are named with their errors.
    #: Against the paper: an interval lies below what it prints.
    REGRESSED = "REGRESSED", "failed"
    #: Samples were gained and none lost: look at it and record it.
    IMPROVED = "IMPROVED", "failed"
    #: As many lost as gained, or other samples, or fewer than there were, or a metric is n/a that
    #: was not.
    CHANGED = "CHANGED", "failed"
    #: The table was made with other data, weights, seed, device or metric definitions: not
    #: comparable.
    STALE = "STALE", "failed"
    #: The table was edited by hand or is torn.
    DAMAGED = "DAMAGED", "failed"
    #: There is no table, or only a part of the samples was judged (and agrees).
    NOT_CHECKED = "NOT CHECKED", "skipped", "failed"
    #: With --snapshot-update: the table was written.
    RECORDED = "RECORDED", "passed"
    #: With --snapshot-update: it was not, for the reason that is given.
    NOT_RECORDED = "NOT RECORDED", "failed"


def compare(golden: RunTable | None, new: RunTable) -> list[Verdict]:
    """Compare a run's table with its golden one; one verdict per category.

    Where the golden table allows for a spread there is one more, of all categories together.
    """
    if golden is None:
        return [
            Verdict(
                Word.NOT_CHECKED,
                ALL,
                f"there is no golden table of {new.method} on {new.dataset}; if these results are"
                " right, record them with --snapshot-update",
            )
        ]
    stale = differences(golden.identity, new.identity)
    if stale:
        return [
            Verdict(
                Word.STALE,
                ALL,
                f"the golden table was made under other conditions: {'; '.join(stale)}. Restore"
                " them, or record it anew with --snapshot-update",
            )
        ]
    categories = sorted({*golden.listed, *new.listed})
    pairings = [_Pairing.of(golden, new, category) for category in categories]
    notes = [f"note: {line}" for line in differences(golden.provenance, new.provenance)]
    if not any(sample.repeats for sample in golden.samples.values()):
        return [_exact_verdict(pairing, notes) for pairing in pairings]
    pairings.append(_Pairing.of(golden, new, None))
    level = FALSE_ALARMS / (len(pairings) * len(THRESHOLDS))
    return [_spread_verdict(pairing, golden.seeds, level, notes) for pairing in pairings]


@dataclass(frozen=True)
class _Pairing:
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
    def of(cls, golden: RunTable, new: RunTable, category: str | None) -> _Pairing:
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

    def flips(self, index: int) -> _Flips:
        """What changed at a threshold."""
        names: dict[str, list[str]] = {"10": [], "01": [], "-": []}
        seen: Counter[str] = Counter()
        for name in self.both:
            pair = self.old[name].outcome[index] + self.new[name].outcome[index]
            seen[pair] += 1
            if pair[0] != pair[1]:
                names["-" if "-" in pair else pair].append(name)
        return _Flips(
            before=sum(n for pair, n in seen.items() if pair[0] == "1"),
            after=sum(n for pair, n in seen.items() if pair[1] == "1"),
            lost=names["10"],
            gained=names["01"],
            not_applicable=names["-"],
        )

    def told(self, index: int, flips: _Flips, remark: str = "") -> list[str]:
        """The flips at a threshold in words, the samples named."""
        count = f"{flips.before} -> {flips.after} of {len(self.both)} correct"
        lines = [f"{THRESHOLDS[index].label}: {count}{remark}"]
        for what, names in (
            ("lost", flips.lost),
            ("gained", flips.gained),
            ("n/a changed", flips.not_applicable),
        ):
            if names:
                lines.append(f"    {what}: {self._named(names)}")
        return lines

    def _named(self, names: Sequence[str]) -> str:
        told = [
            f"{name} ({self.old[name].describe()} -> {self.new[name].describe()})"
            for name in names[:_NAMED]
        ]
        rest = len(names) - len(told)
        return "; ".join(told) + (f"; and {rest} more" if rest else "")

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

    def seeds_correct(self, index: int, seeds: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which samples the recorded seeds got right (n, seeds), and which the run (n,)."""
        recorded, new = [], []
        for name in self.both:
            old = self.old[name]
            told = [old.outcome, *(old.repeats or [old.outcome] * (seeds - 1))]
            if "-" not in (old.outcome[index], self.new[name].outcome[index]):
                recorded.append([outcome[index] == "1" for outcome in told])
                new.append(self.new[name].outcome[index] == "1")
        return np.array(recorded, bool).reshape(-1, seeds), np.array(new, bool)

    @property
    def drift(self) -> list[str]:
        """Errors that moved without crossing a threshold, the one that moved most named."""
        lines = []
        for column, (what, factor, unit) in enumerate(_MOVING):
            count, most = 0, (0.0, "", 0.0, 0.0)
            for name in self.both:
                old, new = self.old[name].errors[column], self.new[name].errors[column]
                if old is None or new is None:
                    continue
                if not math.isclose(old, new, rel_tol=_SAME_RELATIVE, abs_tol=_SAME_ABSOLUTE):
                    count, most = count + 1, max(most, (abs(new - old), name, old, new))
            if count:
                _, name, before, after = most
                lines.append(
                    f"note: {what} moved in {count} samples, most in {name}:"
                    f" {factor * before:.3g} -> {factor * after:.3g}{unit}"
                )
        return lines


@dataclass(frozen=True)
class _Flips:
    """Counts of correct samples in both tables, and the samples that differ."""

    before: int
    after: int
    lost: Sequence[str]
    gained: Sequence[str]
    not_applicable: Sequence[str]

    def __bool__(self) -> bool:
        return bool(self.lost or self.gained or self.not_applicable)

    @property
    def net(self) -> int:
        return len(self.gained) - len(self.lost)


def _exact_verdict(pairing: _Pairing, notes: Sequence[str]) -> Verdict:
    """Where no flip is allowed."""
    changes = [
        (flips, index) for index in range(len(THRESHOLDS)) if (flips := pairing.flips(index))
    ]
    changes.sort(key=lambda change: change[0].net)  # what fell most stands first
    lines = [line for flips, index in changes for line in pairing.told(index, flips)]
    lines += pairing.other_samples
    if not lines:
        return _unchanged(pairing, "agree with the golden table")
    if changes and changes[0][0].net < 0:
        return Verdict(Word.REGRESSED, pairing.category, "\n  ".join([*lines, *notes]))
    only_gains = not pairing.other_samples and not any(
        flips.lost or flips.not_applicable for flips, _ in changes
    )
    return _to_record(Word.IMPROVED if only_gains else Word.CHANGED, pairing, lines, notes)


def _spread_verdict(pairing: _Pairing, seeds: int, level: float, notes: Sequence[str]) -> Verdict:
    """Where the flips may be those of another seed."""
    told: dict[Word, list[str]] = {Word.REGRESSED: [], Word.CHANGED: [], Word.IMPROVED: []}
    margins, blind = [], []
    for index, threshold in enumerate(THRESHOLDS):
        flips = pairing.flips(index)
        if flips.not_applicable:
            told[Word.CHANGED] += pairing.told(index, flips)
        recorded, new = pairing.seeds_correct(index, seeds)
        if not recorded.any() and not new.any():
            continue
        totals = recorded.sum(axis=0)
        seen = f" ({seeds} recorded seeds: {totals.min()} to {totals.max()}; p = {{:.1g}})"
        if (p := fewer(recorded, new)) < level:
            told[Word.REGRESSED] += pairing.told(index, flips, seen.format(p))
        elif (p := more(recorded, new)) < level:
            told[Word.IMPROVED] += pairing.told(index, flips, seen.format(p))
        elif loss := detectable_loss(recorded, level):
            margins.append(f"{loss} at {threshold.label}")
        else:
            blind.append(threshold.label)
    told[Word.CHANGED] += pairing.other_samples
    lines = [line for group in told.values() for line in group]
    word = next((word for word, group in told.items() if group), None)
    if word is Word.REGRESSED:
        return Verdict(word, pairing.category, "\n  ".join([*lines, *notes]))
    if word is not None:
        return _to_record(word, pairing, lines, notes)
    called = f"; a loss of {', '.join(margins)} would be called" if margins else ""
    if blind:
        called += f"; {seeds} seeds of so few samples cannot show a loss at {', '.join(blind)}"
    if blind and not margins:
        words = f"{len(pairing.both)} of {pairing.total} judged{called}; record more seeds"
        return Verdict(Word.NOT_CHECKED, pairing.category, words)
    return _unchanged(pairing, f"are within the spread of the {seeds} recorded seeds{called}")


def _to_record(
    word: Word, pairing: _Pairing, lines: Sequence[str], notes: Sequence[str]
) -> Verdict:
    advice = "if this is right, record it with --snapshot-update"
    return Verdict(word, pairing.category, "\n  ".join([*lines, advice, *notes]))


def _unchanged(pairing: _Pairing, how: str) -> Verdict:
    """No difference was found in what was judged; how much that was, and what may have moved."""
    judged, total = len(pairing.both), pairing.total
    if judged == total:
        words = f"all {total} samples {how}"
        return Verdict(Word.MATCHES, pairing.category, "\n  ".join([words, *pairing.drift]))
    words = f"{judged} of {total} judged"
    if judged:
        words += (
            f"; the {judged} judged {how}. A change of {detectable_flips(judged, total)} of the"
            f" {total} samples or more would have shown in such a part with"
            f" {100 * CONFIDENCE:.0f} % probability"
        )
    return Verdict(Word.NOT_CHECKED, pairing.category, "\n  ".join([words, *pairing.drift]))


def detectable_flips(judged: int, total: int) -> int:
    """The least number of flips among ``total`` samples of which a random part shows one.

    With at least :data:`CONFIDENCE` probability, if ``judged`` >= 1 of them are judged; exact
    (hypergeometric).
    """
    parts = math.comb(total, judged)

    def shown(flips: int) -> float:
        return 1 - math.comb(total - flips, judged) / parts

    return bisect.bisect_left(range(total), CONFIDENCE, lo=1, key=shown)
