"""How long iCaps takes for one object, CPU, all cores, with random weights and a codebook of the
published size; the published code takes 94 s on a machine of 2 cores.

    python benchmarks/bench_icaps.py

The object is an ellipsoid that fills about 8000 pixels. Random weights find nothing, but the work
is that of trained ones: the same crops, steps and grids. Only how often the decoder is evaluated
anew depends on the path that the pose takes.
"""

from __future__ import annotations

import time
from unittest.mock import patch

import numpy as np
import torch

from method_adapters._networks.icaps import CODE_SIZE, AutoEncoder, DeepSdf, LatentNet, Shape
from method_adapters._networks.icaps_matching import ROTATIONS, Codebook, Matcher
from method_adapters._networks.icaps_refinement import Refiner
from method_adapters.icaps import ICaps
from pytest_cpas.types import Camera, Observation

PUBLISHED_SECONDS = 94.0


def observation() -> Observation:
    camera = Camera(640, 480, 577.0, 577.0, 319.5, 239.5)
    v, u = np.mgrid[:480, :640]
    away = np.hypot((u - 350) / 42, (v - 220) / 63)
    mask = away < 1
    depth = np.where(mask, 0.75 - 0.05 * np.sqrt(np.maximum(1 - away**2, 0)), 1.4)
    rgb = np.zeros((480, 640, 3), np.float32)
    return Observation("mug", rgb, depth.astype(np.float32), mask, camera)


def method() -> ICaps:
    random = np.random.default_rng(0)
    quaternions = random.standard_normal((ROTATIONS, 4))
    codebook = Codebook.__new__(Codebook)
    codebook.quaternions = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    codes = torch.randn((ROTATIONS, CODE_SIZE), generator=torch.Generator().manual_seed(0))
    codebook.codes = torch.nn.functional.normalize(codes, dim=1)
    torch.manual_seed(0)
    decoder = DeepSdf()
    for i in range(8):
        torch.nn.init.normal_(decoder.get_submodule(f"lin{i}").weight_v)
    made = ICaps()
    refiner = Refiner(LatentNet().eval(), decoder, 2.2)
    made._networks = {"mug": (Matcher(AutoEncoder(), codebook), refiner)}
    return made


def main() -> None:
    seen, icaps = observation(), method()
    evaluations = []
    real = Shape.distances_and_gradients

    def counted(self: Shape, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        evaluations.append(len(points))
        return real(self, points)

    with patch.object(Shape, "distances_and_gradients", counted):
        wall, cpu = time.perf_counter(), time.process_time()
        (prediction,) = icaps.predict([seen], 0)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(
        f"{np.count_nonzero(seen.mask)} pixels: {wall:.1f} s ({cpu:.1f} s of processor time,"
        f" {torch.get_num_threads()} threads, decoder evaluated at {sum(evaluations)} points);"
        f" ratio to the published 94 s {wall / PUBLISHED_SECONDS:.2f} (at most 0.20)"
    )
    print(prediction.reason or "a pose and a mesh")


if __name__ == "__main__":
    main()
