"""The program of a method that answers from another interpreter: both sides of it."""

from __future__ import annotations

import hashlib
from dataclasses import replace

from pytest_cpas.evaluation.program import UNKNOWN, Program
from pytest_cpas.evaluation.surroundings import left_out
from pytest_cpas.remote import OtherSide, RaisedThereError, RemoteMethod, WorkerError
from pytest_cpas.types import Method

__all__ = ["with_other_side"]


def with_other_side(program: Program, method: Method) -> Program:
    """A program with what is known of the other side, if ``method`` has one.

    Its code is unknown if that of the other side is, or if that cannot be asked: what nobody can
    identify is never taken for the same.
    """
    if not isinstance(method, RemoteMethod):
        return program
    try:
        other = method.remote.other_side(left_out())
    except (WorkerError, RaisedThereError):
        other = OtherSide(UNKNOWN, "unknown", {})
    told = f"{program.code} {other.code}"
    code = UNKNOWN if UNKNOWN in (program.code, other.code) else _digest(told)
    return replace(
        program,
        code=code,
        packages=f"{program.packages}; other side: {other.packages}",
        revision="",  # of this side alone
        files={**program.files, **other.files},
    )


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
