"""The metrics of this package."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas import metrics as m
from pytest_cpas.checks.metrics import Sample, offer
from pytest_cpas.metrics.boxes import of_unit_diagonal
from pytest_cpas.types import Camera, Mesh, Pose, Symmetry

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


def _hypotheses(
    which: int,
) -> Callable[[Sequence[Sequence[m.precision.Row]], Mapping[str, float]], float | None]:
    def precision(
        hypotheses: Sequence[Sequence[m.precision.Row]], limits: Mapping[str, float]
    ) -> float | None:
        counts = m.best_and_worst(hypotheses, m.JointThreshold(**limits))
        return None if counts is None else counts[which].precision

    return precision


def _curve(errors: Array, name: str, thresholds: Array) -> list[float]:
    counts = m.curve(m.Errors({name: errors}), name, thresholds)
    return [] if counts is None else [count.precision for count in counts]


def _ends(interval: m.Interval | None) -> tuple[float, float] | None:
    return None if interval is None else (interval.low, interval.high)


def _scaled_boxes(*boxes: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    a, b = boxes[:3], boxes[3:]
    return (a[0], *of_unit_diagonal(*a[1:])), (b[0], *of_unit_diagonal(*b[1:]))


def _equal_diagonals_iou(*boxes: Array) -> Any:
    _ = m.oriented_iou(*boxes)  # refuses what is no box
    a, b = _scaled_boxes(*boxes)
    return m.oriented_iou(*a, *b)


def _relative_translation_error(*boxes: Array) -> Any:
    _ = m.oriented_iou(*boxes)
    a, b = _scaled_boxes(*boxes)
    return m.translation_error(a[1], b[1])


def _iou_plus(estimate: Array, truth: Array) -> float:
    here = Pose(np.eye(3), np.zeros(3))
    return m.iou_plus(estimate, here, truth, here)


def _mean_detection_ap(
    pred_images: Array,
    pred_categories: Array,
    scores: Array,
    true_images: Array,
    true_categories: Array,
    iou: Array,
    threshold: float,
    categories: Sequence[int],
) -> float | None:
    found = m.Detections(
        pred_images, pred_categories, scores, true_images, true_categories, categories
    )
    # what is no pair is checked as well
    _ = m.Errors({"iou": iou.ravel()})
    return found.iou_ap(iou[found.pairs[:, 0], found.pairs[:, 1]], threshold).mean


def _pose_ap(
    pred_images: Array,
    pred_categories: Array,
    scores: Array,
    true_images: Array,
    true_categories: Array,
    degrees: Array,
    metres: Array,
    most_degrees: float,
    most_metres: float,
    category: int,
    iou: Array | None = None,
) -> float | None:
    found = m.Detections(
        pred_images, pred_categories, scores, true_images, true_categories, [category]
    )
    i, j = found.pairs.T
    # what is no pair is checked as well
    _ = m.Errors({"rotation_deg": degrees.ravel(), "position_m": metres.ravel()})
    if not len(scores) == len(degrees) == len(metres):
        raise ValueError("the rows are not those of the predictions")
    match = None
    if iou is not None:
        _ = m.Errors({"iou": iou.ravel()})
        match = iou[i, j]
    limits = most_degrees, most_metres
    return found.pose_ap(degrees[i, j], metres[i, j], *limits, match_iou=match).mean


def _pair(r: Array, t: Array, r_true: Array, t_true: Array) -> tuple[Pose, Pose]:
    return Pose(r, t), Pose(r_true, t_true)


def _mspd(*args: Any) -> float:
    *poses, points, symmetry, (fx, fy, cx, cy), width = args
    camera = Camera(width, width, fx, fy, cx, cy)
    return m.mspd(*_pair(*poses), m.ModelPoints(points), symmetry, camera)


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
    "equal_diagonals_iou": offer(_equal_diagonals_iou),
    "relative_translation_error": offer(_relative_translation_error),
    "axis_aligned_iou": offer(m.axis_aligned_box_iou),
    "legacy_iou": offer(m.nocs_legacy_iou),
    "iou_plus": offer(_iou_plus),
    "best_precision": offer(_hypotheses(0)),
    "worst_precision": offer(_hypotheses(1)),
    "precision_curve": offer(_curve),
    "count_interval": offer(
        lambda correct, total, confidence: m.Count(correct, total).interval(confidence)
    ),
    "mean_interval": offer(lambda values, sure: _ends(m.mean_interval(values, sure))),
    "median_interval": offer(lambda values, sure: _ends(m.median_interval(values, sure))),
    "mean_detection_ap": offer(_mean_detection_ap),
    "pose_ap": offer(_pose_ap),
    "matched_pose_ap": offer(_pose_ap),
    "sample_surface": offer(
        lambda vertices, triangles, count, seed: m.sample_surface(
            Mesh(vertices, triangles), count, seed
        )
    ),
    "add": offer(lambda *x: m.add(*_pair(*x[:4]), m.ModelPoints(x[4]))),
    "add_s": offer(lambda *x: m.add_s(*_pair(*x[:4]), m.ModelPoints(x[4]))),
    "mssd": offer(lambda *x: m.mssd(*_pair(*x[:4]), m.ModelPoints(x[4]), x[5])),
    "mspd": offer(_mspd),
}
