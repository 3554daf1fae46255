"""Which triangle each pixel sees: our z-buffer beside Open3D's ray caster, and Embree's if at hand.

    python benchmarks/bench_rendering.py

On frames of the embedded data sets, each with what it takes to build its scene: processor time, the
best of nine.
For Embree by way of trimesh: ``pip install embreex``.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable

import numpy as np
import trimesh

from pytest_cpas.datasets import synthetic
from pytest_cpas.datasets._scenes import Shapes
from pytest_cpas.datasets.rasterising import rasterise
from pytest_cpas.datasets.rendering import _corners, camera_rays, cast_rays
from pytest_cpas.types import Array, Camera


def embree(corners: Array, camera: Camera) -> object:
    """Embree's answer, through trimesh."""
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), faces, process=False)
    rays = camera_rays(camera).reshape(-1, 3)
    return RayMeshIntersector(mesh).intersects_first(np.zeros_like(rays), rays)


def milliseconds(call: Callable[[], object]) -> float:
    """Processor time, the shortest of nine."""
    times = []
    for _ in range(9):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1000 * min(times)


def main() -> None:
    """Measure and print."""
    for split in (synthetic.TABLETOP, synthetic.HANDHELD):
        stock = Shapes(synthetic.SEED, split.key)
        scene = split.kind(stock, synthetic.SEED, split.key, 3, split.camera)
        items = scene.compose(np.random.default_rng(3))
        corners = np.concatenate([_corners(item.mesh, item.pose) for item in items])
        told = [f"{split.name}, {len(corners)} triangles, 640 x 480:"]
        for name, cast in (("open3d", cast_rays), ("z-buffer", rasterise), ("embreex", embree)):
            try:
                taken = f"{milliseconds(functools.partial(cast, corners, split.camera)):.0f} ms"
            except ImportError:
                taken = "is not installed"
            told.append(f"{name} {taken},")
        print(" ".join(told).rstrip(","))


if __name__ == "__main__":
    main()
