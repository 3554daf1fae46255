"""The verdict on a run: its table against a golden one, sample by sample.

A table of a single seed allows no flip: a method that is deterministic has none on the platform
where it was recorded. Where ``--cpas-jitter`` saw the seeds disagree, the recorded seeds say how
often each sample is correct, and a run is worse only if its losses are improbable beside them
(:mod:`pytest_cpas.golden.jitter`).

Everything here is pure: tables in, verdicts out.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.golden.drift import may_not_move
from pytest_cpas.golden.exact import Exact, to_record
from pytest_cpas.golden.jitter import answers_of, drift_words, loss_words, luckiest
from pytest_cpas.golden.pairing import (
    Pairing,
    SharedColumn,
    first_few,
    mean_the_same,
    shared_columns,
)
from pytest_cpas.golden.spread import ALARM, DOUBT, Spread
from pytest_cpas.golden.tables import RunTable, differences, other_conditions
from pytest_cpas.golden.words import Word
from pytest_cpas.protocols import CountColumn, asked_for
from pytest_cpas.reading.words import decimal
from pytest_cpas.types import Verdict
from pytest_cpas.types.samples import ALL, COMPLETENESS

#: What is said of a category under several seeds: the first of these that one of them gives.
SEVERITY = (
    Word.REGRESSED,
    Word.CHANGED,
    Word.IMPROVED,
    Word.BORDERLINE,
    Word.NOT_CHECKED,
    Word.MATCHES,
)


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
    stale = other_conditions(golden, new)
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
    others = _other_columns(golden, new)
    if golden.seeds > 1 and all(may_not_move(golden, new, category) for category in categories):
        return [*_seed_by_seed(golden, new, columns, alarm, notes), *others]
    if not any(sample.wavers for sample in golden.samples.values()):
        varies = all(golden.provenance_of(c).get("deterministic") == "no" for c in categories)
        beside = Spread(answers_of(golden, new, [])) if golden.seeds > 1 and varies else None
        exact = Exact(golden, new, columns, alarm, len(categories), beside)
        verdicts = [exact.verdict(p, notes[p.category]) for p in pairings]
        if not any(verdict.failed for verdict in verdicts):
            together = exact.drifted(Pairing.of(golden, new, None), [])
            verdicts += [together] if together else []
        return [*verdicts, *others]
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
    declared = {"deterministic", "tolerance"}  # which are recorded if they are not the usual ones
    now = {
        key: fact
        for key, fact in new.provenance_of(category).items()
        if key in told or key in declared
    }
    return [f"note: {line}" for line in differences(told, now)]


def _seed_by_seed(
    golden: RunTable,
    new: RunTable,
    columns: Sequence[SharedColumn],
    alarm: float,
    notes: Mapping[str, Sequence[str]],
) -> list[Verdict]:
    """The verdicts where a seed must give what it gave, one per category: the worst of any seed."""
    verdicts: dict[str, list[tuple[int, Verdict]]] = {category: [] for category in notes}
    count = min(golden.seeds, new.seeds)
    for seed in range(count):
        then, now = golden.of_seed(seed), new.of_seed(seed)
        exact = Exact(then, now, columns, alarm, len(notes), None)
        for category, told in notes.items():
            verdict = exact.verdict(Pairing.of(then, now, category), told)
            verdicts[category].append((seed, verdict))
    first = int(decimal(new.identity.get("seed", "")) or 0)  # a text, perhaps of somebody else
    worst = []
    for found in verdicts.values():
        seed, verdict = min(found, key=lambda each: SEVERITY.index(each[1].word))
        if count > 1 and verdict.word is not Word.NOT_CHECKED:
            which = (
                f"each of {count} seeds" if verdict.word is Word.MATCHES else f"seed {first + seed}"
            )
            verdict = replace(verdict, details=f"under {which}: {verdict.details}")
        worst.append(verdict)
    return worst


def _other_columns(golden: RunTable, new: RunTable) -> list[Verdict]:
    """Columns, of all kinds, of one table that cannot be judged against the other: what was
    redefined is stale, what only one has is not checked."""
    old, now = (
        {column.key: column for protocol in table.protocols for column in protocol.columns}
        for table in (golden, new)
    )
    verdicts = []
    if stale := [
        key for key in old if key in now and not mean_the_same(golden, new, old[key], now[key])
    ]:
        told = (
            f"{', '.join(stale)}: defined otherwise when the golden table was recorded. Record it"
            " anew with --snapshot-update"
        )
        verdicts.append(Verdict(Word.STALE, ALL, told))
    if golden.outdated or golden.misplaced:
        form = "which knew less" if golden.outdated else "a folder for each perturbation"
        told = (
            f"the golden table has an earlier form, {form}; if these results are right, record it"
            " anew with --snapshot-update"
        )
        verdicts.append(Verdict(Word.OUTDATED, COMPLETENESS, told))
    then, here = ([protocol.name for protocol in table.protocols] for table in (golden, new))
    gone = [key for key in old if key not in now and key.partition(".")[0] in here]
    new_columns = [key for key in now if key not in old and key.partition(".")[0] in then]
    if golden.outdated:  # that its form knew nothing but counts has been told
        new_columns = [key for key in new_columns if isinstance(now[key], CountColumn)]
    for keys, where in ((gone, "the golden table alone has"), (new_columns, "this run alone has")):
        if keys:
            told = (
                f"{where} {', '.join(keys)}; if these results are right, record them anew with"
                " --snapshot-update"
            )
            verdicts.append(Verdict(Word.NOT_CHECKED, COMPLETENESS, told))
    if golden.ranking is not None and new.ranking is None and new.ranking_columns:
        told = (
            "the golden table ranks detections, and this run has none to rank: average precision is"
            " judged of all frames, with scores"
        )
        verdicts.append(Verdict(Word.NOT_CHECKED, COMPLETENESS, told))
    if lacking := [name for name in then if name not in here]:
        told = (
            f"the golden table has columns of {', '.join(lacking)}, which this run was not judged"
            f" under: pass {asked_for([*here, *lacking])}"
        )
        verdicts.append(Verdict(Word.NOT_CHECKED, COMPLETENESS, told))
    if added := [name for name in here if name not in then]:
        told = (
            f"the golden table has no columns of {', '.join(added)}; if these results are right,"
            " record it anew with --snapshot-update"
        )
        verdicts.append(Verdict(Word.NOT_CHECKED, COMPLETENESS, told))
    return verdicts


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
        if answered := pairing.answered:
            word = Word.REGRESSED if answered.lost else Word.IMPROVED
            told[word] += pairing.told(None, answered)
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
        for word, moved in drift_words(self.spread, scope, self.alarm).items():
            told[word] += moved
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
        return to_record(word, pairing, lines, self.notes[scope])

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
        known = answers.known[:, index] & answers.among(pairing.category)
        recorded, run = answers.of(pairing.category, index)
        names = [answers.names[i] for i in np.flatnonzero(known).tolist()]
        moved = run.mean(axis=1) - recorded.mean(axis=1)

        def told(i: int) -> str:
            then, now = recorded[i], run[i]
            return f"{names[i]} {then.sum()} of {len(then)} -> {now.sum()} of {len(now)}"

        lines = []
        for what, sign in (("worse", -1), ("better", 1)):
            order = [i for i in np.argsort(-sign * moved, kind="stable") if sign * moved[i] > 0]
            if order:
                lines.append(f"    {what}, in seeds that are correct: {first_few(order, told)}")
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
        gains = sorted((self.spread.p(scope, i, better=True), i) for i in indices)
        if gains[0][0] < DOUBT:
            better, index = gains[0]
            seen, more = self._seen(scope, index, better), sum(p < DOUBT for p, _ in gains) - 1
            words += f"; probably better at {self.columns[index].label} ({seen})"
            words += f", as at {more} of the other columns" if more else ""
        loss = loss_words(self._lucky, self.columns, scope, self.alarm)
        if not loss and word is Word.MATCHES:
            word = Word.CANNOT_TELL
        words += f"; {loss or f'not even the loss of all would be improbable: {_MORE_SEEDS}'}"
        return Verdict(word, scope, words)


#: What makes smaller losses show.
_MORE_SEEDS = "record more seeds, or judge under several (--cpas-jitter)"


def _from_to(answers: NDArray[np.bool_]) -> str:
    """How many of n samples are correct under each of K seeds; (n, K)."""
    totals = sorted(set(answers.sum(axis=0).tolist()))
    return f"{totals[0]}" if len(totals) == 1 else f"{totals[0]} to {totals[-1]}"
