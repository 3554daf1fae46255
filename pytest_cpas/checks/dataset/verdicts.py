"""Verdicts of a data set's checks; what is known of it is in :mod:`pytest_cpas.checks.known`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from statistics import median
from typing import TYPE_CHECKING

from pytest_cpas._deprecation import deprecated
from pytest_cpas.checks.dataset import CHECKS, Problem
from pytest_cpas.checks.dataset.facts import Survey
from pytest_cpas.checks.known import KnownFailure, gone
from pytest_cpas.types import Verdict, VerdictWord
from pytest_cpas.types.derived import Part

__all__ = ["DatasetWord", "judge"]

#: So many problems of a check are named.
_NAMED = 10


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


def judge(survey: Survey, check: str, known: Sequence[KnownFailure] = ()) -> Verdict:
    """Run one of the checks on what was measured; the verdict's subject is the check."""
    problems = CHECKS[check](survey)
    not_judged = _fits(survey) if check == "fits" else _not_judged(survey, check)
    if problems is None:
        return Verdict(DatasetWord.NOT_APPLICABLE, check, not_judged)
    known = [fault for fault in known if fault.check == check]
    new = [p for p in problems if not any(_covers(fault, p) for fault in known)]
    happened = [fault for fault in known if any(_covers(fault, p) for p in problems)]
    lines = [str(problem) for problem in new[:_NAMED]]
    if len(new) > _NAMED:
        counts = Counter(problem.model or problem.category for problem in new)
        shares = ", ".join(f"{name} {count}" for name, count in counts.most_common(_NAMED))
        lines.append(f"and {len(new) - _NAMED} more; of all {len(new)}: {shares}")
    lines += [
        f"known fault does not happen any more, take it out: {fault} ({fault.reason})"
        for fault in gone(known, happened, complete=survey.complete)
    ]
    if lines:
        return Verdict(DatasetWord.FAILED, check, "\n".join(lines))
    if problems:
        reasons = "; ".join(fault.reason for fault in happened)
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        return Verdict(DatasetWord.KNOWN, check, f"{problems[0]}{more}. Known: {reasons}")
    return Verdict(DatasetWord.PASSED, check, not_judged)


#: The checks that need meshes.
_OF_MESHES = ("mesh-metric", "mesh-centred", "mesh-closed", "extents", "depth")

#: The part of a sample that a check is about.
_PARTS: dict[str, Part] = {"masks": "mask", "extents": "extents"}


def _fits(survey: Survey) -> str:
    """How well fitted poses fit."""
    errors = [1000 * f.fit_error for f in survey.samples.values() if f.fit_error is not None]
    if not errors:
        return "no pose is fitted" if survey.samples else ""
    return f"off by {median(errors):.1f} mm (median of {len(errors)}), at most {max(errors):.1f} mm"


def _not_judged(survey: Survey, check: str) -> str:
    """Which samples a check does not judge, and why; empty for none."""
    part = _PARTS.get(check)
    left_out = [name for name in survey.samples if part and survey.compares_itself(name, part)]
    if not part or not left_out:
        of_meshes = check in _OF_MESHES and survey.samples and not survey.meshes
        return "no sample has a mesh" if of_meshes else ""
    how = next(
        each.how for each in survey.derived if each.part == part and each.covers(left_out[0])
    )
    some = f"{len(left_out)} of {len(survey.samples)} samples, first {left_out[0]}, "
    whose = some if len(left_out) < len(survey.samples) else ""
    return f"{whose}not judged: {part} made of what it would be held against ({how})"


def _covers(fault: KnownFailure, problem: Problem) -> bool:
    where = {"sample": problem.sample, "model": problem.model, "category": problem.category}
    alike = fault.matches(**where) and fault.says(problem.message)
    return alike and fault.is_no_worse(problem.value)


if not TYPE_CHECKING:  # a type checker would take every name for one that there is

    def __getattr__(name: str) -> object:
        if name == "KnownFault":
            deprecated(f"{__name__}.KnownFault", "pytest_cpas.checks.known.KnownFailure", "0.3")
            return KnownFailure
        if name == "Word":
            deprecated(f"{__name__}.Word", f"{__name__}.DatasetWord", "0.3")
            return DatasetWord
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
