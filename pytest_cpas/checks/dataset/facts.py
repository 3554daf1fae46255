"""What the checks of a data set measure: plain values of each sample, and of each mesh once.

A sample's mesh is rendered at its pose and compared with the measured depth and the mask. A mesh
is looked at from six sides: where its inside is seen, it is open.
"""

from __future__ import annotations

import functools
import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.datasets._edges import uneven_edges
from pytest_cpas.datasets.rendering import camera_rays, hidden, render
from pytest_cpas.types import (
    Array,
    Camera,
    ContractError,
    Dataset,
    Derived,
    GroundTruth,
    Mesh,
    Observation,
    Pose,
    SampleRef,
    as_dataset,
)
from pytest_cpas.types.datasets import mask_box
from pytest_cpas.types.derived import Part, derived_note, itself

__all__ = [
    "ImageFacts",
    "MeshFacts",
    "SampleFacts",
    "Survey",
    "measure_mesh",
    "measure_sample",
    "survey",
]

#: Sides of an object as (axis, sign).
_SIDES = {
    "top": (1, 1),
    "bottom": (1, -1),
    "+x side": (0, 1),
    "-x side": (0, -1),
    "+z side": (2, 1),
    "-z side": (2, -1),
}


#: What the checks compare a part with.
COMPARED: dict[Part, frozenset[str]] = {
    "mask": frozenset({"mesh", "pose", "depth"}),
    "extents": frozenset({"mesh"}),
}


@dataclass(frozen=True)
class ImageFacts:
    """What was measured in the images of a sample; lengths in metres.

    ``camera``: width, height, fx, fy, cx, cy. ``centre``: pixel of the object's centre, None if it
    is behind the camera. ``overlap``: share of the mask's bounding rectangle that lies in that of
    the projected box. ``residual`` and ``offset``: median of |measured - rendered| depth, and of
    its signed value, over the mask's pixels that show the mesh and have a depth; None if there are
    none. ``iou``: of the mask and the rendered silhouette, less what something else hides of it;
    None without a mesh. ``colour`` and ``depth``: digests of the image, each with the mask.
    """

    camera: tuple[int, int, float, float, float, float]
    centre: tuple[float, float] | None
    overlap: float
    residual: float | None
    offset: float | None
    iou: float | None
    colour: str
    depth: str


@dataclass(frozen=True)
class SampleFacts:
    """What was measured of one sample; lengths in metres.

    ``up``: the object's up axis in the camera frame. ``distance``: z of the object's centre.
    ``mesh``: key of its mesh, empty if there is none. ``extents_error``: largest difference of a
    side of the mesh's box from the sample's extents, None without a mesh. ``image``: None where a
    copy of the data set has the truth without the images. ``fit_error``: how well the pose fits,
    None where it is published.
    """

    sample: str
    category: str
    model: str
    up: tuple[float, float, float]
    distance: float
    mesh: str
    extents_error: float | None
    image: ImageFacts | None
    fit_error: float | None = None


@dataclass(frozen=True)
class MeshFacts:
    """What was measured of one mesh, in metres.

    ``sample``: the first one that has it. ``open_edges``: edges of an odd number of triangles,
    after vertices in the same place were merged, 0 if the surface has no border; ``crowded_edges``:
    those of them that are of three or more. ``inside``: per
    side the share of what is seen from there that is the inside of the surface. ``volume``: m^3,
    signed; negative where triangles are wound inwards.
    """

    key: str
    sample: str
    category: str
    model: str
    open_edges: int
    inside: dict[str, float]
    volume: float
    centre: tuple[float, float, float]
    extents: tuple[float, float, float]
    crowded_edges: int = 0

    @property
    def name(self) -> str:
        """The model's name, or else whose mesh it is."""
        return self.model or f"mesh of {self.sample}"


@dataclass
class Survey:
    """A data set, and what has been measured of it so far.

    ``refs``: all samples it lists; ``unreadable``: per sample why it cannot be loaded;
    ``elsewhere``: keys of meshes that have been measured for another survey; ``derived``: of the
    data set.
    """

    name: str
    refs: Sequence[SampleRef]
    missing: Sequence[str] = ()
    damaged: Sequence[str] = ()
    notes: Sequence[str] = ()
    samples: dict[str, SampleFacts] = field(default_factory=dict)
    meshes: dict[str, MeshFacts] = field(default_factory=dict)
    unreadable: dict[str, str] = field(default_factory=dict)
    elsewhere: Collection[str] = ()
    derived: Sequence[Derived] = ()

    @classmethod
    def of(cls, dataset: Dataset, elsewhere: Collection[str] = ()) -> Survey:
        """Of a data set of which nothing has been measured yet."""
        return cls(
            dataset.name,
            dataset.samples,
            dataset.missing,
            dataset.damaged,
            dataset.notes,
            elsewhere=elsewhere,
            derived=dataset.derived,
        )

    @property
    def derived_note(self) -> str:
        """What is derived, in a line; empty for nothing."""
        return derived_note(self.derived, [ref.id for ref in self.refs])

    def compares_itself(self, sample: str, part: Part) -> bool:
        """Whether a part of a sample is made of the very things that its check compares it with."""
        return itself(self.derived, sample, part, COMPARED[part])

    @property
    def listed(self) -> Counter[str]:
        """Samples per category."""
        return Counter(ref.category for ref in self.refs)

    @property
    def examined(self) -> int:
        """How many samples were looked at."""
        return len(self.samples) + len(self.unreadable)

    @property
    def complete(self) -> bool:
        """Whether every sample that was published was looked at."""
        return not self.missing and self.examined == len(self.refs)

    @property
    def up_axes(self) -> Array:
        """The objects' up axes in the camera frame, (n, 3)."""
        return np.array([facts.up for facts in self.samples.values()]).reshape(-1, 3)

    def sort(self) -> None:
        """Bring the samples into the data set's order, however they arrived."""
        order = {ref.id: index for index, ref in enumerate(self.refs)}
        self.samples = dict(sorted(self.samples.items(), key=lambda entry: order[entry[0]]))
        self.unreadable = dict(sorted(self.unreadable.items(), key=lambda entry: order[entry[0]]))

    def examine(self, dataset: Dataset, ref: SampleRef) -> None:
        """Measure one sample, and its mesh if it is new."""
        try:
            if ref.id in dataset.absent:
                truth, seen = dataset.truth(ref), None
            else:
                sample = dataset.load(ref)
                truth, seen = sample.truth, sample.observation
            fit_error = dataset.fit_error(ref)
        except ContractError as error:
            self.unreadable[ref.id] = str(error)
            return
        facts = replace(measure_sample(ref, truth, seen), fit_error=fit_error)
        self.samples[ref.id] = facts
        new = facts.mesh not in self.meshes and facts.mesh not in self.elsewhere
        if new and isinstance(truth.surface, Mesh):
            self.meshes[facts.mesh] = measure_mesh(truth.surface, ref)


def survey(dataset: Dataset, refs: Iterable[SampleRef] | None = None) -> Survey:
    """Measure a data set, or the samples ``refs`` of it."""
    dataset = as_dataset(dataset)
    result = Survey.of(dataset)
    for ref in dataset.samples if refs is None else refs:
        result.examine(dataset, ref)
    return result


def measure_sample(ref: SampleRef, truth: GroundTruth, seen: Observation | None) -> SampleFacts:
    """Measure one sample; raises :class:`ImportError` where Open3D is missing."""
    mesh = truth.surface if isinstance(truth.surface, Mesh) else None
    corners = truth.pose.apply((np.array(list(np.ndindex(2, 2, 2))) - 0.5) * truth.extents)
    difference = None
    if mesh is not None:
        difference = float(np.abs(np.ptp(mesh.bounds, axis=0) - truth.extents).max())
    return SampleFacts(
        sample=ref.id,
        category=ref.category,
        model=ref.model,
        up=_triple(truth.pose.rotation[:, 1]),
        distance=float(truth.pose.translation[2]),
        mesh="" if mesh is None else _mesh_key(mesh),
        extents_error=difference,
        image=None if seen is None else _measure_image(seen, truth.pose, mesh, corners),
    )


def _measure_image(seen: Observation, pose: Pose, mesh: Mesh | None, corners: Array) -> ImageFacts:
    camera, mask = seen.camera, seen.mask
    residual = offset = iou = centre = None
    if pose.translation[2] > 0:
        u, v = camera.project(pose.translation).tolist()
        centre = (u, v)
    if mesh is not None:
        rendered = render([(mesh, pose)], camera).depth
        shown = rendered > 0
        both = shown & mask & (seen.depth > 0)
        if both.any():
            differences = seen.depth[both] - rendered[both]
            residual, offset = float(np.median(np.abs(differences))), float(np.median(differences))
        union = mask | (shown & ~hidden(rendered, seen.depth))
        iou = float(np.count_nonzero(mask & shown) / np.count_nonzero(union))
    return ImageFacts(
        camera=(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy),
        centre=centre,
        overlap=_overlap(mask, camera.project(corners)) if corners[:, 2].min() > 0 else 0.0,
        residual=residual,
        offset=offset,
        iou=iou,
        colour=_digest(seen.rgb, mask),
        depth=_digest(seen.depth, mask),
    )


def measure_mesh(mesh: Mesh, ref: SampleRef) -> MeshFacts:
    """Measure one mesh, of which ``ref`` is a sample."""
    low, high = mesh.bounds
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles] - (low + high) / 2, 1, 0)
    single, crowded = uneven_edges(mesh)
    return MeshFacts(
        key=_mesh_key(mesh),
        sample=ref.id,
        category=ref.category,
        model=ref.model,
        open_edges=single + crowded,
        crowded_edges=crowded,
        inside={side: _inside_seen(mesh, *direction) for side, direction in _SIDES.items()},
        volume=float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6),
        centre=_triple((low + high) / 2),
        extents=_triple(high - low),
    )


def _inside_seen(mesh: Mesh, axis: int, sign: int) -> float:
    """Share of the pixels that show the inside, seen from far out on an object axis."""
    low, high = mesh.bounds
    z = np.zeros(3)
    z[axis] = -sign
    x = np.roll(np.abs(z), 1)
    rotation = np.stack([x, np.cross(z, x), z])
    distance = 20 * float(np.linalg.norm(high - low))
    pose = Pose(rotation, -rotation @ ((low + high) / 2 - distance * z))
    camera = Camera(128, 128, 2400.0, 2400.0, 63.5, 63.5)
    seen = render([(mesh, pose)], camera)
    pixels = seen.triangle >= 0
    if not pixels.any():
        return 0.0
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles[seen.triangle[pixels]]], 1, 0)
    outwards = np.cross(b - a, c - a) @ rotation.T
    away = np.einsum("ij,ij->i", outwards, camera_rays(camera)[pixels]) > 0
    return float(np.mean(away))


def _overlap(mask: NDArray[np.bool_], pixels: Array) -> float:
    """Share of the mask's bounding rectangle within that of ``pixels`` (n, 2)."""
    top, left, bottom, right = mask_box(mask)
    share = 1.0
    for first, end, low, high in (
        (left, right, *_range(pixels[:, 0])),
        (top, bottom, *_range(pixels[:, 1])),
    ):
        share *= max(0.0, min(end - 0.5, high) - max(first - 0.5, low)) / (end - first)
    return float(share)


def _range(values: Array) -> tuple[float, float]:
    return float(values.min()), float(values.max())


@functools.lru_cache(maxsize=8)
def _mesh_key(mesh: Mesh) -> str:
    return _digest(mesh.vertices, mesh.triangles)


def _digest(*arrays: NDArray[np.generic]) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for array in arrays:
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
