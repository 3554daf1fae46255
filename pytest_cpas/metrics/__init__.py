"""Metrics: pure functions on arrays, usable without pytest, data sets or methods."""

from pytest_cpas.metrics.average_precision import POSE_MATCH_IOU, AveragePrecision, Detections
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
    "FAILED",
    "METRICS",
    "PAPER_THRESHOLDS",
    "POSE_MATCH_IOU",
    "AveragePrecision",
    "Count",
    "Detections",
    "Errors",
    "JointThreshold",
    "Surface",
    "SurfaceErrors",
    "best_and_worst",
    "count",
    "count_by_category",
    "curve",
    "diameter",
    "iou_auc",
    "mean_over_categories",
    "pose_vus",
    "sample_surface",
    "surface_errors",
]
