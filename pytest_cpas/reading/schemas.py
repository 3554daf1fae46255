"""Values from JSON against a schema: the first thing that is wrong, in time that grows with what is
there and no faster.

The keywords are those that ``tools/make_schema.py`` writes. Beyond them every number must be finite
and of a size that can be computed with.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from pytest_cpas.types import DataError, shown

#: Largest whole number, and largest magnitude of any other.
_LARGEST_INTEGER, _LARGEST = 2**53, 1e300

_TYPES: Mapping[str, tuple[type, ...]] = {
    "object": (dict,),
    "array": (list,),
    "string": (str,),
    "integer": (int,),
    "number": (int, float),
    "boolean": (bool,),
    "null": (type(None),),
}

#: Checks a value that is at a place, and raises :class:`DataError`.
_Check = Callable[[Any, str], None]

_NOTES = ("$schema", "$defs", "title", "description", "required", "maxItems")


def check_schema(schema: Mapping[str, Any], value: Any, where: str) -> None:
    """Raise :class:`DataError` that begins with ``where`` and says which part of ``value`` is not
    as ``schema`` says."""
    try:
        _Schema(schema).check(schema)(value, "$")
    except DataError as error:
        raise DataError(f"{where}: {error}") from None


class _Schema:
    """The parts of a schema, each made into a function once."""

    def __init__(self, whole: Mapping[str, Any]) -> None:
        self.parts: Mapping[str, Any] = whole.get("$defs", {})
        self.made: dict[str, _Check] = {}

    def check(self, schema: Mapping[str, Any]) -> _Check:
        checks = [
            made
            for key, told in schema.items()
            if key not in _NOTES and (made := self._keyword(key, told, schema))
        ]

        def every(value: Any, place: str) -> None:
            for check in checks:
                check(value, place)

        return every

    def _keyword(self, key: str, told: Any, schema: Mapping[str, Any]) -> _Check | None:
        if key == "$ref":
            return self._named(told.rpartition("/")[2])
        if key == "type":
            return _of_type(told if isinstance(told, list) else [told])
        if key in ("enum", "const"):
            return _one_of(told if key == "enum" else [told])
        if key == "anyOf":
            return _any_of([self.check(each) for each in told])
        if key == "properties":
            return self._properties(told, schema.get("required", ()), schema)
        if key == "additionalProperties":
            return None if "properties" in schema else _each_value(self.check(told))
        if key == "items":
            return _each_item(self.check(told))
        if key == "pattern":
            return _matching(told)
        if key == "minItems":
            return _of_length(told)
        return _limited(key, told)

    def _named(self, name: str) -> _Check:
        """Of a part that others name; parts may be in each other."""

        def named(value: Any, place: str) -> None:
            if name not in self.made:
                self.made[name] = self.check(self.parts[name])
            self.made[name](value, place)

        return named

    def _properties(
        self, told: Mapping[str, Any], required: Any, schema: Mapping[str, Any]
    ) -> _Check:
        checks = {name: self.check(part) for name, part in told.items()}
        closed = schema.get("additionalProperties") is False

        def properties(value: Any, place: str) -> None:
            if not isinstance(value, dict):
                return
            for name in required:
                if name not in value:
                    raise DataError(f"{place} has no {name!r}")
            for name, part in value.items():
                if name in checks:
                    checks[name](part, f"{place}.{name}")
                elif closed:
                    raise DataError(f"{place} has {shown(name)}, which is not known")

        return properties


def _of_type(names: list[str]) -> _Check:
    types = tuple(each for name in names for each in _TYPES[name])

    def of_type(value: Any, place: str) -> None:
        if not isinstance(value, types) or (isinstance(value, bool) and "boolean" not in names):
            raise DataError(f"{place} is {shown(value)}, expected {' or '.join(names)}")
        if isinstance(value, int | float):
            largest = _LARGEST_INTEGER if isinstance(value, int) else _LARGEST
            if not -largest <= value <= largest:
                raise DataError(f"{place} is {shown(value)}, expected a finite number in use")

    return of_type


def _one_of(values: list[Any]) -> _Check:
    def one_of(value: Any, place: str) -> None:
        if not any(type(value) is type(each) and value == each for each in values):
            raise DataError(f"{place} is {shown(value)}, expected one of {shown(values)}")

    return one_of


def _any_of(checks: list[_Check]) -> _Check:
    def any_of(value: Any, place: str) -> None:
        found = None
        for check in checks:
            try:
                return check(value, place)
            except DataError as error:
                found = found or error
        raise found or DataError(f"{place} is {shown(value)}")

    return any_of


def _each_value(check: _Check) -> _Check:
    def each_value(value: Any, place: str) -> None:
        if isinstance(value, dict):
            for key, part in value.items():
                check(part, f"{place}[{shown(key)}]")

    return each_value


def _each_item(check: _Check) -> _Check:
    def each_item(value: Any, place: str) -> None:
        if isinstance(value, list):
            for index, part in enumerate(value):
                check(part, f"{place}[{index}]")

    return each_item


def _matching(pattern: str) -> _Check:
    expression = re.compile(pattern)

    def matching(value: Any, place: str) -> None:
        if isinstance(value, str) and not expression.search(value):
            raise DataError(f"{place} is {shown(value)}, expected a text like {pattern}")

    return matching


def _of_length(length: int) -> _Check:
    def of_length(value: Any, place: str) -> None:
        if isinstance(value, list) and len(value) != length:
            raise DataError(f"{place} has {len(value)} items, expected {length}")

    return of_length


def _limited(key: str, limit: float) -> _Check:
    met: Callable[[float], bool] = {
        "minimum": lambda number: number >= limit,
        "exclusiveMinimum": lambda number: number > limit,
        "maximum": lambda number: number <= limit,
        "exclusiveMaximum": lambda number: number < limit,
    }[key]

    def limited(value: Any, place: str) -> None:
        if isinstance(value, int | float) and not isinstance(value, bool) and not met(value):
            raise DataError(f"{place} is {shown(value)}, beyond its {key} of {limit:g}")

    return limited
