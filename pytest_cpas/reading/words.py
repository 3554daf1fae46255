"""Words of texts that stand for numbers."""

from __future__ import annotations

import math
import re

__all__ = ["decimal"]

#: Python's float takes more: blanks, underscores, digits of any script, "infinity".
_DECIMAL = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")

#: Characters of a number.
_LONGEST = 400


def decimal(text: str) -> float | None:
    """The finite number that ``text`` is, in decimal digits of ASCII; None for any other text."""
    if len(text) > _LONGEST or not _DECIMAL.fullmatch(text):
        return None
    number = float(text)
    return number if math.isfinite(number) else None
