"""From answers to rows: the errors of each answer against the truth."""

from __future__ import annotations

import functools
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_cpas.evaluation.estimates import encode_estimate
from pytest_cpas.evaluation.rows import FSCORE_DISTANCE, Row, failed_row
from pytest_cpas.metrics.boxes import symmetric_iou
from pytest_cpas.metrics.pose import rotation_error, translation_error
from pytest_cpas.metrics.surfaces import Surface, surface_errors
from pytest_cpas.types import (
    AnswerError,
    Array,
    DataError,
    GroundTruth,
    Hypothesis,
    Mesh,
    MethodInfo,
    Prediction,
    SampleRef,
    Symmetry,
    raised_as,
)
from pytest_cpas.types.frames import to_standard

__all__ = ["measure"]


def measure(
    refs: Sequence[SampleRef],
    truths: Sequence[GroundTruth],
    predictions: Sequence[Prediction],
    info: MethodInfo,
) -> list[Row]:
    """The errors of each prediction's best hypothesis; frames are converted as ``info`` declares.

    Raises :class:`AnswerError` for a hypothesis without the shape that ``info`` declares, or with
    one that has no area; :class:`DataError` for such a truth.
    """
    rows: list[Row | None] = []
    groups: dict[Symmetry, list[int]] = defaultdict(list)
    best: dict[int, Hypothesis] = {}
    for index, (ref, truth, prediction) in enumerate(zip(refs, truths, predictions, strict=True)):
        rows.append(None)
        if prediction.hypotheses:
            best[index] = to_standard(prediction.hypotheses[0], info)
            groups[truth.symmetry].append(index)
        else:
            shape = "shape" in info.gives and truth.surface is not None
            rows[index] = failed_row(ref, prediction.reason, "extents" in info.gives, shape)
    for symmetry, members in groups.items():
        estimates, true = [best[i] for i in members], [truths[i] for i in members]
        rotations = np.stack([h.rotation for h in estimates])
        translations = np.stack([h.translation for h in estimates])
        true_rotations = np.stack([t.pose.rotation for t in true])
        true_translations = np.stack([t.pose.translation for t in true])
        angles = np.degrees(rotation_error(rotations, true_rotations, symmetry))
        distances = translation_error(translations, true_translations)
        ious: Sequence[float | None] = [None] * len(members)
        if "extents" in info.gives:
            extents = np.stack([declared_part(h.extents, "extents") for h in estimates])
            true_extents = np.stack([t.extents for t in true])
            true_box = true_rotations, true_translations, true_extents
            ious = symmetric_iou(rotations, translations, extents, *true_box, symmetry).tolist()
        for i, distance, angle, iou in zip(members, distances, angles, ious, strict=True):
            fscore = _fscore(truths[i], best[i]) if "shape" in info.gives else None
            rows[i] = Row(
                sample=refs[i].id,
                category=refs[i].category,
                translation_error=float(distance),
                rotation_error=float(angle),
                iou=iou,
                fscore_1cm=fscore,
                estimate=encode_estimate(best[i]),
            )
    return [row for row in rows if row is not None]


def declared_part(value: Any, part: str) -> Any:
    if value is None:
        raise AnswerError(
            f"hypothesis: {part} is None, but info.gives has {part!r}; give it or do not declare it"
        )
    return value


def _fscore(truth: GroundTruth, estimate: Hypothesis) -> float | None:
    if truth.surface is None:
        return None
    with raised_as(DataError):
        true_surface = _truth_surface(_Same(truth.surface))
    with raised_as(AnswerError):
        # another seed than the truth's: two samplings of one mesh must not coincide
        surface = Surface.of(declared_part(estimate.shape, "shape"), seed=1)
    errors = surface_errors(
        true_surface,
        surface,
        truth_pose=truth.pose,
        estimated_pose=estimate.pose,
    )
    return float(errors.fscore(FSCORE_DISTANCE))


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
