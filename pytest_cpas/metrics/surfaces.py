"""How well a reconstructed surface fits the true one: distances, F-score, diameter.

Everything follows the definitions of Bruns & Jensfelt (2023, section on shape metrics): S is the
true surface, S~ the estimate, both as points, in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from pytest_cpas.types import ContractError, Mesh, Pose
from pytest_cpas.types._arrays import LARGEST, checked_integer, checked_number, finite_array

__all__ = ["Surface", "SurfaceErrors", "diameter", "sample_surface", "surface_errors"]

Array = NDArray[np.float64]

#: Points that the paper samples on every true surface (and on every estimated mesh).
SAMPLE_COUNT = 10_000

#: Squares of smaller coordinates are less exact than these are.
_SQUARES_VANISH = 1e-140

#: More points than memory holds are a slip of the pen.
_MOST_POINTS = 100_000_000

#: Relative slack of every pruning test in :func:`diameter`, far above the rounding of a distance.
_SLACK = 1e-9


def _points(value: ArrayLike, what: str) -> Array:
    points = finite_array(value, what)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ContractError(f"{what}: shape is {points.shape}, expected (N, 3) with N >= 1")
    return points


def sample_surface(mesh: Mesh, count: int, seed: int | np.random.Generator) -> Array:
    """Sample ``count`` points uniformly by area on ``mesh``.

    Returns (count, 3), metres, in the mesh's frame. The same seed gives the same points, bit for
    bit, on every machine: only IEEE elementary operations and a sequential sum are used. Raises
    :class:`ContractError` for a mesh without area or ``count`` < 1.
    """
    count = checked_integer(count, "sample_surface: count", 1, _MOST_POINTS)
    if not isinstance(seed, np.random.Generator):
        seed = checked_integer(seed, "sample_surface: seed", 0)
    rng = np.random.default_rng(seed)
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    u, v = b - a, c - a
    normals = u[:, [1, 2, 0]] * v[:, [2, 0, 1]] - u[:, [2, 0, 1]] * v[:, [1, 2, 0]]
    squares = normals * normals
    double_areas = np.sqrt(squares[:, 0] + squares[:, 1] + squares[:, 2])
    cumulative = np.cumsum(double_areas)
    if not cumulative[-1] > 0:
        raise ContractError(
            "sample_surface: the mesh has no area; are its vertices all equal, or within 1e-80 m?"
        )
    where, first, second = rng.random((3, count))
    # side="right" never picks a triangle without area
    chosen = np.searchsorted(cumulative, where * cumulative[-1], side="right")
    chosen = np.minimum(chosen, np.searchsorted(cumulative, cumulative[-1]))
    # uniform in the parallelogram, folded onto the triangle
    folded = first + second > 1
    first, second = np.where(folded, 1 - first, first), np.where(folded, 1 - second, second)
    sampled: Array = a[chosen] + first[:, None] * u[chosen] + second[:, None] * v[chosen]
    return sampled


@dataclass(frozen=True, eq=False)
class Surface:
    """A surface as points (N, 3) in the object frame, metres, that remembers what was computed.

    The search tree and the diameter are made when first needed and kept. A rigid motion changes
    no distance, so one true surface serves every sample that shows its object, whatever the pose.
    """

    points: Array

    def __post_init__(self) -> None:
        points = np.array(_points(self.points, "surface points"))
        points.setflags(write=False)
        object.__setattr__(self, "points", points)

    @classmethod
    def of(
        cls, surface: Mesh | ArrayLike, seed: int | np.random.Generator, count: int = SAMPLE_COUNT
    ) -> Surface:
        """The surface of a mesh (``count`` points sampled with ``seed``) or of points as given."""
        if isinstance(surface, Mesh):
            return cls(sample_surface(surface, count, seed))
        return cls(finite_array(surface, "surface points"))

    @cached_property
    def tree(self) -> cKDTree:
        """The nearest-neighbour search tree of the points."""
        return cKDTree(self.points)

    @cached_property
    def diameter(self) -> float:
        """Largest distance of two of the points, metres, exact."""
        return diameter(self.points)


@dataclass(frozen=True, eq=False)
class SurfaceErrors:
    """The nearest-neighbour distances between a true and an estimated surface.

    ``to_estimate`` (N,): distance of each true point to the nearest estimated point;
    ``to_truth`` (M,): distance of each estimated point to the nearest true point; metres. Every
    metric is computed from these two arrays.
    """

    to_estimate: Array
    to_truth: Array
    _truth: Surface = field(repr=False)
    _estimate: Surface = field(repr=False)

    def __post_init__(self) -> None:
        for name in ("to_estimate", "to_truth"):
            distances = finite_array(getattr(self, name), name, 10 * LARGEST)
            if distances.ndim != 1 or not distances.size or distances.min() < 0:
                raise ContractError(
                    f"{name}: shape {distances.shape}, expected distances (N,) with N >= 1, none"
                    " negative"
                )
            object.__setattr__(self, name, distances)

    @cached_property
    def ad_truth_to_estimate(self) -> float:
        """AD(S -> S~): mean distance from the true points to the estimate, metres."""
        return float(np.mean(self.to_estimate))

    @cached_property
    def ad_estimate_to_truth(self) -> float:
        """AD(S~ -> S): mean distance from the estimated points to the truth, metres."""
        return float(np.mean(self.to_truth))

    @property
    def chamfer(self) -> float:
        """CD: the mean of the two ADs (neither squared nor summed), metres."""
        return (self.ad_truth_to_estimate + self.ad_estimate_to_truth) / 2

    @cached_property
    def nad(self) -> float:
        """NAD: max(AD(S -> S~) / diam(S), AD(S~ -> S) / diam(S~)), without unit.

        Raises :class:`ContractError` if all points of a surface coincide (its diameter is 0).
        """
        parts = []
        for name, mean, surface in (
            ("true", self.ad_truth_to_estimate, self._truth),
            ("estimated", self.ad_estimate_to_truth, self._estimate),
        ):
            if surface.diameter == 0:
                raise ContractError(
                    f"NAD: all {len(surface.points)} points of the {name} surface coincide, so"
                    " that its diameter is 0"
                )
            parts.append(mean / surface.diameter)
        return checked_number(max(parts), "NAD, whose diameter is next to nothing", 0)

    def recall_counts(self, thresholds: ArrayLike) -> NDArray[np.int64]:
        """True points **strictly** nearer to the estimate than each threshold (metres)."""
        return _count_below(self.to_estimate, thresholds)

    def precision_counts(self, thresholds: ArrayLike) -> NDArray[np.int64]:
        """Estimated points **strictly** nearer to the truth than each threshold (metres)."""
        return _count_below(self.to_truth, thresholds)

    def recall(self, thresholds: ArrayLike) -> Array:
        """Share of true points strictly nearer than each threshold (metres); its shape."""
        return self.recall_counts(thresholds) / len(self.to_estimate)

    def precision(self, thresholds: ArrayLike) -> Array:
        """Share of estimated points strictly nearer than each threshold (metres); its shape."""
        return self.precision_counts(thresholds) / len(self.to_truth)

    def fscore(self, thresholds: ArrayLike) -> Array:
        """F: harmonic mean of precision and recall at each threshold (metres); its shape.

        0 where precision or recall is 0. Raises :class:`ContractError` for thresholds that are NaN,
        infinite or negative.
        """
        p, r = self.precision(thresholds), self.recall(thresholds)
        both = (p > 0) & (r > 0)
        return np.where(both, 2 * p * r / np.where(both, p + r, 1), 0.0)


def _count_below(distances: Array, thresholds: ArrayLike) -> NDArray[np.int64]:
    limits = finite_array(thresholds, "thresholds (metres)")
    if limits.size and limits.min() < 0:
        raise ContractError(f"thresholds (metres): {limits.min():g}, expected none below 0")
    if limits.size <= 2:
        counts = [np.count_nonzero(distances < limit) for limit in limits.flat]
        return np.array(counts, dtype=np.int64).reshape(limits.shape)
    return np.searchsorted(np.sort(distances), limits, side="left").astype(np.int64)


def surface_errors(
    truth: Surface,
    estimate: Surface | ArrayLike,
    *,
    truth_pose: Pose | None = None,
    estimated_pose: Pose | None = None,
) -> SurfaceErrors:
    """Compare an estimated surface with the true one.

    ``estimate``: a :class:`Surface` or points (M, 3) in the estimate's object frame, metres. With
    both poses (object to camera) the posed surfaces are compared, as the paper does it; with
    neither, the shapes alone, in the object frame. Raises :class:`ContractError` for one pose
    alone and for points that are not (M, 3) finite numbers.
    """
    if (truth_pose is None) != (estimated_pose is None):
        raise ContractError(
            "surface_errors: got one pose; give both (camera frame) or neither (object frame)"
        )
    surface = (
        estimate
        if isinstance(estimate, Surface)
        else Surface(finite_array(estimate, "estimated points"))
    )
    to_own, to_other = surface.points, truth.points
    if truth_pose is not None and estimated_pose is not None:
        # each side is moved into the frame of the tree that it is searched in
        shift = estimated_pose.translation - truth_pose.translation
        turn = truth_pose.rotation.T @ estimated_pose.rotation
        to_own = surface.points @ turn.T + shift @ truth_pose.rotation
        to_other = truth.points @ turn - shift @ estimated_pose.rotation
    to_truth, _ = truth.tree.query(to_own)
    to_estimate, _ = surface.tree.query(to_other)
    return SurfaceErrors(np.asarray(to_estimate), np.asarray(to_truth), truth, surface)


def diameter(points: ArrayLike) -> float:
    """Largest distance of two of the (N, 3) ``points``, in their unit; 0 for a single point.

    Exact: a pair is left out only where it provably is nearer than one already found. Takes
    O(N log N) time for anything but bodies of constant width that are no balls, and O(N) memory
    always.
    """
    cloud = _points(points, "diameter")
    cloud = cloud - (cloud.min(axis=0) + cloud.max(axis=0)) / 2
    reach = float(np.abs(cloud).max())
    if 0 < reach < _SQUARES_VANISH:
        return diameter(cloud / reach) * reach
    best = _walk(cloud)
    while len(cloud) > 64:
        size = len(cloud)
        centre, radius = _enclosing_ball(cloud)
        cloud, best = _prune(cloud, centre, radius, best)
        if len(cloud) > 0.8 * size:
            break
    for start in range(0, len(cloud), 256):
        best = max(best, float(cdist(cloud[start : start + 256], cloud[start:]).max()))
    return best


def _walk(cloud: Array) -> float:
    """A large distance of two points: from each axis' ends, hop to the farthest until it stays."""
    best = 0.0
    for axis in range(3):
        start = cloud[np.argmax(cloud[:, axis])]
        while True:
            distances = cdist(start[None], cloud)[0]
            farthest = int(np.argmax(distances))
            if distances[farthest] <= best:
                break
            best, start = float(distances[farthest]), cloud[farthest]
    return best


def _prune(cloud: Array, centre: Array, radius: float, best: float) -> tuple[Array, float]:
    """Leave out points that take part in no pair farther apart than ``best``, and raise it.

    All points lie in the ball around ``centre``. What is farther than ``best`` from a point p at
    distance d from the centre lies, seen from the centre, within an angle phi of the direction
    opposite to p, where cos phi = (best^2 - d^2 - radius^2) / (2 d radius). No point of that lens
    is farther from the point of the sphere opposite to p than the lens' rim is, 2 radius
    sin(phi / 2): if the nearest neighbour is, then p has no partner. On a round body it is also a
    very good partner, so that one search settles nearly all points. A point in the centre has no
    opposite, nor a part in the farthest pair: that is at least 1.6 radii long (Jung's theorem).
    """
    offsets = cloud - centre
    d = np.sqrt(np.einsum("ij,ij->i", offsets, offsets))
    alive = (d + radius >= best * (1 - _SLACK)) & (d > 0)
    cloud, offsets, d = cloud[alive], offsets[alive], d[alive]
    if len(cloud) < 2:
        return cloud, best
    opposite = centre - offsets * (radius / d)[:, None]
    gaps, partners = cKDTree(cloud).query(opposite)
    reached = cloud - cloud[partners]
    best = max(best, float(np.sqrt(np.einsum("ij,ij->i", reached, reached).max())))
    cosine = np.clip((best**2 - d**2 - radius**2) / (2 * d * radius), -1, 1)
    rim = radius * np.sqrt(2 - 2 * cosine) + np.sqrt(_SLACK) * radius
    return cloud[gaps <= rim], best


def _enclosing_ball(cloud: Array) -> tuple[Array, float]:
    """Centre and radius of the smallest ball around ``cloud`` (to 1e-9 of its radius)."""
    support = cloud[[np.argmax(cloud[:, 0])]]
    centre, radius = support[0], 0.0
    for _ in range(100):
        distances = cdist(centre[None], cloud)[0]
        farthest = int(np.argmax(distances))
        if distances[farthest] <= radius * (1 + _SLACK):
            break
        support = np.vstack([support, cloud[farthest]])
        centre, radius, support = _ball_of_few(support)
    return centre, float(cdist(centre[None], cloud).max())


def _ball_of_few(points: Array) -> tuple[Array, float, Array]:
    """The smallest ball around at most five points, and the points that hold it."""
    best: tuple[Array, float, Array] | None = None
    for size in range(2, min(len(points), 4) + 1):
        for chosen in combinations(range(len(points)), size):
            # the newest point is outside the ball of the others, so it holds the new one
            if len(points) - 1 not in chosen:
                continue
            corners = points[list(chosen)]
            edges = corners[1:] - corners[0]
            weights = np.linalg.lstsq(2 * edges @ edges.T, (edges**2).sum(axis=1), rcond=None)[0]
            centre = corners[0] + weights @ edges
            radius = float(np.sqrt(((corners - centre) ** 2).sum(axis=1).max()))
            reach = np.sqrt(((points - centre) ** 2).sum(axis=1).max())
            if reach <= radius * (1 + 1e-12) and (best is None or radius < best[1]):
                best = centre, radius, corners
    if best is None:
        centre = points.mean(axis=0)
        radius = float(np.sqrt(((points - centre) ** 2).sum(axis=1).max()))
        return centre, radius, points[-1:]
    return best
