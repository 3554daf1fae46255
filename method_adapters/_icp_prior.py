"""The category prior of the ``icp`` baseline: a few shapes per category as distance grids."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from importlib import resources

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

#: Categories that look the same from every side around y.
SYMMETRIC = ("bottle", "bowl", "can")
#: Categories whose x and z side scale together: a round body stays round.
ROUND = (*SYMMETRIC, "mug")
#: Real objects vary more than the shapes that the prior was made from: factor on the deviations
#: of their log extents, and what is added to them.
WIDENING, LEAST_DEVIATION = 1.25, 0.05
#: Surface samples that a shape's grid is made of; every how many of them is a model point; how
#: many model points lead, spread most evenly; and the samples' seed.
SAMPLES, THINNING, EVEN_POINTS, SAMPLE_SEED = 18_000, 3, 400, 0
#: Cells along the longest side of a distance grid (more for the laptop, whose plates are thin
#: beside its size), and the grid's margin around the shapes' box.
GRID_CELLS, LAPTOP_GRID_CELLS, GRID_MARGIN = 64, 80, 0.12


@dataclass(frozen=True)
class Prior:
    """The shapes of a category, object frame, metres, each centred on its bounding box.

    ``points`` (V, M, 3) and ``normals`` (V, M, 3): M surface samples of V shapes, in an order in
    which every leading part covers the surface evenly. ``log_extents`` (V, 3) of the shapes: over
    the category these are normally distributed about ``mean_log_extents`` (3,) with inverse
    covariance ``information`` (3, 3). ``scale_basis`` (3, B): the log scales of the axes that may
    change. The grid holds, per cell centre, signed distance and unit gradient.
    """

    points: Array
    normals: Array
    log_extents: Array
    mean_log_extents: Array
    information: Array
    symmetric: bool
    scale_basis: Array
    grid: NDArray[np.float32]
    grid_low: Array
    grid_size: NDArray[np.int64]
    cell: float

    @classmethod
    @functools.cache  # the grids take a fraction of a second, and never change
    def of(cls, category: str) -> Prior:
        """The prior of ``category``: read from the packaged asset, its grids built once."""
        asset = resources.files("method_adapters") / "icp_priors.npz"
        with asset.open("rb") as stream, np.load(stream) as arrays:
            vertices = arrays[f"{category}_vertices"] * 1e-5
            triangles = arrays[f"{category}_triangles"].astype(np.int64)
            mean, covariance = arrays[f"{category}_mean"], arrays[f"{category}_covariance"]
        samples = [_sample(shape, triangles) for shape in vertices]
        thin = [(p[::THINNING], n[::THINNING]) for p, n in samples]
        order = [_farthest_first(p, EVEN_POINTS) for p, _ in thin]
        points = np.stack([p[index] for (p, _), index in zip(thin, order, strict=True)])
        normals = np.stack([n[index] for (_, n), index in zip(thin, order, strict=True)])
        flat = points.reshape(-1, 3)
        margin = GRID_MARGIN * np.ptp(flat, axis=0).max()
        low, high = flat.min(axis=0) - margin, flat.max(axis=0) + margin
        cells = LAPTOP_GRID_CELLS if category == "laptop" else GRID_CELLS
        cell = float((high - low).max() / cells)
        size = np.ceil((high - low) / cell).astype(np.int64)
        xz, y = [[1.0], [0.0], [1.0]], [[0.0], [1.0], [0.0]]
        return cls(
            points=points,
            normals=normals,
            log_extents=np.log(np.ptp(vertices, axis=1)),
            mean_log_extents=mean,
            information=np.linalg.inv(WIDENING**2 * covariance + LEAST_DEVIATION**2 * np.eye(3)),
            symmetric=category in SYMMETRIC,
            scale_basis=np.hstack([xz, y]) if category in ROUND else np.eye(3),
            grid=np.concatenate([_distance(p, n, low, cell, size) for p, n in samples]),
            grid_low=low,
            grid_size=size,
            cell=cell,
        )

    def distance(self, variant: NDArray[np.int64], points: Array) -> tuple[Array, Array]:
        """Signed distance (K, N) of object-frame points (K, N, 3) to shape ``variant`` (K,),
        metres, to first order around the nearest cell centre, and its unit gradient."""
        index = np.floor((points - self.grid_low) / self.cell).astype(np.int64)
        np.clip(index, 0, self.grid_size - 1, out=index)
        flat = (index[..., 0] * self.grid_size[1] + index[..., 1]) * self.grid_size[2]
        flat += index[..., 2] + (variant * self.grid_size.prod())[:, None]
        value = self.grid[flat].astype(float)
        gradient = value[..., 1:]
        offset = points - (self.grid_low + (index + 0.5) * self.cell)
        return value[..., 0] + np.einsum("kni,kni->kn", gradient, offset), gradient


def _sample(vertices: Array, triangles: NDArray[np.int64]) -> tuple[Array, Array]:
    """Points and normals (SAMPLES, 3) evenly by area."""
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    area = np.linalg.norm(across, axis=1)
    rng = np.random.default_rng(SAMPLE_SEED)
    # one sample in every equal share of the area
    share = (np.arange(SAMPLES) + rng.random(SAMPLES)) / SAMPLES
    face = np.searchsorted(np.cumsum(area) / area.sum(), share).clip(max=len(area) - 1)
    u, v = rng.random((2, SAMPLES, 1))
    root = np.sqrt(u)
    points = (1 - root) * a[face] + root * (1 - v) * b[face] + root * v * c[face]
    normals = (across / np.maximum(area, 1e-12)[:, None])[face]
    return points, normals


def _farthest_first(points: Array, count: int) -> NDArray[np.int64]:
    """An order that starts with ``count`` points, each the farthest from those before it."""
    chosen = np.zeros(count, np.int64)
    distance = np.full(len(points), np.inf)
    for index in range(1, count):
        distance = np.minimum(distance, ((points - points[chosen[index - 1]]) ** 2).sum(axis=1))
        chosen[index] = np.argmax(distance)
    rest = np.setdiff1d(np.arange(len(points)), chosen)
    return np.concatenate([chosen, rest])


def _distance(
    points: Array, normals: Array, low: Array, cell: float, size: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Signed distance and unit gradient (C, 4) at the centres of a grid's cells."""
    centres = low + (np.indices(tuple(size)).reshape(3, -1).T + 0.5) * cell
    nearest = _nearest_by_cells(points, low, cell, size)
    near = np.linalg.norm(centres - points[nearest], axis=1) < 3 * cell
    tree = cKDTree(points)
    nearest[near] = tree.query(centres[near])[1]
    offset, normal = centres - points[nearest], normals[nearest]
    distance = np.linalg.norm(offset, axis=1)
    height = np.einsum("ci,ci->c", offset, normal)
    sign = np.where(height < 0, -1.0, 1.0)
    # close to the surface the nearest sample is beside the foot of the perpendicular: its tangent
    # plane is the better surface there
    spacing = np.median(np.asarray(tree.query(points, k=[2])[0]))
    beside = np.sqrt(np.maximum(distance**2 - height**2, 0))
    plane = beside < 1.5 * spacing
    gradient = np.where(
        plane[:, None], normal, sign[:, None] * offset / np.maximum(distance, 1e-9)[:, None]
    )
    value = np.where(plane, height, sign * distance)
    return np.column_stack([value, gradient]).astype(np.float32)


def _nearest_by_cells(
    points: Array, low: Array, cell: float, size: NDArray[np.int64]
) -> NDArray[np.int64]:
    """A point of the nearest cell that has any, for every cell: exact enough far away."""
    index = np.full(size, -1)
    index[tuple(np.floor((points - low) / cell).astype(np.int64).T)] = np.arange(len(points))
    where = distance_transform_edt(index < 0, return_distances=False, return_indices=True)
    found: NDArray[np.int64] = index[tuple(where)].ravel()
    return found
