"""Metrics: pure functions on arrays, usable without pytest, data sets or methods."""

from pytest_cpas.metrics.average_precision import POSE_MATCH_IOU, AveragePrecision, Detections
from pytest_cpas.metrics.boxes import (
    axis_aligned_box_iou,
    iou_plus,
    nocs_legacy_iou,
    oriented_iou,
    symmetric_iou,
)
from pytest_cpas.metrics.definitions import (
    DEFINITIONS,
    Definition,
    definition,
    require_same_definition,
)
from pytest_cpas.metrics.model_points import (
    ModelPoints,
    add,
    add_s,
    mspd,
    mssd,
    symmetry_rotations,
)
from pytest_cpas.metrics.pose import rotation_error, translation_error
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
    "ModelPoints",
    "Surface",
    "SurfaceErrors",
    "add",
    "add_s",
    "axis_aligned_box_iou",
    "best_and_worst",
    "count",
    "count_by_category",
    "curve",
    "definition",
    "diameter",
    "iou_auc",
    "iou_plus",
    "mean_over_categories",
    "mspd",
    "mssd",
    "nocs_legacy_iou",
    "oriented_iou",
    "pose_vus",
    "require_same_definition",
    "rotation_error",
    "sample_surface",
    "surface_errors",
    "symmetric_iou",
    "symmetry_rotations",
    "translation_error",
]
