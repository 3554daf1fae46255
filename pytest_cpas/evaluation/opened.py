"""Files that a program has opened, as a results file knows them: by name and digest."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from pytest_cpas.evaluation.surroundings import digest_again, named

__all__ = ["differences", "digest_of_opened", "opened_name"]


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


def differences(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """What to say of the files that two programs have read, and that were not the same."""
    others = sorted(name for name in before.keys() & now.keys() if before[name] != now[name])
    return [f"read, and changed since: {named(others)}"] if others else []
