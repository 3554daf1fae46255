"""``icp``: a classical baseline without weights, from depth and mask alone.

Shapes of the category (the packaged asset ``icp_priors.npz``) are placed behind the visible
surface in orientations that cover all rotations. Every candidate is refined by Gauss-Newton steps
on rotation, translation and axis scales; the worse are dropped from stage to stage while points
are added and the robust kernel narrows. The residuals are

* observed point to the tangent plane of the nearest model surface (one-sided: hidden parts of the
  model need no evidence), and
* how far model points reach into space that the camera sees to be free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from method_adapters._icp_evidence import Evidence, TooLittleEvidenceError
from method_adapters._icp_prior import Prior
from pytest_cpas.adapting import (
    CATEGORIES,
    Hypothesis,
    MethodInfo,
    Observation,
    Prediction,
    stage,
)

Array = NDArray[np.float64]

#: Cost of free-space violations beside that of the observed points.
FREE_SPACE_WEIGHT = 1.0
#: Weight of the prior on the extents beside that of all observed points.
PRIOR_WEIGHT = 0.06
#: Cost of an observed normal across the model's, beside that of the observed points.
NORMAL_WEIGHT = 0.5
#: What decides between candidates that the depth cannot tell apart: objects mostly stand upright.
UPRIGHT_WEIGHT = 0.02
#: Rotations tried first: about y axes alone where the category is symmetric, else all.
AXES, ROTATIONS = 160, 600
#: Shapes of the prior that the first stages try, all later ones trying all.
FIRST_SHAPES = 2
#: Candidates whose rotations differ by less are one, degrees.
SAME_ROTATION = 12.0


@dataclass(frozen=True)
class Stage:
    """``steps`` Gauss-Newton steps with ``points`` observed and model points and a robust kernel
    of ``width`` metres, for every candidate or, with ``shapes``, for every candidate with every
    shape of the prior; the ``keep`` best that differ in rotation go on."""

    points: int
    width: float
    steps: int
    keep: int
    shapes: bool = False


STAGES = (
    Stage(40, 0.03, 4, keep=200),
    Stage(80, 0.02, 6, keep=32),
    Stage(160, 0.012, 8, keep=20, shapes=True),
    Stage(400, 0.006, 10, keep=6),
    Stage(400, 0.004, 12, keep=1, shapes=True),
)


class Icp:
    """The baseline as a :class:`pytest_cpas.types.Method`."""

    info = MethodInfo(
        name="icp",
        categories=CATEGORIES,
        needs=frozenset({"depth"}),
        gives=frozenset({"extents", "shape"}),
        licence="MIT",
        # not roll: where the depth leaves a choice, UPRIGHT_WEIGHT makes it
        equivariances=frozenset({"shift", "resolution", "distance", "mirror"}),
    )

    def load(self, assets: Path | None, device: str) -> None:
        """Nothing to read: a category's prior is packaged, and built when first asked for."""

    def predict(self, batch: Sequence[Observation], seed: int) -> list[Prediction]:
        """One prediction per observation; each is fitted on its own with ``seed``."""
        return [self._fit(observation, seed) for observation in batch]

    def _fit(self, observation: Observation, seed: int) -> Prediction:
        try:
            with stage("pre-processing"):
                evidence = Evidence.of(observation, np.random.default_rng(seed))
        except TooLittleEvidenceError as error:
            return Prediction.failed(str(error))
        prior = Prior.of(observation.category)
        with stage("fit"):
            best = fit(prior, evidence)
        scale = np.exp(best.log_scale[0])
        points = prior.points[best.variant[0]] * scale
        # centred on its own box to rounding, whatever the asset was rounded to
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        rotation = best.rotation[0]
        return Prediction(
            (
                Hypothesis(
                    rotation=rotation,
                    translation=best.translation[0] + rotation @ centre,
                    extents=np.ptp(points, axis=0),
                    points=points - centre,
                ),
            )
        )


@dataclass(frozen=True)
class Candidates:
    """K placements: shape ``variant`` (K,), ``rotation`` (K, 3, 3), ``translation`` (K, 3) metres,
    ``log_scale`` (K, 3) of the object's axes."""

    variant: NDArray[np.int64]
    rotation: Array
    translation: Array
    log_scale: Array

    def __getitem__(self, index: NDArray[np.int64] | slice) -> Candidates:
        return Candidates(
            self.variant[index],
            self.rotation[index],
            self.translation[index],
            self.log_scale[index],
        )


def fit(prior: Prior, evidence: Evidence) -> Candidates:
    """The one placement of a prior's shape that explains the evidence best."""
    candidates = _start(prior, evidence)
    for step in STAGES:
        if step.shapes:
            candidates = _all_shapes(prior, candidates)
        candidates = _refine(prior, evidence, candidates, step)
        candidates = _distinct(prior, candidates)[: step.keep]
    return candidates


def _refine(prior: Prior, evidence: Evidence, at: Candidates, stage: Stage) -> Candidates:
    """The candidates after the stage's steps, the best first."""
    for _ in range(stage.steps):
        _, hessian, gradient = _linearise(prior, evidence, at, stage)
        at = _move(prior, at, hessian, gradient)
    cost, _, _ = _linearise(prior, evidence, at, stage)
    # a stable sort of rounded costs: equal candidates keep their order on every machine
    return at[np.argsort(np.round(cost, 9), kind="stable")]


def _distinct(prior: Prior, at: Candidates) -> Candidates:
    """Without those whose rotation is nearly that of a better one."""
    if prior.symmetric:
        y = at.rotation[:, :, 1]
        cosine = y @ y.T
    else:
        flat = at.rotation.reshape(-1, 9)
        cosine = (flat @ flat.T - 1) / 2
    same = cosine > np.cos(np.deg2rad(SAME_ROTATION))
    kept = np.ones(len(same), bool)
    for index in range(len(same)):
        if kept[index]:
            kept[index + 1 :] &= ~same[index, index + 1 :]
    return at[np.flatnonzero(kept)]


def _all_shapes(prior: Prior, at: Candidates) -> Candidates:
    """Every candidate with every shape of the prior, its extents kept as far as they may change."""
    shapes, candidates = len(prior.points), len(at.variant)
    repeated = at[np.tile(np.arange(candidates), shapes)]
    variant = np.repeat(np.arange(shapes), candidates)
    change = prior.log_extents[repeated.variant] - prior.log_extents[variant]
    basis = prior.scale_basis
    allowed = basis @ np.linalg.pinv(basis)
    return replace(repeated, variant=variant, log_scale=repeated.log_scale + change @ allowed)


def _start(prior: Prior, evidence: Evidence) -> Candidates:
    """The first shapes in every starting rotation, visible side where the observed points are."""
    rotations = _axis_rotations(AXES) if prior.symmetric else _super_fibonacci(ROTATIONS)
    variants = min(len(prior.points), FIRST_SHAPES)
    variant = np.repeat(np.arange(variants), len(rotations))
    rotation = np.tile(rotations, (variants, 1, 1))
    observed = evidence.points
    middle = observed.mean(axis=0)
    view = middle / np.linalg.norm(middle)
    spread = _spread(observed - middle, view)
    count = 200
    points, normals = prior.points[:variants, :count], prior.normals[:variants, :count]
    # the share of the image that a surface element takes is the cosine of its slant
    weight = np.maximum(-np.einsum("rij,i,vmj->vrm", rotations, view, normals), 0)
    weight /= weight.sum(axis=-1, keepdims=True)
    seen = np.einsum("vrm,vmj->vrj", weight, points)
    second = np.einsum("vrm,vmi,vmj->vrij", weight, points, points)
    second -= np.einsum("vri,vrj->vrij", seen, seen)
    local = np.einsum("rij,i->rj", rotations, view)
    across = np.trace(second, axis1=-2, axis2=-1)
    across -= np.einsum("ri,vrij,rj->vr", local, second, local)
    ratio = np.log(spread / np.sqrt(across)).reshape(-1)
    log_scale = np.clip(0.7 * ratio, -0.4, 0.4)
    shift = np.einsum("kij,kj->ki", rotation, seen.reshape(-1, 3)) * np.exp(log_scale)[:, None]
    return Candidates(variant, rotation, middle - shift, np.repeat(log_scale[:, None], 3, axis=1))


def _spread(points: Array, view: Array) -> float:
    across = points - np.outer(points @ view, view)
    return float(np.sqrt(np.mean(np.sum(across**2, axis=1))))


def _axis_rotations(count: int) -> Array:
    """Rotations (count, 3, 3) that take y to directions spread evenly over the sphere."""
    k = np.arange(count)
    height = 1 - (2 * k + 1) / count
    angle = k * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - height**2)
    y = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=1)
    helper = np.eye(3)[np.argmin(np.abs(y), axis=1)]
    x = np.cross(y, helper)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def _super_fibonacci(count: int) -> Array:
    """Rotations (count, 3, 3) spread evenly over SO(3): Alexa, Super-Fibonacci Spirals, CVPR 2022,
    with the constants that the paper gives."""
    s = np.arange(count) + 0.5
    phi, psi = np.sqrt(2), 1.533751168755204288118041
    r, big_r = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / phi, 2 * np.pi * s / psi
    quaternions = np.stack(
        [r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)], axis=1
    )
    return Rotation.from_quat(quaternions).as_matrix()


def _linearise(
    prior: Prior, evidence: Evidence, at: Candidates, stage: Stage
) -> tuple[Array, Array, Array]:
    """Cost (K,), Gauss-Newton matrix (K, P, P) and gradient (K, P) of the candidates.

    The parameters are a rotation vector about the object's centre and a shift, both in the camera
    frame, and the free log scales. Each residual counts with the pseudo-Huber loss.
    """
    basis = prior.scale_basis
    scale = np.exp(at.log_scale)[:, None]
    back = at.rotation.transpose(0, 2, 1)

    observed, normals = evidence.points[: stage.points], evidence.normals[: stage.points]
    arm = observed - at.translation[:, None]
    local = arm @ at.rotation
    distance, gradient = prior.distance(at.variant, local / scale)
    slope = gradient / scale
    stretch = 1 / np.linalg.norm(slope, axis=-1, keepdims=True)
    slope *= stretch
    distance *= stretch[..., 0]
    normal = slope @ back
    # a model surface that lies across does not explain an observed one; that weighs in the choice
    # alone, for beyond an edge of the model such points are what makes it grow
    agreement = np.abs(np.einsum("kni,ni->kn", normal, normals))
    loss, weight = _robust(distance, stage.width)
    jacobian = -np.concatenate([np.cross(arm, normal), normal, (slope * local) @ basis], axis=-1)
    cost = (loss + NORMAL_WEIGHT * (1 - agreement)).mean(axis=1)
    hessian, descent = _normal_equations(jacobian, distance, weight)

    model = prior.points[at.variant, : stage.points] * scale
    placed = model @ back
    amount, push = evidence.free_space.violation(placed + at.translation[:, None])
    loss, weight = _robust(amount, stage.width)
    weight *= FREE_SPACE_WEIGHT
    jacobian = np.concatenate(
        [np.cross(placed, push), push, (push @ at.rotation * model) @ basis], axis=-1
    )
    cost += FREE_SPACE_WEIGHT * loss.mean(axis=1)
    free_hessian, free_descent = _normal_equations(jacobian, amount, weight)

    deviation = prior.log_extents[at.variant] + at.log_scale - prior.mean_log_extents
    pull = PRIOR_WEIGHT * deviation @ prior.information
    cost += np.einsum("ki,ki->k", pull, deviation) / 2
    cost += UPRIGHT_WEIGHT * (1 + at.rotation[:, 1, 1]) / 2
    hessian += free_hessian
    descent += free_descent
    hessian[:, 6:, 6:] += PRIOR_WEIGHT * basis.T @ prior.information @ basis
    descent[:, 6:] += pull @ basis
    return cost, hessian, descent


def _robust(residual: Array, width: float) -> tuple[Array, Array]:
    """Pseudo-Huber loss in units of ``width`` and the residuals' weights. Its pull does not fade:
    a laptop's edge or a mug's handle far from the model must not become an outlier."""
    root = np.sqrt(1 + (residual / width) ** 2)
    return root - 1, 1 / (root * width**2)


def _normal_equations(jacobian: Array, residual: Array, weight: Array) -> tuple[Array, Array]:
    weighted = (jacobian * (weight / residual.shape[1])[..., None]).transpose(0, 2, 1)
    return weighted @ jacobian, (weighted @ residual[..., None])[..., 0]


def _move(prior: Prior, at: Candidates, hessian: Array, gradient: Array) -> Candidates:
    """One damped Gauss-Newton step of every candidate."""
    diagonal = np.einsum("kii->ki", hessian)  # a view
    diagonal *= 1.01
    diagonal += 1e-3
    step = np.asarray(-np.linalg.solve(hessian, gradient[..., None])[..., 0], dtype=np.float64)
    turn = _limited(step[:, :3], 0.4)
    return Candidates(
        at.variant,
        Rotation.from_rotvec(turn).as_matrix() @ at.rotation,
        at.translation + _limited(step[:, 3:6], 0.05),
        np.clip(at.log_scale + _limited(step[:, 6:], 0.2) @ prior.scale_basis.T, -0.8, 0.8),
    )


def _limited(vectors: Array, longest: float) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    limited: Array = vectors * np.minimum(1, longest / np.maximum(length, 1e-12))
    return limited
