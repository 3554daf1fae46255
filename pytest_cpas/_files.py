"""Files of our own: where they are kept, and how they are written."""

from __future__ import annotations

import json
import os
from pathlib import Path

import platformdirs


def cache_folder() -> Path:
    """Where what can be made again is kept: ``CPAS_CACHE``, or the user's cache; it need not
    exist."""
    named = os.environ.get("CPAS_CACHE")
    return Path(named) if named else platformdirs.user_cache_path("pytest-cpas")


def toml_string(text: str) -> str:
    """Text as a TOML basic string, which a JSON string is."""
    return json.dumps(text, ensure_ascii=False)


def write_text(path: Path, text: str) -> None:
    """Write a file as a whole or not at all; what UTF-8 does not have is written as an escape."""
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file as a whole or not at all."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        unfinished.write_bytes(content)
        unfinished.replace(path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise
