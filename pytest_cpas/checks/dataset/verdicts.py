"""Verdicts of a data set's checks; known faults of published data are data: ``NAME.known.toml``.

::

    [[fault]]
    check = "depth"                    # one of the checks
    model = "can_arizona_tea_norm"     # optional, as are sample and category: patterns (* and ?)
    reason = "why it is so, and how it is known"

A known fault is reported and does not fail the run. It must happen: an entry that a complete run
does not come across is an error.
"""

from __future__ import annotations

import inspect
import tomllib
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from pytest_cpas.checks.dataset import CHECKS, Problem
from pytest_cpas.checks.dataset.facts import Survey
from pytest_cpas.types import Dataset, DeclarationError, Verdict, VerdictWord

__all__ = ["DatasetWord", "KnownFault", "judge", "known_faults_file", "read_known_faults"]

#: So many problems of a check are named.
_NAMED = 10


@dataclass(frozen=True)
class KnownFault:
    """A fault that is known: problems of ``check`` that match all three patterns."""

    check: str
    reason: str
    sample: str = "*"
    model: str = "*"
    category: str = "*"

    def __post_init__(self) -> None:
        if self.check not in CHECKS:
            raise ValueError(f"check {self.check!r}, expected one of {', '.join(CHECKS)}")
        if not self.reason.strip():
            raise ValueError(f"check {self.check!r}: no reason is given")

    def covers(self, problem: Problem) -> bool:
        """Whether a problem of this fault's check is the fault."""
        return all(
            fnmatchcase(getattr(problem, key), getattr(self, key))
            for key in ("sample", "model", "category")
        )

    def __str__(self) -> str:
        patterns = [f"{k} {v}" for k, v in asdict(self).items() if v != "*"][2:]
        return " ".join([self.check, *patterns])


def known_faults_file(dataset: Dataset) -> Path:
    """Where the known faults of a data set are: beside the module of its class."""
    return Path(inspect.getfile(type(dataset))).with_name(f"{dataset.name}.known.toml")


def read_known_faults(path: Path) -> list[KnownFault]:
    """The entries of a file; :class:`DeclarationError` if it is damaged or not there."""
    try:
        entries = tomllib.loads(path.read_text(encoding="utf-8")).get("fault", [])
        return [KnownFault(**entry) for entry in entries]
    except (OSError, TypeError, ValueError, AttributeError) as error:
        raise DeclarationError(
            f"{path}: not a list of known faults ({error}); expected tables [[fault]] with check,"
            " reason and, as wanted, sample, model and category"
        ) from error


class DatasetWord(VerdictWord):
    """The verdict of a check."""

    #: No problem was found.
    PASSED = "passed", "passed"
    #: A problem that is not known, or a known one that no longer happens: fails the run.
    FAILED = "FAILED", "failed"
    #: All problems that were found are known faults (pytest's xfailed).
    KNOWN = "known", "skipped"
    #: There is nothing that the check could judge (pytest's skipped).
    NOT_APPLICABLE = "n/a", "skipped"


def judge(survey: Survey, check: str, known: Sequence[KnownFault] = ()) -> Verdict:
    """Run one of the checks on what was measured; the verdict's subject is the check."""
    problems = CHECKS[check](survey)
    if problems is None:
        return Verdict(DatasetWord.NOT_APPLICABLE, check)
    known = [fault for fault in known if fault.check == check]
    new = [p for p in problems if not any(fault.covers(p) for fault in known)]
    happened = [fault for fault in known if any(fault.covers(p) for p in problems)]
    lines = [str(problem) for problem in new[:_NAMED]]
    if len(new) > _NAMED:
        counts = Counter(problem.model or problem.category for problem in new)
        shares = ", ".join(f"{name} {count}" for name, count in counts.most_common(_NAMED))
        lines.append(f"and {len(new) - _NAMED} more; of all {len(new)}: {shares}")
    if survey.complete:
        lines += [
            f"known fault does not happen any more, take it out: {fault} ({fault.reason})"
            for fault in known
            if fault not in happened
        ]
    if lines:
        return Verdict(DatasetWord.FAILED, check, "\n".join(lines))
    if problems:
        reasons = "; ".join(fault.reason for fault in happened)
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        return Verdict(DatasetWord.KNOWN, check, f"{problems[0]}{more}. Known: {reasons}")
    return Verdict(DatasetWord.PASSED, check)
