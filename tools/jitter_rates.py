"""How often the verdict on jitter calls unchanged code, and which losses it finds.

The answers of ``icp`` under many seeds (``tests/golden/icp_seeds.csv``) give the runs: some seeds
are the recording and another one is the run. For any number of seeds and samples a model draws
both: every sample is like one that is there, the answers of a sample are those of its seeds, and in
one of :data:`OTHERS` cases that of another sample of its category. From the project's root::

    python tools/jitter_rates.py [RUNS]
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.golden.spread import ALARM, DOUBT, Answers, Spread
from pytest_cpas.metrics.precision import Count
from pytest_cpas.protocols import PAPER, shipped_protocol

PATH = Path(__file__).parents[1] / "tests" / "golden" / "icp_seeds.csv"
OTHERS = 100
#: Samples of a category in the model.
SIZE = 21
#: The columns of a digit in the file, the highest bit first.
COLUMNS = [column for column in shipped_protocol(PAPER).counts if not column.guard]
#: A loss is planted in samples that this share of all seeds gets right, at 10 deg and 2 cm.
EASY = 0.9

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Drawn:
    """Seeds of n samples: ``correct`` (n, seeds, T); ``easy`` (n,): where a loss is planted."""

    categories: NDArray[np.str_]
    easy: Flags
    correct: Flags

    def split(self, run: int = 1) -> Answers:
        """The last ``run`` seeds as the run, the others as the recording."""
        recorded, new = self.correct[:, :-run], self.correct[:, -run:].copy()
        known = np.ones((len(recorded), len(COLUMNS)), bool)
        return Answers(self.categories, recorded, new, known)

    def plant(self, answers: Answers, loss: int, rng: np.random.Generator) -> str:
        """Lose samples of a category with enough easy ones, at all thresholds; the category."""
        names, counts = np.unique(self.categories[self.easy], return_counts=True)
        category = str(rng.choice(names[counts >= loss]))
        among = np.flatnonzero(self.easy & (self.categories == category))
        answers.run[rng.choice(among, loss, replace=False)] = False
        return category


Draw = Callable[[int, np.random.Generator], Drawn]


class Icp:
    """The file: ``categories`` (n,) and ``correct`` (n, S, T)."""

    def __init__(self) -> None:
        with PATH.open(newline="", encoding="utf-8") as file:
            lines = list(csv.DictReader(file))
        self.categories = np.array([line["category"] for line in lines])
        digits = np.array([[int(digit, 16) for digit in line["seeds"]] for line in lines])
        shifts = np.arange(len(COLUMNS))[::-1]
        self.correct = (digits[..., None] >> shifts & 1).astype(bool)
        self.easy = self.correct[..., 0].mean(axis=1) >= EASY

    def seeds(self, count: int, rng: np.random.Generator) -> Drawn:
        """Different ones of the seeds, of the samples as they are."""
        drawn = rng.permutation(self.correct.shape[1])[:count]
        return Drawn(self.categories, self.easy, self.correct[:, drawn])

    def model(self, count: int, rng: np.random.Generator) -> Drawn:
        """:data:`SIZE` samples of each category, each like one that is there, and independent."""
        groups = [np.flatnonzero(self.categories == name) for name in np.unique(self.categories)]
        samples = np.concatenate([rng.choice(own, SIZE) for own in groups])
        others = np.concatenate([rng.choice(own, (SIZE, count)) for own in groups])
        rows = np.where(rng.random(others.shape) < 1 / OTHERS, others, samples[:, None])
        seeds = rng.integers(self.correct.shape[1], size=rows.shape)
        return Drawn(self.categories[samples], self.easy[samples], self.correct[rows, seeds])


def least(answers: Answers, scopes: Sequence[str], *, better: bool = False) -> float:
    """The p of the most improbable answer on ``scopes``."""
    spread = Spread(answers)
    columns = range(len(COLUMNS))
    return min(spread.p(scope, column, better=better) for scope in scopes for column in columns)


def alarms(draw: Draw, seeds: int, runs: int, rng: np.random.Generator) -> list[int]:
    """Of ``runs`` without a change: REGRESSED, IMPROVED, and not these but PROBABLY WORSE."""
    counts = [0, 0, 0]
    for _ in range(runs):
        answers = draw(seeds + 1, rng).split()
        worse, better = (least(answers, answers.scopes, better=b) for b in (False, True))
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
    return float(np.mean(np.array(found) < ALARM)), float(np.mean(np.array(found) < DOUBT))


def main(runs: int) -> None:
    icp = Icp()
    samples, seeds = icp.correct.shape[:2]
    print(f"{samples} samples, {seeds} seeds\n")
    _print_power(icp, runs // 100)
    _print_alarms(icp, runs)


def _print_alarms(icp: Icp, runs: int) -> None:
    rng = np.random.default_rng(0)
    print("| recorded seeds | drawn by | runs | REGRESSED | IMPROVED | PROBABLY WORSE |")
    print("|---|---|---|---|---|---|")
    cases = [(5, icp.seeds), (10, icp.seeds), (20, icp.seeds), (5, icp.model), (20, icp.model)]
    called = 0
    for seeds, draw in cases:
        counts = alarms(draw, seeds, runs // len(cases), rng)
        called += counts[0] + counts[1]
        numbers = " | ".join(map(str, (runs // len(cases), *counts)))
        print(f"| {seeds} | {draw.__name__} | {numbers} |", flush=True)
    _, high = Count(called, runs).interval(0.98)
    print(f"\n{called} false alarms in {runs} runs, less than {high:.2g} (exact, 99 %)\n")


def _print_power(icp: Icp, runs: int) -> None:
    rng = np.random.default_rng(1)
    print("| recorded seeds | seeds of the run | 2 of 21 lost | 4 of 21 lost | 8 of 21 lost |")
    print("|---|---|---|---|---|")
    for again in (1, 5):
        for seeds in (5, 10, 20, 40):
            cells = [str(seeds), str(again)]
            for loss in (2, 4, 8):
                red, doubt = power(icp.model, seeds, loss, runs, rng, again)
                cells.append(f"{100 * red:.0f} % ({100 * doubt:.0f} %)")
            print(f"| {' | '.join(cells)} |", flush=True)
    print(flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20000)
