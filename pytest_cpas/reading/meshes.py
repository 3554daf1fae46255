"""Reading meshes."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
import trimesh

from pytest_cpas.reading.files import read_bytes
from pytest_cpas.types import Array, ContractError, DataError, Mesh

_FORMATS = (".obj", ".off", ".ply", ".stl")

#: Largest file, bytes: two million triangles have half of it.
_LARGEST = 2**28

#: Elements that a PLY may announce.
_MOST_ELEMENTS = 20_000_000


def read_mesh(path: Path, axes: Array | None = None) -> Mesh:
    """The mesh in a file; ``axes`` (3, 3), if given, maps its coordinates to those wanted.

    Where ``axes`` mirrors, the triangles are turned, so that their outside stays outside.

    Raises :class:`DataError` naming the file when it is damaged or has no triangles.
    """
    kind = path.suffix.lower()
    if kind not in _FORMATS:  # some others name further files to be read
        raise DataError(f"{path}: not a mesh of {', '.join(_FORMATS)}")
    content = read_bytes(path, _LARGEST)
    try:
        box = _check_obj(content) if kind == ".obj" else None
        if kind == ".ply":
            _check_ply(content)
        # of bytes alone, no material and no texture can be looked for, beside the file or elsewhere
        loaded = trimesh.load_mesh(
            io.BytesIO(content), file_type=kind[1:], process=False, skip_materials=True
        )
        vertices = np.asarray(loaded.vertices, dtype=float)
        mesh = Mesh(vertices, np.asarray(loaded.faces))
        if box is not None and not np.array_equal(mesh.bounds, box):
            raise DataError("its faces give indices in several forms, which were not read rightly")
        if axes is None:
            return mesh
        vertices, triangles = vertices @ axes.T, mesh.triangles
        return Mesh(vertices, triangles if np.linalg.det(axes) > 0 else triangles[:, ::-1])
    except ContractError as error:
        raise DataError(f"{path}: not a readable mesh: {error}") from None
    except Exception as error:  # trimesh raises what its parsers raise
        reason = " ".join(str(error).split())
        raise DataError(f"{path}: not a readable mesh ({reason}); fetch it again") from error


def _check_obj(content: bytes) -> Array | None:
    """Raise :class:`DataError` for indices that trimesh would take for others.

    Where the forms of the faces' corners differ, the box (2, 3) of the vertices that they name.
    """
    content = content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    faces = [match[1] for match in re.finditer(rb"^[ \t]*+f[ \t]++([^\r\n#]*+)", content, re.M)]
    vertices = list(re.finditer(rb"^[ \t]*+v[ \t]++([^\r\n#]*+)", content, re.M))
    corners = b" ".join(faces)
    try:
        indices = np.array([int(word) for word in re.sub(rb"/\S*+", b"", corners).split()], int)
    except (ValueError, OverflowError):
        raise DataError("a face names its corners by what are no integers") from None
    if not len(indices):
        raise DataError("it has no triangles")
    if (indices == 0).any():
        raise DataError("a face names vertex 0; the first one is 1")
    if np.abs(indices).max() > len(vertices):
        worst = indices[np.abs(indices).argmax()]
        raise DataError(f"a face names vertex {worst}, but there are {len(vertices)}")
    if (indices < 0).any():
        first = re.search(rb"^[ \t]*+f[ \t]", content, re.M)
        if first and first.start() < vertices[-1].start():
            raise DataError(
                "faces count vertices backwards, and more vertices follow; expected all vertices"
                " before all faces"
            )
        indices = np.where(indices < 0, indices + len(vertices) + 1, indices)
    if len(set(re.sub(rb"-?\d++", b"n", corners).split())) == 1:
        return None
    used = (vertices[i - 1][1].split()[:3] for i in np.unique(indices).tolist())
    places = np.array([[float(number) for number in place] for place in used])
    return np.stack([places.min(axis=0), places.max(axis=0)])


def _check_ply(content: bytes) -> None:
    """Raise :class:`DataError` for a header that announces more than the file can hold."""
    header = content[: 2**16].partition(b"end_header")[0]
    for kind, words in re.findall(rb"^[ \t]*element[ \t]+(\S+)[ \t]+([^\r\n]*)", header, re.M):
        count = int(words) if re.fullmatch(rb"\d{1,9}", words.strip()) else -1
        if not 0 <= count <= min(len(content), _MOST_ELEMENTS):
            raise DataError(
                f"it announces {words[:40].decode('latin-1')!r} elements of"
                f" {kind[:40].decode('latin-1')!r} in {len(content)} bytes"
            )
