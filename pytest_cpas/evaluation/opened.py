"""Files that a program has opened, as a results file knows them: by name and digest."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from pytest_cpas.evaluation.surroundings import digest_again, named

__all__ = ["OWN", "differences", "digest_of_opened", "opened_name", "other_names"]

#: In place of a digest: the program has written the file itself.
OWN = "written"


def opened_name(path: Path) -> str:
    """What a file is called: its path, from ``~`` on below that."""
    with suppress(RuntimeError, ValueError):
        return f"~/{path.relative_to(Path.home()).as_posix()}"
    return str(path)


def digest_of_opened(name: str) -> str:
    """A digest of the file that has a name as of :func:`opened_name` here, and now."""
    try:
        return digest_again(Path(name).expanduser(), "")
    except (RuntimeError, ValueError, OSError):
        return "unreadable"


def other_names(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """The files that two programs have read, that were not the same, and that neither has written
    itself."""
    return sorted(
        name
        for name in before.keys() & now.keys()
        if before[name] != now[name] and OWN not in (before[name], now[name])
    )


def differences(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """What to say of :func:`other_names`."""
    others = other_names(before, now)
    return [f"read, and changed since: {named(others)}"] if others else []
