"""What pytest represents of an error, as terminal, JUnit and other reporters may show it."""

from __future__ import annotations

from typing import Any

from pytest_cpas.reading.text import terminal_lines


def shown_parts(value: Any) -> Any:
    """A representation of pytest's with every text in it escaped; trees of them are changed."""
    if isinstance(value, str):
        return terminal_lines(value)
    if isinstance(value, list | tuple):
        return type(value)(map(shown_parts, value))
    if hasattr(value, "toterminal"):
        for name, part in vars(value).items():
            setattr(value, name, shown_parts(part))
    return value
