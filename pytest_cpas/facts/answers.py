"""Answers beside their truths, as arrays: what facts are computed from."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.metrics.boxes import of_unit_diagonal
from pytest_cpas.metrics.model_points import ModelPoints
from pytest_cpas.metrics.surfaces import Surface, SurfaceErrors, surface_errors
from pytest_cpas.types import (
    AnswerError,
    Array,
    Camera,
    DataError,
    GroundTruth,
    Hypothesis,
    Mesh,
    Pose,
    Symmetry,
    raised_as,
)

__all__ = ["AnswerBatch", "declared_part"]

#: A box as three arrays: rotation (n, 3, 3), translation (n, 3) and extents (n, 3), metres.
Boxes = tuple[Array, Array, Array]

#: A distance, metres, of an estimated and a true pose of a model.
ModelDistance = Callable[[Pose, Pose, ModelPoints], float]


@dataclass(frozen=True, eq=False)
class AnswerBatch:
    """n answers, in the standard frames, and the truth about each.

    All truths have one ``symmetry``, and one ``symmetry_in_view``. ``cameras``: of each image, None
    where it is not known. ``others``: further hypotheses of each answer. What several facts need is
    computed once, when it is first asked for.
    """

    truths: Sequence[GroundTruth]
    estimates: Sequence[Hypothesis]
    symmetry: Symmetry
    symmetry_in_view: Symmetry
    cameras: Sequence[Camera | None]
    others: Sequence[Sequence[Hypothesis]]
    _distances: dict[ModelDistance, list[float | None]] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.truths)

    @functools.cached_property
    def hypotheses(self) -> tuple[AnswerBatch, NDArray[np.int64]]:
        """All hypotheses, those of an answer one after the other, as answers of their own; and at
        which of them each answer begins, (n,)."""
        each = [(h, *more) for h, more in zip(self.estimates, self.others, strict=True)]
        counts = [len(several) for several in each]
        flat = replace(
            self,
            truths=[t for t, count in zip(self.truths, counts, strict=True) for _ in range(count)],
            estimates=[hypothesis for several in each for hypothesis in several],
            cameras=[
                c for c, count in zip(self.cameras, counts, strict=True) for _ in range(count)
            ],
            others=[()] * sum(counts),
            _distances={},
        )
        return flat, np.cumsum(counts, dtype=np.int64) - counts

    @functools.cached_property
    def rotations(self) -> tuple[Array, Array]:
        """Estimated and true, (n, 3, 3) each."""
        return (
            np.stack([h.rotation for h in self.estimates]),
            np.stack([t.pose.rotation for t in self.truths]),
        )

    @functools.cached_property
    def translations(self) -> tuple[Array, Array]:
        """Estimated and true, (n, 3) each, metres."""
        return (
            np.stack([h.translation for h in self.estimates]),
            np.stack([t.pose.translation for t in self.truths]),
        )

    @functools.cached_property
    def extents(self) -> tuple[Array, Array]:
        """Estimated and true, (n, 3) each, metres; :class:`AnswerError` for one without any."""
        return (
            np.stack([declared_part(h.extents, "extents") for h in self.estimates]),
            np.stack([t.extents for t in self.truths]),
        )

    @property
    def boxes(self) -> tuple[Boxes, Boxes]:
        """The estimated boxes and the true ones."""
        parts = self.rotations, self.translations, self.extents
        estimated, true = zip(*parts, strict=True)
        return estimated, true

    @functools.cached_property
    def boxes_of_unit_diagonal(self) -> tuple[Boxes, Boxes]:
        """The same boxes, each scaled about the camera until its diagonal is 1."""
        (rotation, *estimated), (true_rotation, *true) = self.boxes
        return (
            (rotation, *of_unit_diagonal(*estimated)),
            (true_rotation, *of_unit_diagonal(*true)),
        )

    @functools.cached_property
    def surfaces(self) -> Sequence[SurfaceErrors | None]:
        """The posed surfaces side by side; None where the data set has no true one.

        Raises :class:`AnswerError` for an estimate without a shape, or with one that has no area;
        :class:`DataError` for such a truth.
        """
        return [
            _surface_errors(truth, estimate)
            for truth, estimate in zip(self.truths, self.estimates, strict=True)
        ]

    @functools.cached_property
    def models(self) -> Sequence[ModelPoints | None]:
        """The points of the true shapes; None where the data set has none.

        Raises :class:`DataError` for one whose points all coincide.
        """
        return [None if t.surface is None else _model(_Same(t.surface)) for t in self.truths]

    def of_models(self, distance: ModelDistance) -> Sequence[float | None]:
        """A distance of the estimated and the true pose of every model; None where there is none.

        A function is asked once, whichever facts want it.
        """
        if distance not in self._distances:
            self._distances[distance] = [
                None if model is None else distance(estimate.pose, truth.pose, model)
                for truth, estimate, model in zip(
                    self.truths, self.estimates, self.models, strict=True
                )
            ]
        return self._distances[distance]

    def of_surfaces(self, fact: Callable[[SurfaceErrors], float]) -> Sequence[float | None]:
        """A fact of every pair of surfaces; None where there is none."""
        return [None if errors is None else float(fact(errors)) for errors in self.surfaces]


def declared_part(value: Any, part: str) -> Any:
    """A part of a hypothesis that its method declares; :class:`AnswerError` if it is not there."""
    if value is None:
        raise AnswerError(
            f"hypothesis: {part} is None, but info.gives has {part!r}; give it or do not declare it"
        )
    return value


def _surface_errors(truth: GroundTruth, estimate: Hypothesis) -> SurfaceErrors | None:
    if truth.surface is None:
        return None
    with raised_as(DataError):
        true_surface = _truth_surface(_Same(truth.surface))
    with raised_as(AnswerError):
        # another seed than the truth's: two samplings of one mesh must not coincide
        surface = Surface.of(declared_part(estimate.shape, "shape"), seed=1)
    return surface_errors(
        true_surface, surface, truth_pose=truth.pose, estimated_pose=estimate.pose
    )


@dataclass(frozen=True, eq=False)
class _Same:
    """A surface as a key of a cache: equal if it is the same object."""

    surface: Mesh | Array

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.surface is other.surface

    def __hash__(self) -> int:
        return id(self.surface)


@functools.lru_cache(maxsize=256)
def _truth_surface(same: _Same) -> Surface:
    return Surface.of(same.surface, seed=0)


@functools.lru_cache(maxsize=256)
@raised_as(DataError)
def _model(same: _Same) -> ModelPoints:
    model = ModelPoints.of(same.surface)
    _ = model.diameter  # which all facts but one need
    return model
