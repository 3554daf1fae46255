"""Judge all stored predictions of a method on REAL275: time and memory.

    OMP_NUM_THREADS=1 python benchmarks/bench_judge.py [dualposenet_real275.npz]

Rotation and translation error, oriented, axis-aligned and legacy IoU of every prediction with
every ground truth of its image and category; AP of IoU and pose; precision of the 16118 ground
truths at joint thresholds. Must stay below 20 s and 1 GiB.
"""

from __future__ import annotations

import os
import resource
import sys
import time
from pathlib import Path

import numpy as np

from pytest_cpas.metrics.average_precision import Detections
from pytest_cpas.metrics.boxes import axis_aligned_box_iou, nocs_legacy_iou, symmetric_iou
from pytest_cpas.metrics.pose import rotation_error, translation_error
from pytest_cpas.metrics.precision import (
    FAILED,
    Errors,
    JointThreshold,
    count_by_category,
    iou_auc,
    pose_vus,
)
from pytest_cpas.types import CATEGORIES, Symmetry

POSES = ((5, 0.02), (5, 0.05), (10, 0.02), (10, 0.05))


def boxes(data: dict[str, np.ndarray], side: str, rows: np.ndarray) -> list[np.ndarray]:
    linear = data[f"{side}_RTs"][rows, :3, :3]
    scale = np.cbrt(np.linalg.det(linear))[:, None]
    translation = data[f"{side}_RTs"][rows, :3, 3]
    return [linear / scale[..., None], translation, data[f"{side}_scales"][rows] * scale]


def judge(path: Path) -> None:
    with np.load(path) as stored:
        data = {name: stored[name] for name in stored.files}
    images = np.arange(len(data["frame"]))
    detections = Detections(
        np.repeat(images, np.diff(data["pred_offset"])),
        data["pred_class_ids"],
        data["pred_scores"],
        np.repeat(images, np.diff(data["gt_offset"])),
        data["gt_class_ids"],
        range(1, 7),
    )
    p, g = detections.pairs.T
    pred, true = boxes(data, "pred", p), boxes(data, "gt", g)
    category = data["gt_class_ids"][g]
    no_handle = (category == 6) & (data["gt_handle_visibility"][g] == 0)
    symmetric = np.isin(category, (1, 2, 4)) | no_handle
    degrees, oriented, aligned, legacy = (np.empty(len(p)) for _ in range(4))
    metres = translation_error(pred[1], true[1])
    for chosen, symmetry, spins in (
        (symmetric, Symmetry.about((0, 1, 0)), 20),
        (~symmetric, Symmetry.none(), 1),
    ):
        part = [array[chosen] for array in (*pred, *true)]
        degrees[chosen] = np.degrees(rotation_error(part[0], part[3], symmetry))
        oriented[chosen] = symmetric_iou(*part, symmetry)
        aligned[chosen] = axis_aligned_box_iou(*part, spins=spins)
        legacy[chosen] = nocs_legacy_iou(*part, spins=spins)

    print(f"{len(data['gt_class_ids'])} ground truths, {len(p)} pairs with a prediction")
    for name, iou in (("legacy", legacy), ("axis-aligned", aligned), ("oriented", oriented)):
        values = [detections.iou_ap(iou, limit).mean for limit in (0.25, 0.5, 0.75)]
        print(f"mAP, {name} IoU 25 50 75:", " ".join(f"{100 * (v or 0):.1f}" for v in values))
    for name, iou in (("matched at legacy IoU 0.1", legacy), ("all", None)):
        values = [
            detections.pose_ap(degrees, metres, *limits, match_iou=iou).mean for limits in POSES
        ]
        print(f"mAP, pose, {name}:", " ".join(f"{100 * (v or 0):.1f}" for v in values))

    # precision: every ground truth counts, with the prediction of its category that overlaps most
    order = np.lexsort((-oriented, g))
    best = order[np.r_[True, np.diff(g[order]) > 0]]
    columns = {
        name: np.full(len(data["gt_class_ids"]), FAILED[name])
        for name in ("rotation_deg", "position_m", "iou")
    }
    for name, values in (("rotation_deg", degrees), ("position_m", metres), ("iou", oriented)):
        columns[name][g[best]] = values[best]
    names = [CATEGORIES[i - 1] for i in data["gt_class_ids"]]
    for threshold in [JointThreshold(rotation_deg=d, position_m=m) for d, m in POSES]:
        counts = count_by_category(Errors(columns), names, threshold, CATEGORIES)
        cells = [f"{n} {c.correct}/{c.total}" for n, c in counts.items() if c is not None]
        print(f"precision at {threshold.label}:", ", ".join(cells))
    aucs = [iou_auc(columns["iou"], lower) for lower in (0.25, 0.5, 0.75)]
    volumes = [pose_vus(columns["rotation_deg"], columns["position_m"], *pose) for pose in POSES]
    print("IoU AUC, pose VUS:", " ".join(f"{100 * (v or 0):.1f}" for v in (*aucs, *volumes)))


if __name__ == "__main__":
    data_folder = os.environ.get(
        "CPAS_TEST_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"
    )
    file = Path(data_folder, "predictions", "dualposenet_real275.npz")
    start = time.perf_counter()
    judge(Path(sys.argv[1]) if len(sys.argv) > 1 else file)
    seconds = time.perf_counter() - start
    # kilobytes on Linux
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{seconds:.1f} s (limit 20 s), peak memory of the process {peak:.0f} MiB (limit 1024)")
    sys.exit(seconds > 20 or peak > 1024)
