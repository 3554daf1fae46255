"""Carrying out a pickle, opcode by opcode, within its limits."""

from __future__ import annotations

import struct
from collections.abc import Collection, Sequence
from typing import Any

from pytest_cpas.reading.pickle_arrays import Unfilled
from pytest_cpas.reading.pickle_limits import MAX_MARKS, MAX_STEPS, Damaged, check_values
from pytest_cpas.reading.pickle_machine import Machine
from pytest_cpas.reading.pickle_opcodes import OPCODES, Opcode
from pytest_cpas.reading.pickle_records import RECORD_OPCODES, RecordMachine
from pytest_cpas.types import DataError


def unpickle(content: bytes, classes: Collection[str] = ()) -> Any:
    """The value that a pickle holds; :class:`DataError` says at which byte what is wrong.

    ``classes``: those, ``module.name``, whose objects it may hold, which become dicts.
    """
    machine = RecordMachine(content, classes) if classes else Machine(content)
    try:
        value = carried_out(machine, RECORD_OPCODES if classes else OPCODES)
        if machine.next != len(content):
            raise DataError(
                f"it ends, and {len(content) - machine.next} bytes follow; expected one pickle in"
                " the file"
            )
        check_values(value)
        return value
    except Damaged as error:
        raise DataError(
            f"not a readable pickle: at byte {machine.at}, {error}; is the file damaged? Fetch it"
            " again"
        ) from None
    except DataError as error:
        raise DataError(f"at byte {machine.at}, {error}") from None


def carried_out(machine: Machine, opcodes: Sequence[Opcode | None]) -> Any:
    """The value of the pickle that begins at ``machine.next``, which is where it ends afterwards.

    What arrays and long lists are mostly made of is done here, for speed, if all that it takes is
    there; the table of opcodes does the rest, and says what is missing.
    """
    content, stack, marked, memo = machine.content, machine.stack, machine.marked, machine.memo
    at, end = machine.next, len(content) - 9  # after which what follows an opcode may be missing
    for _ in range(MAX_STEPS):
        code = content[at] if at < end else 0
        match code:
            case 0x71 if stack:  # BINPUT
                memo[content[at + 1]] = stack[-1]
                at += 2
            case 0x4B:  # BININT1
                stack.append(content[at + 1])
                at += 2
            case 0x68 if type(memo.get(content[at + 1], _ABSENT)) is not Unfilled:  # BINGET
                stack.append(memo[content[at + 1]])
                at += 2
            case 0x4E:  # NONE
                stack.append(None)
                at += 1
            case 0x28 if len(marked) < MAX_MARKS:  # MARK
                marked.append(stack)
                stack = []
                at += 1
            case 0x74 if marked:  # TUPLE
                values = tuple(stack)
                stack = marked.pop()
                stack.append(values)
                at += 1
            case 0x87 if len(stack) > 2:  # TUPLE3
                stack[-3:] = [tuple(stack[-3:])]
                at += 1
            case 0x43 if at + 2 + content[at + 1] < end:  # SHORT_BINBYTES
                begin = at + 2
                at = begin + content[at + 1]
                stack.append(content[begin:at])
            case 0x85 if stack:  # TUPLE1
                stack[-1] = (stack[-1],)
                at += 1
            case 0x47:  # BINFLOAT
                stack += _DOUBLE.unpack_from(content, at + 1)
                at += 9
            case 0x4A:  # BININT
                stack += _INT.unpack_from(content, at + 1)
                at += 5
            case 0x89:  # NEWFALSE
                stack.append(False)
                at += 1
            case 0x94 if stack and len(memo) < 256:  # MEMOIZE
                memo[len(memo)] = stack[-1]
                at += 1
            case _:
                if at >= len(content):
                    machine.at = at
                    raise Damaged("it ends without the opcode STOP")
                code = content[at]
                machine.at, machine.next, machine.stack = at, at + 1, stack
                carry_out = opcodes[code]
                if carry_out is None:
                    return _stop(machine, code)
                carry_out(machine)
                at, stack = machine.next, machine.stack
    machine.at = at
    raise DataError(f"more than {MAX_STEPS} opcodes, at most as many are read")


_ABSENT = Unfilled()
_DOUBLE = struct.Struct(">d")
_INT = struct.Struct("<i")


def _stop(machine: Machine, code: int) -> Any:
    if code != ord("."):
        raise Damaged(f"there is no opcode {bytes([code])!r}")
    if len(machine.stack) != 1 or machine.marked:
        raise Damaged(f"{len(machine.stack)} values are left at its end, expected one")
    return machine.stack[0]
