"""Pickles that hold objects of a few known classes, which are read as dicts of their fields.

A class is a name here as well: it is not imported, no code of it is run, and what is read is what
the pickle says of the fields.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from pytest_cpas.reading.pickle_arrays import Name
from pytest_cpas.reading.pickle_limits import Budget, Damaged
from pytest_cpas.reading.pickle_machine import Machine
from pytest_cpas.reading.pickle_opcodes import OPCODES, Opcode, build

__all__ = ["RECORD_OPCODES", "RecordMachine"]


class RecordMachine(Machine):
    """A machine that knows classes, ``module.name``, beside what arrays need."""

    __slots__ = ("_known", "made")

    def __init__(self, content: bytes, classes: Collection[str]) -> None:
        """Nothing is read yet."""
        super().__init__(content)
        self._known = {name: Name(name, _not_called) for name in classes} | _DICTS
        self.made: dict[int, dict[str, Any]] = {}  # objects without fields yet, by their identity

    def name(self, module: str, name: str) -> Name:
        """What a name stands for; raises as for arrays for those that are not known."""
        known = self._known.get(f"{module}.{name}")
        return super().name(module, name) if known is None else known


def _not_called(_: tuple[Any, ...], __: Budget) -> None:
    return None


def _dict(arguments: tuple[Any, ...], budget: Budget) -> dict[Any, Any] | None:
    """A dict that is made empty, or of another one, as collections.Counter is."""
    if not arguments:
        return {}
    if len(arguments) != 1 or type(arguments[0]) is not dict:
        return None
    budget.take(64 * len(arguments[0]))
    return dict(arguments[0])


#: Kinds of dicts, read as such.
_DICTS = {name: Name(name, _dict) for name in ("collections.OrderedDict", "collections.Counter")}


def _new_object(machine: Machine) -> None:
    arguments, kind = machine.pop_two()
    if (
        not isinstance(machine, RecordMachine)
        or type(kind) is not Name
        or kind.call is not _not_called
        or arguments != ()
    ):
        machine.refuse("the pickle makes an object of a class")
    made: dict[str, Any] = {}
    machine.made[id(made)] = made  # which keeps it, so that no other gets its identity
    machine.push_container(made)


def _build_record(machine: Machine) -> None:
    state, target = machine.pop_two()
    machine.stack.append(target)
    made = machine.made if isinstance(machine, RecordMachine) else {}
    if made.pop(id(target), None) is None:
        machine.stack.append(state)
        build(machine)
        return
    if type(state) is not dict or not all(type(key) is str for key in state):
        raise Damaged("an object is given a state that is no dict of its fields")
    machine.budget.take(64 * len(state))
    target.update(state)


#: As those of :mod:`pickle_opcodes`, for a :class:`RecordMachine`.
RECORD_OPCODES: list[Opcode | None] = [*OPCODES]
RECORD_OPCODES[0x81] = _new_object
RECORD_OPCODES[ord("b")] = _build_record
