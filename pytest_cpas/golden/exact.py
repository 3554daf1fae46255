"""The verdict on a category where no flip is allowed: a golden table of one seed, or of seeds that
agree."""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from scipy.special import bdtr

from pytest_cpas.facts import SAME
from pytest_cpas.golden.drift import Drift, drifts, may_not_move, other_platform
from pytest_cpas.golden.jitter import drift_words
from pytest_cpas.golden.noise import at_least
from pytest_cpas.golden.pairing import Flips, Pairing, SharedColumn, first_few, shared_facts
from pytest_cpas.golden.rankings import ranking_changes
from pytest_cpas.golden.spread import DOUBT, Spread
from pytest_cpas.golden.tables import RunTable, TableSample
from pytest_cpas.golden.words import Word
from pytest_cpas.protocols import RankingColumn
from pytest_cpas.reading.words import decimal
from pytest_cpas.types import Verdict
from pytest_cpas.types.declarations import TOLERANCE
from pytest_cpas.types.samples import ALL

__all__ = ["ELSEWHERE", "Exact", "detectable_flips", "to_record"]

#: How a line begins that says that a match was not made where the table was recorded.
ELSEWHERE = "another platform than that of the recording"

#: With this probability a part of the samples shows a change of the size that it states.
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Exact:
    """Where no flip is allowed; ``alarm``: the probability of a false alarm of drift in any of the
    categories; ``beside``: the facts of several recorded seeds that vary."""

    golden: RunTable
    new: RunTable
    columns: Sequence[SharedColumn]
    alarm: float
    categories: int
    beside: Spread | None

    @property
    def level(self) -> float:
        """That in one category, or in all together, in one direction."""
        return self.alarm / (2 * (self.categories + 1))

    def verdict(self, pairing: Pairing, notes: Sequence[str]) -> Verdict:
        """The verdict on a category."""
        flipped = [(flips, column) for column in self.columns if (flips := pairing.flips(column))]
        ties: list[tuple[Flips, SharedColumn]] = []
        changes: list[tuple[Flips, SharedColumn | None]] = [*flipped]
        if not may_not_move(self.golden, self.new, pairing.category):
            real = [
                (pairing.without_ties(column, flips, self.golden.noise), column)
                for flips, column in flipped
            ]
            changes = [(flips, column) for flips, column in real if flips]
            ties = [
                (_difference(every, flips), column)
                for (every, column), (flips, _) in zip(flipped, real, strict=True)
            ]
        if answered := pairing.answered:
            changes.append((answered, None))
        changes.sort(key=lambda change: change[0].net)  # what fell most stands first
        rankings = sorted(
            ranking_changes(self.golden, self.new, pairing.category), key=lambda each: each.gain
        )
        lines: list[str] = []
        for worse in (True, False):  # all losses stand before what is no loss
            lines += _told_once(pairing, [each for each in changes if (each[0].net < 0) is worse])
            told = (each.lines for each in rankings if (each.gain < 0) is worse)
            lines += itertools.chain.from_iterable(told)
        lines += pairing.other_samples
        if wavering := [name for name in pairing.both if pairing.new[name].wavers]:
            lines.append(
                f"the {self.new.seeds} seeds of this run disagree in {len(wavering)} samples, first"
                f" {wavering[0]}; the golden table has {self.golden.seeds}, without disagreement"
            )
        moved = self._moved(pairing)
        drift = [f"note: {self._told(each)}" for each in moved]
        if not lines:
            return (
                self._drifted(pairing, moved, notes)
                or self._borderline(pairing, ties, [*drift, *notes])
                or _unchanged(pairing, [*drift, *self._elsewhere(pairing)])
            )
        gains = [flips.net for flips, _ in changes] + [change.gain for change in rankings]
        if gains and min(gains) < 0:
            return Verdict(Word.REGRESSED, pairing.category, "\n  ".join([*lines, *drift, *notes]))
        only_gains = (
            not (pairing.other_samples or wavering)
            and not any(flips.lost or flips.not_applicable for flips, _ in changes)
            and all(change.gain > 0 for change in rankings)
        )
        fell = [each for each in moved if each.worse < DOUBT / len(self._facts)]
        if only_gains and not fell:
            return to_record(Word.IMPROVED, pairing, [*lines, *drift], notes)
        if only_gains:  # what was gained is not all that moved
            head = f"facts got worse in more samples than better: {first_few(fell, Drift.summary)}"
            lines = [head, *(f"    {self._told(each)}" for each in fell), *lines]
            drift = [line for each, line in zip(moved, drift, strict=True) if each not in fell]
            if any(each.worse < self.level / len(self._facts) for each in fell):
                return Verdict(
                    Word.REGRESSED, pairing.category, "\n  ".join([*lines, *drift, *notes])
                )
        return to_record(Word.CHANGED, pairing, [*lines, *drift], notes)

    def _moved(self, pairing: Pairing) -> list[Drift]:
        """The facts that moved in samples of which nothing flipped."""
        recorded = self.golden.provenance_of(pairing.category).get("tolerance", "")
        tolerance = decimal(recorded) or TOLERANCE
        return list(drifts(pairing, self.columns, self._facts, self.new.scenes, tolerance))

    def _elsewhere(self, pairing: Pairing) -> list[str]:
        """What a match on another platform does not say."""
        changes = other_platform(self.golden, self.new, pairing.category)
        if not changes or pairing.category == ALL or not pairing.both or not self._facts:
            return []
        scenes = {self.new.scenes.get(name, name) for name in pairing.both}
        line = f"{ELSEWHERE} ({'; '.join(changes)}): moves of facts are judged by their signs"
        if 0.5 ** len(scenes) >= self.level / len(self._facts):
            line += f", and {len(scenes)} scenes are too few to tell one from chance"
        return [line]

    def _borderline(
        self,
        pairing: Pairing,
        ties: Sequence[tuple[Flips, SharedColumn]],
        notes: Sequence[str],
    ) -> Verdict | None:
        """The verdict on flips of facts that hardly moved, or no further than other platforms moved
        them; None without any."""
        lost = {name for flips, _ in ties for name in flips.lost}
        gained = {name for flips, _ in ties for name in flips.gained} - lost
        if not lost and not gained:
            return None
        noise = self.golden.noise
        by = f"by less than {SAME:g} of themselves"
        if noise.platforms:
            by += f" or no further than on {len(noise.platforms)} platforms where that was measured"
        head = (
            f"{len(lost)} samples lost and {len(gained)} gained on another platform, by facts that"
            f" moved {by}, across a threshold of"
            f" {first_few([column.label for tie, column in ties if tie])}"
        )
        lines = [
            head,
            *(f"    {line}" for line in _told_once(pairing, [tie for tie in ties if tie[0]])),
        ]
        # as a fair coin falls
        p = float(bdtr(len(gained), len(lost) + len(gained), 0.5))
        if p < self.level:
            lines.append(f"so many of them worse are improbable on either platform: p = {p:.1g}")
            return Verdict(Word.REGRESSED, pairing.category, "\n  ".join([*lines, *notes]))
        if noise.platforms:
            risks = [self._risk(pairing.old[name]) for name in pairing.both]
            p = at_least(len(lost), risks)
            lines.append(f"measured moves explain {sum(risks):.2g} of them on average: p = {p:.1g}")
            if p < self.level:
                return Verdict(Word.REGRESSED, pairing.category, "\n  ".join([*lines, *notes]))
        return Verdict(Word.BORDERLINE, pairing.category, "\n  ".join([*lines, *notes]))

    def _risk(self, sample: TableSample) -> float:
        """How probable it is that another platform loses a sample in some column."""
        met = [column.column for column in self.columns if sample.outcome[column.old] == "1"]
        return self.golden.noise.risk(sample.facts, met)

    def drifted(self, pairing: Pairing, notes: Sequence[str]) -> Verdict | None:
        """The verdict on the facts of all samples together; None if they may have moved so."""
        return self._drifted(pairing, self._moved(pairing), notes)

    def _told(self, drift: Drift) -> str:
        """How a fact moved, and the columns that are made of it."""
        made_of = [
            column.label
            for protocol in self.new.protocols
            for column in protocol.columns
            if not isinstance(column, RankingColumn)
            and drift.fact in (made.name for made in column.facts)
        ]
        return f"{drift.told()}{f'; judged in {first_few(made_of)}' if made_of else ''}"

    @property
    def _facts(self) -> Sequence[str]:
        return shared_facts(self.golden, self.new)

    def _drifted(
        self, pairing: Pairing, moved: Sequence[Drift], notes: Sequence[str]
    ) -> Verdict | None:
        """The verdict on facts that moved although nothing flipped; None if they may have."""
        if self.beside is not None:
            return self._drifted_beside(self.beside, pairing, notes)
        if not moved:
            return None
        if may_not_move(self.golden, self.new, pairing.category):
            head = (
                "nothing flipped, but on the platform of the recording facts moved by more than"
                f" {SAME:g} of themselves and than the method's tolerance:"
                f" {first_few(moved, Drift.summary)}"
            )
            lines = [head, *(f"    {self._told(each)}" for each in moved)]
            return to_record(Word.CHANGED, pairing, lines, notes)
        level = self.level / len(self._facts)
        told: dict[Word, list[str]] = {}
        names = []
        for word, direction in ((Word.REGRESSED, "worse"), (Word.IMPROVED, "better")):
            found = [(each, p) for each in moved if (p := getattr(each, direction)) < level]
            names += [f"{each.fact} {direction}" for each, _ in found]
            told[word] = [
                f"    {self._told(each)}; {direction} in so many with p = {p:.1g}"
                for each, p in found
            ]
        than = "another platform moves"
        if self.golden.provenance_of(pairing.category).get("deterministic") == "no":
            than = "chance moves"
        head = (
            f"nothing flipped, but facts moved one way in more samples than {than}:"
            f" {first_few(names)}"
        )
        lines = [head, *told[Word.REGRESSED], *told[Word.IMPROVED]]
        if told[Word.REGRESSED]:
            return Verdict(Word.REGRESSED, pairing.category, "\n  ".join([*lines, *notes]))
        if told[Word.IMPROVED]:
            return to_record(Word.IMPROVED, pairing, lines, notes)
        return None

    def _drifted_beside(
        self, beside: Spread, pairing: Pairing, notes: Sequence[str]
    ) -> Verdict | None:
        """The same beside several seeds, whose facts vary although none of their outcomes does."""
        told = drift_words(beside, pairing.category, self.alarm)
        lines = [f"    {line}" for group in told.values() for line in group]
        if not lines:
            return None
        word = next(word for word, group in told.items() if group)
        names = [line.split()[0] for line in lines]
        head = "nothing flipped, but facts moved one way beside those of recorded seeds:"
        lines.insert(0, f"{head} {first_few(names)}")
        if word is Word.IMPROVED:
            return to_record(word, pairing, lines, notes)
        return Verdict(word, pairing.category, "\n  ".join([*lines, *notes]))


def _told_once(pairing: Pairing, changes: Iterable[tuple[Flips, SharedColumn | None]]) -> list[str]:
    """The flips of columns in words; samples that flipped in several are named once."""
    alike: dict[tuple[tuple[str, ...], ...], list[list[str]]] = {}
    for flips, column in changes:
        names = tuple(flips.lost), tuple(flips.gained), tuple(flips.not_applicable)
        alike.setdefault(names, []).append(pairing.told(column, flips))
    return [
        line for told in alike.values() for line in (*(head for head, *_ in told), *told[0][1:])
    ]


def _difference(every: Flips, real: Flips) -> Flips:
    """The flips of ``every`` that are none of the ``real`` ones."""
    return replace(
        every,
        lost=[name for name in every.lost if name not in real.lost],
        gained=[name for name in every.gained if name not in real.gained],
        not_applicable=[],
    )


def to_record(word: Word, pairing: Pairing, lines: Sequence[str], notes: Sequence[str]) -> Verdict:
    """A verdict that may be right, with how to keep it."""
    advice = "if this is right, record it with --snapshot-update"
    return Verdict(word, pairing.category, "\n  ".join([*lines, advice, *notes]))


def _unchanged(pairing: Pairing, drift: Sequence[str]) -> Verdict:
    """No difference was found in what was judged: how much that was, and what moved."""
    judged, total = len(pairing.both), pairing.total
    how = "agree with the golden table"
    if judged == total:
        words = f"all {total} samples {how}"
        return Verdict(Word.MATCHES, pairing.category, "\n  ".join([words, *drift]))
    words = f"{judged} of {total} judged"
    if judged:
        words += (
            f"; the {judged} judged {how}. A change of {detectable_flips(judged, total)} of the"
            f" {total} samples or more would have shown in such a part with"
            f" {100 * CONFIDENCE:.0f} % probability"
        )
    return Verdict(Word.NOT_CHECKED, pairing.category, "\n  ".join([words, *drift]))


def detectable_flips(judged: int, total: int) -> int:
    """The least number of flips among ``total`` samples of which a random part shows one.

    With at least :data:`CONFIDENCE` probability, if ``judged`` >= 1 of them are judged; exact
    (hypergeometric).
    """
    parts = math.comb(total, judged)

    def shown(flips: int) -> float:
        return 1 - math.comb(total - flips, judged) / parts

    return bisect.bisect_left(range(total), CONFIDENCE, lo=1, key=shown)
