"""Names that become folders, files and words of a table."""

from __future__ import annotations

import re

from pytest_cpas.types.errors import ContractError, shown

__all__ = ["checked_name", "checked_text"]

#: Longest name: with what is added to it, a name of a file may have 255 bytes.
_LONGEST = 150

#: Longest id of a sample, or name of a category, a scene or a model.
_LONGEST_TEXT = 500


def checked_name(kind: str, name: object) -> str:
    """``name`` if it can be a folder's; :class:`ContractError` that says what it should be.

    ``kind``: what has the name, such as "method", for the message.
    """
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._+-]*", name):
        raise ContractError(
            f"{kind} {shown(name)}: a name becomes a folder of golden tables; expected letters,"
            " digits, '.', '_', '+' and '-', a letter or digit first"
        )
    if len(name) > _LONGEST:
        raise ContractError(f"{kind} {shown(name)}: {len(name)} characters, at most {_LONGEST}")
    return name


def checked_text(kind: str, text: object) -> str:
    """``text`` if it can stand in one line of a table; :class:`ContractError` if not."""
    if not isinstance(text, str) or not text.isprintable() or len(text) > _LONGEST_TEXT:
        raise ContractError(
            f"{kind} {shown(text)}: expected at most {_LONGEST_TEXT} printable characters"
        )
    return text
