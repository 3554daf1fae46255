"""Data sets whose index holds all that is known of a sample but its images and its mesh."""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.datasets._index import Scan
from pytest_cpas.datasets._tree import Tree
from pytest_cpas.datasets.nocs import symmetry_of
from pytest_cpas.datasets.rendering import hidden, render
from pytest_cpas.reading.images import read_ids
from pytest_cpas.reading.meshes import read_mesh
from pytest_cpas.reading.numbers import numbers
from pytest_cpas.types import (
    Array,
    Camera,
    ContractError,
    DataError,
    GroundTruth,
    Mesh,
    Observation,
    Pose,
    Sample,
    SampleRef,
    Symmetry,
    raised_as,
)
from pytest_cpas.types.datasets import mask_box

#: Most meshes kept at a time: the largest data sets have more than fit into memory.
_MESHES = 64


class Record(NamedTuple):
    """A sample. Paths are below the root, ``None`` where there is none.

    ``camera``: width, height, fx, fy, cx, cy. ``rotation`` (9,), row by row, and ``translation``
    (3,), metres: object to camera, in the axes of :mod:`pytest_cpas.types`. ``extents`` (3,),
    metres, or the mesh's box. The mask is where the mask image has ``mask_id``, or is not 0;
    without an image, the mesh is rendered. ``amodal``: the image shows also what others hide, of
    which the part that was measured nearer than the mesh is left out. ``fit_error``: metres, as of
    :meth:`pytest_cpas.types.Dataset.fit_error`.
    """

    rgb: str
    depth: str
    camera: list[float]
    rotation: list[float]
    translation: list[float]
    extents: list[float] | None = None
    mesh: str | None = None
    mask: str | None = None
    mask_id: int | None = None
    depth_per_metre: float = 1000.0
    symmetry: str | None = None
    amodal: bool = False
    fit_error: float | None = None


class RecordTree(Tree):
    """A data set whose samples are listed as a :class:`Record` each."""

    #: Maps the coordinates of the mesh files to ShapeNet axes, metres.
    mesh_axes: Array | None = None

    def __init__(self, name: str, root: Path) -> None:
        """List the samples."""
        super().__init__(name, root)
        self._mesh = functools.lru_cache(maxsize=_MESHES)(self._read_mesh)

    @raised_as(DataError)
    def load(self, ref: SampleRef) -> Sample:
        """Read one sample; :class:`DataError` names the file that is damaged."""
        record, truth = Record(*self._details[ref.id]), self.truth(ref)
        width, height, *intrinsics = record.camera
        camera = Camera(int(width), int(height), *intrinsics)
        depth = self._read_depth(self.root / record.depth, camera, record.depth_per_metre)
        rgb = self._read_rgb(self.root / record.rgb, camera)
        mask = self._mask(record, truth, depth, camera)
        try:
            observation = Observation(
                category=ref.category, rgb=rgb, depth=depth, mask=mask, camera=camera
            )
        except ContractError as error:
            raise DataError(f"{self.root / record.depth}: {error}") from None
        return Sample(ref, observation, truth)

    @raised_as(DataError)
    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about a sample, without its images."""
        record = Record(*self._details[ref.id])
        mesh = None if record.mesh is None else self._mesh(record.mesh)
        if record.extents is not None:
            extents = numbers(record.extents, (3,), f"{ref.id}: extents")
        elif isinstance(mesh, Mesh):
            extents = mesh.bounds[1] - mesh.bounds[0]
        else:
            raise DataError(f"{ref.id}: neither extents nor a mesh")
        rotation = numbers(record.rotation, (3, 3), f"{ref.id}: rotation")
        translation = numbers(record.translation, (3,), f"{ref.id}: translation")
        try:
            pose = Pose(rotation, translation)
            return GroundTruth(
                pose=pose, extents=extents, symmetry=self._symmetry(ref, record), surface=mesh
            )
        except ContractError as error:
            raise DataError(f"{ref.id}: {error}") from None

    def fit_error(self, ref: SampleRef) -> float | None:
        """How well a fitted pose fits, metres."""
        return Record(*self._details[ref.id]).fit_error

    def box_of(self, ref: SampleRef) -> Array | None:
        """The 2-D box of what is seen of an object: that of its mask."""
        record = Record(*self._details[ref.id])
        if ref.id in self.absent or record.mask is None or record.amodal:
            return super().box_of(ref)
        width, height, *intrinsics = record.camera
        camera = Camera(int(width), int(height), *intrinsics)
        mask = self._listed_mask(record, record.mask, camera)
        return mask_box(mask) if mask.any() else None

    def _symmetry(self, ref: SampleRef, record: Record) -> Symmetry:
        return symmetry_of(ref.category)

    def _mask(
        self, record: Record, truth: GroundTruth, depth: NDArray[np.float32], camera: Camera
    ) -> NDArray[np.bool_]:
        if record.mask is not None:
            mask = self._listed_mask(record, record.mask, camera)
            if record.amodal and isinstance(truth.surface, Mesh):
                mask = mask & ~hidden(_rendered(truth.surface, truth.pose, camera), depth)
            where = record.mask
        elif isinstance(truth.surface, Mesh):
            mask = _visible(truth.surface, truth.pose, depth, camera)
            where = record.depth
        else:
            raise DataError(f"{record.rgb}: neither a mask nor a mesh to render one from")
        if not mask.any():
            raise DataError(f"{self.root / where}: nothing is seen of the object")
        return mask

    def _read_mesh(self, name: str) -> Mesh | Array:
        return read_mesh(self.root / name, self.mesh_axes)

    def _listed_mask(self, record: Record, path: str, camera: Camera) -> NDArray[np.bool_]:
        ids = self._read_ids(self.root / path, camera)
        mask: NDArray[np.bool_] = ids > 0 if record.mask_id is None else ids == record.mask_id
        return mask

    def add_seen(self, scan: Scan, listed: Sequence[tuple[SampleRef, Record]]) -> None:
        """List the samples of which their mask has a pixel. This opens the masks."""
        sizes = {record.mask: record.camera[:2] for _, record in listed if record.mask}
        for mask in sizes:
            scan.weigh(mask)

        def ids(mask: str) -> set[int] | ContractError:
            width, height = map(int, sizes[mask])
            try:
                seen = read_ids(self.root / mask, Camera(width, height, 1, 1, 0, 0))
            except ContractError as error:
                return error
            return set(np.flatnonzero(np.bincount(seen.ravel())).tolist())

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            found = dict(zip(sizes, pool.map(ids, sizes), strict=True))
        scan.damaged += [str(error) for error in found.values() if isinstance(error, ContractError)]
        for ref, record in listed:
            seen = found[record.mask or ""]
            if isinstance(seen, ContractError):
                continue
            if record.mask_id in seen:
                scan.add(ref, record)
            else:
                scan.lacks("objects that are hidden in their image", ref.id)


def _visible(
    mesh: Mesh, pose: Pose, depth: NDArray[np.float32], camera: Camera
) -> NDArray[np.bool_]:
    """Where (H, W) a posed mesh is seen and nothing was measured in front of it.

    ``depth`` (H, W): measured metres, 0 = missing. A pixel without a measurement counts as seen.
    """
    rendered = _rendered(mesh, pose, camera)
    mask: NDArray[np.bool_] = (rendered > 0) & ~hidden(rendered, depth)
    return mask


def _rendered(mesh: Mesh, pose: Pose, camera: Camera) -> Array:
    """Depth (H, W) of a posed mesh, metres, 0 = nothing."""
    return render([(mesh, pose)], camera).depth
