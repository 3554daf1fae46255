"""How much a pickle may hold: more than any file of the field, less than a machine has."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from pytest_cpas.types import DataError

#: Largest pickle, bytes.
MAX_FILE = 2**27

#: What a pickle and the texts, arrays and containers in it may take together, bytes.
MAX_MEMORY = 3 * MAX_FILE + 2**20

#: Opcodes that are carried out, and values in what comes out (one that is there twice counts
#: twice). A run on REAL275 in one file has half a million.
MAX_STEPS = 6_000_000

#: Lists, tuples, dicts and arrays in what comes out, on one level. Were all poses of that run lists
#: of lists, they would have 150,000.
MAX_CONTAINERS = 1_000_000

#: Levels of lists, tuples and dicts within each other.
MAX_DEPTH = 64

#: Containers that are begun, one within the other, and not ended. Writers begin two a level.
MAX_MARKS = 256

#: Bytes of one text, digits of one number in decimals, and bytes of one that is binary.
MAX_TEXT = 2**26
MAX_DIGITS = 40
MAX_INTEGER = 16

#: Characters of a key, and elements of a tuple that is one.
MAX_KEY = 4096
MAX_TUPLE_KEY = 16

#: Steps that the keys of all dicts may need which are no text, were they made to collide. A dict of
#: 30,000 numbers stays below. Numbers so large that many share a hash are compared, and tuples part
#: by part: 7,000 and 3,900 stay below.
MAX_COLLISIONS = 500_000_000
_WIDE = 2**60
_WIDE_COSTS = 16
_TUPLE_COSTS = 64


class Damaged(DataError):
    """Bytes that are no pickle, or not all of one."""


class Budget:
    """What is left of the limits while one pickle is read."""

    __slots__ = ("bytes", "collisions")

    def __init__(self, size: int) -> None:
        """For a pickle of ``size`` bytes."""
        self.bytes = MAX_MEMORY - size
        self.collisions = MAX_COLLISIONS

    def take(self, size: int) -> None:
        """Count ``size`` bytes of memory; :class:`DataError` if they are too many."""
        self.bytes -= size
        if self.bytes < 0:
            raise DataError(
                f"its values take more than {MAX_MEMORY} bytes, at most as many are read"
            )

    def add(self, known: dict[Any, Any], values: list[Any]) -> None:
        """Put keys and values, one after the other, into a dict.

        Raises :class:`DataError` for keys that are not plain, or too many.
        """
        keys = values[::2]
        if set(map(type, keys)) <= {str} and max(map(len, keys), default=0) <= MAX_KEY:
            known.update(zip(keys, values[1::2], strict=True))
            return
        for key, value in zip(keys, values[1::2], strict=True):
            known[self._key(key, len(known))] = value

    def members(self, values: Iterable[Any], known: set[Any] | None = None) -> set[Any]:
        """Put ``values`` into a set, ``known`` or a new one; raises as :meth:`add`."""
        found: set[Any] = set() if known is None else known
        for value in values:
            self.take(64)
            found.add(self._key(value, len(found)))
        return found

    def _key(self, key: Any, others: int) -> Any:
        # scalars of numpy compare themselves with what they are not, and may raise then
        plain = key.item() if isinstance(key, np.generic) else key
        if type(plain) is tuple and len(plain) <= MAX_TUPLE_KEY:
            parts = plain = tuple(_plain(part) for part in plain)
            others *= _TUPLE_COSTS
        else:
            parts = (plain,)
            if type(plain) in (int, float) and abs(plain) >= _WIDE:
                others *= _WIDE_COSTS
        for part in parts:
            if type(part) not in _KEYS:
                raise DataError(
                    f"a {type(key).__name__} is a key or in a set; expected text, bytes, numbers,"
                    f" None or tuples of at most {MAX_TUPLE_KEY} of them"
                )
            if type(part) in (str, bytes) and len(part) > MAX_KEY:
                raise DataError(f"a key has {len(part)} characters, at most {MAX_KEY} are read")
        if type(plain) is not str:
            self.collisions -= others
            if self.collisions < 0:
                raise DataError(
                    "it has too many keys that are not text, at most about 30000 numbers or 3900"
                    " tuples in one dict are read"
                )
        return plain


_KEYS = frozenset((str, bytes, int, float, bool, type(None)))


def _plain(part: Any) -> Any:
    return part.item() if isinstance(part, np.generic) else part


#: The numbers that arrays are read of, as numpy names them. Of other sizes they differ from
#: machine to machine.
NUMBER_CODES = ("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8", "c8", "c16")

_TEXTS = frozenset((str, bytes, bytearray, np.str_, np.bytes_))
_NUMBERS = frozenset(np.dtype(code).type for code in NUMBER_CODES)
_LEAVES = _TEXTS | _NUMBERS | {type(None), bool, int, float, complex}
_CONTAINERS = frozenset((list, tuple, dict, set, frozenset, np.ndarray))


def check_values(root: Any) -> None:
    """What was read is made of plain values and arrays, of limited depth and size.

    What is there twice is counted twice, for whoever walks the values meets it twice. Raises
    :class:`DataError`.
    """
    level: dict[int, tuple[Any, int]] = {0: ((root,), 1)}  # containers, and how often each is met
    count = size = 0
    for _ in range(MAX_DEPTH + 2):
        below: dict[int, tuple[Any, int]] = {}
        for container, times in level.values():
            values = _children(container)
            kinds = set(map(type, values))
            if kinds - _LEAVES - _CONTAINERS:
                raise DataError(
                    "a name of numpy, a dtype or an array without content is one of its values;"
                    " expected plain values and arrays"
                )
            count += times * len(values)
            if kinds & _TEXTS:
                size += times * sum(len(value) for value in values if type(value) in _TEXTS)
            if kinds & _CONTAINERS:
                for value in values:
                    if type(value) in _CONTAINERS:
                        _, before = below.get(id(value), (None, 0))
                        below[id(value)] = (value, before + times)
                        size += times * value.nbytes if type(value) is np.ndarray else 0
                        if len(below) > MAX_CONTAINERS:
                            raise DataError(
                                f"it holds more than {MAX_CONTAINERS} lists, tuples, dicts and"
                                " arrays on one level, at most as many are read"
                            )
        if count > MAX_STEPS or size > MAX_MEMORY:
            raise DataError(
                f"it holds more than {MAX_STEPS} values or {MAX_MEMORY} bytes, what it holds twice"
                " counted twice; at most as many are read"
            )
        level = below
        if not level:
            return
    raise DataError(
        f"its values are nested more than {MAX_DEPTH} levels deep, at most as many are read"
    )


def _children(value: Any) -> Any:
    if type(value) is dict:
        return [*value, *value.values()]
    if type(value) is np.ndarray:
        return value.ravel().tolist() if value.dtype.hasobject else ()
    return value
