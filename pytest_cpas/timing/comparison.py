"""What the rounds of a method and its reference say about a slow-down."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pytest_cpas.timing.intervals import LOOK_CONFIDENCE, Interval, median_interval
from pytest_cpas.timing.measuring import Rounds
from pytest_cpas.timing.records import SpeedRecord, incomparable, read_record
from pytest_cpas.timing.verdicts import SpeedWord, judge
from pytest_cpas.types import Verdict


class Comparison(ABC):
    """With what the time of the rounds is compared, and which slow-down is too much, if any."""

    limit: float | None

    @abstractmethod
    def slowdown(self, rounds: Rounds) -> Interval | None:
        """How many times as long it takes; None if that is not known."""

    @abstractmethod
    def reference(self) -> str:
        """The time that it is compared with, as a message says it; or why there is none."""

    def verdict(self, rounds: Rounds) -> Verdict:
        """On all rounds so far."""
        return judge(self.slowdown(rounds), self.reference(), self.limit, len(rounds.ratios))

    def undecided(self, rounds: Rounds) -> bool:
        """Whether further rounds may bring a verdict."""
        return self.verdict(rounds).word is SpeedWord.UNDECIDED


@dataclass(frozen=True)
class WithRival(Comparison):
    """With another method, or revision, that was timed in turns."""

    name: str
    limit: float | None

    def slowdown(self, rounds: Rounds) -> Interval:
        """The ratio of the two."""
        return median_interval([ratio for _, ratio in rounds.ratios], LOOK_CONFIDENCE)

    def reference(self) -> str:
        """By name."""
        return f"the time of {self.name}"


@dataclass(frozen=True)
class WithRecord(Comparison):
    """With the recorded ratio to the calibration kernel; ``record`` is None if there is none for
    these samples (by ``names``), as ``why_not`` says."""

    names: Sequence[str]
    record: SpeedRecord | None
    why_not: str
    limit: float | None

    @classmethod
    def of(
        cls, path: Path, identity: Mapping[str, str], names: Sequence[str], limit: float | None
    ) -> WithRecord:
        """With what the file ``path`` holds; :class:`pytest_cpas.timing.records.RecordError` if it
        is damaged."""
        record = read_record(path)
        advice = "record it with --cpas-benchmark --snapshot-update"
        if record is None:
            others = sorted(other.stem for other in path.parent.glob("*.toml"))
            seen = f"only on {', '.join(others)}" if others else "on no machine"
            why_not = f"the ratio is recorded {seen}; for this one, {path.stem}, {advice}"
        else:
            why_not = incomparable(record, identity, names)
            if why_not:
                why_not = (
                    f"the ratio was recorded under other conditions: {why_not}. Restore them, or"
                    f" {advice}"
                )
        return cls(names, None if why_not else record, why_not, limit)

    def slowdown(self, rounds: Rounds) -> Interval | None:
        """The ratio over the recorded one."""
        if self.record is None:
            return None
        return self.record.slowdown([(self.names[index], ratio) for index, ratio in rounds.ratios])

    def reference(self) -> str:
        """Relative to the kernel, as everything here."""
        return self.why_not or "the recorded time, relative to the calibration kernel"
