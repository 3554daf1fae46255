"""What a run gave, sample by sample, judged under its protocols."""

from __future__ import annotations

import functools
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

from pytest_cpas.evaluation import Answer, Answered, Row, Run
from pytest_cpas.facts import Facts, fact, in_order
from pytest_cpas.golden.noise import Noise
from pytest_cpas.protocols import (
    CountColumn,
    Protocol,
    Ranking,
    RankingColumn,
    ScoreTable,
    Table,
    asked_for,
    count_columns,
    count_table,
    judge_outcomes,
    ranking_columns,
    ranking_table,
    score_columns,
    score_table,
)
from pytest_cpas.types import ToldError

__all__ = ["GoldenError", "RunTable", "TableSample", "describe", "differences"]

#: Characters of a reason that are kept.
_LONGEST_REASON = 2000


class GoldenError(ToldError):
    """A golden table that cannot be read, or not be written."""


class NewerError(GoldenError):
    """A golden table that a newer version has written."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TableSample(Answered):
    """What was answered for a sample, one answer per seed, and how that is judged.

    ``outcomes``: per seed a character for each column of the table that counts samples, as of
    :func:`pytest_cpas.protocols.judge_outcomes`.
    """

    outcomes: tuple[str, ...]

    @property
    def outcome(self) -> str:
        """That of the first seed."""
        return self.outcomes[0]

    @property
    def wavers(self) -> bool:
        """Whether the seeds disagree."""
        return len(set(self.outcomes)) > 1

    def describe(self, names: Collection[str] | None = None) -> str:
        """The facts in words, all of them or those of some ``names``."""
        facts = self.facts if names is None else {k: v for k, v in self.facts.items() if k in names}
        return describe(facts, self.failure)

    def is_close_to(self, other: TableSample) -> bool:
        """Whether nothing is judged otherwise, and no fact moved by more than its tolerance."""
        return (
            self.category == other.category
            and self.outcomes == other.outcomes
            and all(
                a.facts.keys() == b.facts.keys() and not a.difference(b)
                for a, b in zip(self.answers, other.answers, strict=True)
            )
        )


@dataclass(frozen=True, kw_only=True)
class RunTable:
    """What a run gave, sample by sample; recorded, it is a golden table.

    ``identity`` must agree for two tables to be comparable, ``definitions`` (of facts, by name) for
    two columns to be, ``provenance`` need not; ``own_provenance`` is that of categories which were
    recorded by another run than the rest. ``listed`` counts per category the samples that there
    are, judged or not; ``seeds`` how often each sample was judged. ``ranking``: the detections of
    the data set, None where there are none, or no protocol ranks them. ``scenes``: of a run, by
    sample. ``noise``: how far other platforms move the facts, as far as it was measured.
    ``outdated``: it was read from files of an older form, which know less; ``misplaced``: from a
    folder in which earlier versions kept it.
    """

    method: str
    dataset: str
    identity: Mapping[str, str]
    definitions: Mapping[str, str]
    provenance: Mapping[str, str]
    protocols: tuple[Protocol, ...]
    samples: Mapping[str, TableSample]
    listed: Mapping[str, int]
    seeds: int = 1
    ranking: Ranking | None = None
    own_provenance: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    scenes: Mapping[str, str] = field(default_factory=dict, compare=False)
    noise: Noise = field(default_factory=Noise)
    outdated: bool = False
    misplaced: bool = field(default=False, compare=False)

    @classmethod
    def of(cls, run: Run, rows: Sequence[Row] | None = None) -> RunTable:
        """The table of a run's rows; without them, every sample is judged first."""
        if rows is None:
            rows = [run.judge(ref) for ref in run.samples]
        answers = {
            row.sample: (
                row.category,
                tuple(
                    Answer(facts=answer.facts, failure=_recordable_text(answer.failure))
                    for answer in row.answers
                ),
            )
            for row in rows
        }
        return cls(
            method=run.method,
            dataset=run.dataset,
            identity=run.identity,
            definitions=run.definitions,
            provenance=run.provenance,
            protocols=run.protocols,
            samples=table_samples(run.protocols, answers),
            listed=run.listed,
            seeds=run.seeds,
            ranking=run.ranking(rows) if ranking_columns(run.protocols) else None,
            scenes={ref.id: ref.scene for ref in run.samples},
        )

    def of_seed(self, index: int) -> RunTable:
        """What was given under one of the seeds. Rankings are of the first."""
        samples = {
            name: replace(
                sample, answers=(sample.answers[index],), outcomes=(sample.outcomes[index],)
            )
            for name, sample in self.samples.items()
        }
        ranking = None if index else self.ranking
        return replace(self, samples=samples, seeds=1, ranking=ranking)

    @functools.cached_property
    def columns(self) -> tuple[CountColumn, ...]:
        """Those that count samples, in the order of the outcomes' characters."""
        return count_columns(self.protocols)

    @functools.cached_property
    def table(self) -> Table:
        """The counts, of the first seed."""
        return count_table(self.columns, ((s.category, s.outcome) for s in self.samples.values()))

    @functools.cached_property
    def scores(self) -> ScoreTable:
        """The scores, of the first seed, and the average precision of rankings."""
        samples = self.samples.values()
        scores = score_table(
            score_columns(self.protocols),
            [sample.category for sample in samples],
            [sample.facts for sample in samples],
        )
        for category, cells in ranking_table(self.ranking_columns, self.ranking).items():
            scores.setdefault(category, {}).update(cells)
        return scores

    @functools.cached_property
    def ranking_columns(self) -> tuple[RankingColumn, ...]:
        """Those that rank detections, in the order of the detections' outcomes."""
        return ranking_columns(self.protocols)

    @functools.cached_property
    def facts(self) -> tuple[str, ...]:
        """The names of what is known of samples."""
        answers = (answer for sample in self.samples.values() for answer in sample.answers)
        return tuple(in_order({name for answer in answers for name in answer.facts}))

    def provenance_of(self, category: str) -> Mapping[str, str]:
        """What else should be known of the run that gave a category."""
        return self.own_provenance.get(category, self.provenance)

    def without(self, categories: Collection[str]) -> RunTable:
        """This table without some categories, as if they were not there."""
        return replace(
            self,
            samples={k: s for k, s in self.samples.items() if s.category not in categories},
            listed={k: n for k, n in self.listed.items() if k not in categories},
            ranking=self.ranking and self.ranking.without(categories),
        )

    def recordable(self, previous: RunTable | None) -> RunTable:
        """This table as it is recorded in the place of ``previous``.

        Categories of ``previous`` that it does not hold itself are kept, and so are samples of
        which nothing is judged otherwise and no fact moved beyond its tolerance. Raises
        :class:`GoldenError` unless every category that it holds is complete, or if what is kept
        was made under other conditions, or judged under protocols that this one lacks.
        """
        counts = Counter(sample.category for sample in self.samples.values())
        partial = [f"{k} {n} of {self.listed[k]}" for k, n in counts.items() if n < self.listed[k]]
        if partial or not counts:
            raise GoldenError(
                f"not every sample was judged ({', '.join(partial) or 'none was'}); a golden table"
                " is recorded from complete categories only"
            )
        if previous is None:
            return self
        if previous.seeds > self.seeds:
            raise GoldenError(
                f"the golden table allows for the spread of {previous.seeds} seeds, and this run"
                f" has {self.seeds}: pass --cpas-jitter {previous.seeds}, or remove the table first"
            )
        names = [protocol.name for protocol in self.protocols]
        if lacking := [p.name for p in previous.protocols if p.name not in names]:
            raise GoldenError(
                f"the golden table guards the columns of {', '.join(lacking)} as well: pass"
                f" {asked_for([*names, *lacking])}, or remove"
                " the table first"
            )
        kept = {
            name: sample
            for name, sample in previous.samples.items()
            if sample.category not in counts and sample.category in self.listed
        }
        same_kind = (
            previous.seeds == self.seeds
            and not previous.outdated
            and previous.protocols == self.protocols
            and previous.definitions == self.definitions
            and not differences(previous.identity, self.identity)
        )
        if kept and previous.outdated:
            raise GoldenError(
                "the golden table has an earlier form, which cannot keep its other categories;"
                " record all categories together (leave out --cpas-category)"
            )
        if kept and not same_kind:
            raise GoldenError(
                "the cells of the other categories were made under other conditions; record all"
                " categories together"
            )
        now = dict(self.samples)
        if same_kind:
            old = previous.samples
            now = {
                name: old[name] if name in old and sample.is_close_to(old[name]) else sample
                for name, sample in now.items()
            }
        noise = previous.noise if same_kind else self.noise
        if not kept:
            return replace(self, samples=now, noise=noise)
        still = {sample.category for sample in kept.values()}
        own = {name: told for name, told in previous.own_provenance.items() if name in still}
        if self.provenance != previous.provenance:
            own |= dict.fromkeys(counts, self.provenance)
        ranking = self.ranking
        if ranking and previous.ranking:
            ranking = previous.ranking.without(counts).joined(ranking)
        return replace(
            self,
            samples=kept | now,
            ranking=ranking,
            noise=noise,
            provenance=previous.provenance,
            own_provenance=own,
        )


def table_samples(
    protocols: Sequence[Protocol], answers: Mapping[str, tuple[str, tuple[Answer, ...]]]
) -> dict[str, TableSample]:
    """Samples, given as category and answers by name, judged under protocols."""
    columns = count_columns(protocols)
    outcomes = iter(
        judge_outcomes(columns, [a.facts for _, given in answers.values() for a in given])
    )
    return {
        name: TableSample(
            category=category,
            answers=given,
            outcomes=tuple(next(outcomes) for _ in given),
        )
        for name, (category, given) in answers.items()
    }


def describe(facts: Facts, failure: str | None) -> str:
    """An answer in words: its facts, or why there is none."""
    if failure:
        return f"failed: {failure}"
    return ", ".join(
        fact(name).pattern.format(f"{fact(name).factor * value:.3g}")
        for name, value in facts.items()
        if value is not None
    )


def differences(golden: Mapping[str, str], run: Mapping[str, str]) -> list[str]:
    """What differs between two identities, or two provenances, in words."""
    return [
        f"{key} was {golden.get(key, 'not recorded')}, now {run.get(key, 'not given')}"
        for key in sorted({*golden, *run})
        if golden.get(key) != run.get(key)
    ]


def other_conditions(golden: RunTable, run: RunTable) -> list[str]:
    """What differs, in words, of what must agree for two tables to be comparable: their identities,
    but for the device, where both tell of one. Another device is another platform."""
    then, now = dict(golden.identity), dict(run.identity)
    if "device" in then and "device" in now:
        del then["device"], now["device"]
    return differences(then, now)


def _recordable_text(text: str | None) -> str | None:
    """A reason as a table keeps it: not endless, and of characters that every reader takes."""
    if text is None:
        return None
    if len(text) > _LONGEST_REASON:
        text = f"{text[:_LONGEST_REASON]}... ({len(text)} characters)"
    return re.sub(
        r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]",
        lambda match: match[0].encode("unicode_escape").decode("ascii"),
        text,
    )
