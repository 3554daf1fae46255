"""The one rendering path: posed meshes to depth, instances and normals.

Open3D's ray caster (Embree), or :mod:`pytest_cpas.datasets.rasterising`, only decides which
triangle a pixel's ray meets. Depth and normal come from that triangle's plane in double precision
by elementwise operations, which are the same on every processor.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_cpas._open3d import import_open3d
from pytest_cpas.types import Array, Camera, Mesh, Pose

__all__ = [
    "Cast",
    "Rendering",
    "camera_rays",
    "cast_rays",
    "cross",
    "dot",
    "hidden",
    "render",
]

#: What was measured so much nearer than an object, metres, hides it.
IN_FRONT = 0.01

#: Of triangles' corners (F, 3, 3) in a camera's frame: the flat indices of the pixels whose ray
#: meets one, and which it meets first.
Cast = Callable[[Array, Camera], tuple[NDArray[np.int64], NDArray[np.int64]]]


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a camera sees, per pixel.

    ``depth`` (H, W) metres along the optical axis, 0 = nothing. ``instance`` (H, W): index of the
    mesh seen, -1 = nothing. ``triangle`` (H, W): index of its triangle, -1 = nothing. ``normal``
    (H, W, 3): unit normal in the camera frame, turned towards the camera, 0 = nothing.
    """

    depth: Array
    instance: NDArray[np.int64]
    triangle: NDArray[np.int64]
    normal: Array


@functools.lru_cache(maxsize=4)
def camera_rays(camera: Camera) -> Array:
    """Directions (H, W, 3) through the pixel centres, scaled to z = 1."""
    u = (np.arange(camera.width) - camera.cx) / camera.fx
    v = (np.arange(camera.height) - camera.cy) / camera.fy
    rays = np.stack(np.broadcast_arrays(u[None, :], v[:, None], 1.0), axis=-1)
    rays.setflags(write=False)
    return rays


def render(
    objects: Sequence[tuple[Mesh, Pose]], camera: Camera, cast: Cast | None = None
) -> Rendering:
    """Render meshes at their object-to-camera poses; both sides of a triangle are seen.

    ``cast`` is Open3D's by default, which raises :class:`ImportError` that says what to install
    where Open3D is missing.
    """
    shape = (camera.height, camera.width)
    depth, normals = np.zeros(shape), np.zeros((*shape, 3))
    instances, triangles = np.full(shape, -1), np.full(shape, -1)
    if not objects:
        return Rendering(depth, instances, triangles, normals)
    corners = np.concatenate([_corners(mesh, pose) for mesh, pose in objects])
    first = np.cumsum([0] + [len(mesh.triangles) for mesh, _ in objects])
    hit, triangle = (cast or cast_rays)(corners, camera)

    # planes: normal . x = offset
    normal = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.sqrt(dot(normal, normal))
    normal /= np.where(length > 0, length, 1)[:, None]
    offset = dot(normal, corners[:, 0])
    low, high = corners[:, :, 2].min(axis=1), corners[:, :, 2].max(axis=1)
    seen = normal[triangle]
    towards = dot(seen, camera_rays(camera).reshape(-1, 3)[hit])
    with np.errstate(divide="ignore", invalid="ignore"):
        z = offset[triangle] / towards
    # a ray along the plane has no depth there, and rounding can push one off a triangle's edge
    z = np.clip(np.where(np.isfinite(z), z, low[triangle]), low[triangle], high[triangle])

    instance = np.searchsorted(first, np.arange(len(corners)), side="right") - 1
    depth.flat[hit] = z
    normals.reshape(-1, 3)[hit] = np.where(towards > 0, -1.0, 1.0)[:, None] * seen
    instances.flat[hit] = instance[triangle]
    triangles.flat[hit] = triangle - first[instance[triangle]]
    return Rendering(depth, instances, triangles, normals)


def hidden(rendered: Array, measured: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Where (H, W) something else was measured in front of a rendered object.

    Both in metres, 0 = nothing; a pixel without a measurement hides nothing.
    """
    nearer: NDArray[np.bool_] = (measured > 0) & (measured < rendered - IN_FRONT)
    return nearer


def _corners(mesh: Mesh, pose: Pose) -> Array:
    """Corners (F, 3, 3) of a mesh's triangles in the camera frame."""
    v, r = mesh.vertices, pose.rotation
    # a matrix product would go through BLAS, whose rounding depends on the processor
    moved = v[:, :1] * r[:, 0] + v[:, 1:2] * r[:, 1] + v[:, 2:] * r[:, 2] + pose.translation
    return moved[mesh.triangles]


def cast_rays(corners: Array, camera: Camera) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """What Open3D's ray caster says, as a :data:`Cast`."""
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    vertices = corners.reshape(-1, 3).astype(np.float32)
    scene.add_triangles(vertices, np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3))
    answer = scene.cast_rays(o3d.core.Tensor(_float_rays(camera)))
    hit = np.flatnonzero(np.isfinite(answer["t_hit"].numpy()))
    return hit, answer["primitive_ids"].numpy().reshape(-1)[hit].astype(np.int64)


@functools.lru_cache(maxsize=4)
def _float_rays(camera: Camera) -> NDArray[np.float32]:
    """Origins and directions (H, W, 6) for the ray caster."""
    directions = camera_rays(camera)
    return np.concatenate([np.zeros_like(directions), directions], axis=-1).astype(np.float32)


def dot(a: Array, b: Array) -> Array:
    """Inner products (...) of vectors (..., 3), by one order of additions on every processor."""
    product: Array = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
    return product


def cross(a: Array, b: Array) -> Array:
    """Cross products (..., 3) of vectors (..., 3), likewise."""
    return np.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        axis=-1,
    )
