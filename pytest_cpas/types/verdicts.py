"""Verdicts: what judging a run, a method's speed or a data set comes to.

One type for all of them; each kind has its own words (:class:`pytest_cpas.golden.Word` for runs).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from pytest_cpas._deprecation import deprecated
from pytest_cpas.types.samples import ALL

__all__ = ["ItemOutcome", "Required", "Verdict", "VerdictWord"]

#: What a test item ends with, a verdict, a run or a session. skipped: a verdict could not be given,
#: and was not required.
ItemOutcome = Literal["failed", "skipped", "passed"]

#: ``--cpas-require-golden``: not given, given, or with ``=strict``.
Required = Literal[False, True, "strict"]


class VerdictWord(StrEnum):
    """A kind of verdict: its members are ``NAME = text, outcome``.

    ``outcome`` is what the verdict ends with as a test item; a second one, if given, what it ends
    with under ``--cpas-require-golden``, and a third under ``--cpas-require-golden=strict``.
    """

    _outcomes: dict[Required, ItemOutcome]

    def __new__(
        cls,
        text: str,
        outcome: ItemOutcome,
        required: ItemOutcome | None = None,
        strict: ItemOutcome | None = None,
    ) -> VerdictWord:
        """A member."""
        word = str.__new__(cls, text)
        word._value_ = text
        required = required or outcome
        word._outcomes = {False: outcome, True: required, "strict": strict or required}
        return word

    def outcome(self, require_golden: Required) -> ItemOutcome:
        """As what a test item would end; ``require_golden``: what could not be judged fails,
        with ``"strict"`` what is doubtful as well."""
        return self._outcomes[require_golden]


@dataclass(frozen=True)
class Verdict:
    """A word on a subject, and why.

    ``subject``: the category or the check that is judged, "all" for everything. ``details``: for
    people. ``limit``: of a verdict on speed, the slow-down that is too much,
    a factor above 1, if one was given.
    """

    word: VerdictWord
    subject: str
    details: str = ""
    limit: float | None = None

    @property
    def category(self) -> str:
        """The subject of a verdict on a run: one of its categories, or "all"."""
        return self.subject

    @property
    def check(self) -> str:
        """Deprecated: the subject of a verdict on a data set."""
        deprecated("Verdict.check", "Verdict.subject", "0.3")
        return self.subject

    @property
    def message(self) -> str:
        """Deprecated: the details of a verdict on a data set."""
        deprecated("Verdict.message", "Verdict.details", "0.3")
        return self.details

    @property
    def passed(self) -> bool:
        """Whether it passes without reserve."""
        return self.word.outcome(require_golden=False) == "passed"

    @property
    def failed(self) -> bool:
        """Whether it fails the run. (NOT CHECKED fails it under --cpas-require-golden only.)"""
        return self.word.outcome(require_golden=False) == "failed"

    def outcome(self, require_golden: Required) -> ItemOutcome:
        """As what a test item would end; see :meth:`VerdictWord.outcome`."""
        return self.word.outcome(require_golden)

    def __str__(self) -> str:
        subject = "" if self.subject == ALL else f" {self.subject}"
        return f"{self.word.value}{subject}: {self.details}"
