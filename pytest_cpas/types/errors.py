"""What goes wrong with values that cross the border, and whose fault it is."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Generator, Sequence
from contextlib import contextmanager

__all__ = [
    "AnswerError",
    "ContractError",
    "DataError",
    "DeclarationError",
    "ToldError",
    "message_of",
    "raised_as",
    "shortened",
    "shown",
    "some_of",
    "words_of",
]

#: Characters of a message. It may quote what others wrote, and that may be of any length.
LONGEST_MESSAGE = 2000


def some_of(names: Sequence[str]) -> str:
    """The first three names in words, and how many more there are."""
    rest = len(names) - 3
    return ", ".join(names[:3]) + (f" and {rest} more" if rest > 0 else "")


def shortened(text: str, most: int = LONGEST_MESSAGE) -> str:
    """``text``, or its beginning and end, in ``most`` characters (those of a message); at least
    30."""
    if len(text) <= most:
        return text
    left_out = f" ... [{len(text)} characters] ... "
    kept = most - len(left_out)
    return text[: kept - kept // 3] + left_out + text[len(text) - kept // 3 :]


_QUOTED = reprlib.Repr()
_QUOTED.maxstring = _QUOTED.maxother = _LONGEST_QUOTED = 100
_QUOTED.maxlevel = 3


def shown(value: object) -> str:
    """What was seen, as a message quotes it: in a line of about 100 characters at most."""
    try:
        seen = _QUOTED.repr(value)
    except (ValueError, RecursionError):  # an integer of more digits than Python writes
        seen = f"a {type(value).__name__}"
    return shortened(re.sub(r"\s*\n\s*", " ", seen), _LONGEST_QUOTED)


def words_of(error: BaseException) -> str:
    """What was raised, as a message quotes it: its kind, and its message or both ends of it."""
    kind, words = type(error).__name__, message_of(error)
    return shortened(f"{kind}: {words}" if words else kind, LONGEST_MESSAGE // 2)


def message_of(error: BaseException) -> str:
    """The message alone. Whoever wrote the error's class may have it raise another one here."""
    try:
        return str(error)
    except Exception as other:
        return f"its message cannot be told, for that raises {type(other).__name__}"


class ToldError(Exception):
    """An error whose message is for people: of one that is longer than they read, both ends."""

    def __init__(self, *told: object) -> None:
        """``told``: the message, of at most :data:`LONGEST_MESSAGE` characters as it is kept."""
        super().__init__(*(shortened(part) if isinstance(part, str) else part for part in told))


class ContractError(ToldError, ValueError):
    """A value breaks the contract between the harness and a method or a data set.

    Its subclasses say whose value it is. Poses, meshes, cameras, symmetries and metrics serve both
    sides and raise this one; where the side is known, :func:`raised_as` turns it into theirs.
    """


class DataError(ContractError):
    """A data set's sample, truth or file is damaged, or is not what its kind must be."""


class AnswerError(ContractError):
    """A method's answer breaks the contract."""


class DeclarationError(ContractError):
    """What is declared of a method, a metric or known failures is not what it must be."""


@contextmanager
def raised_as(kind: type[ContractError]) -> Generator[None]:
    """Raise every :class:`ContractError` of this block as ``kind``, with its message.

    For where it is known whose value is looked at, whatever the value says itself. Also decorates
    a function.
    """
    try:
        yield
    except ContractError as error:
        if isinstance(error, kind):
            raise
        raise kind(*error.args).with_traceback(error.__traceback__) from error.__cause__
