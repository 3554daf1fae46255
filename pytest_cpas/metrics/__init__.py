"""Metrics: pure functions on arrays, usable without pytest, data sets or methods."""

from pytest_cpas.metrics.average_precision import POSE_MATCH_IOU, AveragePrecision, Detections
from pytest_cpas.metrics.definitions import (
    DEFINITIONS,
    Definition,
    definition,
    require_same_definition,
)
from pytest_cpas.metrics.precision import (
    FAILED,
    METRICS,
    PAPER_THRESHOLDS,
    Count,
    Errors,
    JointThreshold,
    best_and_worst,
    count,
    count_by_category,
    curve,
    iou_auc,
    mean_over_categories,
    pose_vus,
)
from pytest_cpas.metrics.surfaces import (
    Surface,
    SurfaceErrors,
    diameter,
    sample_surface,
    surface_errors,
)

__all__ = [
    "DEFINITIONS",
    "FAILED",
    "METRICS",
    "PAPER_THRESHOLDS",
    "POSE_MATCH_IOU",
    "AveragePrecision",
    "Count",
    "Definition",
    "Detections",
    "Errors",
    "JointThreshold",
    "Surface",
    "SurfaceErrors",
    "best_and_worst",
    "count",
    "count_by_category",
    "curve",
    "definition",
    "diameter",
    "iou_auc",
    "mean_over_categories",
    "pose_vus",
    "require_same_definition",
    "sample_surface",
    "surface_errors",
]
