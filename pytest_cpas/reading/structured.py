"""JSON, TOML and YAML from others: of bounded size and depth, so that nothing recurses too far.

A value may be nested :data:`DEEPEST` levels; what is read can be walked, compared and printed.
"""

from __future__ import annotations

import functools
import json
import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from pytest_cpas.reading.files import BYTE_ORDER_MARK, LARGEST, decoded, read_bytes
from pytest_cpas.types import DataError, shortened, shown

#: Levels of lists and tables within each other. No format that is read here has ten.
DEEPEST = 64

#: Largest texts, bytes: the parsers of TOML and YAML are slow.
LARGEST_JSON = 2**26
LARGEST_TOML = 2**21
LARGEST_YAML = 2**18

#: Lists, tables and keys of a text in JSON, and commas in it: annotations of hundreds of thousands
#: of objects.
MOST_PARTS = 1_000_000
_COMMAS_EACH = 2

#: Names, values and brackets of a text in TOML: tens of thousands of lines.
MOST_TOKENS = 200_000

#: Characters that part values of a text in YAML: thousands of lines.
MOST_MARKS = 15_000
_MARKS = "\n,:-?&*![]{}|>"

#: Values of a text in YAML, those that it refers to counted each time.
_MOST_VALUES = 1_000_000

#: Characters of a number; a sum of such numbers still fits into a float.
_LONGEST_NUMBER = 256

_STRING = re.compile(rb'"(?:[^"\\]++|\\.)*+"?', re.DOTALL)
#: Lists within lists, in one line of YAML.
_MANY_DASHES = re.compile(r"(?<!\S)(?:-[ \t]++){64}")

_NOT_BRACKETS = bytes(sorted(set(range(256)) - set(b"[]{}")))

#: What only a long number has, or one of a large exponent, and texts by chance.
_LONG_NUMBER = re.compile(rb"(?<![0-9])[0-9]{200}|[eE][+-]?+[0-9]{3}")

#: A token of TOML. Of texts that do not end, and nothing can be read after them, the beginning.
_TOML_TOKEN = re.compile(
    r"""(?P<blank>(?:[ \t\r\n]++|\#[^\n]*+)++)
    |(?P<text>\"{3}(?:[^"\\]++|\\.|"{1,2}(?!"))*+"{3,5}|'{3}(?:[^']++|'{1,2}(?!'))*+'{3,5}
        |(?!"{3}|'{3})(?:"(?:[^"\\\n]++|\\.)*+"|'[^'\n]*+'))
    |(?P<word>[A-Za-z0-9_+-]++)
    |(?P<open>[\[{])|(?P<close>[\]}])|(?P<dot>\.)|(?P<other>.)""",
    re.DOTALL | re.VERBOSE,
)


def parse_json(path: Path, content: bytes, kind: type = dict, *, constants: bool = True) -> Any:
    """The object, or what else of ``kind``, that a JSON file holds.

    ``constants``: NaN, Infinity and -Infinity, which are no JSON but are written by many, are read
    as numbers; whoever needs a number checks that it is finite. Raises :class:`DataError` naming
    ``path``.
    """
    return _of_kind(path, json_value(f"{path}", content, constants=constants), kind)


def _of_kind(path: Path, value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        raise DataError(f"{path}: holds a {type(value).__name__}, expected a {kind.__name__}")
    return value


def json_value(
    where: str, content: bytes, *, constants: bool = True, most: int = MOST_PARTS
) -> Any:
    """Any value from JSON in UTF-8, of at most ``most`` lists, tables and keys.

    No key is there twice, and no number is larger than a float can be. The message of
    :class:`DataError` begins with ``where``.
    """
    content = content.removeprefix(BYTE_ORDER_MARK)
    _check_json_size(where, content, most)
    if _depth(content) > DEEPEST:
        raise DataError(f"{where}: nested more than {DEEPEST} levels deep")
    long = _LONG_NUMBER.search(content) is not None
    try:
        return _json_decoder(constants, long).decode(content.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{where}: not readable JSON ({shortened(str(error), 300)}); is it truncated? Fetch it"
            " again"
        ) from error


def _check_json_size(where: str, content: bytes, most: int) -> None:
    """An upper bound, for texts may hold the same characters."""
    parts, commas = sum(map(content.count, (b"[", b"{", b":"))), content.count(b",")
    for seen, limit, what in (
        (len(content), LARGEST_JSON, "bytes"),
        (parts, most, "lists, tables and keys"),
        (commas, _COMMAS_EACH * most, "commas"),
    ):
        if seen > limit:
            raise DataError(f"{where}: {seen} {what}, at most {limit} are read; split it")


@functools.cache
def _json_decoder(constants: bool, long: bool) -> json.JSONDecoder:
    """``long``: numbers are looked at one by one, which takes its time."""
    return json.JSONDecoder(
        object_pairs_hook=_table,
        parse_constant=None if constants else _no_constant,
        parse_int=_whole if long else None,
        parse_float=_finite if long else None,
    )


def _table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        seen: set[str] = set()
        for name, _ in pairs:
            if name in seen:
                raise ValueError(f"key {shown(name)} is there twice")
            seen.add(name)
    return made


def _whole(text: str) -> int:
    if len(text.lstrip("-")) > _LONGEST_NUMBER:
        raise ValueError(f"{shown(text)} has more than {_LONGEST_NUMBER} digits")
    return int(text)


def _finite(text: str) -> float:
    """A number of JSON or TOML, which may also write infinity."""
    number = float(text)
    if math.isinf(number) and "inf" not in text:
        raise ValueError(f"{shown(text)} is too large for a number")
    return number


def read_json(
    path: Path, kind: type = dict, *, limit: int = LARGEST, most: int = MOST_PARTS
) -> Any:
    """As :func:`parse_json`, of a file of at most ``limit`` bytes and ``most`` parts, without
    constants."""
    content = read_bytes(path, limit)
    return _of_kind(path, json_value(f"{path}", content, constants=False, most=most), kind)


def parse_toml(where: str, text: str) -> dict[str, Any]:
    """What a text in TOML holds; the message of :class:`DataError` begins with ``where``."""
    if len(text) > LARGEST_TOML:
        raise DataError(f"{where}: {len(text)} characters, at most {LARGEST_TOML} are read")
    _check_tokens(where, text)
    try:
        content = tomllib.loads(text, parse_float=_finite)
    except RecursionError:
        raise DataError(f"{where}: nested more than {DEEPEST} levels deep") from None
    except ValueError as error:
        raise DataError(f"{where}: {shortened(str(error), 300)}") from error
    _check_values(where, content, 64)  # as TOML has them
    return content


def _check_tokens(where: str, text: str) -> None:
    """How many there are, how deep, and how many names a key has, before they are parsed: the
    parser's time grows with the square of some of them."""
    count = depth = names = 0
    after_dot = False
    for match in _TOML_TOKEN.finditer(text):
        kind = match.lastgroup
        if kind == "blank":
            continue
        fault = ""
        if kind in ("text", "word"):
            names = names + 1 if after_dot else 1
            if names > DEEPEST:
                fault = f"more than {DEEPEST} keys in one name"
            elif kind == "word" and match.end() - match.start() > _LONGEST_NUMBER:
                fault = (
                    f"{shown(match[0])}, at most {_LONGEST_NUMBER} characters are read of what has"
                    " no quotes"
                )
        elif kind in ("open", "close"):
            depth += 1 if kind == "open" else -1
            if depth > DEEPEST:
                fault = f"nested more than {DEEPEST} levels deep"
        elif match[0] in ("'", '"'):  # it does not end, and the parser says so
            return
        # the parser looks at all names of a key for each of them
        count += names if kind in ("text", "word") else kind != "dot"
        if count > MOST_TOKENS:
            fault = f"more than {MOST_TOKENS} names, values and brackets before it"
        if fault:
            line = text.count("\n", 0, match.start()) + 1
            raise DataError(f"{where}, line {line}: {fault}")
        after_dot = kind == "dot"


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
    if (marks := sum(map(text.count, _MARKS))) > MOST_MARKS:
        raise DataError(
            f"{path}: {marks} lines and marks such as ',' and ':', at most {MOST_MARKS} are read"
        )
    try:
        content = yaml.safe_load(text)
    except RecursionError:
        raise DataError(f"{path}: nested more than {DEEPEST} levels deep") from None
    except (yaml.YAMLError, ArithmeticError, LookupError, *_NOT_YAML) as error:
        reason = shortened(" ".join(str(error).split()), 300)
        raise DataError(f"{path}: not readable YAML ({reason})") from error
    _check_values(f"{path}", content, 4 * _LONGEST_NUMBER)
    return content


#: What is no date, and no number, raises what Python raises; these, and errors of look-ups.
_NOT_YAML = (ValueError, TypeError, AttributeError)


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


def _check_values(where: str, value: Any, bits: int) -> None:
    """How deep and how many they are, and that integers fit into so many ``bits`` with their sign:
    YAML can have a container many times, and put one into itself, and Python cannot write any
    integer."""
    level, count = [value], 0
    for _ in range(DEEPEST + 1):
        below: list[Any] = []
        for each in level:
            if isinstance(each, _CONTAINERS):
                count += len(each)
                if count > _MOST_VALUES:
                    raise DataError(
                        f"{where}: more than {_MOST_VALUES} values, each as often as"
                        " another one refers to it"
                    )
                below += _parts(each)
            elif isinstance(each, int) and (each if each >= 0 else ~each).bit_length() >= bits:
                raise DataError(f"{where}: a whole number of more than {bits} bits")
        level = below
    if level:
        raise DataError(f"{where}: nested more than {DEEPEST} levels deep")


_CONTAINERS = (dict, list, tuple, set)


def _parts(container: Any) -> Iterator[Any]:
    """What is in a container; keys of YAML may be tuples."""
    yield from container
    if isinstance(container, dict):
        yield from container.values()
