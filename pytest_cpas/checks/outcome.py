"""What a check can end with."""

from __future__ import annotations

from enum import StrEnum


class Outcome(StrEnum):
    """What checking one property of one implementation can end with."""

    #: No counterexample was found.
    PASSED = "passed"
    #: A wrong value.
    VIOLATED = "violated"
    #: Not offered, or not expressible under what is declared.
    NOT_OFFERED = "n/a"
    #: An exception for valid input.
    RAISED = "raised"
    #: No value within the time that a property has.
    HUNG = "hung"
    #: Something else than a number, or than a truth value.
    WRONG_TYPE = "wrong type"
    #: It wrote to the standard streams.
    PRINTED = "printed"
    #: An array that was passed is not the same after the call.
    CHANGED_ARGUMENTS = "changed its arguments"
    #: It drew from the global random generators, or seeded them.
    DREW_GLOBAL_RANDOM = "drew from the global random state"
    #: A mistake of the check itself.
    HARNESS_ERROR = "harness error"


class Finding(Exception):
    """What is wrong with the implementation, as one of :class:`Outcome`."""

    def __init__(self, outcome: Outcome, message: str) -> None:
        """``message``: one line that says what was seen and what was expected."""
        super().__init__(message)
        self.outcome = outcome
