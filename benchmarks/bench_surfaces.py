"""Surface metrics and diameter against cpas_toolbox 1.0.0, in the same process, one thread.

    pip install --no-deps cpas_toolbox==1.0.0
    OMP_NUM_THREADS=1 python benchmarks/bench_surfaces.py

Prints medians and their ratio. The peer's all-pairs diameter takes about 3 GB of memory.
"""

from __future__ import annotations

import statistics
import time
import tracemalloc
from collections.abc import Callable

import numpy as np
from cpas_toolbox import metrics as peer
from scipy.spatial.transform import Rotation

from pytest_cpas.metrics.pose import rotation_error, translation_error
from pytest_cpas.metrics.precision import PAPER_THRESHOLDS, JointThreshold
from pytest_cpas.metrics.surfaces import Surface, diameter, surface_errors
from pytest_cpas.types import Pose

POSITIONS = [JointThreshold(position_m=0.005 * i) for i in range(11)]
ROTATIONS = [JointThreshold(rotation_deg=float(i)) for i in range(21)]
# the published configuration lists 0.4 twice
SHAPES = [JointThreshold(fscore=f) for f in sorted([*(0.05 * np.arange(21)), 0.4])]
GRID = [*POSITIONS, *ROTATIONS, *SHAPES, *PAPER_THRESHOLDS]


def milliseconds(function: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(1000 * (time.perf_counter() - start))
    return statistics.median(times)


def mug_like(count: int, seed: int) -> np.ndarray:
    """Points on a 10 cm open cylinder."""
    rng = np.random.default_rng(seed)
    angle, height = 2 * np.pi * rng.random(count), rng.random(count) - 0.5
    return np.stack([0.04 * np.cos(angle), 0.1 * height, 0.04 * np.sin(angle)], axis=1)


def one_sample() -> None:
    rng = np.random.default_rng(0)
    truth_points, estimate = mug_like(10_000, 1), mug_like(1024, 2) * 1.02
    turn = Rotation.random(rng=rng)
    pose = Pose(turn.as_matrix(), np.array([0.1, -0.05, 0.8]))
    off = Rotation.from_rotvec([0.02, 0.03, -0.01])
    estimated = Pose((turn * off).as_matrix(), np.array([0.102, -0.049, 0.804]))
    truth = Surface(truth_points)
    _ = truth.tree

    def ours() -> list[bool | None]:
        errors = surface_errors(truth, estimate, truth_pose=pose, estimated_pose=estimated)
        values = {
            "rotation_deg": float(np.degrees(rotation_error(estimated.rotation, pose.rotation))),
            "position_m": float(translation_error(estimated.translation, pose.translation)),
            "fscore": float(errors.fscore(0.01)),
        }
        return [threshold.is_correct(**values) for threshold in GRID]

    def theirs() -> list[bool]:
        posed_truth, posed_estimate = pose.apply(truth_points), estimated.apply(estimate)
        return [
            bool(
                peer.correct_thresh(
                    position_gt=pose.translation,
                    position_prediction=estimated.translation,
                    orientation_gt=Rotation.from_matrix(pose.rotation),
                    orientation_prediction=Rotation.from_matrix(estimated.rotation),
                    points_gt=posed_truth,
                    points_prediction=posed_estimate,
                    position_threshold=threshold.position_m,
                    degree_threshold=threshold.rotation_deg,
                    fscore_threshold=threshold.fscore,
                )
            )
            for threshold in GRID
        ]

    if ours() != theirs():
        raise SystemExit("ours and the peer's verdicts differ")
    a, b = milliseconds(ours, 21), milliseconds(theirs, 5)
    print(f"one sample, {len(GRID)} thresholds, 10000 against 1024 points")
    print(f"  ours {a:9.2f} ms   cpas_toolbox {b:9.1f} ms   ratio {b / a:7.1f}")


def diameters() -> None:
    sphere = np.random.default_rng(0).normal(size=(10_000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    x, y, z = sphere.T[:, :, None]
    clouds = {
        "sphere": 0.05 * sphere,
        "ellipsoid": sphere * [0.05, 0.04, 0.03],
        "egg": 0.05 * sphere * (1 + 0.2 * z),
        "bumpy": 0.05 * sphere * (1 + 0.02 * np.sin(3 * x + 1) * np.cos(2 * y)),
    }
    print("diameter of a smooth surface of 10000 points")
    for name, cloud in clouds.items():
        a, b = (
            milliseconds(lambda c=cloud: diameter(c), 21),
            milliseconds(lambda c=cloud: peer.diameter(c), 3),
        )
        if not np.isclose(diameter(cloud), peer.diameter(cloud), rtol=1e-14, atol=0):
            raise SystemExit(f"{name}: the diameters differ")
        print(f"  {name:10s} ours {a:9.2f} ms   cpas_toolbox {b:9.1f} ms   ratio {b / a:7.1f}")
    for count in (10_000, 40_000):
        cloud = np.random.default_rng(1).normal(size=(count, 3))
        cloud /= np.linalg.norm(cloud, axis=1, keepdims=True)
        tracemalloc.start()
        diameter(cloud)
        peak = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
        print(f"  memory of ours, sphere of {count} points: {peak:.1f} MB")


if __name__ == "__main__":
    one_sample()
    diameters()
