"""What the ``icp`` baseline takes from one observation: surface points and free space.

The masked depth gives points on the object's surface. The rest of the image is evidence as well:
a part of the object cannot lie where the camera looks through to something further away, neither
in front of the depth measured inside the mask, nor beside the mask and in front of the background.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pytest_cpas.adapting import Camera, Observation

Array = NDArray[np.float64]

#: Fewer masked pixels with a usable depth than this do not determine a pose.
MIN_POINTS = 30
#: Points kept for the neighbourhood statistics, neighbours looked at, and points fitted.
CLOUD_POINTS, NEIGHBOURS, FIT_POINTS = 1600, 20, 400
#: Points nearer than this hang together, metres. What lies in front of or behind the largest
#: connected piece by more than this part of its width is not the object, but at least this far.
LINK, GAP_SHARE, GAP_LEAST = 0.02, 0.5, 0.05
#: Longer side, in cells, of the mask's box in the free-space map; margin around it in boxes.
MAP_CELLS, MAP_MARGIN = 96, 0.6
#: A stand-in for infinity that keeps products finite, metres or focal units.
FAR = 1e3


class TooLittleEvidenceError(ValueError):
    """The observation holds too few usable depth values to fit a shape."""


@dataclass(frozen=True)
class FreeSpace:
    """The image as a limit on where the object can be, on a grid of (rows, columns) cells.

    Per cell: ``depth`` (metres), in front of which nothing of the object can be; and beside the
    mask ``distance`` to it in focal lengths with its unit gradient ``direction`` (..., 2).
    Violation of a point at depth z: ``min(depth - z, distance * z)`` where positive.
    """

    depth: Array
    distance: Array
    direction: Array
    shape: tuple[int, int]
    focal: tuple[float, float]
    centre: tuple[float, float]

    def violation(self, points: Array) -> tuple[Array, Array]:
        """How far points (..., 3) reach into free space (...), metres, and its gradient."""
        z = np.maximum(points[..., 2], 1e-3)
        columns = np.rint(points[..., 0] / z * self.focal[0] + self.centre[0])
        rows = np.rint(points[..., 1] / z * self.focal[1] + self.centre[1])
        columns = np.clip(columns, 0, self.shape[1] - 1).astype(np.int64)
        rows = np.clip(rows, 0, self.shape[0] - 1).astype(np.int64)
        cell = rows * self.shape[1] + columns
        ahead = self.depth[cell] - z
        beside = self.distance[cell] * z
        is_ahead = ahead < beside
        amount = np.maximum(np.where(is_ahead, ahead, beside), 0)
        gradient = np.empty(points.shape)
        gradient[..., :2] = np.where(is_ahead[..., None], 0, self.direction[cell])
        gradient[..., 2] = np.where(is_ahead, -1, 0)
        return amount, gradient


@dataclass(frozen=True)
class Evidence:
    """Surface ``points`` (N, 3) with ``normals`` (N, 3) towards the camera, in the camera frame,
    in an order in which every leading part covers the surface evenly; and ``free_space``."""

    points: Array
    normals: Array
    free_space: FreeSpace

    @classmethod
    def of(cls, observation: Observation, rng: np.random.Generator) -> Evidence:
        """Gather the evidence. Raises :class:`TooLittleEvidenceError`."""
        points, normals = _surface(observation, rng)
        return cls(points, normals, _free_space(observation, points[:, 2].max() + GAP_LEAST))


def _surface(observation: Observation, rng: np.random.Generator) -> tuple[Array, Array]:
    mask, depth, camera = observation.mask, observation.depth, observation.camera
    usable = mask & (depth > 0)
    cloud = camera.back_project(depth, usable)
    if len(cloud) < MIN_POINTS:
        raise TooLittleEvidenceError(
            f"only {len(cloud)} pixels of the mask have a depth, {MIN_POINTS} are needed"
        )
    cloud = cloud[rng.permutation(len(cloud))[:CLOUD_POINTS]]
    neighbours = min(NEIGHBOURS, len(cloud))
    distances, indices = map(np.asarray, cKDTree(cloud).query(cloud, k=neighbours))
    spacing = distances[:, -1]
    keep = spacing < 3 * np.median(spacing)  # flying pixels stand alone
    keep &= _one_object(cloud, indices, distances, keep)
    if np.count_nonzero(keep) < MIN_POINTS:
        raise TooLittleEvidenceError(
            f"only {np.count_nonzero(keep)} of {len(cloud)} masked depth values hang together,"
            f" {MIN_POINTS} are needed"
        )
    chosen = np.flatnonzero(keep)[:FIT_POINTS]
    around = cloud[indices[chosen]]
    around = around - around.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
    points = cloud[chosen]
    away = np.einsum("ni,ni->n", normals, points) > 0
    normals[away] *= -1
    return points, normals


def _one_object(
    cloud: Array, indices: NDArray[np.int64], distances: Array, keep: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which points are in the depth range of the largest connected piece.

    A mask that is shifted against the depth holds a strip of the background, far behind; pieces of
    an object that something hides in the middle lie at about the same depth.
    """
    count = len(cloud)
    linked = keep[:, None] & keep[indices] & (distances < LINK)
    rows, columns = np.nonzero(linked)[0], indices[linked]
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    label = connected_components(graph, directed=False)[1]
    piece = cloud[keep & (label == np.bincount(label[keep]).argmax())]
    gap = max(GAP_LEAST, GAP_SHARE * np.ptp(piece[:, :2], axis=0).max())
    near, far = piece[:, 2].min() - gap, piece[:, 2].max() + gap
    within: NDArray[np.bool_] = (cloud[:, 2] > near) & (cloud[:, 2] < far)
    return within


def _free_space(observation: Observation, farthest: float) -> FreeSpace:
    mask, camera = observation.mask, observation.camera
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    low = np.array([rows[0], columns[0]])
    size = np.array([rows[-1], columns[-1]]) + 1 - low
    margin = int(np.ceil(MAP_MARGIN * size.max())) + 2
    step = max(1, round(size.max() / MAP_CELLS))
    first = np.maximum(low - margin, 0)
    last = np.minimum(low + size + margin, mask.shape)
    window = (slice(first[0], last[0], step), slice(first[1], last[1], step))
    inside = mask[window]
    measured = observation.depth[window].astype(float)
    measured[measured <= 0] = FAR
    # the nearest of the cells around: a flying pixel alone must not make space free
    own, other = (
        ndimage.minimum_filter(np.where(part, measured, FAR), size=3) for part in (inside, ~inside)
    )
    depth = np.where(inside, np.where(own < farthest, own, -FAR), other)
    offset = np.zeros((2, *inside.shape))
    if inside.any():  # a mask thinner than the step limits nothing beside it
        nearest = ndimage.distance_transform_edt(
            ~inside, return_distances=False, return_indices=True
        )
        offset += np.indices(inside.shape) - nearest
    steps = np.sqrt((offset**2).sum(axis=0))
    direction = np.moveaxis(offset[::-1] / np.maximum(steps, 1), 0, -1)
    # one pixel of slack: the mask's border is no more exact
    distance = np.where(inside, FAR, np.maximum(steps * step - 1, 0) / camera.fx)
    return FreeSpace(
        depth=depth.ravel(),
        distance=distance.ravel(),
        direction=direction.reshape(-1, 2),
        shape=(inside.shape[0], inside.shape[1]),
        focal=(camera.fx / step, camera.fy / step),
        centre=_window_centre(camera, first, step),
    )


def _window_centre(camera: Camera, first: NDArray[np.int64], step: int) -> tuple[float, float]:
    return (camera.cx - first[1]) / step, (camera.cy - first[0]) / step
