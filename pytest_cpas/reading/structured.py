"""JSON, TOML and YAML from others: of bounded size and depth, so that nothing recurses too far.

A value may be nested :data:`DEEPEST` levels; what is read can be walked, compared and printed.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from pytest_cpas.reading.files import LARGEST, decoded, read_bytes
from pytest_cpas.types import DataError, shown

#: Levels of lists and tables within each other. No format that is read here has ten.
DEEPEST = 64

#: Largest texts in TOML and YAML, bytes: their parsers are slow.
LARGEST_TOML = 2**24
LARGEST_YAML = 2**20

_STRING = re.compile(rb'"(?:[^"\\]++|\\.)*+"?', re.DOTALL)
#: Lists within lists, in one line of YAML.
_MANY_DASHES = re.compile(r"(?<!\S)(?:-[ \t]++){64}")

_NOT_BRACKETS = bytes(sorted(set(range(256)) - set(b"[]{}")))

#: What is perhaps a whole number of more than 64 bits, or stands in a text.
_LONG_INTEGER = re.compile(r"\d[\d_]{17}|0[xob][0-9a-fA-F_]{15}")

#: Keys one below the other in one name: the parser's time grows with the square of their number.
_MANY_KEYS = re.compile(r"""(?<![\w"'.-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){64}""")


def parse_json(path: Path, content: bytes, kind: type = dict, *, constants: bool = True) -> Any:
    """The object, or what else of ``kind``, that a JSON file holds.

    ``constants``: NaN, Infinity and -Infinity, which are no JSON but are written by many, are read
    as numbers; whoever needs a number checks that it is finite. A key that is there twice is an
    error. Raises :class:`DataError` naming ``path``.
    """
    value = json_value(f"{path}", content, constants=constants)
    if not isinstance(value, kind):
        raise DataError(f"{path}: holds a {type(value).__name__}, expected a {kind.__name__}")
    return value


def json_value(where: str, content: bytes, *, constants: bool = True) -> Any:
    """Any value from JSON; the message of :class:`DataError` begins with ``where``."""
    if _depth(content) > DEEPEST:
        raise DataError(f"{where}: nested more than {DEEPEST} levels deep")
    try:
        return json.loads(
            content,
            parse_constant=None if constants else _no_constant,
            object_pairs_hook=_each_once,
        )
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{where}: not readable JSON ({error}); is it truncated? Fetch it again"
        ) from error


def read_json(path: Path, kind: type = dict, *, limit: int = LARGEST) -> Any:
    """As :func:`parse_json`, of a file of at most ``limit`` bytes, without constants."""
    return parse_json(path, read_bytes(path, limit), kind, constants=False)


def parse_toml(where: str, text: str) -> dict[str, Any]:
    """What a text in TOML holds; the message of :class:`DataError` begins with ``where``."""
    if len(text) > LARGEST_TOML:
        raise DataError(f"{where}: {len(text)} characters, at most {LARGEST_TOML} are read")
    if match := _MANY_KEYS.search(text):
        line = text.count("\n", 0, match.start()) + 1
        raise DataError(f"{where}, line {line}: more than {DEEPEST} keys in one name")
    try:
        content = tomllib.loads(text)
    except RecursionError:
        raise DataError(f"{where}: nested more than {DEEPEST} levels deep") from None
    except ValueError as error:
        raise DataError(f"{where}: {error}") from error
    _check_depth(where, content)
    if _LONG_INTEGER.search(text):
        _check_integers(where, content)
    return content


def read_toml(path: Path) -> dict[str, Any]:
    """As :func:`parse_toml`, of a file."""
    return parse_toml(f"{path}", decoded(path, read_bytes(path, LARGEST_TOML)))


def read_yaml(path: Path) -> Any:
    """What a file in YAML holds: plain values alone, whatever tags it has.

    Raises :class:`DataError` naming ``path``; ModuleNotFoundError without PyYAML.
    """
    import yaml

    text = decoded(path, read_bytes(path, LARGEST_YAML))
    # the parser takes a second to find out itself; brackets in texts are counted as well
    if _bracket_depth(text.encode()) > DEEPEST or _MANY_DASHES.search(text):
        raise DataError(f"{path}: nested more than {DEEPEST} levels deep")
    try:
        content = yaml.safe_load(text)
    except RecursionError:
        raise DataError(f"{path}: nested more than {DEEPEST} levels deep") from None
    except (yaml.YAMLError, ValueError, TypeError, KeyError, AttributeError) as error:
        # what is no date, and no number, raises what Python raises
        reason = " ".join(str(error).split())
        raise DataError(f"{path}: not readable YAML ({reason})") from error
    _check_depth(f"{path}", content)
    return content


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON; of a key that is there twice, nobody knows which value is meant."""
    content = dict(pairs)
    if len(content) != len(pairs):
        twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"key {shown(twice)} is there twice")
    return content


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")


def _depth(content: bytes) -> int:
    """How deep brackets are nested, those in strings left aside; an upper bound for JSON."""
    brackets = content.translate(None, _NOT_BRACKETS)
    if len(brackets) <= DEEPEST:
        return len(brackets)
    if b"\\" not in content:  # which is several times faster
        return _bracket_depth(b"".join(content.split(b'"')[::2]))
    return _bracket_depth(_STRING.sub(b"", content))


def _bracket_depth(content: bytes) -> int:
    brackets = content.translate(None, _NOT_BRACKETS)
    codes = np.frombuffer(brackets, np.uint8)
    steps = np.where((codes == ord("[")) | (codes == ord("{")), 1, -1)
    return int(np.cumsum(steps).max(initial=0))


def _check_integers(where: str, value: Any) -> None:
    """TOML has 64 bits; Python reads more, and cannot always write them in an error."""
    for part in value.values() if isinstance(value, dict) else value:
        if isinstance(part, dict | list):
            _check_integers(where, part)
        elif isinstance(part, int) and not -(2**63) <= part < 2**63:
            raise DataError(
                f"{where}: a whole number of more than 64 bits, which TOML does not have"
            )


def _check_depth(where: str, value: Any) -> None:
    """Level by level, each container once, for YAML can share them, and put one into itself."""
    level = [value] if isinstance(value, _CONTAINERS) else []
    for _ in range(DEEPEST):
        below = (child for each in level for child in _children(each))
        level = list({id(child): child for child in below}.values())
    if level:
        raise DataError(f"{where}: nested more than {DEEPEST} levels deep")


_CONTAINERS = (dict, list, tuple, set)


def _children(container: Any) -> Iterator[Any]:
    """Containers in a container; keys of YAML may be tuples."""
    parts = (*container, *container.values()) if isinstance(container, dict) else container
    return (part for part in parts if isinstance(part, _CONTAINERS))
