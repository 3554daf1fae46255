"""What a check can end with."""

from __future__ import annotations

from enum import StrEnum


class Outcome(StrEnum):
    """What checking one property of one implementation can end with."""

    PASSED = "passed"
    VIOLATED = "violated"
    NOT_OFFERED = "n/a"
    RAISED = "raised"
    HUNG = "hung"
    WRONG_TYPE = "wrong type"
    PRINTED = "printed"
    CHANGED_ARGUMENTS = "changed its arguments"
    DREW_GLOBAL_RANDOM = "drew from the global random state"
    HARNESS_ERROR = "harness error"


class Finding(Exception):
    """What is wrong with the implementation, as one of :class:`Outcome`."""

    def __init__(self, outcome: Outcome, message: str) -> None:
        """``message``: one line that says what was seen and what was expected."""
        super().__init__(message)
        self.outcome = outcome
