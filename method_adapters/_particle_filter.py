"""The Rao-Blackwellised particle filter of iCaps, that of PoseRBPF (Deng et al., RSS 2019):
particles for the position, and for each of them the whole distribution over rotations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from method_adapters._crop import MIN_DEPTH_PIXELS, NoAnswerError
from pytest_cpas.adapting import Camera, Observation, draw, tap

if TYPE_CHECKING:
    from torch import Tensor

Array = NDArray[np.float64]

#: Particles in the first image and in the following ones.
FIRST_PARTICLES, NEXT_PARTICLES = 300, 100
#: Noise of a particle's place in the image, pixels, and of its depth, metres; and its share where
#: the place is roughly known.
UV_NOISE, Z_NOISE, KNOWN = 10.0, 0.02, 0.3
#: Depths at which objects are looked for, metres.
NEAREST, FARTHEST = 0.2, 2.0
#: How far a code's cosine similarity may be below the best one.
SIMILARITY_NOISE = 0.02
#: How far an object turns from one image to the next, and the weight of all rotations beside.
TURN_NOISE, TURN_ANY = np.deg2rad(10.0), 1e-3
#: Rotations of the codebook that are averaged with the most probable one.
AVERAGED = np.deg2rad(10.0)
#: Times that the mask is eroded: the depth of its edge is often the background's.
EROSIONS = 2
#: Share of the observed points that the object's bounding sphere must hold, and how many of them
#: are looked at.
INSIDE, MOST_POINTS = 0.99, 500

#: Cosine similarities (K, R) of K regions (K, 4), x0 y0 x1 y1 in pixels of a depth image, with a
#: codebook's rotations; depths (K,) and radii (K,) in metres.
Match = Callable[[NDArray[np.float32], Array, Array, Array], "Tensor"]


@dataclass(frozen=True)
class View:
    """What a depth image shows of an object: ``depth`` (h, w), metres, 0 elsewhere, of the window
    whose first pixel is ``corner`` (u, v); ``cloud`` (N, 3), camera frame, metres."""

    depth: NDArray[np.float32]
    corner: Array
    cloud: Array
    camera: Camera

    @classmethod
    def of(cls, observation: Observation) -> View:
        """Raises :class:`NoAnswerError` where too little of the mask has a depth."""
        inside = ndimage.binary_erosion(observation.mask, iterations=EROSIONS)
        depth = observation.depth
        seen = inside & (depth >= NEAREST) & (depth <= FARTHEST)
        if np.count_nonzero(seen) < MIN_DEPTH_PIXELS:
            raise NoAnswerError(
                f"{np.count_nonzero(seen)} pixels within the mask have a depth from {NEAREST} to"
                f" {FARTHEST} m, expected at least {MIN_DEPTH_PIXELS}"
            )
        rows, columns = np.nonzero(seen)
        # a frame of empty pixels: crops end there as they would in the whole image
        window = np.zeros((np.ptp(rows) + 5, np.ptp(columns) + 5), np.float32)
        corner = np.array([columns.min() - 2, rows.min() - 2])
        window[rows - corner[1], columns - corner[0]] = depth[rows, columns]
        cloud = observation.camera.back_project(depth, seen)
        return cls(window, corner.astype(float), cloud, observation.camera)

    def positions(self, particles: Array) -> Array:
        """Camera-frame positions (K, 3), metres, of particles (K, 3): u, v, z."""
        camera = self.camera
        focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        z = particles[:, 2:]
        return np.concatenate([(particles[:, :2] - middle) / focal * z, z], axis=1)

    def particles(self, positions: Array) -> Array:
        """The inverse of :meth:`positions`."""
        return np.concatenate([self.camera.project(positions), positions[:, 2:]], axis=1)

    def radii(self, positions: Array) -> Array:
        """Radii (K,) of the spheres around positions (K, 3) that hold the observed points."""
        cloud = self.cloud[:: -(-len(self.cloud) // MOST_POINTS)]
        distances = np.linalg.norm(cloud - positions[:, None], axis=2)
        radii: Array = np.quantile(distances, INSIDE, axis=1)
        return radii

    def regions(self, particles: Array, radii: Array) -> Array:
        """Regions (K, 4) of ``depth`` that hold the images of spheres around particles."""
        middle = particles[:, :2] - self.corner
        half = np.array([self.camera.fx, self.camera.fy]) * (radii / particles[:, 2])[:, None]
        return np.concatenate([middle - half, middle + half], axis=1)


@dataclass(frozen=True)
class Belief:
    """``particles`` (K, 3): u, v in pixels, z in metres, and their ``weights`` (K,); the estimated
    ``rotation`` (3, 3), ``translation`` (3,) metres, and ``radius`` of the object's bounding
    sphere; and the mean of what was ``seen`` (3,), metres."""

    particles: Array
    weights: Array
    rotation: Array
    translation: Array
    radius: float
    seen: Array

    def corrected(self, view: View, rotation: Array, translation: Array) -> Belief:
        """With the estimate replaced by a better one; the particles are shifted with it."""
        shift = view.particles(np.stack([self.translation, translation]))
        particles = self.particles + shift[1] - shift[0]
        return replace(self, particles=particles, rotation=rotation, translation=translation)


def first_belief(
    view: View, match: Match, quaternions: Array, generator: np.random.Generator
) -> Belief:
    """Where the object is in a first image; ``quaternions`` (R, 4): the codebook's rotations,
    scalar first."""
    seen = view.particles(view.cloud)
    middle, spread = seen.mean(axis=0), np.ptp(view.cloud[:, :2], axis=0).max() / 2
    particles = np.tile(middle, (FIRST_PARTICLES, 1))
    particles[:, :2] += UV_NOISE * generator.standard_normal((FIRST_PARTICLES, 2))
    # the middle is behind what is seen, at most as far as the object reaches to the side
    particles[:, 2] += generator.uniform(0, spread, FIRST_PARTICLES)
    particles[:, 2] += Z_NOISE * generator.standard_normal(FIRST_PARTICLES)
    particles = draw("particles", _in_range(particles))
    first = _belief(view, particles, match, quaternions)
    particles = _resampled(first, generator)
    return _belief(view, particles, match, quaternions)


def next_belief(
    view: View, last: Belief, match: Match, quaternions: Array, generator: np.random.Generator
) -> Belief:
    """Where the object of the last image is in the next one.

    The particles move as the mean of the observed points does; the size stays.
    """
    moved = view.particles(view.positions(last.particles) + view.cloud.mean(axis=0) - last.seen)
    particles = _resampled(replace(last, particles=moved), generator)
    return _belief(view, particles, match, quaternions, last)


def _resampled(last: Belief, generator: np.random.Generator) -> Array:
    """Particles (100, 3) by systematic resampling, with a share of the noise."""
    places = (generator.uniform() + np.arange(NEXT_PARTICLES)) / NEXT_PARTICLES
    chosen = np.searchsorted(np.cumsum(last.weights), places).clip(max=len(last.weights) - 1)
    noise = generator.standard_normal((NEXT_PARTICLES, 3)) * [UV_NOISE, UV_NOISE, Z_NOISE]
    return draw("resampled", _in_range(last.particles[chosen] + KNOWN * noise))


def _in_range(particles: Array) -> Array:
    u, v, z = particles.T
    return np.stack([u, v, z.clip(NEAREST, FARTHEST)], axis=1)


def _belief(
    view: View,
    particles: Array,
    match: Match,
    quaternions: Array,
    last: Belief | None = None,
) -> Belief:
    """Weigh particles by what they see, and estimate from them.

    In a first image the size follows from the position: the farthest observed point is on the
    bounding sphere.
    """
    import torch

    from method_adapters._networks.graphs import exponential_

    if last is None:
        radii = view.radii(view.positions(particles))
    else:
        radii = np.full(len(particles), last.radius)
    tap("radii", radii)
    likelihood = match(view.depth, view.regions(particles, radii), particles[:, 2], radii)
    best = float(likelihood.max())
    if not np.isfinite(best):
        raise NoAnswerError("the crops' codes are not finite")
    # of particles (rows) and rotations (columns), together; in place, for there are 58 million
    likelihood.sub_(best).square_().mul_(-1 / (2 * SIMILARITY_NOISE**2))
    exponential_(likelihood)
    if last is not None:
        middle = view.positions(particles.mean(axis=0)[None])[0]
        prior = _turn_prior(quaternions, towards(middle).T @ last.rotation)
        likelihood.mul_(torch.from_numpy(prior).to(likelihood.device))
    # the most probable rotation, and those around it with the positions that they fit
    near = _angles(quaternions, quaternions[int(likelihood.amax(0).argmax())]) <= AVERAGED
    columns = torch.from_numpy(np.flatnonzero(near)).to(likelihood.device)
    likely = likelihood.index_select(1, columns).cpu().numpy()
    share = likely.sum(axis=1, dtype=float)
    mean = share @ particles / share.sum()
    translation = view.positions(mean[None])[0]
    rotation = _mean_rotation(quaternions[near], share @ likely)
    weights = likelihood.sum(1, dtype=torch.float64).cpu().numpy()
    belief = Belief(
        particles,
        weights / weights.sum(),
        towards(translation) @ rotation,
        translation,
        float(share @ radii / share.sum()),
        view.cloud.mean(axis=0),
    )
    tap("belief", vars(belief))
    return belief


def _turn_prior(quaternions: Array, rotation: Array) -> NDArray[np.float32]:
    angle = _angles(quaternions, Rotation.from_matrix(rotation).as_quat(scalar_first=True))
    prior: NDArray[np.float32] = np.exp(-(angle**2) / (2 * TURN_NOISE**2)).astype(np.float32)
    return prior + np.float32(TURN_ANY)


def _mean_rotation(quaternions: Array, weights: Array) -> Array:
    """The weighted mean (3, 3) of rotations (Markley et al., 2007)."""
    _, vectors = np.linalg.eigh((quaternions * weights[:, None]).T @ quaternions)
    return Rotation.from_quat(vectors[:, -1], scalar_first=True).as_matrix()


def _angles(quaternions: Array, other: Array) -> Array:
    angles: Array = 2 * np.arccos(np.abs(quaternions @ other).clip(max=1))
    return angles


def towards(position: Array) -> Array:
    """The rotation (3, 3) by the shortest way from the optical axis to a position's direction: an
    object off the axis looks as if it were turned back by it."""
    x, y, z = position / np.linalg.norm(position)
    axis = np.array([-y, x, 0.0])
    sine = np.hypot(x, y)
    if sine < 1e-12:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, z)).as_matrix()
