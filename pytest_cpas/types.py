"""What the harness hands to a method, and what it takes back.

Conventions (everywhere in this package, adapters convert at their own border):

* lengths in metres, float64;
* camera frame: OpenCV (x right, y down, z forward), pixel centres at integers;
* object frame: ShapeNet (y up, origin in the centre of the object's axis-aligned bounding box);
* a pose maps object coordinates to camera coordinates: ``x_camera = R @ x_object + t``.

Everything is validated on entry and raises :class:`ContractError` with what was seen, what was
expected and what to look for in an adapter.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "CATEGORIES",
    "EQUIVARIANCES",
    "Asset",
    "Camera",
    "ContractError",
    "Dataset",
    "GroundTruth",
    "Hypothesis",
    "Mesh",
    "Method",
    "MethodInfo",
    "Observation",
    "Pose",
    "Prediction",
    "Sample",
    "SampleRef",
    "Symmetry",
]

Array = NDArray[np.float64]

#: The categories of the paper, in the order that the field's class ids 1..6 give them.
CATEGORIES = ("bottle", "bowl", "camera", "can", "laptop", "mug")

_IDENTITY = np.eye(3)

#: Largest entry of ``R @ R.T - I`` that still counts as a rotation (float32 networks reach 1e-6).
ORTHONORMAL_TOLERANCE = 1e-4


class ContractError(ValueError):
    """A value breaks the contract between the harness and a method or a data set."""


def _frozen(value: ArrayLike, shape: tuple[int | None, ...], what: str) -> Array:
    """Return a read-only float64 copy of ``value`` with the given shape (None: any length)."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ContractError(f"{what}: not an array of numbers ({error})") from None
    if array.shape != shape and (
        array.ndim != len(shape)
        or any(want not in (None, have) for have, want in zip(array.shape, shape, strict=True))
    ):
        wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ")"
        raise ContractError(f"{what}: shape is {array.shape}, expected {wanted}")
    if not np.isfinite(array).all():
        bad = int(np.count_nonzero(~np.isfinite(array)))
        raise ContractError(f"{what}: {bad} of {array.size} values are NaN or infinite")
    array.setflags(write=False)
    return array


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
        if self.width < 1 or self.height < 1:
            raise ContractError(f"camera: image size is {self.width} x {self.height}")
        values = (self.fx, self.fy, self.cx, self.cy)
        if not np.all(np.isfinite(values)) or self.fx <= 0 or self.fy <= 0:
            raise ContractError(
                f"camera: fx, fy, cx, cy are {values}; expected finite numbers in pixels, fx and"
                " fy positive (intrinsics of an OpenGL camera have a negative fy: change its sign)"
            )

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
        rotation = _frozen(self.rotation, (3, 3), "rotation")
        deviation = float(np.abs(rotation @ rotation.T - _IDENTITY).max())
        if deviation > ORTHONORMAL_TOLERANCE:
            norms = np.array2string(np.linalg.norm(rotation, axis=0), precision=4)
            raise ContractError(
                f"rotation: not orthonormal (R @ R.T differs from I by {deviation:.3g}, column"
                f" norms {norms}); expected a rotation matrix. {_cause(rotation)}"
            )
        if np.linalg.det(rotation) < 0:
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
            self, "translation", _frozen(self.translation, (3,), "translation (metres)")
        )

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """From a (4, 4) rigid transform whose last row is (0, 0, 0, 1)."""
        array = _frozen(matrix, (4, 4), "pose matrix")
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
        vertices = _frozen(self.vertices, (None, 3), "mesh vertices")
        triangles = np.array(self.triangles)
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
        rotations = _frozen(self.rotations, (None, 3, 3), "symmetry rotations")
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
        axis = _frozen(self.axis, (3,), "symmetry axis")
        length = float(np.linalg.norm(axis))
        if length < 1e-9:
            raise ContractError("symmetry: the axis has length 0")
        axis = axis / length
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
        direction = _frozen(axis, (3,), "symmetry axis")
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
        if n < 1:
            raise ContractError(f"symmetry: n-fold with n = {n}, expected n >= 1")
        x, y, z = _frozen(axis, (3,), "symmetry axis") / np.linalg.norm(axis)
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


@dataclass(frozen=True, eq=False)
class Observation:
    """What a method may see of one object.

    ``category``: its name. ``rgb`` (H, W, 3) float32 in 0..1. ``depth`` (H, W) float32 in metres
    along the optical axis, 0 = missing. ``mask`` (H, W) bool, the object's visible pixels.
    """

    category: str
    rgb: NDArray[np.float32]
    depth: NDArray[np.float32]
    mask: NDArray[np.bool_]
    camera: Camera

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        for name, array, shape, dtype in (
            ("rgb", self.rgb, (*size, 3), np.float32),
            ("depth", self.depth, size, np.float32),
            ("mask", self.mask, size, np.bool_),
        ):
            if array.shape != shape or array.dtype != dtype:
                raise ContractError(
                    f"{name}: shape {array.shape} of {array.dtype}, expected {shape} of"
                    f" {np.dtype(dtype)} (the camera is {size[1]} x {size[0]})"
                )
        # min and max propagate NaN, and a comparison with NaN is false
        if not (self.rgb.min() >= 0 and self.rgb.max() <= 1):
            raise ContractError(
                f"rgb: values from {self.rgb.min():g} to {self.rgb.max():g}, expected 0 to 1"
            )
        if not (self.depth.min() >= 0 and self.depth.max() < np.inf):
            raise ContractError(
                f"depth: values from {self.depth.min():g} to {self.depth.max():g}, expected finite"
                " metres, 0 where missing"
            )
        if not self.mask.any():
            raise ContractError("mask: empty, so there is no object to find")


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The truth about one object; a method never sees it.

    ``extents`` (3,) side lengths of the object-frame bounding box, metres. ``surface``: a
    :class:`Mesh` or points (N, 3) in the object frame, metres; None where a data set has no
    shapes (shape metrics are then n/a).
    """

    pose: Pose
    extents: Array
    symmetry: Symmetry
    surface: Mesh | Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "extents", _extents(self.extents))
        if self.surface is not None and not isinstance(self.surface, Mesh):
            object.__setattr__(self, "surface", _frozen(self.surface, (None, 3), "surface points"))


def _extents(value: ArrayLike) -> Array:
    extents = _frozen(value, (3,), "extents (metres)")
    if np.any(extents <= 0):
        raise ContractError(
            f"extents: {extents.tolist()}, expected three positive side lengths in metres (a"
            " negative one often comes from a mirrored axis or an unclamped network output)"
        )
    return extents


@dataclass(frozen=True, slots=True)
class SampleRef:
    """An entry of a data set's index; no image is opened to make one.

    ``id`` is unique in the data set and stable; ``scene`` groups samples that belong together;
    ``model`` is the data set's name of the object, the same for all its samples, if it has one.
    """

    id: str
    category: str
    scene: str
    model: str = ""

    def __post_init__(self) -> None:
        # one object each: few differ, but for the id, which rows and golden tables have too
        for name in ("id", "category", "scene", "model"):
            object.__setattr__(self, name, sys.intern(str(getattr(self, name))))


@dataclass(frozen=True, eq=False)
class Sample:
    """One object in one image: what a method sees, and the truth about it."""

    ref: SampleRef
    observation: Observation
    truth: GroundTruth


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One answer of a method, in the frames that its :class:`MethodInfo` declares.

    ``rotation`` (3, 3), ``translation`` (3,) metres. ``extents`` (3,) side lengths of the box,
    metres. The shape, posed by the same rotation and translation, is given in the object frame,
    metric: ``points`` (N, 3) or ``mesh``. ``score``: larger is surer. What a method does not
    estimate stays None and is n/a in every table.
    """

    rotation: Array
    translation: Array
    extents: Array | None = None
    points: Array | None = None
    mesh: Mesh | None = None
    score: float | None = None

    def __post_init__(self) -> None:
        pose = Pose(self.rotation, self.translation)
        object.__setattr__(self, "rotation", pose.rotation)
        object.__setattr__(self, "translation", pose.translation)
        if self.extents is not None:
            object.__setattr__(self, "extents", _extents(self.extents))
        if self.points is not None:
            points = _frozen(self.points, (None, 3), "points (metres)")
            if len(points) == 0:
                raise ContractError("points: no points; leave it None if there is no shape")
            object.__setattr__(self, "points", points)
        if self.mesh is not None and not isinstance(self.mesh, Mesh):
            raise ContractError(f"mesh: a {type(self.mesh).__name__}, expected pytest_cpas Mesh")
        if self.score is not None and not np.isfinite(self.score):
            raise ContractError(f"score: {self.score}, expected a finite number or None")

    @property
    def pose(self) -> Pose:
        """Rotation and translation as one."""
        return Pose(self.rotation, self.translation)

    @property
    def shape(self) -> Mesh | Array | None:
        """The mesh if there is one, else the points."""
        return self.points if self.mesh is None else self.mesh


@dataclass(frozen=True)
class Prediction:
    """A method's answer for one observation: ``hypotheses``, the best first.

    A method that finds no answer returns ``Prediction.failed("why")``: it counts as not correct,
    with its reason in the report.
    """

    hypotheses: tuple[Hypothesis, ...]
    reason: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "hypotheses", tuple(self.hypotheses))
        for hypothesis in self.hypotheses:
            if not isinstance(hypothesis, Hypothesis):
                raise ContractError(
                    f"prediction: holds a {type(hypothesis).__name__}, expected Hypothesis"
                )
        if not self.hypotheses and not self.reason:
            raise ContractError(
                "prediction: no hypothesis and no reason; say why with Prediction.failed('...')"
            )

    @classmethod
    def failed(cls, reason: str) -> Prediction:
        """No answer, and why."""
        return cls((), reason)


@dataclass(frozen=True)
class Asset:
    """A file that a method needs: ``path`` below the weights folder, where it is published, and
    under which licence."""

    path: str
    url: str
    licence: str

    def locate(self, weights: Path | None) -> Path:
        """The file below the weights folder; :class:`FileNotFoundError` if it is not there."""
        if weights is None or not (weights / self.path).is_file():
            where = f"{weights / self.path} does not exist" if weights else "no --cpas-weights"
            raise FileNotFoundError(
                f"{self.path}: {where}. It is published at {self.url} ({self.licence}); fetch it,"
                " and pass its folder with --cpas-weights DIR or CPAS_WEIGHTS"
            )
        return weights / self.path


#: Changes of the image whose effect on the answer geometry dictates: the image shifted, at half its
#: resolution, seen from further away, mirrored, rolled about the optical axis by 90 degrees.
EQUIVARIANCES = ("shift", "resolution", "distance", "mirror", "roll")


@dataclass(frozen=True)
class MethodInfo:
    """What a method declares about itself; the checks that are demanded of it follow from it.

    ``needs``: the parts of an observation that it uses. ``gives``: the parts of a hypothesis
    beside the pose that it estimates. ``object_frame`` and ``camera_frame``: the axes in which
    its hypotheses are expressed (the harness converts). ``deterministic``: the same seed gives
    the same answer. ``tolerance``: by how much, in metres and radians, answers may differ that
    must be the same: what batch size and threads do to sums of floats. ``equivariances``: what a
    method claims to follow, see :data:`EQUIVARIANCES`.
    """

    name: str
    categories: tuple[str, ...]
    needs: frozenset[Literal["rgb", "depth"]]
    gives: frozenset[Literal["extents", "shape", "score"]]
    licence: str
    object_frame: Literal["shapenet", "nocs"] = "shapenet"
    camera_frame: Literal["opencv", "opengl"] = "opencv"
    deterministic: bool = True
    assets: tuple[Asset, ...] = ()
    tolerance: float = 1e-5
    equivariances: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        for name, allowed in (
            ("needs", {"rgb", "depth"}),
            ("gives", {"extents", "shape", "score"}),
            ("equivariances", set(EQUIVARIANCES)),
        ):
            seen = frozenset(getattr(self, name))
            if not seen <= allowed:
                raise ContractError(
                    f"method {self.name!r}: {name} has {sorted(seen - allowed)}, expected some of"
                    f" {sorted(allowed)}"
                )
            object.__setattr__(self, name, seen)
        for name, choices in (
            ("object_frame", ("shapenet", "nocs")),
            ("camera_frame", ("opencv", "opengl")),
        ):
            if getattr(self, name) not in choices:
                raise ContractError(
                    f"method {self.name!r}: {name} is {getattr(self, name)!r}, expected one of"
                    f" {choices}"
                )
        if not 0 <= self.tolerance < 0.1:
            raise ContractError(
                f"method {self.name!r}: tolerance is {self.tolerance}, expected metres and radians"
                " that float noise explains, below 0.1"
            )
        if not self.categories:
            raise ContractError(f"method {self.name!r}: it declares no categories")
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", self.name):
            raise ContractError(
                f"method {self.name!r}: a name becomes a folder of golden tables; expected letters,"
                " digits, '.', '_' and '-'"
            )


@runtime_checkable
class Method(Protocol):
    """A categorical pose and shape method. Made without arguments, then loaded once.

    For ``assets_in``, which it may have as well, see :func:`assets_of`.
    """

    info: MethodInfo

    def load(self, assets: Path | None, device: str) -> None:
        """Read weights below ``assets`` (None for a method without any) onto ``device``."""

    def predict(self, batch: Sequence[Observation], seed: int) -> Sequence[Prediction]:
        """One prediction per observation, in order; all randomness comes from ``seed``."""


def assets_of(method: Method | type[Method], folder: Path | None) -> Sequence[Asset]:
    """The files that a method, or its class, loads from a weights folder.

    Those that it declares, unless it has a class method ``assets_in(folder)``, which says so where
    it depends on what is there.
    """
    assets_in: Callable[[Path], Sequence[Asset]] | None = getattr(method, "assets_in", None)
    if assets_in is None or folder is None:
        return method.info.assets
    return assets_in(folder)


@runtime_checkable
class Dataset(Protocol):
    """A data set. Made with the folder of ``--cpas-data`` (None if none was given).

    ``samples`` is in a stable order and made without opening an image, or from an index that is
    made once. ``digest`` identifies the
    content that the samples are judged by. ``missing``: what a partial copy lacks, one line each.
    ``damaged``: what could not even be listed, one line each; the run fails over it. A data set may
    have a set ``absent`` of ids that are listed but whose images are not there, so that only their
    truth is known: no method is judged on them; ``truth(ref)``, which reads the truth of a sample
    without its images (with them if ``quick_truth`` is False); and ``camera``, if one took all
    images.
    """

    name: str
    samples: Sequence[SampleRef]
    digest: str
    missing: Sequence[str]
    damaged: Sequence[str]

    def load(self, ref: SampleRef) -> Sample:
        """Read one sample. Raises :class:`ContractError` naming the file that is damaged."""
