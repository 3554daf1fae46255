"""Reading meshes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from pytest_cpas.reading.files import regular
from pytest_cpas.types import Array, ContractError, DataError, Mesh

_FORMATS = (".obj", ".off", ".ply", ".stl")


def read_mesh(path: Path, axes: Array | None = None) -> Mesh:
    """The mesh in a file; ``axes`` (3, 3), if given, maps its coordinates to those wanted.

    Where ``axes`` mirrors, the triangles are turned, so that their outside stays outside.

    Raises :class:`DataError` naming the file when it is damaged or has no triangles.
    """
    if path.suffix.lower() not in _FORMATS:  # some others name further files to be read
        raise DataError(f"{path}: not a mesh of {', '.join(_FORMATS)}")
    try:
        # materials would be looked for beside the file, or wherever it says
        loaded = trimesh.load_mesh(regular(path), process=False, skip_materials=True)
        vertices = np.asarray(loaded.vertices, dtype=float)
        triangles = np.asarray(loaded.faces)
        if axes is None:
            return Mesh(vertices, triangles)
        return Mesh(vertices @ axes.T, triangles if np.linalg.det(axes) > 0 else triangles[:, ::-1])
    except Exception as error:  # trimesh raises what its parsers raise
        if isinstance(error, ContractError) and str(path) in str(error):
            raise
        raise DataError(f"{path}: not a readable mesh ({error}); fetch it again") from error
