"""Files of our own: where they are kept, and how they are written."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import platformdirs


def cache_folder() -> Path:
    """Where what can be made again is kept: ``CPAS_CACHE``, or the user's cache; it need not
    exist."""
    named = os.environ.get("CPAS_CACHE")
    return Path(named) if named else platformdirs.user_cache_path("pytest-cpas")


def toml_string(text: str) -> str:
    """Text as a TOML basic string: a JSON string, but for one character that TOML wants escaped.

    A lone surrogate, which no file in UTF-8 can hold, becomes its escape sequence as text.
    """
    text = text.encode("utf-8", "backslashreplace").decode("utf-8")
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


class LinkError(OSError):
    """Something would be written through a link, out of the folder that was named for it."""


def check_no_link(folder: Path, path: Path) -> None:
    """Raise :class:`LinkError` if any part of ``path`` below ``folder`` is a link.

    ``folder`` is what somebody named, and may be one itself; what is below it may come from
    somebody else, and must not lead elsewhere.
    """
    place = folder
    for part in path.relative_to(folder).parts:
        place /= part
        if place.is_symlink() or (hasattr(place, "is_junction") and place.is_junction()):
            raise LinkError(
                f"{place} is a link to {os.readlink(place)}, and nothing is written through a link"
                f" below {folder}; remove it, or name the folder that it leads to"
            )


def write_file(path: Path, content: str | bytes, *, below: Path | None = None) -> None:
    """Write a file as a whole or not at all, even if the process is killed or the machine stops.

    Its folder is made. Text is UTF-8, its line ends as they are; what UTF-8 cannot say (a lone
    surrogate) is written as its escape. Raises OSError, and then leaves what was there as it was;
    of it, :class:`LinkError` if a part of ``path`` below the folder ``below`` is a link.
    """
    if below is not None:
        check_no_link(below, path)
    with replaced(path) as file:
        file.write(_encoded(content))


@contextmanager
def replaced(path: Path) -> Generator[BinaryIO]:
    """A file to write to, open, that takes the place of ``path`` at the end of the block, as
    :func:`write_file`; on an exception it is removed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{secrets.token_hex(8)}.part")
    try:
        with unfinished.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
        sync_folder(path.parent)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


def _encoded(content: str | bytes) -> bytes:
    return content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content


def write_through(path: Path, content: str | bytes) -> None:
    """Write a file that must not be there, and wait until the disk has it; on an error a part of it
    may be there."""
    with path.open("xb") as file:
        file.write(_encoded(content))
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Wait until the disk has the names in a folder, where a folder can be opened for that."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
