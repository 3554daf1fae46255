"""Arrays as pickles write them, recognised and made anew.

No function of numpy is called that a pickle names: a name is an entry of :data:`NAMES` and nothing
more, and what is done with it is compared with what numpy writes. An array is made of a dtype out
of :data:`_SIZES` or of text, a shape, and exactly as many bytes as both say; it is a read-only view
of them.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.reading.pickle_limits import MAX_FILE, NUMBER_CODES, Budget, Damaged
from pytest_cpas.types import DataError


class Name:
    """What a pickle of plain values and arrays may name, and what is made when it is called."""

    __slots__ = ("call", "name")

    def __init__(self, name: str, call: Callable[[tuple[Any, ...], Budget], object]) -> None:
        """``call`` returns None for arguments that nobody writes."""
        self.name = name
        self.call = call


#: Bytes of an item by code, beside those of text and bytes.
_SIZES = {code: int(code[1:]) for code in NUMBER_CODES} | {"O": 8, "O4": 8, "O8": 8}

#: What an array without items may measure in its other dimensions: a mask of no object has as
#: many as the image has pixels.
_MAX_EMPTY = 2**26
_MAX_DIMENSIONS = 32


class Dtype:
    """A dtype as a pickle makes it: its code, then, by BUILD, its byte order."""

    __slots__ = ("code", "kind", "made", "size")

    def __init__(self, code: str) -> None:
        """Raises :class:`DataError` for any but booleans, numbers, text, bytes and objects."""
        size = _SIZES.get(code)
        if size is None and (match := re.fullmatch(r"([SU])([0-9]{1,7})", code)):
            size = int(match[2]) * (4 if match[1] == "U" else 1)
        if size is None:
            raise DataError(
                f"an array or number has the dtype {code[:40]!a}; expected booleans, integers,"
                " floats and complex numbers of at most 64 bits a part, text or bytes. Convert it"
                " and save it again"
            )
        self.code = code
        self.kind = code[0]
        self.size = size
        self.made: np.dtype[Any] | None = None

    def build(self, state: Any) -> None:
        """Take numpy's state: (3, order, None, None, None, size, alignment, flags)."""
        if self.made is not None:
            raise Damaged("a dtype is given a state for the second time")
        if _types(state) != _DTYPE_STATE or state[0] != 3:
            raise DataError(
                "a dtype has fields, a shape, metadata or a state of unknown form; expected plain"
                " numbers or text. Save each field as an array of its own"
            )
        self.made = _dtype_of(self.code, *state[1:2], *state[5:])


_DTYPE_STATE = (int, str, *(type(None),) * 3, int, int, int)


@functools.lru_cache(256)
def _dtype_of(code: str, order: str, size: int, alignment: int, flags: int) -> np.dtype[Any]:
    """The dtype with this code and state, if it has it."""
    kind, width = code[0], int(code[1:] or 8)
    # objects, bytes and what has one byte have no order
    orders = ("|",) if kind in "OS" or (width == 1 and kind != "U") else ("<", ">")
    states = {
        # whether text needs initialisation was said by some versions
        "U": ((4 * width, 4, 8), (4 * width, 4, 0)),
        "S": ((width, 1, 0),),
        "O": ((-1, -1, 63),),
    }.get(kind, ((-1, -1, 0),))
    if order not in orders or (size, alignment, flags) not in states:
        raise Damaged(f"a dtype {code} has a state that no {code} has")
    return np.dtype(object) if kind == "O" else np.dtype(order + code)


class Unfilled:
    """An array that ``_reconstruct`` promised; BUILD fills it."""

    __slots__ = ("array",)

    def __init__(self) -> None:
        self.array: NDArray[Any] | None = None

    def build(self, state: object, budget: Budget) -> NDArray[Any]:
        """The array of the state that numpy writes: (1, shape, dtype, Fortran order, content)."""
        if self.array is not None:
            raise Damaged("an array is given a state for the second time")
        if type(state) is not tuple or len(state) != 5 or not _is(state[0], 1):
            raise Damaged("an array has a state of unknown form")
        _, shape, dtype, fortran, content = state
        if fortran is not False and not _is(fortran, 0, 1):
            raise Damaged("an array is neither in C nor in Fortran order")
        if type(dtype) is Dtype and dtype.kind == "O":
            self.array = _objects(content, dtype, shape, budget)
        else:
            self.array = _array(_content(content, budget), dtype, shape, budget, bool(fortran))
        return self.array


def _reconstruct(arguments: tuple[Any, ...], _: Budget) -> Unfilled | None:
    if len(arguments) == 3 and arguments[0] is _NDARRAY:
        _, shape, code = arguments
        if type(shape) is tuple and len(shape) == 1 and _is(shape[0], 0):
            return Unfilled() if type(code) in _CODES and _CODES[type(code)] == code else None
    return None


_CODES: Mapping[type, object] = {bytes: b"b", str: "b"}


def _dtype(arguments: tuple[Any, ...], _: Budget) -> Dtype | None:
    if (
        len(arguments) == 3
        and type(arguments[0]) is str
        and all(_is(a, 0, 1) for a in arguments[1:])
    ):
        return Dtype(arguments[0])
    return None


def _scalar(arguments: tuple[Any, ...], budget: Budget) -> Any:
    if len(arguments) != 2 or type(arguments[0]) is not Dtype or arguments[0].kind == "O":
        return None
    dtype, content = arguments[0], _content(arguments[1], budget)
    budget.take(dtype.size)
    if dtype.size == 0 and not content:
        return np.str_() if dtype.kind == "U" else np.bytes_()
    return _array(content, dtype, (), budget)[()]


def _from_buffer(arguments: tuple[Any, ...], budget: Budget) -> NDArray[Any] | None:
    if len(arguments) not in (4, 5) or type(arguments[3]) is not str:
        return None
    content, dtype, shape, order = arguments[:4]
    axes = arguments[4] if len(arguments) == 5 else None
    if order in ("C", "F") and axes is None:
        return _array(_content(content, budget), dtype, shape, budget, order == "F")
    if order != "K" or type(axes) is not tuple or not all(type(axis) is int for axis in axes):
        return None
    array = _array(_content(content, budget), dtype, shape, budget)
    return array.transpose(axes) if sorted(axes) == list(range(array.ndim)) else None


def _encode(arguments: tuple[Any, ...], budget: Budget) -> bytes | None:
    if _types(arguments) == (str, str) and arguments[1] in ("latin1", "latin-1"):
        return _content(arguments[0], budget)
    return None


def _bytes(arguments: tuple[Any, ...], _: Budget) -> bytes | None:
    return None if arguments else b""


def _bytearray(arguments: tuple[Any, ...], budget: Budget) -> bytearray | None:
    if _types(arguments) == (bytes,):
        content: bytes | None = arguments[0]
    else:
        content = _encode(arguments, budget) if arguments else b""
    if content is None:
        return None
    budget.take(len(content))
    return bytearray(content)


def _set(arguments: tuple[Any, ...], budget: Budget) -> set[Any] | None:
    return budget.members(arguments[0]) if _types(arguments) == (list,) else None


def _frozenset(arguments: tuple[Any, ...], budget: Budget) -> frozenset[Any] | None:
    return frozenset(budget.members(arguments[0])) if _types(arguments) == (list,) else None


def _complex(arguments: tuple[Any, ...], _: Budget) -> complex | None:
    return complex(*arguments) if _types(arguments) == (float, float) else None


def _types(values: Any) -> tuple[type, ...]:
    return tuple(map(type, values)) if type(values) is tuple else ()


def _is(value: object, *numbers: int) -> bool:
    """``value`` is an integer, or truth value, out of ``numbers``; asks nothing of other things."""
    return type(value) in (int, bool) and value in numbers


def _content(content: Any, budget: Budget) -> bytes:
    """The bytes of an array; from Python 2 they are text of Latin 1."""
    if type(content) is bytes:
        return content
    if type(content) is bytearray:
        budget.take(len(content))
        return bytes(content)
    if type(content) is not str:
        raise Damaged(f"the bytes of an array are a {type(content).__name__}")
    budget.take(len(content))
    try:
        return content.encode("latin1")
    except UnicodeEncodeError:
        raise Damaged("the bytes of an array are text that is not Latin 1") from None


def _count(shape: Any, size: int) -> int:
    """How many items of ``size`` bytes an array of this shape has."""
    if type(shape) is not tuple or len(shape) > _MAX_DIMENSIONS:
        raise Damaged(f"the shape of an array is no tuple of at most {_MAX_DIMENSIONS} numbers")
    count = 1
    for length in shape:
        if type(length) is not int or not 0 <= length <= MAX_FILE:
            raise Damaged("the shape of an array has lengths that are no lengths")
        count *= length
    if not count and math.prod(n for n in shape if n) * max(size, 1) > _MAX_EMPTY:
        raise DataError(
            f"an array without items has the shape {shape}, whose other lengths give more than"
            f" {_MAX_EMPTY}; at most as many are read"
        )
    return count


def _array(
    content: bytes, dtype: Any, shape: Any, budget: Budget, fortran: bool = False
) -> NDArray[Any]:
    if type(dtype) is not Dtype or dtype.made is None or dtype.kind == "O":
        raise Damaged("an array has no dtype, or one of objects and bytes for them")
    count = _count(shape, dtype.size)
    if count * dtype.size != len(content) or dtype.size == 0:
        raise Damaged(
            f"an array of shape {shape} and dtype {dtype.code} needs {count * dtype.size} bytes,"
            f" {len(content)} are there"
        )
    items = np.frombuffer(content, dtype.made)
    if dtype.kind in "bU":
        budget.take(len(content))  # else looking at the same bytes a million times were free
        _check_items(items, dtype)
    if len(shape) == 1:
        return items
    return items.reshape(shape, order="F") if fortran else items.reshape(shape)


def _check_items(items: NDArray[Any], dtype: Dtype) -> None:
    """Truth values are 0 or 1, and text is made of characters; numpy takes whatever it finds."""
    if dtype.kind == "b":
        if items.view(np.uint8).max(initial=0) > 1:
            raise Damaged("an array of truth values has bytes other than 0 and 1")
        return
    codes = items.view(items.dtype.byteorder + "u4")
    if codes.max(initial=0) > 0x10FFFF or ((codes >= 0xD800) & (codes <= 0xDFFF)).any():
        raise Damaged("an array of text has numbers that are no characters")


def _objects(content: Any, dtype: Dtype, shape: Any, budget: Budget) -> NDArray[Any]:
    """An array of values; they are stored row by row in either order."""
    count = _count(shape, 8)
    if dtype.made is None or type(content) is not list or len(content) != count:
        raise Damaged(f"an array of objects of shape {shape} is not given as a list of {count}")
    budget.take(16 * count)
    items = np.empty(count, dtype=object)
    for index, value in enumerate(content):
        items[index] = value
    return items.reshape(shape)


def _nothing(_: tuple[Any, ...], __: Budget) -> None:
    return None


_NDARRAY = Name("ndarray", _nothing)
_RECONSTRUCT = Name("_reconstruct", _reconstruct)
_SCALAR = Name("scalar", _scalar)

#: By module and name, as written by numpy 1.13 to 2.x and Python 2.7 to 3.14.
NAMES = {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): Name("dtype", _dtype),
    ("_codecs", "encode"): Name("encode", _encode),
}
for _core in ("numpy.core", "numpy._core"):
    NAMES[f"{_core}.numeric", "_frombuffer"] = Name("_frombuffer", _from_buffer)
    for _module in ("multiarray", "_multiarray_umath"):  # numpy 1.16.0 named the second
        NAMES[f"{_core}.{_module}", "_reconstruct"] = _RECONSTRUCT
        NAMES[f"{_core}.{_module}", "scalar"] = _SCALAR
for _module in ("__builtin__", "builtins"):
    for _call in (_bytes, _bytearray, _set, _frozenset, _complex):
        _name = _call.__name__.removeprefix("_")
        NAMES[_module, _name] = Name(_name, _call)
