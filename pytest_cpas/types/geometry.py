"""Cameras, poses, meshes and symmetries."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pytest_cpas.types._arrays import (
    LARGEST_PIXEL,
    Array,
    checked_integer,
    checked_number,
    frozen_array,
)
from pytest_cpas.types.errors import ContractError

__all__ = ["Camera", "Mesh", "Pose", "Symmetry"]


_IDENTITY = np.eye(3)

#: Largest side of an image, pixels.
_LARGEST_IMAGE = 2**20

#: Largest entry of ``R @ R.T - I`` that still counts as a rotation (float32 networks reach 1e-6).
ORTHONORMAL_TOLERANCE = 1e-4


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion.

    ``width``, ``height`` in pixels; ``fx``, ``fy``, ``cx``, ``cy`` in pixels, with the centre of
    the top-left pixel at (0, 0).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            size = f"camera: image size is {self.width!s:.40} x {self.height!s:.40}, {name}"
            side = checked_integer(getattr(self, name), size, 1, _LARGEST_IMAGE)
            object.__setattr__(self, name, side)
        seen = f"camera: fx, fy, cx, cy are {(self.fx, self.fy, self.cx, self.cy)!s:.200}"
        try:
            focal = [
                checked_number(f, "fx, fy", 1 / LARGEST_PIXEL, LARGEST_PIXEL)
                for f in (self.fx, self.fy)
            ]
            centre = [
                checked_number(c, "cx, cy", -LARGEST_PIXEL, LARGEST_PIXEL)
                for c in (self.cx, self.cy)
            ]
        except ContractError:
            raise ContractError(
                f"{seen}; expected finite numbers in pixels, fx and fy positive (intrinsics of an"
                " OpenGL camera have a negative fy: change its sign)"
            ) from None
        for name, value in zip(("fx", "fy", "cx", "cy"), (*focal, *centre), strict=True):
            object.__setattr__(self, name, value)

    @property
    def matrix(self) -> Array:
        """The intrinsic matrix K, (3, 3), pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=float)

    def project(self, points: ArrayLike) -> Array:
        """Project (..., 3) camera-frame points, metres, to (..., 2) pixel coordinates (u, v)."""
        xyz = np.asarray(points, dtype=float)
        u = self.fx * xyz[..., 0] / xyz[..., 2] + self.cx
        v = self.fy * xyz[..., 1] / xyz[..., 2] + self.cy
        return np.stack([u, v], axis=-1)

    def back_project(self, depth: NDArray[np.floating], mask: NDArray[np.bool_]) -> Array:
        """Camera-frame points (N, 3), metres, of the pixels in ``mask`` that have a depth.

        ``depth`` (H, W) in metres, 0 = missing; ``mask`` (H, W). Row-major pixel order.
        """
        rows, columns = np.nonzero(mask & (depth > 0))
        z = depth[rows, columns].astype(float)
        return np.stack(
            [(columns - self.cx) * z / self.fx, (rows - self.cy) * z / self.fy, z], axis=-1
        )


def _cause(rotation: Array) -> str:
    """What can have gone wrong with a matrix that is not orthonormal."""
    gram = rotation.T @ rotation
    scale = float(np.sqrt(np.trace(gram) / 3))
    if scale > 0 and np.abs(gram / scale**2 - _IDENTITY).max() <= ORTHONORMAL_TOLERANCE:
        return (
            f"It is a rotation times {scale:.6g}, a scale left in the rotation: give"
            f" rotation / {scale:.6g} (np.cbrt(np.linalg.det(rotation)) of each sample), and"
            " extents and shape in metres"
        )
    return (
        "Usual causes: the extents left in the rotation, a quaternion that was not normalised,"
        " columns of a network's output that were not made orthogonal"
    )


@dataclass(frozen=True, eq=False)
class Pose:
    """Object-to-camera pose: ``rotation`` (3, 3), ``translation`` (3,) in metres.

    A rotation within ``ORTHONORMAL_TOLERANCE`` of orthonormal is replaced by the nearest
    rotation; anything further away is refused, so that no metric ever scores it.
    """

    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        rotation = frozen_array(self.rotation, (3, 3), "rotation")
        deviation = float(np.abs(rotation @ rotation.T - _IDENTITY).max())
        if deviation > ORTHONORMAL_TOLERANCE:
            norms = np.array2string(np.linalg.norm(rotation, axis=0), precision=4)
            raise ContractError(
                f"rotation: not orthonormal (R @ R.T differs from I by {deviation:.3g}, column"
                f" norms {norms}); expected a rotation matrix. {_cause(rotation)}"
            )
        # of nine numbers this is several times as fast as numpy's determinant
        (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
        if a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0:
            raise ContractError(
                "rotation: determinant -1, a reflection (left-handed); expected +1. Usual causes:"
                " one axis flipped instead of two, a frame change that mirrors"
            )
        if deviation > 1e-14:
            u, _, vt = np.linalg.svd(rotation)
            rotation = u @ vt
            rotation.setflags(write=False)
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(
            self, "translation", frozen_array(self.translation, (3,), "translation (metres)")
        )

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """From a (4, 4) rigid transform whose last row is (0, 0, 0, 1)."""
        array = frozen_array(matrix, (4, 4), "pose matrix")
        if not np.allclose(array[3], (0, 0, 0, 1), atol=1e-6):
            raise ContractError(
                f"pose matrix: last row is {array[3]}, expected (0, 0, 0, 1); is it transposed?"
            )
        return cls(array[:3, :3], array[:3, 3])

    @property
    def matrix(self) -> Array:
        """The rigid transform as a (4, 4) matrix."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def apply(self, points: ArrayLike) -> Array:
        """Map (..., 3) object-frame points to the camera frame, metres."""
        return np.asarray(points, dtype=float) @ self.rotation.T + self.translation

    def inverse(self) -> Pose:
        """The camera-to-object transform."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh: ``vertices`` (V, 3) in metres, ``triangles`` (F, 3) vertex indices."""

    vertices: Array
    triangles: NDArray[np.int64]

    def __post_init__(self) -> None:
        vertices = frozen_array(self.vertices, (None, 3), "mesh vertices")
        try:
            triangles = np.array(self.triangles)
        except (TypeError, ValueError, OverflowError) as error:
            raise ContractError(f"mesh triangles: no vertex indices ({error})") from None
        if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
            raise ContractError(
                f"mesh triangles: shape {triangles.shape} of {triangles.dtype}, expected (F, 3)"
                " vertex indices"
            )
        if len(triangles) == 0:
            raise ContractError("mesh: it has no triangles")
        if triangles.min() < 0 or triangles.max() >= len(vertices):
            raise ContractError(
                f"mesh triangles: indices run from {triangles.min()} to {triangles.max()}, but"
                f" there are {len(vertices)} vertices"
            )
        triangles = triangles.astype(np.int64)
        triangles.setflags(write=False)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "triangles", triangles)

    @property
    def bounds(self) -> Array:
        """The axis-aligned box as (2, 3): lowest and highest corner, metres."""
        used = self.vertices[np.unique(self.triangles)]
        return np.stack([used.min(axis=0), used.max(axis=0)])


def _direction(axis: ArrayLike) -> Array:
    """A unit vector along a symmetry axis (3,)."""
    vector = frozen_array(axis, (3,), "symmetry axis")
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise ContractError(f"symmetry: the axis has length {length:.3g}")
    return np.asarray(vector / length)


#: More turns than that are a continuous axis.
_LARGEST_FOLD = 10_000


@dataclass(frozen=True, eq=False)
class Symmetry:
    """The group of object-frame rotations that leave an object unchanged.

    The group is ``{spin(angle) @ rotation}``: every rotation of ``rotations`` (n, 3, 3; the
    identity is among them), preceded by any spin about ``axis`` if there is one. ``sphere`` is
    the group of all rotations. Build one with the named constructors.
    """

    rotations: Array = field(default_factory=lambda: np.eye(3)[None])
    axis: Array | None = None
    sphere: bool = False

    def __post_init__(self) -> None:
        rotations = frozen_array(self.rotations, (None, 3, 3), "symmetry rotations")
        identity = np.eye(3)
        deviation = np.abs(rotations @ rotations.transpose(0, 2, 1) - identity).max(initial=0)
        if deviation > ORTHONORMAL_TOLERANCE or np.any(np.linalg.det(rotations) < 0):
            raise ContractError("symmetry: every element must be a proper rotation matrix")
        u, _, vt = np.linalg.svd(rotations)
        rotations = u @ vt
        if not np.any(np.abs(rotations - identity).max(axis=(1, 2)) < 1e-6):
            rotations = np.concatenate([identity[None], rotations])
        rotations.setflags(write=False)
        object.__setattr__(self, "rotations", rotations)
        if self.axis is None:
            return
        axis = _direction(self.axis)
        if np.any(np.abs(np.abs(rotations @ axis @ axis) - 1) > 1e-6):
            raise ContractError(
                "symmetry: a rotation turns the continuous axis away from itself; together they"
                " generate all rotations (use Symmetry.full())"
            )
        axis.setflags(write=False)
        object.__setattr__(self, "axis", axis)

    @classmethod
    def none(cls) -> Symmetry:
        """No symmetry: the identity alone."""
        return cls()

    @classmethod
    def about(cls, axis: ArrayLike, *, flip: bool = False) -> Symmetry:
        """Any angle about ``axis`` (3,); with ``flip`` also upside down."""
        direction = _direction(axis)
        if not flip:
            return cls(axis=direction)
        other = np.eye(3)[np.argmin(np.abs(direction))]
        normal = np.cross(direction, other)
        normal /= np.linalg.norm(normal)
        half_turn = 2 * np.outer(normal, normal) - np.eye(3)
        return cls(rotations=np.stack([np.eye(3), half_turn]), axis=direction)

    @classmethod
    def n_fold(cls, axis: ArrayLike, n: int) -> Symmetry:
        """Rotations by multiples of 360/``n`` degrees about ``axis`` (3,)."""
        checked_integer(n, "symmetry: n of n-fold", 1, _LARGEST_FOLD)
        x, y, z = _direction(axis)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        angles = 2 * np.pi * np.arange(n) / n
        return cls(
            np.eye(3)
            + np.sin(angles)[:, None, None] * cross
            + (1 - np.cos(angles))[:, None, None] * (cross @ cross)
        )

    @classmethod
    def box(cls) -> Symmetry:
        """Half turns about the three axes: a box with three different extents."""
        return cls(
            np.stack([np.diag(d) for d in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))])
        )

    @classmethod
    def full(cls) -> Symmetry:
        """All rotations: a sphere."""
        return cls(sphere=True)
