"""The verdict on a run: its table against a golden one, sample by sample.

A table of a single seed allows no flip: a method that is deterministic has none on the platform
where it was recorded. Where ``--cpas-jitter`` saw the seeds disagree, the recorded seeds say how
often each sample is correct, and a run is worse only if its losses are improbable beside them
(:mod:`pytest_cpas.golden.jitter`).

Everything here is pure: tables in, verdicts out.
"""

from __future__ import annotations

import bisect
import functools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.golden.jitter import answers_of, loss_words, luckiest
from pytest_cpas.golden.pairing import Pairing, SharedColumn, shared_columns
from pytest_cpas.golden.spread import ALARM, DOUBT, Spread
from pytest_cpas.golden.tables import RunTable, differences
from pytest_cpas.types import Verdict, VerdictWord
from pytest_cpas.types.samples import ALL, COMPLETENESS

#: With this probability a part of the samples shows a change of the size that it states.
CONFIDENCE = 0.95


class Word(VerdictWord):
    """The verdict on one category of a run."""

    #: Every sample meets the same thresholds as when the table was recorded; of a table that was
    #: recorded under several seeds that disagree: nothing is improbable beside them.
    MATCHES = "MATCHES", "passed"
    #: There is no recorded table, and the exact binomial interval of each count holds what the
    #: paper prints for this method and data set.
    AGREES = "AGREES WITH THE PAPER", "passed"
    #: The same, and an interval lies above what the paper prints.
    ABOVE = "ABOVE THE PAPER", "passed"
    #: At some threshold more samples were lost than gained; they are named with their errors.
    #: Against the paper: an interval lies below what it prints.
    REGRESSED = "REGRESSED", "failed"
    #: Of a table recorded under several seeds: a loss that less than 5 % of all runs without a
    #: change show anywhere, but not as improbable as --cpas-alarm asks of REGRESSED. Its p is told;
    #: it fails with --cpas-require-golden=strict.
    PROBABLY_WORSE = "PROBABLY WORSE", "skipped", "skipped", "failed"
    #: Of a table recorded under several seeds: nothing is improbable beside them, but not even the
    #: loss of every sample of this category would be; that of others would.
    CANNOT_TELL = "CANNOT TELL", "skipped"
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
    #: There is no table, or one whose seeds could show no loss at all, or only a part of the
    #: samples was judged (and agrees).
    NOT_CHECKED = "NOT CHECKED", "skipped", "failed"
    #: The table has the form of an earlier version, which knew less: record it anew. What it knows
    #: is judged all the same.
    OUTDATED = "OUTDATED", "passed"
    #: With --snapshot-update: the table was written.
    RECORDED = "RECORDED", "passed"
    #: With --snapshot-update: it was not, for the reason that is given.
    NOT_RECORDED = "NOT RECORDED", "failed"


def compare(
    golden: RunTable | None,
    new: RunTable,
    *,
    alarm: float = ALARM,
    excluded: Collection[str] = (),
) -> list[Verdict]:
    """Compare a run's table with its golden one; one verdict per category.

    Where the golden table allows for a spread there is one more, of all categories together, and
    ``alarm`` is the probability with which any of them is called without a change. Categories that
    are ``excluded`` were not asked for: nothing is said of them.
    """
    if excluded:
        golden = golden and golden.without(excluded)
        new = new.without(excluded)
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
    if not categories:
        return [Verdict(Word.NOT_CHECKED, ALL, "no category was asked for")]
    columns = shared_columns(golden, new)
    pairings = [Pairing.of(golden, new, category) for category in categories]
    notes = {category: _notes(golden, new, category) for category in categories}
    others = _other_columns(golden, new, columns)
    if not any(sample.wavers for sample in golden.samples.values()):
        seeds = golden.seeds, new.seeds
        exact = [_exact_verdict(p, columns, seeds, notes[p.category]) for p in pairings]
        return [*exact, *others]
    pairings.append(Pairing.of(golden, new, None))
    notes[ALL] = list(dict.fromkeys(line for lines in notes.values() for line in lines))
    answers = answers_of(golden, new, columns)
    judge = _Spread(golden.seeds, columns, Spread(answers), alarm, notes)
    verdicts = [judge.verdict(pairing) for pairing in pairings]
    if all(verdict.word is Word.CANNOT_TELL for verdict in verdicts):
        verdicts = [replace(verdict, word=Word.NOT_CHECKED) for verdict in verdicts]
    return [*verdicts, *others]


def _notes(golden: RunTable, new: RunTable, category: str) -> list[str]:
    """What else was otherwise when a category was recorded."""
    # a commit changes often, and the digest of the code tells whether that means anything
    then = golden.provenance_of(category)
    told = {key: fact for key, fact in then.items() if key != "revision"}
    now = {key: fact for key, fact in new.provenance_of(category).items() if key in told}
    return [f"note: {line}" for line in differences(told, now)]


def _other_columns(
    golden: RunTable, new: RunTable, shared: Sequence[SharedColumn]
) -> list[Verdict]:
    """Columns of one table that cannot be judged against the other: what was redefined is stale,
    what only one has is not checked."""
    same = {column.column.key for column in shared}
    old, now = ([c.key for c in table.columns if c.key not in same] for table in (golden, new))
    verdicts = []
    if stale := [key for key in old if key in now]:
        told = (
            f"{', '.join(stale)}: defined otherwise when the golden table was recorded. Record it"
            " anew with --snapshot-update"
        )
        verdicts.append(Verdict(Word.STALE, ALL, told))
    if golden.outdated:
        told = (
            "the golden table has the form of version 1, which knew less; if these results are"
            " right, record it anew with --snapshot-update"
        )
        verdicts.append(Verdict(Word.OUTDATED, COMPLETENESS, told))
    then, here = ([protocol.name for protocol in table.protocols] for table in (golden, new))
    gone = [key for key in old if key not in now and key.partition(".")[0] in here]
    new_columns = [key for key in now if key not in old and key.partition(".")[0] in then]
    for keys, where in ((gone, "the golden table alone has"), (new_columns, "this run alone has")):
        if keys:
            told = (
                f"{where} {', '.join(keys)}; if these results are right, record them anew with"
                " --snapshot-update"
            )
            verdicts.append(Verdict(Word.NOT_CHECKED, COMPLETENESS, told))
    if lacking := [name for name in then if name not in here]:
        told = (
            f"the golden table has columns of {', '.join(lacking)}, which this run was not judged"
            f" under: pass {' '.join(f'--cpas-protocol {n}' for n in [*here, *lacking])}"
        )
        verdicts.append(Verdict(Word.NOT_CHECKED, COMPLETENESS, told))
    if added := [name for name in here if name not in then]:
        told = (
            f"the golden table has no columns of {', '.join(added)}; if these results are right,"
            " record it anew with --snapshot-update"
        )
        verdicts.append(Verdict(Word.NOT_CHECKED, COMPLETENESS, told))
    return verdicts


def _exact_verdict(
    pairing: Pairing,
    columns: Sequence[SharedColumn],
    seeds: tuple[int, int],
    notes: Sequence[str],
) -> Verdict:
    """Where no flip is allowed; ``seeds``: of the golden table, of the run."""
    changes = [(flips, column) for column in columns if (flips := pairing.flips(column))]
    changes.sort(key=lambda change: change[0].net)  # what fell most stands first
    lines = [line for flips, column in changes for line in pairing.told(column, flips)]
    lines += pairing.other_samples
    if wavering := [name for name in pairing.both if pairing.new[name].wavers]:
        lines.append(
            f"the {seeds[1]} seeds of this run disagree in {len(wavering)} samples, first"
            f" {wavering[0]}; the golden table has {seeds[0]}, without disagreement"
        )
    if not lines:
        return _unchanged(pairing, "agree with the golden table")
    if changes and changes[0][0].net < 0:
        return Verdict(Word.REGRESSED, pairing.category, "\n  ".join([*lines, *notes]))
    only_gains = not (pairing.other_samples or wavering) and not any(
        flips.lost or flips.not_applicable for flips, _ in changes
    )
    return _to_record(Word.IMPROVED if only_gains else Word.CHANGED, pairing, lines, notes)


@dataclass(frozen=True)
class _Spread:
    """Where the flips may be those of another seed."""

    seeds: int
    columns: Sequence[SharedColumn]
    spread: Spread
    alarm: float
    notes: Mapping[str, Sequence[str]]

    def verdict(self, pairing: Pairing) -> Verdict:
        """The verdict on a category, or on all samples."""
        scope = pairing.category
        told: dict[Word, list[str]] = {
            word: [] for word in (Word.REGRESSED, Word.CHANGED, Word.PROBABLY_WORSE, Word.IMPROVED)
        }
        for index, column in enumerate(self.columns):
            flips = pairing.flips(column)
            if flips.not_applicable:
                told[Word.CHANGED] += pairing.told(column, flips)
            worse = self.spread.p(scope, index)
            better = self.spread.p(scope, index, better=True)
            if worse < max(DOUBT, self.alarm):
                word = Word.REGRESSED if worse < self.alarm else Word.PROBABLY_WORSE
                told[word] += self._moved(pairing, index, worse)
            elif better < self.alarm:
                told[Word.IMPROVED] += self._moved(pairing, index, better)
        told[Word.CHANGED] += pairing.other_samples
        lines = [line for group in told.values() for line in group]
        words = [word for word, group in told.items() if group]
        if not words:
            return self._unchanged(pairing)
        if words[0] is Word.REGRESSED:
            return Verdict(words[0], scope, "\n  ".join([*lines, *self.notes[scope]]))
        if words == [Word.PROBABLY_WORSE]:
            advice = (
                "p is the share of all runs without a change in which anything so improbable is"
                f" seen anywhere; to be sure, {self._advice}"
            )
            return Verdict(words[0], scope, "\n  ".join([*lines, advice, *self.notes[scope]]))
        # worse here and better there is neither
        word = words[0] if len(words) == 1 else Word.CHANGED
        return _to_record(word, pairing, lines, self.notes[scope])

    @property
    def _advice(self) -> str:
        """What would make the same loss more improbable."""
        judged = self.spread.answers.run.shape[1]
        if judged < self.seeds:
            return f"judge it under more seeds than {judged} (--cpas-jitter {self.seeds})"
        return (
            f"record more seeds than {self.seeds} of the program that was recorded (--cpas-jitter"
            f" {2 * self.seeds} --snapshot-update), and judge this one again"
        )

    def _moved(self, pairing: Pairing, index: int, p: float) -> list[str]:
        """What is improbable at a threshold: under how many seeds, and in which samples."""
        seen = f" ({self._seen(pairing.category, index, p)})"
        if self.spread.answers.run.shape[1] == 1:
            return [
                *pairing.told(self.columns[index], pairing.flips(self.columns[index]), seen),
                *self._evidence(pairing, index),
            ]
        recorded, run = self.spread.answers.of(pairing.category, index)
        counts = f"{_from_to(recorded)} -> {_from_to(run)} of {len(run)}"
        return [
            f"{self.columns[index].label}: {counts} correct{seen}",
            *self._evidence(pairing, index),
        ]

    def _evidence(self, pairing: Pairing, index: int) -> list[str]:
        """The samples whose share of seeds that are correct moved most, down and up."""
        answers = self.spread.answers
        known = answers.known[answers.among(pairing.category), index]
        recorded, run = answers.of(pairing.category, index)
        names = [name for name, there in zip(pairing.both, known, strict=True) if there]
        moved = run.mean(axis=1) - recorded.mean(axis=1)
        lines = []
        for what, sign in (("worse", -1), ("better", 1)):
            order = [i for i in np.argsort(-sign * moved, kind="stable") if sign * moved[i] > 0]
            told = [
                f"{names[i]} {recorded[i].sum()} of {recorded.shape[1]} -> {run[i].sum()} of"
                f" {run.shape[1]}"
                for i in order[:_NAMED]
            ]
            rest = f"; and {len(order) - _NAMED} more" if len(order) > _NAMED else ""
            if told:
                lines.append(f"    {what}, in seeds that are correct: {'; '.join(told)}{rest}")
        return lines

    @functools.cached_property
    def _lucky(self) -> Spread:
        return luckiest(self.spread.answers)

    def _seen(self, scope: str, index: int, p: float) -> str:
        """What the recorded seeds gave, and p."""
        recorded, run = self.spread.answers.of(scope, index)
        parts = [f"{self.seeds} recorded seeds: {_from_to(recorded)}"]
        if run.shape[1] > 1:
            parts.append(f"{run.shape[1]} seeds of this run: {_from_to(run)}")
        return "; ".join([*parts, f"p = {p:.1g}"])

    def _unchanged(self, pairing: Pairing) -> Verdict:
        scope, judged = pairing.category, len(pairing.both)
        complete = judged == pairing.total
        word = Word.MATCHES if complete else Word.NOT_CHECKED
        words = (
            f"all {judged} samples judged" if complete else f"{judged} of {pairing.total} judged"
        )
        if not judged:
            return Verdict(word, scope, words)
        indices = range(len(self.columns))
        p, index = min((self.spread.p(scope, index), index) for index in indices)
        recorded, run = self.spread.answers.of(scope, index)
        words += (
            f", nothing improbable beside the {self.seeds} recorded seeds (at"
            f" {self.columns[index].label} {_from_to(run)} correct, recorded {_from_to(recorded)};"
            f" p = {p:.1g})"
        )
        for index in indices:
            if (better := self.spread.p(scope, index, better=True)) < DOUBT:
                seen = self._seen(scope, index, better)
                words += f"; probably better at {self.columns[index].label} ({seen})"
        loss = loss_words(self._lucky, self.columns, scope, self.alarm)
        if not loss and word is Word.MATCHES:
            word = Word.CANNOT_TELL
        words += f"; {loss or f'not even the loss of all would be improbable: {_MORE_SEEDS}'}"
        return Verdict(word, scope, "\n  ".join([words, *pairing.drift]))


#: Samples that are named before the rest is only counted.
_NAMED = 8

#: What makes smaller losses show.
_MORE_SEEDS = "record more seeds, or judge under several (--cpas-jitter)"


def _from_to(answers: NDArray[np.bool_]) -> str:
    """How many of n samples are correct under each of K seeds; (n, K)."""
    totals = sorted(set(answers.sum(axis=0).tolist()))
    return f"{totals[0]}" if len(totals) == 1 else f"{totals[0]} to {totals[-1]}"


def _to_record(word: Word, pairing: Pairing, lines: Sequence[str], notes: Sequence[str]) -> Verdict:
    advice = "if this is right, record it with --snapshot-update"
    return Verdict(word, pairing.category, "\n  ".join([*lines, advice, *notes]))


def _unchanged(pairing: Pairing, how: str) -> Verdict:
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
