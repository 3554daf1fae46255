"""What goes wrong with values that cross the border, and whose fault it is."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

__all__ = ["AnswerError", "ContractError", "DataError", "DeclarationError", "raised_as"]


class ContractError(ValueError):
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
