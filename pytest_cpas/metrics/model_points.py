"""Pose errors of a known object: how far the points of its model are from where they should be.

ADD and ADD-S are those of Hinterstoisser et al. (2012), MSSD and MSPD those of the BOP challenge
(Hodan et al. 2020). All compare one model under two poses; no estimated shape takes part.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from pytest_cpas.metrics import surfaces
from pytest_cpas.types import Camera, ContractError, Mesh, Pose, Symmetry
from pytest_cpas.types._arrays import finite_array

__all__ = ["SPINS", "ModelPoints", "add", "add_s", "mspd", "mssd", "symmetry_rotations"]

Array = NDArray[np.float64]

#: Rotations that stand for a continuous axis: between two of them the farthest vertex of a model
#: travels at most a hundredth of its diameter (BOP's ``max_sym_disc_step``, 0.01).
SPINS = int(np.ceil(np.pi / 0.01))

#: The image width for which MSPD's thresholds are given, pixels.
_WIDTH = 640

#: Of a point in the camera's plane, which has no projection, pixels.
_FARTHEST = 1e30

#: Directions in which the outermost points of a model are looked for.
_DIRECTIONS = 100


@dataclass(frozen=True, eq=False)
class ModelPoints:
    """The points (N, 3) of a model in the object frame, metres, and what was computed of them."""

    points: Array

    def __post_init__(self) -> None:
        points = finite_array(self.points, "model points")
        if points.ndim != 2 or points.shape[1:] != (3,) or not len(points):
            raise ContractError(f"model points: shape is {points.shape}, expected (N, 3), N >= 1")
        object.__setattr__(self, "points", points)

    @classmethod
    def of(cls, model: Mesh | ArrayLike) -> ModelPoints:
        """The vertices of a mesh's triangles, each once, or points as they are given."""
        if isinstance(model, Mesh):
            return cls(model.vertices[np.unique(model.triangles)])
        return cls(finite_array(model, "model points"))

    @cached_property
    def tree(self) -> cKDTree:
        """The nearest-neighbour search tree of the points."""
        return cKDTree(self.points)

    @cached_property
    def diameter(self) -> float:
        """Largest distance of two of the points, metres; :class:`ContractError` if that is 0."""
        found = surfaces.diameter(self.points)
        if found == 0:
            raise ContractError(f"model points: all {len(self.points)} coincide, so no diameter")
        return found

    @cached_property
    def outermost(self) -> Array:
        """The few points (M, 3) that lie outermost in directions all around."""
        # a spiral from pole to pole
        index = np.arange(_DIRECTIONS) + 0.5
        height, angle = 1 - 2 * index / _DIRECTIONS, index * np.pi * (1 + np.sqrt(5))
        radius = np.sqrt(1 - height**2)
        around = np.stack([radius * np.cos(angle), radius * np.sin(angle), height])
        chosen = np.unique(np.argmax(self.points @ around, axis=0))
        return np.asarray(self.points[chosen])


def symmetry_rotations(symmetry: Symmetry) -> Array:
    """The elements (S, 3, 3) of a group, of which a continuous axis has :data:`SPINS` spins.

    Raises :class:`ContractError` for the group of all rotations, which no list stands for.
    """
    if symmetry.sphere:
        raise ContractError("symmetry: all rotations; expected a discrete group, or one axis")
    if symmetry.axis is None:
        return symmetry.rotations
    x, y, z = symmetry.axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angles = 2 * np.pi * np.arange(SPINS)[:, None, None] / SPINS
    spins = np.eye(3) + np.sin(angles) * cross + (1 - np.cos(angles)) * (cross @ cross)
    return np.asarray((spins[:, None] @ symmetry.rotations).reshape(-1, 3, 3))


def add(estimate: Pose, truth: Pose, model: ModelPoints) -> float:
    """ADD: mean distance of a point under the one pose to itself under the other, metres."""
    turn, shift = _relative(estimate, truth)
    return float(_lengths(model.points @ (turn - np.eye(3)).T + shift).mean())


def add_s(estimate: Pose, truth: Pose, model: ModelPoints) -> float:
    """ADD-S: mean distance from a point under the true pose to the nearest under the estimated one.

    Metres. bop_toolkit calls it ADI.
    """
    turn, shift = _relative(estimate, truth)
    distances, _ = model.tree.query((model.points - shift) @ turn)
    return float(np.mean(distances))


def mssd(estimate: Pose, truth: Pose, model: ModelPoints, symmetry: Symmetry) -> float:
    """MSSD: the largest distance of a point to itself, metres; smallest over the symmetry group.

    Of an object that no rotation changes, the one that turns truth to estimate is taken.
    """
    turn, shift = _relative(estimate, truth)

    def distances(elements: Array, points: Array) -> Array:
        return _lengths(points @ np.swapaxes(turn - elements, -1, -2) + shift)

    return _least_of_largest(model, _elements(symmetry, turn), distances)


def mspd(
    estimate: Pose, truth: Pose, model: ModelPoints, symmetry: Symmetry, camera: Camera
) -> float:
    """MSPD: the same in the image: pixels, for an image that is scaled to a width of 640.

    Points behind the camera are projected as the formula has it, as BOP does. 1e30 if a point has
    no projection.
    """
    turn, _ = _relative(estimate, truth)

    def distances(elements: Array, points: Array) -> Array:
        estimated = camera.project(estimate.apply(points))
        posed = points @ np.swapaxes(truth.rotation @ elements, -1, -2) + truth.translation
        return _lengths(estimated - camera.project(posed))

    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        pixels = _least_of_largest(model, _elements(symmetry, turn), distances)
        return min(pixels * _WIDTH / camera.width, _FARTHEST)


def _relative(estimate: Pose, truth: Pose) -> tuple[Array, Array]:
    """The estimate, seen from the true object: rotation (3, 3) and translation (3,), metres."""
    inverse = truth.rotation.T
    return inverse @ estimate.rotation, inverse @ (estimate.translation - truth.translation)


def _elements(symmetry: Symmetry, turn: Array) -> Array:
    return turn[None] if symmetry.sphere else symmetry_rotations(symmetry)


def _lengths(vectors: Array) -> Array:
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", vectors, vectors)))


def _least_of_largest(
    model: ModelPoints, elements: Array, distances: Callable[[Array, Array], Array]
) -> float:
    """The smallest, over ``elements`` (S, 3, 3), of the largest of the distances of all points.

    The outermost points alone give a bound from below for each element, so that few elements need
    all points. ``distances(elements, points)``: (S, N).
    """

    def largest(among: Array, points: Array) -> Array:
        found = distances(among, points).max(axis=-1)
        return np.where(np.isnan(found), np.inf, found)

    bounds = largest(elements, model.outermost)
    least = np.inf
    for index in np.argsort(bounds):
        if bounds[index] >= least:
            break
        least = min(least, float(largest(elements[index : index + 1], model.points)[0]))
    return least
