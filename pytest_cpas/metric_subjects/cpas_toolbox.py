"""cpas_toolbox 1.0.0 (MIT), the evaluation of Bruns & Jensfelt 2023."""

from typing import Any

from cpas_toolbox import metrics as m
from scipy.spatial.transform import Rotation

from pytest_cpas.checks.metrics import Sample, offer

#: What the toolbox's limits are called.
LIMITS = {
    "rotation_deg": "degree_threshold",
    "position_m": "position_threshold",
    "iou": "iou_3d_threshold",
    "fscore": "fscore_threshold",
    "nad": "nad_threshold",
}


def _pose_correct(
    estimate: Sample, truth: Sample, limits: dict[str, float], axis: int | None
) -> Any:
    parts: list[Any] = []
    for t, p in zip(vars(truth).values(), vars(estimate).values(), strict=True):
        parts += [t, p] if parts else map(Rotation.from_matrix, (t, p))
    r_t, r_p, t_t, t_p, *rest = parts
    thresholds: dict[str, Any] = {LIMITS[name]: limit for name, limit in limits.items()}
    return m.correct_thresh(t_t, t_p, r_t, r_p, *rest, rotational_symmetry_axis=axis, **thresholds)


METRICS = {
    "box_iou": offer(m.iou_3d, box=("translation", "rotation", "extents"), rotation="scipy"),
    "average_distance": offer(m.mean_completeness),
    "chamfer": offer(m.symmetric_chamfer),
    "surface_precision": offer(m.accuracy_thresh),
    "surface_recall": offer(m.completeness_thresh),
    "fscore": offer(m.reconstruction_fscore),
    "nad": offer(m.normalized_average_distance, normaliser="truth"),
    "diameter": offer(m.diameter),
    "pose_correct": offer(_pose_correct),
}
