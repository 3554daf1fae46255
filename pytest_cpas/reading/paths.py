"""The names of a tree's files."""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath

from pytest_cpas.types import DataError


def names(folder: Path) -> set[str]:
    """What a folder holds; nothing if there is no such folder.

    Raises :class:`DataError` for a folder that may not be listed.
    """
    try:
        return set(os.listdir(folder))
    except (FileNotFoundError, NotADirectoryError):
        return set()
    except (OSError, ValueError) as error:
        raise DataError(f"{folder}: cannot be listed ({error})") from error


def natural(name: str) -> list[str]:
    """A sort key that puts scene_2 before scene_10."""
    parts = re.split(r"(\d+)", name)
    # of two numbers without leading zeros the longer one is larger; they may be too long for int
    parts[1::2] = (f"{len(digits):06}{digits}" for digits in (p.lstrip("0") for p in parts[1::2]))
    return parts


def below(folder: Path, name: object, source: str) -> Path:
    """The path that ``source`` names relative to ``folder``; it must not lead out of it."""
    if not isinstance(name, str) or not name or "\0" in name:
        raise DataError(f"{source}: {name!r}, expected the name of a file below {folder}")
    if not name.isprintable():
        raise DataError(f"{source}: {name[:80]!r}, expected a name of printable characters")
    relative = PurePosixPath(name)
    if relative.is_absolute() or ".." in relative.parts or "\\" in name:
        raise DataError(
            f"{source}: {name!r} leads out of {folder}; expected a path below it, with '/'"
        )
    return folder / relative
