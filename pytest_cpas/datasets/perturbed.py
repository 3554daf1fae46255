"""How much worse an observation may get: perturbations, and data sets that consist of them.

``--cpas-profile robustness`` judges a method on a part of each data set as it is and under every
perturbation at ``SEVERITIES`` severities. What the object is and where stays the truth; only what
a method sees becomes worse. A perturbation draws the same random numbers at every severity, so
that a curve over severities shows the severity and not the draw.
"""

from __future__ import annotations

import hashlib
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import distance_transform_edt

from pytest_cpas.types import (
    Dataset,
    MethodInfo,
    Observation,
    Sample,
    SampleRef,
    WrappedDataset,
)
from pytest_cpas.types.samples import evenly

SEVERITIES = 3

#: Samples of a data set that the profile judges, evenly spaced.
SAMPLES = 36

#: Width of the squares in which depth is missing together, pixels.
_PATCH = 8

#: How much nearer than the nearest measured point of the object its occluder is.
_IN_FRONT = 0.8

Apply = Callable[[Observation, float, np.random.Generator], Observation]


@dataclass(frozen=True)
class Perturbation:
    """``levels``: what a severity of 1, 2, 3 is, in the unit that ``words`` state; ``needs``: the
    parts of an observation that change, so that methods that use none of them are left out."""

    name: str
    words: str
    levels: tuple[float, ...]
    needs: frozenset[str]
    apply: Apply


def noisy_depth(observation: Observation, level: float, rng: np.random.Generator) -> Observation:
    """Gaussian noise of the depth, its standard deviation ``level`` metres at 1 m and growing with
    the square of the distance, as that of structured light does."""
    depth = observation.depth.astype(float)
    noise = level * depth**2 * rng.standard_normal(depth.shape)
    return replace(observation, depth=np.maximum(depth + noise, 0).astype(np.float32))


def missing_depth(observation: Observation, level: float, rng: np.random.Generator) -> Observation:
    """No depth in a share ``level`` of all squares of 8 pixels."""
    height, width = observation.depth.shape
    patches = rng.random((-(-height // _PATCH), -(-width // _PATCH)))
    draws = patches.repeat(_PATCH, axis=0).repeat(_PATCH, axis=1)[:height, :width]
    depth = np.where(draws < level, 0, observation.depth).astype(np.float32)
    return replace(observation, depth=depth)


def eroded_mask(observation: Observation, level: float, rng: np.random.Generator) -> Observation:
    """The mask without what is nearer than ``level`` pixels to its edge; its core stays."""
    inside = distance_transform_edt(observation.mask)
    return replace(observation, mask=inside > min(level, np.nextafter(inside.max(), 0)))


def dilated_mask(observation: Observation, level: float, rng: np.random.Generator) -> Observation:
    """The mask and what is up to ``level`` pixels outside of it."""
    return replace(observation, mask=distance_transform_edt(~observation.mask) <= level)


def occluded(observation: Observation, level: float, rng: np.random.Generator) -> Observation:
    """Something grey in front of a share ``level`` of the mask, from a random side."""
    rows, columns = np.nonzero(observation.mask)
    angle = rng.uniform(0, 2 * np.pi)
    along = np.cos(angle) * columns + np.sin(angle) * rows
    edge = np.quantile(along, level)
    y, x = np.mgrid[: observation.camera.height, : observation.camera.width]
    box = (abs(y - rows.mean()) <= np.ptp(rows)) & (abs(x - columns.mean()) <= np.ptp(columns))
    hidden = box & (np.cos(angle) * x + np.sin(angle) * y < edge)
    measured = observation.depth[observation.mask & (observation.depth > 0)]
    distance = _IN_FRONT * float(measured.min()) if len(measured) else 0.0
    return replace(
        observation,
        rgb=np.where(hidden[..., None], 0.5, observation.rgb).astype(np.float32),
        depth=np.where(hidden, distance, observation.depth).astype(np.float32),
        mask=observation.mask & ~hidden,
    )


def darker(observation: Observation, level: float, rng: np.random.Generator) -> Observation:
    """A share ``level`` of the light, in 8 bits."""
    rgb = np.round(observation.rgb * level * 255) / 255
    return replace(observation, rgb=rgb.astype(np.float32))


PERTURBATIONS = {
    perturbation.name: perturbation
    for perturbation in (
        Perturbation(
            "depth-noise",
            "standard deviation at 1 m, metres",
            (0.002, 0.005, 0.01),
            frozenset({"depth"}),
            noisy_depth,
        ),
        Perturbation(
            "missing-depth",
            "share of the image without depth",
            (0.25, 0.5, 0.75),
            frozenset({"depth"}),
            missing_depth,
        ),
        Perturbation("mask-erosion", "pixels", (2, 4, 8), frozenset({"rgb", "depth"}), eroded_mask),
        Perturbation(
            "mask-dilation", "pixels", (2, 4, 8), frozenset({"rgb", "depth"}), dilated_mask
        ),
        Perturbation(
            "occlusion",
            "share of the mask that is hidden",
            (0.15, 0.3, 0.5),
            frozenset({"rgb", "depth"}),
            occluded,
        ),
        Perturbation(
            "light",
            "share of the light that is left",
            (0.5, 0.25, 0.12),
            frozenset({"rgb"}),
            darker,
        ),
    )
}


@dataclass(frozen=True)
class RobustnessPoint:
    """A point of the curves: part of the data set ``base`` under a ``perturbation`` (its name) of
    ``severity`` 1 to :data:`SEVERITIES`; as it is where they are None and 0."""

    base: str
    perturbation: str | None = None
    severity: int = 0

    @property
    def dataset(self) -> str:
        """The name of the data set that the point is, which rows, results and tables carry."""
        return f"{self.base}+{self.suffix}"

    @property
    def suffix(self) -> str:
        """What was done to the base."""
        return f"{self.perturbation}-{self.severity}" if self.perturbation else "unperturbed"

    @classmethod
    def named(cls, dataset: str) -> RobustnessPoint | None:
        """The point that the name of a data set tells; None if it is none.

        For results and reports, of which nothing but the name is left.
        """
        made = "|".join(PERTURBATIONS)
        match = re.fullmatch(rf"(.+)\+(?:({made})-([1-{SEVERITIES}])|unperturbed)", dataset)
        return cls(match[1], match[2], int(match[3] or 0)) if match else None


class Perturbed(WrappedDataset):
    """A part of a data set under a perturbation; without one, as it is.

    ``point`` says which. It is a data set of its own, whose list of samples is complete, so that
    it has rows, results and golden tables of its own.
    """

    def __init__(
        self, dataset: Dataset, perturbation: Perturbation | None = None, severity: int = 0
    ) -> None:
        """Select evenly spaced samples; nothing is read."""
        super().__init__(dataset)
        self._perturbation = perturbation
        name = perturbation.name if perturbation else None
        self.point = RobustnessPoint(dataset.name, name, severity)
        self.name = self.point.dataset
        present = [ref for ref in dataset.samples if ref.id not in dataset.absent]
        self.samples = evenly(present, SAMPLES)
        self._level = perturbation.levels[severity - 1] if perturbation else 0
        parts = (
            dataset.digest,
            self.point.suffix,
            str(self._level),
            *(ref.id for ref in self.samples),
        )
        self.digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()

    def load(self, ref: SampleRef) -> Sample:
        """The sample with what is seen of it perturbed."""
        sample = super().load(ref)
        if self._perturbation is None:
            return sample
        seed = [zlib.crc32(ref.id.encode()), zlib.crc32(self._perturbation.name.encode())]
        rng = np.random.default_rng(seed)
        seen = self._perturbation.apply(sample.observation, self._level, rng)
        return replace(sample, observation=seen)


def perturbed(dataset: Dataset, info: MethodInfo) -> Iterator[Perturbed]:
    """The points of all curves, the unperturbed one first, for a method that declares ``info``."""
    yield Perturbed(dataset)
    for perturbation in PERTURBATIONS.values():
        if perturbation.needs & info.needs:
            for severity in range(1, SEVERITIES + 1):
                yield Perturbed(dataset, perturbation, severity)
