"""Writing files."""

from __future__ import annotations

import json
import os
from pathlib import Path


def toml_string(text: str) -> str:
    """Text as a TOML basic string, which a JSON string is."""
    return json.dumps(text, ensure_ascii=False)


def write_text(path: Path, text: str) -> None:
    """Write a file as a whole or not at all."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        unfinished.write_bytes(text.encode("utf-8", "backslashreplace"))
        unfinished.replace(path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise
