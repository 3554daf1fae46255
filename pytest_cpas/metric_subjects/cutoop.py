"""cutoop 0.1.0 (MIT), the evaluation of Omni6DPose (Zhang et al. 2024)."""

from typing import Any

import numpy as np
from cutoop import eval_utils, iou, rotation

from pytest_cpas.checks.metrics import offer
from pytest_cpas.types import Symmetry


def _sampled(estimate: Any, truth: Any, symmetry: Symmetry) -> Any:
    """What its default does: DetectMatch.calibrate_rotation, then the plain angle."""
    axis = "xyz"[int(np.argmax(np.abs(symmetry.axis)))] if symmetry.axis is not None else "y"
    kind = "cylinder" if len(symmetry.rotations) > 1 else "cone"
    label = rotation.SymLabel.from_str(f"{axis}-{kind}")
    same = estimate @ rotation.rot_canonical_sym(truth, estimate, label)
    return rotation.rot_diff_theta_pointwise(truth[None], same[None])[0]


METRICS = {
    "rotation_error": offer(lambda a, b: rotation.rot_diff_theta(a, b)[0]),
    "symmetric_rotation_error": offer(
        _sampled, symmetries=("principal axis", "principal axis with flip")
    ),
    "box_iou": offer(iou.compute_3d_bbox_iou),
    "average_precision": offer(
        lambda scores, correct, truths: eval_utils.compute_average_precision(
            correct, scores, truths
        ),
        interpolated=False,
    ),
}
