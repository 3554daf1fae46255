"""Finding and reading the files of a tree; every damage is a :class:`DataError` with a path."""

from __future__ import annotations

import json
import re
from pathlib import Path, PurePosixPath
from typing import Any

from pytest_cpas.types import DataError


def names(folder: Path) -> set[str]:
    """What a folder holds; nothing if there is no such folder."""
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()


def natural(name: str) -> list[int | str]:
    """A sort key that puts scene_2 before scene_10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def regular(path: Path) -> Path:
    """``path`` if it is a file; opening a pipe would wait for ever, a device could do anything."""
    if not path.is_file():
        what = "not a regular file" if path.exists() else "no such file"
        raise DataError(f"{path}: {what}")
    return path


def below(folder: Path, name: object, source: str) -> Path:
    """The path that ``source`` names relative to ``folder``; it must not lead out of it."""
    if not isinstance(name, str) or not name or "\0" in name:
        raise DataError(f"{source}: {name!r}, expected the name of a file below {folder}")
    relative = PurePosixPath(name)
    if relative.is_absolute() or ".." in relative.parts or "\\" in name:
        raise DataError(
            f"{source}: {name!r} leads out of {folder}; expected a path below it, with '/'"
        )
    return folder / relative


def parse_json(path: Path, content: bytes, kind: type = dict) -> Any:
    """The object, or what else of ``kind``, that a JSON file holds."""
    try:
        parsed = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{path}: not readable JSON ({error}); is it truncated? Fetch it again"
        ) from error
    if not isinstance(parsed, kind):
        raise DataError(f"{path}: holds a {type(parsed).__name__}, expected a {kind.__name__}")
    return parsed
