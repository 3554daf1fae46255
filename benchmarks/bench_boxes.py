"""Oriented and symmetric IoU against cpas_toolbox 1.0.0, in the same process, one thread, CPU time.

    pip install --no-deps cpas_toolbox==1.0.0
    OMP_NUM_THREADS=1 python benchmarks/bench_boxes.py

Prints pairs per second (medians) and their ratio, and how far each side stays below the largest
symmetric IoU that either side or a dense search finds. With numba the compiled kernel is timed
after it was loaded; loading and compiling it are printed beside. The peer's symmetric loop
crashes as published (it hands a number to Rotation.from_rotvec where it built a vector); it is
repeated here with that call repaired. It spins the first box that it is given; so does ours here.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np
from cpas_toolbox import metrics as peer
from scipy.spatial.transform import Rotation

from pytest_cpas.metrics import _box_clipping
from pytest_cpas.metrics.boxes import oriented_iou, symmetric_iou
from pytest_cpas.metrics.pose import rotation_error
from pytest_cpas.types import Symmetry

KINDS = ("near", "random")
SPIN = Symmetry.about((0, 1, 0))
Boxes = tuple[Rotation, np.ndarray, np.ndarray, Rotation, np.ndarray, np.ndarray]


def pairs(kind: str, count: int) -> Boxes:
    """Box A and box B as rotations, centres and extents; handheld objects of 5 to 30 cm."""
    rng = np.random.default_rng(1)
    rotation_b, centre_b = Rotation.random(count, rng=rng), rng.normal(size=(count, 3))
    extents_b = rng.uniform(0.05, 0.3, (count, 3))
    if kind == "near":
        turn = Rotation.from_rotvec(rng.normal(size=(count, 3)) * np.radians(5))
        rotation_a, centre_a = rotation_b * turn, centre_b + rng.normal(size=(count, 3)) * 0.01
        extents_a = extents_b * rng.uniform(0.9, 1.1, (count, 3))
    else:
        rotation_a = Rotation.random(count, rng=rng)
        centre_a = centre_b + rng.normal(size=(count, 3)) * 0.05
        extents_a = rng.uniform(0.05, 0.3, (count, 3))
    return rotation_a, centre_a, extents_a, rotation_b, centre_b, extents_b


def arrays(boxes: Boxes) -> tuple[np.ndarray, ...]:
    return tuple(part.as_matrix() if isinstance(part, Rotation) else part for part in boxes)


def peer_iou(boxes: Boxes, i: int) -> float:
    rotation_a, centre_a, extents_a, rotation_b, centre_b, extents_b = (part[i] for part in boxes)
    return float(peer.iou_3d(centre_b, rotation_b, extents_b, centre_a, rotation_a, extents_a))


def peer_symmetric_iou(boxes: Boxes, i: int) -> float:
    rotation_a, centre_a, extents_a, rotation_b, centre_b, extents_b = (part[i] for part in boxes)
    return max(
        peer.iou_3d(
            centre_a, rotation_a, extents_a,
            centre_b, rotation_b * Rotation.from_rotvec((0, angle, 0)), extents_b,
        )
        for angle in np.linspace(0, np.pi, 100)
    )  # fmt: skip


def dense_symmetric_iou(boxes: tuple[np.ndarray, ...], i: int) -> float:
    angles = np.linspace(0, 2 * np.pi, 20_000)
    spins = Rotation.from_rotvec(angles[:, None] * (0, 1, 0)).as_matrix()
    a, b = [part[i] for part in boxes[:3]], [part[i] for part in boxes[3:]]
    return float(oriented_iou(*a, b[0] @ spins, b[1], b[2]).max())


def seconds(function: Callable[[], object], repeats: int = 5) -> float:
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return statistics.median(times)


def peer_times(function: Callable[[Boxes, int], float], boxes: Boxes) -> tuple[np.ndarray, float]:
    """The peer's values, and its median seconds for one pair."""
    values, times = [], []
    for i in range(len(boxes[0])):
        start = time.process_time()
        values.append(function(boxes, i))
        times.append(time.process_time() - start)
    return np.array(values), statistics.median(times)


def compare(name: str, ours: float, theirs: float, note: str) -> None:
    print(
        f"{name:<34}{1 / ours:>12,.0f}{1 / theirs:>12,.1f}{theirs / ours:>9,.0f} x  {note}",
        flush=True,
    )


def run(path: str) -> None:
    print(f"\n{path:<34}{'ours 1/s':>12}{'peer 1/s':>12}{'ratio':>9}")
    for kind in KINDS:
        few, many = pairs(kind, 400), arrays(pairs(kind, 20_000))
        theirs, their_time = peer_times(peer_iou, few)
        difference = np.abs(oriented_iou(*arrays(few)) - theirs).max()
        our_time = seconds(lambda many=many: oriented_iou(*many)) / 20_000
        compare(f"oriented IoU, {kind}", our_time, their_time, f"differ by {difference:.0e}")
    for kind in KINDS:
        few, many = pairs(kind, 40), arrays(pairs(kind, 2000))
        theirs, their_time = peer_times(peer_symmetric_iou, few)
        ours = symmetric_iou(*arrays(few), SPIN)
        dense = [dense_symmetric_iou(arrays(few), i) for i in range(len(few[0]))]
        best = np.max([ours, theirs, dense], axis=0)
        our_time = seconds(lambda many=many: symmetric_iou(*many, SPIN), 3) / 2000
        note = (
            f"below the maximum: ours {(best - ours).max():.0e}, peer {(best - theirs).max():.0e}"
        )
        compare(f"symmetric IoU, {kind}", our_time, their_time, note)


def main() -> None:
    _box_clipping._clipped_by_numpy = -(10**12)  # numpy alone
    run("numpy")
    many = arrays(pairs("near", 20_000))
    alone = seconds(lambda: rotation_error(many[0], many[3])) / 20_000
    print(f"rotation error: {1 / alone:,.0f} pairs per second")
    _box_clipping._clipped_by_numpy = _box_clipping._WARM
    start = time.perf_counter()
    if _box_clipping._compiled() is None:
        print("numba is not installed: no compiled kernel")
        return
    oriented_iou(*arrays(pairs("near", 1)))
    print(f"\nloading the kernel (cached, or compiled): {time.perf_counter() - start:.2f} s")
    run("compiled")


if __name__ == "__main__":
    main()
