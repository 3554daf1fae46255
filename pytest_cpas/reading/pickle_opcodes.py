"""The opcodes of pickles, carried out so that values are made here and nothing of a file is run.

All opcodes of protocols 0 to 5 are carried out as ``pickletools`` documents them. A pickle can name
a function and have it called; here a name is looked up in a table of those that arrays need, is
never imported, and what is done with it is recognised (:mod:`pytest_cpas.reading.pickle_arrays`).
"""

from __future__ import annotations

import codecs
import re
import struct
from collections.abc import Callable
from typing import Any

from pytest_cpas.reading.pickle_arrays import Dtype, Name, Unfilled
from pytest_cpas.reading.pickle_limits import (
    MAX_DIGITS,
    MAX_INTEGER,
    MAX_MARKS,
    MAX_TEXT,
    Damaged,
)
from pytest_cpas.reading.pickle_machine import Machine
from pytest_cpas.types import DataError

_MAX_PROTOCOL = 5

Opcode = Callable[[Machine], None]
#: What each byte does; nothing but STOP, which ends the loop, and bytes that are no opcode.
OPCODES: list[Opcode | None] = [None] * 256


def _opcode(code: bytes) -> Callable[[Opcode], Opcode]:
    def register(function: Opcode) -> Opcode:
        OPCODES[code[0]] = function
        return function

    return register


def _constant(code: bytes, value: object) -> None:
    OPCODES[code[0]] = lambda machine: machine.stack.append(value)


_constant(b"N", None)
_constant(b"\x88", True)
_constant(b"\x89", False)
_constant(b")", ())


def _sized(code: bytes, size: int, push: Callable[[Machine, int], None]) -> None:
    """An opcode that a number of ``size`` bytes follows: a value, a length or a place."""

    @_opcode(code)
    def carry_out(machine: Machine) -> None:
        push(machine, int.from_bytes(machine.take(size), "little"))


def _push(machine: Machine, number: int) -> None:
    machine.stack.append(number)


_sized(b"K", 1, _push)
_sized(b"M", 2, _push)


@_opcode(b"J")
def _binint(machine: Machine) -> None:
    machine.stack.append(int.from_bytes(machine.take(4), "little", signed=True))


def _long(machine: Machine, size: int) -> None:
    if size > MAX_INTEGER:
        raise DataError(f"an integer has {size} bytes, at most {MAX_INTEGER} are read")
    machine.stack.append(int.from_bytes(machine.take(size), "little", signed=True))


_sized(b"\x8a", 1, _long)
_sized(b"\x8b", 4, _long)


@_opcode(b"I")
@_opcode(b"L")
def _decimal(machine: Machine) -> None:
    text = machine.line(MAX_DIGITS + 2)
    if text in (b"00", b"01"):
        machine.stack.append(text == b"01")
    elif re.fullmatch(rb"-?[0-9]{1,%d}L?" % MAX_DIGITS, text):
        machine.stack.append(int(text.removesuffix(b"L")))
    else:
        raise Damaged(f"{text!r} is no integer")


@_opcode(b"F")
def _float(machine: Machine) -> None:
    text = machine.line(MAX_DIGITS)
    if not re.fullmatch(rb"-?(?:inf|nan|[0-9]+\.?[0-9]*(?:e[+-]?[0-9]+)?)", text):
        raise Damaged(f"{text!r} is no number")
    machine.stack.append(float(text))


@_opcode(b"G")
def _binfloat(machine: Machine) -> None:
    machine.stack.append(struct.unpack(">d", machine.take(8))[0])


#: As Python 2 writes bytes; ``escape_decode`` would warn of other escapes.
_ESCAPED = re.compile(rb"(?:[^\\]++|\\x[0-9a-fA-F]{2}|\\[\\'\"nrt])*+")


@_opcode(b"S")
def _string(machine: Machine) -> None:
    quoted = machine.line(MAX_TEXT)
    if len(quoted) < 2 or quoted[:1] not in (b"'", b'"') or quoted[-1:] != quoted[:1]:
        raise Damaged("a text has no quotes around it")
    if not _ESCAPED.fullmatch(quoted, 1, len(quoted) - 1):
        raise Damaged("a text has a backslash that stands for nothing")
    machine.push_text(codecs.escape_decode(quoted[1:-1])[0], "latin1")


@_opcode(b"V")
def _unicode(machine: Machine) -> None:
    machine.push_text(machine.line(MAX_TEXT), "raw-unicode-escape")


def _utf8(machine: Machine, size: int) -> None:
    machine.push_text(machine.take(size), "utf-8")


def _latin1(machine: Machine, size: int) -> None:
    # the bytes of Python 2: text for whoever asks for a key, an array takes them back
    machine.push_text(machine.take(size), "latin1")


def _binary(machine: Machine, size: int) -> None:
    machine.stack.append(machine.payload(size))


def _bytearray(machine: Machine, size: int) -> None:
    machine.stack.append(bytearray(machine.payload(size)))


for _code, _size, _function in (
    (b"X", 4, _utf8),
    (b"\x8c", 1, _utf8),
    (b"\x8d", 8, _utf8),
    (b"T", 4, _latin1),
    (b"U", 1, _latin1),
    (b"B", 4, _binary),
    (b"C", 1, _binary),
    (b"\x8e", 8, _binary),
    (b"\x96", 8, _bytearray),
):
    _sized(_code, _size, _function)


@_opcode(b"(")
def _mark(machine: Machine) -> None:
    if len(machine.marked) >= MAX_MARKS:
        raise DataError(f"its values are nested too deep: {MAX_MARKS} are begun and not ended")
    machine.marked.append(machine.stack)
    machine.stack = []


@_opcode(b"1")
def _pop_mark(machine: Machine) -> None:
    machine.pop_mark()


@_opcode(b"0")
def _pop(machine: Machine) -> None:
    machine.pop()


@_opcode(b"2")
def _dup(machine: Machine) -> None:
    value = machine.pop()
    machine.stack += [value, value]


@_opcode(b"t")
def _tuple(machine: Machine) -> None:
    machine.push_container(tuple(machine.pop_mark()))


def _short_tuple(code: bytes, size: int) -> None:
    @_opcode(code)
    def push(machine: Machine) -> None:
        values = [machine.pop() for _ in range(size)]
        machine.push_container(tuple(values[::-1]))


for _size, _code in enumerate((b"\x85", b"\x86", b"\x87"), start=1):
    _short_tuple(_code, _size)


@_opcode(b"]")
def _empty_list(machine: Machine) -> None:
    machine.push_container([])


@_opcode(b"l")
def _list(machine: Machine) -> None:
    machine.push_container(machine.pop_mark())


@_opcode(b"a")
def _append(machine: Machine) -> None:
    value = machine.pop()
    machine.top(list, "a value is put into a list").append(value)


@_opcode(b"e")
def _appends(machine: Machine) -> None:
    values = machine.pop_mark()
    machine.top(list, "values are put into a list").extend(values)


@_opcode(b"}")
def _empty_dict(machine: Machine) -> None:
    machine.push_container({})


@_opcode(b"d")
def _dict(machine: Machine) -> None:
    values = machine.pop_mark()
    machine.push_container({})
    _add(machine, values)


@_opcode(b"s")
def _setitem(machine: Machine) -> None:
    value, key = machine.pop_two()
    _add(machine, [key, value])


@_opcode(b"u")
def _setitems(machine: Machine) -> None:
    _add(machine, machine.pop_mark())


def _add(machine: Machine, values: list[Any]) -> None:
    if len(values) % 2:
        raise Damaged("a dict is given a key without a value")
    known = machine.top(dict, "keys and values are put into a dict")
    machine.budget.add(known, values)


@_opcode(b"\x8f")
def _empty_set(machine: Machine) -> None:
    machine.push_container(set())


@_opcode(b"\x90")
def _additems(machine: Machine) -> None:
    values = machine.pop_mark()
    machine.budget.members(values, machine.top(set, "values are put into a set"))


@_opcode(b"\x91")
def _frozenset(machine: Machine) -> None:
    machine.push_container(frozenset(machine.budget.members(machine.pop_mark())))


for _code, _size in ((b"q", 1), (b"r", 4)):
    _sized(_code, _size, Machine.remember)
for _code, _size in ((b"h", 1), (b"j", 4)):
    _sized(_code, _size, Machine.recall)


@_opcode(b"\x94")
def _memoize(machine: Machine) -> None:
    machine.remember(len(machine.memo))


@_opcode(b"p")
def _put(machine: Machine) -> None:
    machine.remember(_index(machine))


@_opcode(b"g")
def _get(machine: Machine) -> None:
    machine.recall(_index(machine))


def _index(machine: Machine) -> int:
    text = machine.line(10)
    if not text.isdigit():
        raise Damaged(f"{text!r} is no place in the memo")
    return int(text)


@_opcode(b"c")
def _global(machine: Machine) -> None:
    module, name = (machine.line(200).decode("latin1") for _ in range(2))
    machine.stack.append(machine.name(module, name))


@_opcode(b"\x93")
def _stack_global(machine: Machine) -> None:
    name, module = machine.pop_two()
    if type(name) is not str or type(module) is not str:
        raise Damaged("what is named is not given as two texts")
    machine.stack.append(machine.name(module, name))


@_opcode(b"R")
def _reduce(machine: Machine) -> None:
    arguments, function = machine.pop_two()
    if type(function) is not Name:
        machine.refuse(f"the pickle calls a {type(function).__name__}")
    made = function.call(arguments, machine.budget) if type(arguments) is tuple else None
    if made is None:
        raise Damaged(f"{function.name} is called with what nobody calls it with")
    machine.push_container(made)


@_opcode(b"b")
def build(machine: Machine) -> None:
    """Give what arrays are made of its state; anything else is refused."""
    state, target = machine.pop_two()
    if type(target) is Dtype:
        target.build(state)
        machine.stack.append(target)
    elif type(target) is Unfilled:
        machine.stack.append(target.build(state, machine.budget))
    else:
        machine.refuse(f"the pickle sets the state of a {type(target).__name__}")


@_opcode(b"i")
def _inst(machine: Machine) -> None:
    module, name = (machine.line(200).decode("latin1") for _ in range(2))
    machine.name(module, name)
    machine.refuse(f"the pickle makes an object of the class {module}.{name}")


def _refused(code: bytes, seen: str) -> None:
    OPCODES[code[0]] = lambda machine: machine.refuse(f"the pickle {seen}")


for _code in (b"o", b"\x81", b"\x92"):
    _refused(_code, "makes an object of a class")
for _code in (b"\x82", b"\x83", b"\x84"):
    _refused(_code, "names something by a number of the registry of Python's copyreg")
for _code in (b"P", b"Q", b"\x97", b"\x98"):
    _refused(_code, "refers to something that is not in it")


def _proto(machine: Machine, protocol: int) -> None:
    if protocol > _MAX_PROTOCOL:
        raise DataError(f"it is of protocol {protocol}, at most {_MAX_PROTOCOL} is read")


def _frame(machine: Machine, size: int) -> None:
    if machine.next + size > len(machine.content):
        raise Damaged(f"{size} bytes should follow, {len(machine.content) - machine.next} do")


_sized(b"\x80", 1, _proto)
_sized(b"\x95", 8, _frame)
