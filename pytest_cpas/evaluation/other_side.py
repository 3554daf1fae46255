"""The program of a method that answers from another interpreter: both sides of it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection
from dataclasses import replace

from pytest_cpas.evaluation.program import UNKNOWN, Program
from pytest_cpas.evaluation.surroundings import left_out
from pytest_cpas.remote import OtherSide, RaisedThereError, RemoteMethod, WorkerError
from pytest_cpas.types import Method

__all__ = ["digests_there", "heard_there", "is_there", "parts_here", "with_other_side"]

#: How the name of a file begins that was read on the other side.
_THERE = "other side: "


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


def parts_here(
    method: Method, made_by: Callable[..., object]
) -> list[type | Callable[..., object]]:
    """What the program of a method is looked for by: its class, and what was called for it. Of all
    that have another side, this one is the same."""
    if isinstance(method, RemoteMethod):
        return [RemoteMethod]
    parts: list[type | Callable[..., object]] = [type(method), made_by]
    return [*dict.fromkeys(parts)]


def heard_there(method: Method, since: int) -> list[tuple[str, str]]:
    """Name and digest of each file that ``method`` has read on its other side, if it has one,
    behind the first ``since``."""
    if not isinstance(method, RemoteMethod):
        return []
    return [(f"{_THERE}{path}", digest) for path, digest in method.remote.heard(since)]


def is_there(name: str) -> bool:
    """Whether a file is one of the other side, by its name."""
    return name.startswith(_THERE)


def digests_there(method: Method, names: Collection[str]) -> dict[str, str]:
    """Digests of files of the other side as they are now, by their names; of none that cannot be
    asked for."""
    if not isinstance(method, RemoteMethod) or not names:
        return dict.fromkeys(names, UNKNOWN)
    try:
        now = method.remote.digests([name.removeprefix(_THERE) for name in names])
    except (WorkerError, RaisedThereError):
        now = {}
    return {name: now.get(name.removeprefix(_THERE), UNKNOWN) for name in names}


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
