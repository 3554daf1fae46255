"""Known violations of an implementation, as data beside its adapter: ``NAME.violations.toml``.

Each is replayed instead of searched for, and must still happen: strict expectations.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pytest_cpas._files import write_file
from pytest_cpas.checks.metrics.running import Result, adapter_module
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.types import DeclarationError

__all__ = ["Expectation", "expectations_file", "read_expectations", "write_expectations"]


@dataclass(frozen=True)
class Expectation:
    """That a property fails with ``outcome`` for ``case`` (JSON); ``snippet`` shows the calls."""

    property: str
    outcome: Outcome
    message: str
    case: str
    snippet: str


def expectations_file(name: str) -> Path:
    """Where the known violations of a subject are: beside the module of its adapter."""
    file = adapter_module(name).__file__
    if file is None:
        raise DeclarationError(f"metrics {name!r}: its adapter's module has no file")
    return Path(file).with_suffix(".violations.toml")


def read_expectations(path: Path) -> dict[str, Expectation]:
    """By property; empty if there is no file. :class:`DeclarationError` if it is damaged."""
    if not path.is_file():
        return {}
    try:
        entries = tomllib.loads(path.read_text(encoding="utf-8")).get("violation", [])
        read = [Expectation(**{**entry, "outcome": Outcome(entry["outcome"])}) for entry in entries]
    except (tomllib.TOMLDecodeError, TypeError, KeyError, ValueError, AttributeError) as error:
        raise DeclarationError(
            f"{path}: not a list of violations ({error}); record it anew with --snapshot-update"
        ) from error
    return {entry.property: entry for entry in read}


def write_expectations(path: Path, results: Iterable[Result]) -> int:
    """Record what failed; returns how many. The file is removed if nothing did."""
    failed = [r for r in results if r.outcome not in (Outcome.PASSED, Outcome.NOT_OFFERED)]
    if not failed:
        path.unlink(missing_ok=True)
        return 0
    parts = ["# Recorded by pytest --cpas-metrics NAME --snapshot-update\n"]
    for result in failed:
        parts.append("[[violation]]")
        parts.append(f"property = {_text(result.property)}")
        parts.append(f"outcome = {_text(result.outcome.value)}")
        parts.append(f"message = {_text(result.message)}")
        parts.append(f"case = {_text(result.case)}")
        parts.append(f"snippet = {_text(result.snippet)}\n")
    write_file(path, "\n".join(parts))
    return len(failed)


def _text(text: str) -> str:
    """A TOML string: literal where possible."""
    if "\n" in text and "'''" not in text:
        return f"'''\n{text}'''"
    if "'" not in text and text.isprintable():
        return f"'{text}'"
    escaped = "".join(
        char if char.isprintable() and char not in '"\\' else f"\\u{ord(char):04x}" for char in text
    )
    return f'"{escaped}"'
