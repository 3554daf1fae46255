"""How the values of a reference are called here, and which way round they are: ``parity.toml``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from pytest_cpas.reading.schemas import check_schema
from pytest_cpas.reading.structured import read_toml
from pytest_cpas.traces.recording import Trace
from pytest_cpas.traces.values import Array, Value
from pytest_cpas.types import DataError, message_of

__all__ = ["NameMap", "Named", "read_map"]

_SCHEMA: Mapping[str, Any] = {
    "type": "object",
    "properties": {
        "replay": {"type": "array", "items": {"type": "string"}},
        "ignore": {"type": "array", "items": {"type": "string"}},
        "values": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "reference": {"type": "string"},
                    "here": {"type": "string"},
                    "transpose": {"type": "array", "items": {"type": "integer", "minimum": 0}},
                    "reshape": {"type": "array", "items": {"type": "integer"}},
                    "axis": {"type": "integer", "minimum": 0},
                    "take": {"type": "array", "minItems": 2, "items": {"type": "integer"}},
                    "calls": {"type": "array", "items": {"type": "integer", "minimum": 1}},
                    "quaternion": {"enum": ["scalar-first"]},
                },
                "required": ["reference", "here"],
                "additionalProperties": False,
            },
        },
    },
    "additionalProperties": False,
}


@dataclass(frozen=True, kw_only=True)
class Named:
    """A value of the reference under the name that it has here.

    In this order: ``take`` two numbers, the first and the one behind the last, along ``axis``;
    ``transpose``: the axes in the order that they have here; ``reshape``: the shape here;
    ``quaternion`` "scalar-first": as the reference has it, and here the scalar is last. ``calls``:
    the numbers of the reference's calls, in the order in which they come here.
    """

    reference: str
    here: str
    take: Sequence[int] | None = None
    axis: int = 0
    transpose: Sequence[int] | None = None
    reshape: Sequence[int] | None = None
    quaternion: str | None = None
    calls: Sequence[int] | None = None

    def of(self, value: Value) -> Value:
        """The value as it would be here; :class:`pytest_cpas.types.DataError` for one that cannot
        be."""
        if self.calls is not None and value.call in self.calls:
            value = value.replaced(call=self.calls.index(value.call) + 1)
        changes = (self.take, self.transpose, self.reshape, self.quaternion)
        if all(change is None for change in changes):
            return value.replaced(name=self.here)
        if not value.is_whole:
            raise DataError(
                f"{value.told}: only every {value.stride}th number of it was kept, so it cannot be"
                " turned as the map says; record it with a larger --cpas-trace-max"
            )
        try:
            kept = self._turned(value.kept)
        except (ValueError, IndexError) as error:
            raise DataError(
                f"{value.told} {value.shape} cannot be turned as the map says: {message_of(error)}"
            ) from error
        turned = Value.of(self.here, value.call, value.kind, value.stage, kept)
        return turned.replaced(spread=value.spread)

    def _turned(self, array: Array) -> Array:
        if self.take is not None:
            array = array.take(range(*self.take), self.axis)
        if self.transpose is not None:
            array = array.transpose(self.transpose)
        if self.reshape is not None:
            array = array.reshape(self.reshape)
        if self.quaternion is not None:
            if array.shape[-1:] != (4,):
                raise ValueError(f"the last axis of {array.shape} is none of quaternions")
            array = np.roll(array, -1, axis=-1)
        return array


@dataclass(frozen=True, kw_only=True)
class NameMap:
    """All of them; ``replay``: names, as they are here, of what is drawn at random and is taken
    over from the reference; ``ignore``: patterns with ``*`` of names of the reference that mean
    something else here."""

    values: Sequence[Named] = field(default=())
    replay: Sequence[str] = field(default=())
    ignore: Sequence[str] = field(default=())

    def applied(self, trace: Trace) -> Trace:
        """A trace of the reference, in the names that are used here; a value may become several.

        Raises :class:`pytest_cpas.types.DataError`.
        """
        by_name: dict[str, list[Named]] = {}
        for named in self.values:
            by_name.setdefault(named.reference, []).append(named)
        values: list[Value] = []
        for value in trace.values:
            if any(fnmatchcase(value.name, pattern) for pattern in self.ignore):
                continue
            values += [named.of(value) for named in by_name.get(value.name, ())] or [value]
        return Trace(values=values, reason=trace.reason)

    def in_vain(self, here: Trace, reference: Trace) -> list[str]:
        """What it names that neither ``here`` nor the ``reference``, as recorded, has, in words."""
        ours, theirs = ({value.name for value in each.values} for each in (here, reference))
        drawn = {value.name for value in here.values if value.kind == "draw"}
        given = {value.name for value in self.applied(reference).values if value.kind == "draw"}
        return [
            *(f"reference = {n.reference!r}" for n in self.values if n.reference not in theirs),
            *(f"here = {named.here!r}" for named in self.values if named.here not in ours),
            *(
                f"ignore {pattern!r}"
                for pattern in self.ignore
                if not any(fnmatchcase(name, pattern) for name in theirs)
            ),
            *(f"replay {name!r}" for name in self.replay if name not in drawn & given),
        ]


def read_map(path: Path) -> NameMap:
    """A map from a file; :class:`pytest_cpas.types.DataError` for any other file."""
    content = read_toml(path)
    check_schema(_SCHEMA, content, f"{path}")
    return NameMap(
        values=tuple(Named(**each) for each in content.get("values", ())),
        replay=tuple(content.get("replay", ())),
        ignore=tuple(content.get("ignore", ())),
    )
