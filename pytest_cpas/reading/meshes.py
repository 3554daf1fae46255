"""Reading meshes: of each format what is there is read, or the file is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pytest_cpas.reading.files import read_bytes
from pytest_cpas.reading.mesh_binary import ply_mesh, stl_mesh
from pytest_cpas.reading.mesh_texts import obj_mesh, off_mesh
from pytest_cpas.types import Array, ContractError, DataError, Mesh

_FORMATS = {".obj": obj_mesh, ".off": off_mesh, ".ply": ply_mesh, ".stl": stl_mesh}

#: Largest file, bytes: two million triangles have half of it.
_LARGEST = 2**28


def read_mesh(path: Path, axes: Array | None = None) -> Mesh:
    """The mesh in a file; ``axes`` (3, 3), if given, maps its coordinates to those wanted.

    Polygons become triangles that share their first corner. Where ``axes`` mirrors, the triangles
    are turned, so that their outside stays outside. Materials and textures are not looked for.

    Raises :class:`DataError` naming the file when it is damaged or has no triangles.
    """
    kind = path.suffix.lower()
    if kind not in _FORMATS:
        raise DataError(f"{path}: not a mesh of {', '.join(_FORMATS)}")
    content = read_bytes(path, _LARGEST)
    try:
        vertices, triangles = _FORMATS[kind](content)
        del content
        if axes is not None:
            vertices = vertices @ axes.T
            triangles = triangles if np.linalg.det(axes) > 0 else triangles[:, ::-1]
        return Mesh(vertices, triangles)
    except ContractError as error:
        raise DataError(f"{path}: not a readable mesh: {error}; fetch or export it again") from None
