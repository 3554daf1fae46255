"""Timing a candidate and a reference in turns.

A round is one prediction of the candidate with one of the reference before or after it. Two rounds
with the same sample make a quadruple: candidate, reference, reference, candidate, or the other way
round. What drifts, and who comes first, cancels in the geometric mean of a quadruple's two ratios.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from itertools import pairwise
from typing import Any, Protocol

from pytest_cpas.evaluation import MethodRun
from pytest_cpas.types import ContractError, DataError, Sample, SampleRef

#: Different samples that a run is timed with, about: as many of each category.
SAMPLES = 12

#: Seconds that rounds may take; the least that a verdict or a record needs are timed all the same.
PATIENCE = 300.0


class Timed(Protocol):
    """Something that is timed."""

    def run(self, index: int) -> float:
        """Seconds of one prediction for the ``index``-th sample."""


class Rounds:
    """Rounds with ``samples`` samples in turn, and the seconds they took."""

    def __init__(self, candidate: Timed, reference: Timed, samples: int) -> None:
        self.samples = samples
        self.candidate_seconds: list[float] = []
        self.reference_seconds: list[float] = []
        self._candidate, self._reference = candidate, reference
        self._over = 0
        self._start = time.monotonic()

    def setup(self) -> None:
        """What comes before the candidate."""
        if self._reference_first:
            self._time_reference()

    def time_candidate(self) -> float:
        """The timed part of a round; its seconds."""
        self.candidate_seconds.append(self._candidate.run(self._sample))
        return self.candidate_seconds[-1]

    def teardown(self) -> None:
        """What comes after the candidate."""
        if not self._reference_first:
            self._time_reference()
        self._over += 1

    def _time_reference(self) -> None:
        self.reference_seconds.append(self._reference.run(self._sample))

    @property
    def _sample(self) -> int:
        return self._over // 2 % self.samples

    @property
    def _reference_first(self) -> bool:
        quadruple, second = divmod(self._over, 2)
        return quadruple % 2 != second

    def elapsed(self) -> float:
        """The candidate's seconds so far: the clock that pytest-benchmark reads."""
        return math.fsum(self.candidate_seconds)

    @property
    def seconds(self) -> float:
        """Seconds since these rounds were made."""
        return time.monotonic() - self._start

    @property
    def ratios(self) -> list[tuple[int, float]]:
        """Of each quadruple the sample, and the candidate's time over the reference's."""
        pairs = [
            candidate / reference
            for candidate, reference in zip(
                self.candidate_seconds, self.reference_seconds, strict=True
            )
        ]
        return [
            (quadruple % self.samples, math.sqrt(first * second))
            for quadruple, (first, second) in enumerate(zip(pairs[::2], pairs[1::2], strict=True))
        ]

    def by_sample(self) -> list[list[float]]:
        """The ratios of each sample's quadruples."""
        groups: dict[int, list[float]] = defaultdict(list)
        for sample, ratio in self.ratios:
            groups[sample].append(ratio)
        return [groups[sample] for sample in sorted(groups)]


def time_rounds(
    benchmark: Any, rounds: Rounds, looks: Sequence[int], undecided: Callable[[Rounds], bool]
) -> None:
    """Time as many quadruples as the first of ``looks`` says, and up to each further one for as
    long as they are ``undecided`` and it would not take longer than :data:`PATIENCE`.

    ``benchmark`` is pytest-benchmark's fixture, whose timer has to be :meth:`Rounds.elapsed`.
    """
    first, *further = looks
    benchmark.pedantic(
        rounds.time_candidate, setup=rounds.setup, teardown=rounds.teardown, rounds=2 * first
    )
    for count in further:
        if rounds.seconds * count / len(rounds.ratios) > PATIENCE or not undecided(rounds):
            return
        while len(rounds.candidate_seconds) < 2 * count:
            rounds.setup()
            benchmark.stats.update(rounds.time_candidate())
            rounds.teardown()


def timed_samples(run: MethodRun, categories: Collection[str]) -> list[Sample]:
    """Some :data:`SAMPLES` samples of a run, read: evenly spaced in each of ``categories``, or one
    of each of so many categories.

    Of a damaged sample the next one takes the place. Raises :class:`ContractError` if
    there is none.
    """
    by_category: dict[str, list[SampleRef]] = defaultdict(list)
    for ref in run.samples:
        if ref.category in categories:
            by_category[ref.category].append(ref)
    if not by_category:
        raise ContractError(
            f"{run.dataset}: no samples of {', '.join(categories) or 'both methods'}"
        )
    listed = [refs for _, refs in sorted(by_category.items())]
    taken = min(SAMPLES, len(listed))
    chosen: list[Sample] = []
    for refs in (listed[index * len(listed) // taken] for index in range(taken)):
        count = min(math.ceil(SAMPLES / taken), len(refs))
        edges = [index * len(refs) // count for index in range(count + 1)]
        for low, high in pairwise(edges):
            chosen += _first_readable(run, refs[low:high])
    if not chosen:
        raise DataError(f"no sample of {run.dataset} can be read")
    return chosen


def _first_readable(run: MethodRun, refs: Sequence[SampleRef]) -> list[Sample]:
    for ref in refs:
        try:
            return [run.read(ref)]
        except ContractError:
            continue  # the sample's own item says what is damaged
    return []
