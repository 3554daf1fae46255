"""How often the verdict on jitter calls unchanged code, and which losses it finds.

The answers of ``icp`` under many seeds give the runs: some seeds are the recording and another one
is the run. For any number of seeds and samples a model draws both: every sample is like one that is
there, the answers of a sample are those of its seeds, and in one of :data:`OTHERS` cases that of
another sample of its category. There are two sets of seeds: ``tests/golden/icp_seeds.csv`` has what
seeds 0 to 39 get right at the thresholds of the paper; ``tests/golden/icp_facts.npz`` the facts of
84 of the samples under seeds 100 to 139, which are judged under all protocols that ship (their
columns that rank detections need a data set of detections). From the project's root::

    python tools/jitter_rates.py [RUNS [PART [SEED]]]

``PART``: "losses", "moves", "counts" (alarms of the first set), "together" (alarms of seeds that
move all of its samples) or "facts" (alarms of the second set); all if it is left out.
"""

from __future__ import annotations

import csv
import functools
import itertools
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from pytest_cpas.facts import fact
from pytest_cpas.golden.ranks import Moves
from pytest_cpas.golden.spread import ALARM, DOUBT, Answers, Spread
from pytest_cpas.metrics.precision import Count
from pytest_cpas.protocols import (
    PAPER,
    count_columns,
    facts_of,
    judge_outcomes,
    score_columns,
    shipped_protocol,
    shipped_protocols,
)

FOLDER = Path(__file__).parents[1] / "tests" / "golden"
OTHERS = 100
#: Samples of a category in the model.
SIZE = 21
#: The columns of a digit in the file, the highest bit first.
COLUMNS = [column for column in shipped_protocol(PAPER).counts if not column.guard]
#: A loss is planted in samples that this share of all seeds gets right, at 10 deg and 2 cm.
EASY = 0.9

Flags = NDArray[np.bool_]
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Drawn:
    """Seeds of n samples: ``correct`` (n, seeds, T), ``facts`` by name (n, seeds); ``easy`` (n,):
    where a loss is planted."""

    categories: NDArray[np.str_]
    easy: Flags
    correct: Flags
    facts: Mapping[str, Array]

    def split(self, run: int = 1) -> Answers:
        """The last ``run`` seeds as the run, the others as the recording."""
        recorded, new = self.correct[:, :-run], self.correct[:, -run:].copy()
        known = np.ones((len(recorded), recorded.shape[2]), bool)
        facts = {
            name: Moves(fact(name), values[:, :-run], values[:, -run:].copy())
            for name, values in self.facts.items()
        }
        return Answers(self.categories, recorded, new, known, facts)

    def plant(self, answers: Answers, loss: int, rng: np.random.Generator) -> str:
        """Lose samples of a category with enough easy ones, at all thresholds; the category."""
        names, counts = np.unique(self.categories[self.easy], return_counts=True)
        category = str(rng.choice(names[counts >= loss]))
        among = np.flatnonzero(self.easy & (self.categories == category))
        answers.run[rng.choice(among, loss, replace=False)] = False
        return category


Draw = Callable[[int, np.random.Generator], Drawn]


@dataclass(frozen=True)
class Icp:
    """What is known of n samples under S seeds: ``correct`` (n, S, T), ``facts`` by name (n, S)."""

    categories: NDArray[np.str_]
    correct: Flags
    facts: Mapping[str, Array] = field(default_factory=dict)

    @classmethod
    def of_counts(cls) -> Icp:
        """Seeds 0 to 39, at the thresholds of the paper."""
        with (FOLDER / "icp_seeds.csv").open(newline="", encoding="utf-8") as file:
            lines = list(csv.DictReader(file))
        categories = np.array([line["category"] for line in lines])
        digits = np.array([[int(digit, 16) for digit in line["seeds"]] for line in lines])
        shifts = np.arange(len(COLUMNS))[::-1]
        return cls(categories, (digits[..., None] >> shifts & 1).astype(bool))

    @classmethod
    def of_facts(cls, *protocols: str) -> Icp:
        """Seeds 100 to 139, under some of the protocols that ship; under all if none is named."""
        made = [shipped_protocol(name) for name in protocols or shipped_protocols()]
        columns = count_columns(made)
        needed = set(facts_of([*columns, *score_columns(made)]))
        with np.load(FOLDER / "icp_facts.npz") as stored:
            categories = stored["categories"]
            facts = {
                name: stored[name].astype(np.float64) for name in stored.files if name in needed
            }
        if lacking := needed.difference(facts):
            raise ValueError(f"icp_facts.npz lacks {', '.join(sorted(lacking))}: make it anew")
        shape = next(iter(facts.values())).shape
        answers = [
            {name: float(values[index]) for name, values in facts.items()}
            for index in np.ndindex(shape)
        ]
        told = "".join(judge_outcomes(columns, answers))
        correct = np.frombuffer(told.encode(), "S1").reshape(*shape, len(columns)) == b"1"
        return cls(categories, correct, facts)

    @functools.cached_property
    def easy(self) -> Flags:
        """(n,) which samples most seeds get right."""
        easy: Flags = self.correct[..., 0].mean(axis=1) >= EASY
        return easy

    def _drawn(
        self, samples: NDArray[np.int64], rows: NDArray[np.int64], seeds: NDArray[np.int64]
    ) -> Drawn:
        return Drawn(
            self.categories[samples],
            self.easy[samples],
            self.correct[rows, seeds],
            {name: values[rows, seeds] for name, values in self.facts.items()},
        )

    def seeds(self, count: int, rng: np.random.Generator) -> Drawn:
        """Different ones of the seeds, of the samples as they are."""
        samples = np.arange(len(self.categories))
        drawn = rng.permutation(self.correct.shape[1])[:count]
        return self._drawn(samples, samples[:, None], drawn)

    def model(self, count: int, rng: np.random.Generator) -> Drawn:
        """:data:`SIZE` samples of each category, each like one that is there, and independent."""
        groups = [np.flatnonzero(self.categories == name) for name in np.unique(self.categories)]
        samples = np.concatenate([rng.choice(own, SIZE) for own in groups])
        others = np.concatenate([rng.choice(own, (SIZE, count)) for own in groups])
        rows = np.where(rng.random(others.shape) < 1 / OTHERS, others, samples[:, None])
        return self._drawn(samples, rows, rng.integers(self.correct.shape[1], size=rows.shape))

    def together(self, deviate: float, count: int, rng: np.random.Generator) -> Drawn:
        """The samples as they are, independent but for what a seed adds to the log odds of all."""
        seeds = self.correct.shape[1]
        odds = logit(np.clip(self.correct.mean(axis=1), 0.5 / seeds, 1 - 0.5 / seeds))
        chance = expit(odds[:, None] + rng.normal(0, deviate, (1, count, 1)))
        # what is right at a strict threshold is right at a looser one
        correct = rng.random((len(odds), count, 1)) < chance
        return Drawn(self.categories, self.easy, correct, {})


def least(answers: Answers, scopes: Sequence[str], *, better: bool = False) -> float:
    """The p of the most improbable answer on ``scopes``."""
    return _least(Spread(answers), scopes, better)


def _least(spread: Spread, scopes: Sequence[str], better: bool) -> float:
    asked = [*range(spread.answers.known.shape[1]), *spread.answers.facts]
    return min(spread.p(scope, each, better=better) for scope in scopes for each in asked)


def alarms(draw: Draw, seeds: int, runs: int, rng: np.random.Generator) -> list[int]:
    """Of ``runs`` without a change: REGRESSED, IMPROVED, and not these but PROBABLY WORSE."""
    counts = [0, 0, 0]
    for _ in range(runs):
        spread = Spread(draw(seeds + 1, rng).split())
        worse, better = (_least(spread, spread.answers.scopes, b) for b in (False, True))
        counts[0] += worse < ALARM
        counts[1] += better < ALARM
        counts[2] += min(worse, better) >= ALARM and worse < DOUBT
    return counts


def power(
    draw: Draw, seeds: int, loss: int, runs: int, rng: np.random.Generator, again: int = 1
) -> tuple[float, float]:
    """Share of runs that lost ``loss`` samples that are REGRESSED, and at least PROBABLY WORSE."""
    found = []
    for _ in range(runs):
        drawn = draw(seeds + again, rng)
        answers = drawn.split(again)
        category = drawn.plant(answers, loss, rng)
        found.append(least(answers, (category, "all")))
    return _shares(found)


def power_of_moves(
    draw: Draw,
    seeds: int,
    factor: float,
    runs: int,
    rng: np.random.Generator,
    everywhere: bool,
    again: int = 1,
) -> tuple[float, float]:
    """The same of runs whose rotation errors are ``factor`` times as large, in one category or in
    all samples, though no count changed."""
    found = []
    for _ in range(runs):
        answers = draw(seeds + again, rng).split(again)
        category = str(rng.choice(answers.scopes[:-1]))
        moved = answers.facts["rotation_deg"]
        among = answers.among("all" if everywhere else category)
        moved.run[among] *= factor
        found.append(least(answers, (category, "all")))
    return _shares(found)


def _shares(found: Sequence[float]) -> tuple[float, float]:
    return float(np.mean(np.array(found) < ALARM)), float(np.mean(np.array(found) < DOUBT))


def main(runs: int, part: str, seed: int) -> None:
    if part in ("losses", ""):
        _print_losses(Icp.of_counts(), runs // 100, seed)
    if part in ("moves", ""):
        _print_moves(Icp.of_facts(PAPER), runs // 200, seed)
    if part in ("counts", ""):
        _print_alarms(Icp.of_counts(), runs, seed)
    if part in ("together", ""):
        _print_together(Icp.of_counts(), runs // 20, seed)
    if part in ("facts", ""):
        _print_alarms(Icp.of_facts(), runs, seed)


def _print_alarms(icp: Icp, runs: int, seed: int) -> None:
    rng = np.random.default_rng([seed, 0])
    samples, seeds, columns = icp.correct.shape
    print(f"{samples} samples, {seeds} seeds, {columns} counts, {len(icp.facts)} facts\n")
    print("| recorded seeds | drawn by | runs | REGRESSED | IMPROVED | PROBABLY WORSE |")
    print("|---|---|---|---|---|---|")
    cases = [(5, icp.seeds), (10, icp.seeds), (20, icp.seeds), (5, icp.model), (20, icp.model)]
    called = 0
    for recorded, draw in cases:
        counts = alarms(draw, recorded, runs // len(cases), rng)
        called += counts[0] + counts[1]
        numbers = " | ".join(map(str, (runs // len(cases), *counts)))
        print(f"| {recorded} | {draw.__name__} | {numbers} |", flush=True)
    _, high = Count(called, runs).interval(0.98)
    print(f"\n{called} false alarms in {runs} runs, less than {high:.2g} (exact, 99 %)\n")


def _print_together(icp: Icp, runs: int, seed: int) -> None:
    rng = np.random.default_rng([seed, 3])
    print("| recorded seeds | deviate | runs | REGRESSED | IMPROVED | PROBABLY WORSE |")
    print("|---|---|---|---|---|---|")
    for recorded, deviate in itertools.product((5, 20), (0.25, 0.5, 1.0)):
        counts = alarms(functools.partial(icp.together, deviate), recorded, runs, rng)
        print(f"| {recorded} | {deviate} | {runs} | {' | '.join(map(str, counts))} |", flush=True)
    print(flush=True)


def _print_losses(icp: Icp, runs: int, seed: int) -> None:
    rng = np.random.default_rng([seed, 1])
    print("| recorded seeds | seeds of the run | 2 of 21 lost | 4 of 21 lost | 8 of 21 lost |")
    print("|---|---|---|---|---|")
    for again in (1, 5):
        for seeds in (5, 10, 20, 40):
            cells = [_told(power(icp.model, seeds, loss, runs, rng, again)) for loss in (2, 4, 8)]
            print(f"| {seeds} | {again} | {' | '.join(cells)} |", flush=True)
    print(flush=True)


def _print_moves(icp: Icp, runs: int, seed: int) -> None:
    rng = np.random.default_rng([seed, 2])
    cases = [(1.25, False), (1.5, False), (1.1, True), (1.25, True)]
    heads = [
        f"{100 * (factor - 1):.0f} % in {'all' if everywhere else 'a category'}"
        for factor, everywhere in cases
    ]
    print(f"| recorded seeds | seeds of the run | {' | '.join(heads)} |")
    print("|" + "---|" * (2 + len(heads)))
    for again in (1, 5):
        for seeds in (5, 10, 20, 40):
            cells = [
                _told(power_of_moves(icp.model, seeds, factor, runs, rng, everywhere, again))
                for factor, everywhere in cases
            ]
            print(f"| {seeds} | {again} | {' | '.join(cells)} |", flush=True)
    print(flush=True)


def _told(shares: tuple[float, float]) -> str:
    red, doubt = shares
    return f"{100 * red:.0f} % ({100 * doubt:.0f} %)"


if __name__ == "__main__":
    given = sys.argv[1:]
    main(
        int(given[0]) if given else 20000,
        given[1] if len(given) > 1 else "",
        int(given[2]) if len(given) > 2 else 0,
    )
