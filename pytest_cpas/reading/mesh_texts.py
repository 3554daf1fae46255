"""Meshes as text: OBJ and OFF. Whatever in them is not understood is refused, never skipped."""

from __future__ import annotations

import re

import numpy as np

from pytest_cpas.reading.mesh_rows import Indices, Rows, corners, fans, lines_of, shown
from pytest_cpas.types import Array, DataError

_BOM = b"\xef\xbb\xbf"

#: Statements of OBJ that say nothing of the surface's shape: normals, texture, groups, points and
#: lines, materials. Curved surfaces are not among them.
_OBJ_OTHERS = frozenset(
    b"vn vt vp p l g o s mg bevel c_interp d_interp lod maplib mtllib shadow_obj trace_obj usemap"
    b" usemtl".split()
)

_OFF_HEADER = re.compile(rb"(C?N?)OFF(?:[ \t]*(\d[\d \t]*))?")

#: Numbers of a vertex: with a colour of three or four numbers, with a normal, with both.
_OFF_LENGTHS = {b"": (3,), b"C": (6, 7), b"N": (6,), b"CN": (9, 10)}


def obj_mesh(content: bytes) -> tuple[Array, Indices]:
    """Vertices (V, 3) that faces name, and triangles (F, 3); :class:`DataError` for any fault."""
    content = content.removeprefix(_BOM)
    if b"\\" in content:  # which continues a line
        content = content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    # three coordinates, and perhaps a weight, a colour, a colour with transparency
    vertices, faces = Rows("a vertex (v x y z)", (3, 4, 6, 7)), Rows("a face (f)")
    before = -1  # vertices before the first face
    for number, line in lines_of(content):
        kind, *rest = line.split(None, 1)
        if kind == b"v":
            vertices.add(number, rest[0] if rest else b"")
        elif kind == b"f":
            before = vertices.count if before < 0 else before
            text = rest[0] if rest else b""
            faces.add(number, _without_texture(number, text) if b"/" in text else text)
        elif kind not in _OBJ_OTHERS:
            raise DataError(
                f"line {number} begins with {shown(kind)}, which is no statement of OBJ that is"
                " read; expected v, f, and what describes neither vertices nor faces"
            )
    places = vertices.columns(3)
    _check_weights(vertices)
    values, counts = faces.values()
    if not len(counts):
        raise DataError("it has no triangles")
    if (values == 0).any():
        raise DataError("a face names vertex 0; the first one is 1")
    if (values < 0).any() and before < len(places):
        raise DataError(
            "faces count vertices backwards, and more vertices follow; expected all vertices"
            " before all faces"
        )
    count = len(places)
    indices = corners(values, "a face", -count, count, count)
    indices = np.where(indices < 0, indices + count, indices - 1)
    used, indices = np.unique(indices, return_inverse=True)
    return places[used], fans(indices.reshape(-1), counts)


def _without_texture(number: int, text: bytes) -> bytes:
    """The vertices of a face's corners, without their texture and normals."""
    words = text.split()
    if any(word[:1] == b"/" for word in words):
        raise DataError(f"line {number}: a face has a corner without a vertex, {shown(text)}")
    return b" ".join(word.partition(b"/")[0] for word in words)


def _check_weights(vertices: Rows) -> None:
    values, counts = vertices.values()
    weighted = (np.cumsum(counts) - 1)[counts == 4]
    if (values[weighted] != 1).any():
        seen = values[weighted][values[weighted] != 1][0]
        raise DataError(f"a vertex has the weight {seen:g}, expected none or 1")


def off_mesh(content: bytes) -> tuple[Array, Indices]:
    """Vertices (V, 3) and triangles (F, 3) of an OFF file; :class:`DataError` for any fault."""
    lines = lines_of(content.removeprefix(_BOM))
    _, first = next(lines, (1, b""))
    header = _OFF_HEADER.fullmatch(first)
    if not header:
        raise DataError(f"it begins with {shown(first)}, expected OFF, COFF, NOFF or CNOFF")
    counts = (header[2] or next(lines, (1, b""))[1]).split()
    if not 2 <= len(counts) <= 3 or not all(re.fullmatch(rb"\d{1,9}", n) for n in counts):
        raise DataError("expected the numbers of vertices, faces and edges after OFF")
    announced, polygons = map(int, counts[:2])
    vertices, faces = Rows("a vertex", _OFF_LENGTHS[header[1]]), Rows("a face")
    for number, line in lines:
        (vertices if vertices.count < announced else faces).add(number, line)
    if (vertices.count, faces.count) != (announced, polygons):
        raise DataError(
            f"it announces {announced} vertices and {polygons} faces, and has"
            f" {vertices.count + faces.count} lines of them"
        )
    places = vertices.columns(3)
    values, lengths = faces.values()
    starts = np.cumsum(lengths) - lengths
    sizes = values[starts]
    # behind the corners there may be a colour of up to four numbers
    extra = lengths - sizes - 1
    if not ((extra >= 0) & (extra <= 4) & (sizes == np.floor(sizes))).all():
        raise DataError("a face has another number of corners than it says")
    return places, polygon_triangles(values, starts + 1, sizes, len(places))


def polygon_triangles(values: Array, starts: Indices, sizes: Array, vertices: int) -> Indices:
    """The triangles of polygons whose corners are ``sizes`` numbers of ``values`` from ``starts``
    on, of so many vertices, the first being 0."""
    counts = sizes.astype(np.int64)
    within = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
    named = values[np.repeat(starts, counts) + within]
    return fans(corners(named, "a face", 0, vertices - 1, vertices), counts)
