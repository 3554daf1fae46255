"""The metrics of this package."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas import metrics as m
from pytest_cpas.checks.metrics import Sample, offer
from pytest_cpas.types import Symmetry

Array = NDArray[np.float64]


def _surfaces(truth: Array, estimate: Array) -> m.SurfaceErrors:
    return m.surface_errors(m.Surface(truth), estimate)


def _precision(errors: Mapping[str, Array], limits: Mapping[str, float]) -> float | None:
    counted = m.count(m.Errors(errors), m.JointThreshold(**limits))
    return None if counted is None else counted.precision


def _mean_precision(
    errors: Mapping[str, Array],
    limits: Mapping[str, float],
    categories: Sequence[str],
    names: Sequence[str],
) -> float | None:
    counts = m.count_by_category(m.Errors(errors), categories, m.JointThreshold(**limits), names)
    return m.mean_over_categories(counts)


def _pose_correct(
    estimate: Sample, truth: Sample, limits: Mapping[str, float], axis: int | None
) -> bool | None:
    symmetry = Symmetry.none() if axis is None else Symmetry.about(np.eye(3)[axis])
    a, b = ((s.rotation, s.translation, s.extents) for s in (estimate, truth))
    errors: dict[str, Any] = {
        "rotation_deg": np.rad2deg(m.rotation_error(a[0], b[0], symmetry)),
        "position_m": m.translation_error(a[1], b[1]),
    }
    if "iou" in limits:
        errors["iou"] = m.symmetric_iou(*a, *b, symmetry)
    if "fscore" in limits or "nad" in limits:
        surfaces = _surfaces(truth.points, estimate.points)
        errors |= {"fscore": surfaces.fscore(0.01), "nad": surfaces.nad}
    return m.JointThreshold(**limits).is_correct(**{k: float(v) for k, v in errors.items()})


def _average_precision(scores: Array, correct: Array, truths: int) -> float | None:
    # one image per detection, which overlaps with a ground truth of its own where it is correct
    images = np.arange(len(scores))
    true_images = np.concatenate([images[correct], -1 - np.arange(truths - int(correct.sum()))])
    found = m.Detections(
        images, np.zeros(len(scores)), scores, true_images, np.zeros(truths), categories=[0]
    )
    return found.iou_ap(np.ones(len(found.pairs)), 0.5).mean


def _detection_ap(
    pred_images: Array,
    pred_categories: Array,
    scores: Array,
    true_images: Array,
    true_categories: Array,
    iou: Array,
    threshold: float,
    category: int,
) -> float | None:
    found = m.Detections(
        pred_images, pred_categories, scores, true_images, true_categories, [category]
    )
    return found.iou_ap(iou[found.pairs[:, 0], found.pairs[:, 1]], threshold).mean


METRICS = {
    "rotation_error": offer(m.rotation_error),
    "symmetric_rotation_error": offer(m.rotation_error),
    "translation_error": offer(m.translation_error),
    "box_iou": offer(m.oriented_iou),
    "symmetric_box_iou": offer(m.symmetric_iou),
    "average_distance": offer(lambda a, b: _surfaces(a, b).ad_truth_to_estimate),
    "chamfer": offer(lambda a, b: _surfaces(a, b).chamfer),
    "surface_precision": offer(lambda a, b, limit: _surfaces(a, b).precision(limit)),
    "surface_recall": offer(lambda a, b, limit: _surfaces(a, b).recall(limit)),
    "fscore": offer(lambda a, b, limit: _surfaces(a, b).fscore(limit)),
    "nad": offer(lambda a, b: _surfaces(a, b).nad),
    "diameter": offer(m.diameter),
    "precision": offer(_precision),
    "mean_precision": offer(_mean_precision),
    "iou_auc": offer(m.iou_auc),
    "pose_vus": offer(m.pose_vus),
    "pose_correct": offer(_pose_correct),
    "average_precision": offer(_average_precision),
    "detection_ap": offer(_detection_ap),
}
