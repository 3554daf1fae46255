"""Meshes in PLY and STL, as text or as bytes: what they announce is what is there, to the byte."""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.reading.mesh_rows import (
    MOST_ELEMENTS,
    MOST_NUMBERS,
    Indices,
    Rows,
    lines_of,
    shown,
)
from pytest_cpas.reading.mesh_texts import polygon_triangles
from pytest_cpas.types import Array, DataError

#: Bytes of a header of PLY, and elements and properties in it.
_LONGEST_HEADER = 2**16
_MOST_PROPERTIES = 256

#: Numbers of a list: corners of a polygon.
_LONGEST_LIST = 2**16

#: Types of PLY, as numpy calls them.
_TYPES = {
    name: code
    for code, names in {
        "i1": "char int8",
        "u1": "uchar uint8",
        "i2": "short int16",
        "u2": "ushort uint16",
        "i4": "int int32",
        "u4": "uint uint32",
        "f4": "float float32",
        "f8": "double float64",
    }.items()
    for name in names.split()
}

_CORNERS = ("vertex_indices", "vertex_index")

_STL_HEAD = 84
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
_STL_FACET = [b"facet", b"outer", b"vertex", b"vertex", b"vertex", b"endloop", b"endfacet"]


@dataclass
class _Property:
    """A property of an element: ``length`` is the type of a list's length, "" if it is none."""

    name: str
    kind: str
    length: str = ""


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)


def ply_mesh(content: bytes) -> tuple[Array, Indices]:
    """Vertices (V, 3) and triangles (F, 3) of a PLY file; :class:`DataError` for any fault."""
    order, elements, body = _ply_header(content)
    lengths = {element.name: len(element.properties) for element in elements}
    if "vertex" not in lengths or "face" not in lengths:
        raise DataError(
            f"its elements are {', '.join(lengths) or 'none'}, expected vertex and face"
        )
    _check_kinds(elements)
    read = _ply_text if order == "" else _ply_bytes
    columns = read(body, order, elements)
    try:
        places = np.stack([columns["vertex", axis][0] for axis in "xyz"], axis=1)
    except KeyError:
        raise DataError("a vertex has no x, y and z") from None
    named = [name for name in _CORNERS if ("face", name) in columns]
    if len(named) != 1:
        raise DataError(f"a face has no list called {' or '.join(_CORNERS)}, or both")
    values, starts, sizes = columns["face", named[0]]
    return places, polygon_triangles(values, starts, sizes, len(places))


def _check_kinds(elements: Sequence[_Element]) -> None:
    """Raise :class:`DataError` for corners that are no list of whole numbers, and for x, y or z
    that is a list."""
    for element in elements:
        for part in element.properties:
            name = f"{part.name} of a {element.name}"
            if element.name == "face" and part.name in _CORNERS and not part.length:
                raise DataError(f"{name} is one number, expected a list")
            if element.name == "face" and part.name in _CORNERS and part.kind[0] == "f":
                raise DataError(f"{name} is a list of floats, expected whole numbers such as int")
            if (element.name, part.name) in _AXES and part.length:
                raise DataError(f"{name} is a list, expected one number")


#: Of a property its values, one after the other; of a list also where each row's begin, and how
#: many they are.
_Columns = dict[tuple[str, str], tuple[Array, Indices, Array]]


def _ply_header(content: bytes) -> tuple[str, list[_Element], bytes]:
    """The byte order ("" for text), the elements, and what follows the header."""
    end = re.search(rb"^end_header[ \t]*(?:\r\n|\n|\r)", content[:_LONGEST_HEADER], re.M)
    if not end:
        raise DataError(f"no end_header in its first {_LONGEST_HEADER} bytes")
    lines = [line.split() for line in content[: end.start()].decode("latin-1").splitlines()]
    lines = [line for line in lines if line and line[0] not in ("comment", "obj_info")]
    order: str | None = None
    elements: list[_Element] = []
    if not lines or lines[0] != ["ply"]:
        raise DataError("it does not begin with the line 'ply'")
    for words in lines[1:]:
        match words:
            case ["format", form, "1.0"] if form in _ORDERS and order is None:
                order = _ORDERS[form]
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,9}", count):
                if int(count) > min(MOST_ELEMENTS, len(content)):
                    raise DataError(
                        f"it announces {count} elements {name[:40]!r} in {len(content)} bytes; at"
                        f" most {MOST_ELEMENTS} are read"
                    )
                elements.append(_Element(name, int(count)))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[kind]))
            case ["property", "list", length, kind, name] if (
                elements and kind in _TYPES and _TYPES.get(length, "f")[0] in "iu"
            ):
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[length]))
            case _:
                raise DataError(f"its header has the line {' '.join(words)[:80]!r}")
    if order is None:
        raise DataError(f"its format is none of {', '.join(_ORDERS)}, version 1.0")
    for names in ([e.name for e in elements], *([p.name for p in e.properties] for e in elements)):
        if len(set(names)) < len(names) or len(names) > _MOST_PROPERTIES:
            raise DataError(
                f"its header gives a name twice, or more than {_MOST_PROPERTIES} properties"
            )
    return order, elements, content[end.end() :]


_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def _ply_text(body: bytes, order: str, elements: list[_Element]) -> _Columns:
    lines = lines_of(body)
    columns: _Columns = {}
    for element in elements:
        rows = Rows(f"the element {element.name[:40]!r}")
        for number, line in islice(lines, element.count):
            rows.add(number, line)
        if rows.count < element.count:
            raise DataError(
                f"{rows.count} rows of the element {element.name[:40]!r}, but its header announces"
                f" {element.count}; it is torn"
            )
        values, counts = rows.values()
        ends = np.cumsum(counts)
        at = ends - counts
        for part in element.properties:
            if (at >= ends).any():
                break
            sizes = np.ones(len(at))
            if part.length:
                sizes = values[at]
                at = at + 1
            if not ((sizes >= 0) & (sizes <= ends - at) & (sizes == np.floor(sizes))).all():
                break
            columns[element.name, part.name] = (
                (values, at, sizes) if part.length else (values[at], at, sizes)
            )
            at = at + sizes.astype(np.int64)
        else:
            if (at == ends).all():
                continue
        raise DataError(
            f"a row of the element {element.name[:40]!r} has another number of numbers than its"
            " header says"
        )
    for number, _ in lines:
        raise DataError(
            f"rows follow that its header does not announce (line {number} of the body)"
        )
    return columns


def _ply_bytes(body: bytes, order: str, elements: list[_Element]) -> _Columns:
    columns: _Columns = {}
    at = 0
    for element in elements:
        rows = _equal_rows(body, at, order, element)
        if rows is None:
            at = _unequal_rows(body, at, order, element, columns)
            continue
        at += rows.nbytes
        for index, part in enumerate(element.properties):
            if (element.name, part.name) in _WANTED:
                values = rows[f"values{index}"]
                length = values.shape[1]
                if values.size > MOST_NUMBERS:
                    raise DataError(f"a face has {length} corners, too many are read in all")
                columns[element.name, part.name] = (
                    values.astype(float).reshape(-1),
                    np.arange(element.count) * length,
                    np.full(element.count, float(length)),
                )
    if at != len(body):
        raise DataError(f"{len(body) - at} bytes follow that its header does not announce")
    return columns


_AXES = {("vertex", axis) for axis in "xyz"}

_WANTED = _AXES | {("face", name) for name in _CORNERS}


def _equal_rows(body: bytes, at: int, order: str, element: _Element) -> NDArray[np.void] | None:
    """The rows of an element, if all have lists of the same lengths; None if not."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    lengths = []
    first = at
    for index, part in enumerate(element.properties):
        length = 1
        if part.length:
            length = _length(body, first, order + part.length) if element.count else 0
            fields.append((f"length{index}", order + part.length))
            first += np.dtype(part.length).itemsize
            lengths.append((f"length{index}", length))
        fields.append((f"values{index}", order + part.kind, (length,)))
        first += length * np.dtype(part.kind).itemsize
    dtype = np.dtype(fields)
    if not element.count:
        return np.empty(0, dtype)
    if dtype.itemsize * element.count > len(body) - at or not dtype.itemsize:
        return None
    rows = np.frombuffer(body, dtype, element.count, at)
    return rows if all((rows[name] == length).all() for name, length in lengths) else None


def _unequal_rows(body: bytes, at: int, order: str, element: _Element, columns: _Columns) -> int:
    """Read an element row by row into ``columns``; where its rows end."""
    parts = [
        (part, np.dtype(part.kind).itemsize, array("d"), array("q"), array("d"))
        for part in element.properties
    ]
    for _ in range(element.count):
        for part, size, values, starts, sizes in parts:
            length = 1
            if part.length:
                length = _length(body, at, order + part.length)
                at += np.dtype(part.length).itemsize
            if length * size > len(body) - at:
                raise DataError(f"it is torn in the element {element.name[:40]!r}")
            if (element.name, part.name) in _WANTED:
                starts.append(len(values))
                sizes.append(length)
                values.extend(struct.unpack_from(f"{order}{length}{_CODES[part.kind]}", body, at))
                if len(values) > MOST_NUMBERS:
                    raise DataError(
                        f"its faces have more than {MOST_NUMBERS} corners, the most read"
                    )
            at += length * size
    for part, _, values, starts, sizes in parts:
        if (element.name, part.name) in _WANTED:
            columns[element.name, part.name] = (
                np.frombuffer(values, float) if values else np.empty(0),
                np.array(starts, np.int64),
                np.array(sizes, float),
            )
    return at


#: Types, as struct calls them.
_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}


def _length(body: bytes, at: int, kind: str) -> int:
    """The length of a list, of numpy's type ``kind``."""
    try:
        length: int = struct.unpack_from(kind[0] + _CODES[kind[1:]], body, at)[0]
    except struct.error:
        raise DataError("it is torn within a list") from None
    if not 0 <= length <= _LONGEST_LIST:
        raise DataError(f"a list has {length} numbers, expected 0 to {_LONGEST_LIST}")
    return length


def stl_mesh(content: bytes) -> tuple[Array, Indices]:
    """Vertices (3F, 3) and triangles (F, 3) of an STL file; :class:`DataError` for any fault."""
    count = int.from_bytes(content[_STL_HEAD - 4 : _STL_HEAD], "little")
    if len(content) == _STL_HEAD + count * _STL_TRIANGLE.itemsize:
        if count > MOST_ELEMENTS:
            raise DataError(f"it has {count} triangles, at most {MOST_ELEMENTS} are read")
        places = np.frombuffer(content, _STL_TRIANGLE, count, _STL_HEAD)["corners"].astype(float)
    elif content[:5].lower() == b"solid" and b"\0" not in content:
        places = _stl_text(content)
    else:
        raise DataError(
            f"its header announces {count} triangles, which with it are"
            f" {_STL_HEAD + count * _STL_TRIANGLE.itemsize} bytes, and {len(content)} are there"
        )
    places = places.reshape(-1, 3)
    return places, np.arange(len(places)).reshape(-1, 3)


def _stl_text(content: bytes) -> Array:
    vertices = Rows("a vertex", (3,), 3 * MOST_ELEMENTS)
    words: list[bytes] = []
    inside = False
    for number, line in lines_of(content):
        word, *rest = line.split(None, 1)
        word = word.lower()
        if word in (b"solid", b"endsolid"):
            if inside == (word == b"solid") or words:
                raise DataError(f"line {number}: {word.decode()} where none is expected")
            inside = not inside
            continue
        if not inside or _STL_FACET[len(words)] != word:
            expected = _STL_FACET[len(words)].decode() if inside else "solid"
            raise DataError(f"line {number} begins with {shown(word)}, expected {expected}")
        words = [] if word == b"endfacet" else [*words, word]
        if word == b"vertex":
            vertices.add(number, rest[0] if rest else b"")
    if inside:
        raise DataError("it ends without endsolid; it is torn")
    return vertices.columns(3)
