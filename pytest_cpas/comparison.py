"""The verdict on a run: its table against a golden one, sample by sample.

A table of a single seed allows no flip: a method that is deterministic has none on the platform
where it was recorded. Where ``--cpas-jitter`` saw the seeds disagree, the recorded seeds say how
often a sample is correct, and a run is worse only if its losses are more than their spread
explains (:mod:`pytest_cpas.spread`).

Everything here is pure: tables in, verdicts out.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

from pytest_cpas.evaluation import THRESHOLDS
from pytest_cpas.golden import RunTable, TableSample, differences

#: Samples that a message names before it only counts the rest.
_NAMED = 8

#: Errors that agree to this many significant digits are the same on another machine.
_SAME = 1e-3

#: With this probability a part of the samples shows a change of the size that it states.
CONFIDENCE = 0.95


class Word(Enum):
    """The verdict on one category of a run."""

    MATCHES = "MATCHES"
    AGREES = "AGREES WITH THE PAPER"
    ABOVE = "ABOVE THE PAPER"
    REGRESSED = "REGRESSED"
    IMPROVED = "IMPROVED"
    CHANGED = "CHANGED"
    STALE = "STALE"
    DAMAGED = "DAMAGED"
    NOT_CHECKED = "NOT CHECKED"
    RECORDED = "RECORDED"
    NOT_RECORDED = "NOT RECORDED"


#: Verdicts that pass without reserve.
GOOD = (Word.MATCHES, Word.AGREES, Word.ABOVE, Word.RECORDED)


@dataclass(frozen=True)
class Verdict:
    """The comparison of one category with its golden cells; ``details`` is for people."""

    word: Word
    category: str
    details: str

    @property
    def failed(self) -> bool:
        """Whether it fails the run. (NOT CHECKED fails it under --cpas-require-golden only.)"""
        return self.word not in (*GOOD, Word.NOT_CHECKED)

    def __str__(self) -> str:
        subject = "" if self.category == "all" else f" {self.category}"
        return f"{self.word.value}{subject}: {self.details}"


def compare(golden: RunTable | None, new: RunTable) -> list[Verdict]:
    """Compare a run's table with its golden one; one verdict per category.

    Where the golden table allows for a spread there is one more, of all categories together.
    """
    if golden is None:
        return [
            Verdict(
                Word.NOT_CHECKED,
                "all",
                f"there is no golden table of {new.method} on {new.dataset}; if these results are"
                " right, record them with --snapshot-update",
            )
        ]
    stale = differences(golden.identity, new.identity)
    if stale:
        return [
            Verdict(
                Word.STALE,
                "all",
                f"the golden table was made under other conditions: {'; '.join(stale)}. Restore"
                " them, or record it anew with --snapshot-update",
            )
        ]
    spread = any(sample.repeats for sample in golden.samples.values())
    categories = sorted({*golden.listed, *new.listed})
    pairings = [_Pairing.of(golden, new, [category], category) for category in categories]
    if spread:
        pairings.append(_Pairing.of(golden, new, categories, "all"))
    elsewhere = differences(golden.provenance, new.provenance)
    verdicts = []
    for pairing in pairings:
        verdict = _spread_verdict(...) if spread else _exact_verdict(pairing)
    return verdicts
