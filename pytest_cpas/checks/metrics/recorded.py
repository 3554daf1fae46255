"""What is known of an implementation of metrics: recorded, and replayed instead of searched for."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from pytest_cpas.checks.known import KnownFailure, known_failures, record_known
from pytest_cpas.checks.metrics.properties import PROPERTIES
from pytest_cpas.checks.metrics.running import Result, adapter_module
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.types import DeclarationError

__all__ = ["known_of", "record"]


def known_of(subject: str) -> dict[str, KnownFailure]:
    """By property; :class:`DeclarationError` for a file that is damaged."""
    known = known_failures(*_place(subject), "metric", PROPERTIES)
    return {failure.check: failure for failure in known}


def record(subject: str, results: Iterable[Result]) -> tuple[int, Path]:
    """Record what failed; how many that is, and where.

    Raises :class:`DeclarationError` if the file holds what was not recorded.
    """
    known = [
        KnownFailure(
            check=result.property,
            outcome=result.outcome,
            reason=result.message,
            case=result.case,
            snippet=result.snippet,
        )
        for result in results
        if result.outcome not in (Outcome.PASSED, Outcome.NOT_OFFERED)
    ]
    return len(known), record_known(*_place(subject), known)


def _place(subject: str) -> tuple[Path, str]:
    """The folder of the adapter's module, and its name."""
    file = adapter_module(subject).__file__
    if file is None:
        raise DeclarationError(f"metrics {subject!r}: its adapter's module has no file")
    return Path(file).parent, Path(file).stem
