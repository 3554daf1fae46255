"""Pickles that torch reads, gone through beforehand within the limits of our own.

torch calls nothing that a checkpoint names but what makes tensors, but lets it hold any number of
values, and keys that are made to collide, on which Python then spends hours. Here names are texts,
what is called makes nothing, or an empty dict, and a tensor is None.
"""

from __future__ import annotations

from pytest_cpas.reading.pickle_limits import Damaged, check_values
from pytest_cpas.reading.pickle_loop import carried_out
from pytest_cpas.reading.pickle_machine import Machine
from pytest_cpas.reading.pickle_opcodes import OPCODES, Opcode
from pytest_cpas.types import DataError

#: Called, they make what keys are put into.
_DICTS = frozenset(("OrderedDict", "defaultdict", "Counter", "dict"))


def walk(content: bytes, begin: int = 0) -> int:
    """Where the pickle ends that begins at a byte of ``content``.

    Raises :class:`DataError` if it is none, or holds more than :mod:`~.pickle_limits` says.
    """
    machine = Machine(content, begin)
    try:
        check_values(carried_out(machine, _OPCODES))
    except Damaged as error:
        raise DataError(f"not a readable pickle: at byte {machine.at}, {error}") from None
    except DataError as error:
        raise DataError(f"at byte {machine.at}, {error}") from None
    return machine.next


def _global(machine: Machine) -> None:
    module, name = (machine.line(200).decode("latin1") for _ in range(2))
    machine.push_text(f"{module}.{name}".encode("latin1"), "latin1")


def _stack_global(machine: Machine) -> None:
    name, module = machine.pop_two()
    machine.stack.append(f"{str(module)[:200]}.{str(name)[:200]}")


def _call(machine: Machine) -> None:
    arguments, function = machine.pop_two()
    if type(function) is not str or type(arguments) is not tuple:
        raise Damaged(f"a {type(function).__name__} is called with a {type(arguments).__name__}")
    for values in arguments:
        if type(values) is list:  # of keys, or of pairs of a key and a value
            parts = (v[0] if type(v) in (list, tuple) and len(v) == 2 else v for v in values)
            machine.budget.members(part for part in parts if type(part) not in (list, dict, set))
    machine.push_container({} if function.rpartition(".")[2] in _DICTS else None)


def _build(machine: Machine) -> None:
    machine.pop()


def _new_object(machine: Machine) -> None:
    machine.pop_two()
    machine.stack.append(None)


def _refer(machine: Machine) -> None:
    machine.pop()
    machine.stack.append(None)


def _long(machine: Machine) -> None:
    machine.stack.append(int.from_bytes(machine.take(*machine.take(1)), "little", signed=True))


_OPCODES: list[Opcode | None] = [*OPCODES]
for _code, _function in {
    b"c": _global,
    b"\x93": _stack_global,
    b"R": _call,
    b"b": _build,
    b"\x81": _new_object,
    b"Q": _refer,
    b"\x8a": _long,
}.items():
    _OPCODES[_code[0]] = _function
