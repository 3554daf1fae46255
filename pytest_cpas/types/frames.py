"""Changes of axes, in one place; adapters declare their frames and the harness converts."""

from __future__ import annotations

import dataclasses

import numpy as np

from pytest_cpas.types import Array, Hypothesis, Mesh, MethodInfo, Prediction

#: ShapeNet object coordinates -> NOCS object coordinates: y stays, NOCS x is ShapeNet -z
#: (the quaternion (0, -1/sqrt 2, 0, 1/sqrt 2), scalar last).
NOCS_FROM_SHAPENET = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
NOCS_FROM_SHAPENET.setflags(write=False)

#: Object coordinates with z up -> ShapeNet ones: x stays, y is z.
SHAPENET_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
SHAPENET_FROM_Z_UP.setflags(write=False)

#: OpenGL camera coordinates (y up, looking along -z) -> OpenCV ones (y down, looking along +z).
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
OPENCV_FROM_OPENGL.setflags(write=False)


def permute_extents(extents: Array, axes: Array) -> Array:
    """Extents (3,) of a box after a change of axes by a signed permutation matrix (3, 3)."""
    permuted: Array = np.abs(axes) @ extents
    return permuted


def to_standard(hypothesis: Hypothesis, info: MethodInfo) -> Hypothesis:
    """Express a hypothesis in the OpenCV camera frame and the ShapeNet object frame."""
    if (info.camera_frame, info.object_frame) == ("opencv", "shapenet"):
        return hypothesis
    camera = OPENCV_FROM_OPENGL if info.camera_frame == "opengl" else np.eye(3)
    # maps ShapeNet object coordinates to the method's
    axes = NOCS_FROM_SHAPENET if info.object_frame == "nocs" else np.eye(3)
    extents, points, mesh = hypothesis.extents, hypothesis.points, hypothesis.mesh
    return dataclasses.replace(
        hypothesis,
        rotation=camera @ hypothesis.rotation @ axes,
        translation=camera @ hypothesis.translation,
        extents=None if extents is None else permute_extents(extents, axes.T),
        points=None if points is None else points @ axes,
        mesh=None if mesh is None else Mesh(mesh.vertices @ axes, mesh.triangles),
    )


def standard_prediction(prediction: Prediction, info: MethodInfo) -> Prediction:
    """A prediction with all its hypotheses as of :func:`to_standard`."""
    hypotheses = tuple(to_standard(hypothesis, info) for hypothesis in prediction.hypotheses)
    return Prediction(hypotheses, reason=prediction.reason)
