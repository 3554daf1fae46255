"""Pieces of which faulty metrics are made: the plain definitions, with a place to go wrong."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection, cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from pytest_cpas import metrics as m
from pytest_cpas.types import Symmetry


def angle_by_trace(a, b, dtype=np.float64, clip=True, transpose=True, half=1.0):
    a, b = np.asarray(a, dtype=dtype), np.asarray(b, dtype=dtype)
    cosine = (np.trace(a @ (b.T if transpose else b)) - 1) / 2
    cosine = np.clip(cosine, -1, 1) if clip else cosine
    return float(np.arccos(cosine)) * half


def axis_angle(a, b, symmetry, which=None, clip=True):
    """Angle between the axes; ``which``: a fixed axis instead of the symmetry's."""
    if symmetry.axis is None or symmetry.sphere:
        return float(m.rotation_error(a, b, symmetry))
    axis = symmetry.axis if which is None else np.eye(3)[which]
    cosine = (a @ axis) @ (b @ axis)
    errors = [cosine] if len(symmetry.rotations) == 1 else [cosine, -cosine]
    best = max(errors)
    return float(np.arccos(np.clip(best, -1, 1) if clip else best))


def elements(symmetry, count=100, span=2 * np.pi):
    """Sampled rotations of a group."""
    if symmetry.axis is None:
        return list(symmetry.rotations)
    spins = Rotation.from_rotvec(np.outer(np.arange(count) * span / count, symmetry.axis))
    return [s @ r for s in spins.as_matrix() for r in symmetry.rotations]


def sampled_error(a, b, symmetry, count=100, span=2 * np.pi, pick=min):
    if symmetry.sphere:
        return 0.0
    return pick(float(m.rotation_error(a, b @ e)) for e in elements(symmetry, count, span))


def sampled_iou(a, t_a, e_a, b, t_b, e_b, symmetry, count=20, span=2 * np.pi, pick=np.max):
    group = np.stack(elements(symmetry, count, span))
    return float(pick(m.oriented_iou(a, t_a, e_a, b @ group, t_b, e_b)))


def box_by_half_spaces(*boxes, epsilon=0.0, transpose=False, half=2.0, union=True):
    rows, volumes = [], []
    for rotation, centre, extents in (boxes[:3], boxes[3:]):
        normals = rotation if transpose else rotation.T
        along = normals @ centre
        rows += [*np.column_stack([normals, -along - extents / half]).tolist()]
        rows += [*np.column_stack([-normals, along - extents / half]).tolist()]
        volumes.append(float(np.prod(extents)))
    rows = np.array(rows)
    from scipy.optimize import linprog

    found = linprog(
        [0, 0, 0, -1], A_ub=np.column_stack([rows[:, :3], np.ones(12)]), b_ub=-rows[:, 3],
        bounds=(None, None),
    )  # fmt: skip
    if found.x[3] <= epsilon:
        return 0.0
    shared = ConvexHull(HalfspaceIntersection(rows, found.x[:3]).intersections).volume
    return shared / (sum(volumes) - (shared if union else 0))


def corners(rotation, centre, extents):
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return signs * extents / 2 @ rotation.T + centre


def sampled_volume(*boxes, count=2000, rng=None):
    rng = np.random.default_rng(0) if rng is None else rng
    (r_a, t_a, e_a), (r_b, t_b, e_b) = boxes[:3], boxes[3:]
    points = (rng.random((count, 3)) - 0.5) * e_a @ r_a.T + t_a
    inside = np.all(np.abs((points - t_b) @ r_b) < e_b / 2, axis=1).mean()
    shared = inside * np.prod(e_a)
    return float(shared / (np.prod(e_a) + np.prod(e_b) - shared))


def nearest(a, b, dtype=np.float64):
    return cKDTree(np.asarray(b, dtype=dtype)).query(np.asarray(a, dtype=dtype))[0]


def expanded(a, b, dtype=np.float64):
    """Nearest distances from |a|^2 + |b|^2 - 2ab, as GPU codes compute them."""
    a, b = np.asarray(a, dtype=dtype), np.asarray(b, dtype=dtype)
    square = (a**2).sum(1)[:, None] + (b**2).sum(1)[None] - 2 * a @ b.T
    return np.sqrt(np.maximum(square, 0)).min(axis=1).astype(float)


def valid_clouds(function):
    """Refuse what our own metrics refuse, so that only the planted fault shows."""

    def checked(*args):
        for arg in args:
            if isinstance(arg, np.ndarray):
                m.Surface(arg)
        return function(*args)

    return checked


def harmonic(p, r):
    return 2 * p * r / (p + r) if p and r else 0.0


def ranked_area(scores, correct, truths, kind="quicksort", interpolate=True, first=1, ends=False):
    """Average precision by ranks, without care for ties."""
    order = np.argsort(-scores, kind=kind)
    hits = np.cumsum(correct[order])
    if truths == 0 or hits[-1] == 0:
        return 0.0
    precision = hits / (np.arange(len(hits)) + first)
    if interpolate:
        precision = np.maximum.accumulate(precision[::-1])[::-1]
    if ends:
        recall = np.concatenate([[0], hits / truths])
        return float(np.trapezoid(np.concatenate([precision[:1], precision]), recall))
    return float((precision * np.diff(hits, prepend=0)).sum() / truths)


def points_11(scores, correct, truths):
    """The 11-point interpolation of VOC 2007."""
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(correct[order])
    precision, recall = hits / np.arange(1, len(hits) + 1), hits / truths
    best = [max(precision[recall >= t - 1e-12], default=0.0) for t in np.linspace(0, 1, 11)]
    return float(np.mean(best))


def bounding(points):
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def from_centre(points):
    return float(2 * np.linalg.norm(points - points.mean(axis=0), axis=1).max())


def by_hull_of_sample(points):
    few = points[:: max(1, len(points) // 50)]
    return float(cdist(few, few).max())


def no_symmetry(a, b, symmetry):
    return float(m.rotation_error(a, b))


def half_turn_only(symmetry):
    """The group about y instead of the object's axis."""
    return symmetry if symmetry.axis is None else Symmetry.about((0, 1, 0))


def as_euler(a, b):
    angles = Rotation.from_matrix(a @ b.T).as_euler("xyz")
    return float(np.linalg.norm(angles))


def of_quaternions(a, b, doubled=True, absolute=True):
    p, q = (Rotation.from_matrix(x).as_quat() for x in (a, b))
    dot = float(p @ q)
    dot = abs(dot) if absolute else dot
    return (2 if doubled else 1) * math.acos(min(max(dot, -1), 1))
