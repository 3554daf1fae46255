"""The names of a tree's files."""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath

from pytest_cpas.types import DataError

#: What systems write beside files that people copy: resource forks, views of folders, thumbnails.
_OF_SYSTEMS = re.compile(r"\._.*|\.DS_Store|Thumbs\.db|desktop\.ini|__MACOSX", re.IGNORECASE)


def names(folder: Path) -> set[str]:
    """What a folder holds, but for what systems write; nothing if there is no such folder.

    Raises :class:`DataError` for a folder that may not be listed.
    """
    try:
        return {name for name in os.listdir(folder) if not _OF_SYSTEMS.fullmatch(name)}
    except (FileNotFoundError, NotADirectoryError):
        return set()
    except (OSError, ValueError) as error:
        raise DataError(f"{folder}: cannot be listed ({error})") from error


def matching(folder: Path, pattern: str) -> list[Path]:
    """The paths in a folder that match a pattern, in order, but for what systems write."""
    return sorted(path for path in folder.glob(pattern) if not _OF_SYSTEMS.fullmatch(path.name))


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
