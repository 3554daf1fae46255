"""Fixed operations that a method is timed against, so that a ratio says more than seconds do.

What slows a machine down (another job, a lower clock, full memory channels) slows both; it does so
alike if both do similar things. So a kernel mixes what methods spend their time with. A kernel
never changes: ratios recorded with it would no longer mean anything. Another one gets another name.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


class CpuKernel:
    """Interpreter, small matrix products, elementwise functions, scattered memory.

    One thread; each part takes a similar share of some 12 ms.
    """

    name = "cpu-1"

    def __init__(self) -> None:
        generator = np.random.default_rng(0)
        self._matrices = generator.standard_normal((100, 32, 32)) / 6
        self._values = generator.random(100_000)
        self._large = generator.random(1_000_000)
        self._places = generator.permutation(len(self._large))[:200_000]

    def __call__(self) -> float:
        """Do it once; what comes out only proves that it was done."""
        counts: dict[int, int] = {}
        for number in range(25_000):
            key = number * 7919 % 127
            counts[key] = counts.get(key, 0) + 1
        product = self._matrices
        for _ in range(8):
            product = product @ self._matrices
        waves = np.sqrt(np.exp(np.sin(self._values)) + np.cos(3 * self._values))
        scattered = self._large[self._places].sum()
        return float(counts[0] + product[0, 0, 0] + waves[0] + scattered)


class TorchKernel:
    """For a device of torch: transfers there and back, a matrix product, a convolution."""

    name = "torch-1"

    def __init__(self, device: str) -> None:
        import torch

        self._torch: Any = torch
        self._device = torch.device(device)
        generator = torch.Generator().manual_seed(0)
        self._image = torch.rand((1, 3, 224, 224), generator=generator)
        self._filters = torch.rand((64, 3, 7, 7), generator=generator).to(self._device)
        self._matrix = torch.rand((1024, 1024), generator=generator).to(self._device) / 1024

    def __call__(self) -> float:
        """Do it once, and wait for the result."""
        with self._torch.inference_mode():
            image = self._image.to(self._device)
            features = self._torch.nn.functional.conv2d(image, self._filters, stride=2).relu()
            product = self._matrix
            for _ in range(8):
                product = product @ self._matrix
            return float((features.mean() + product.mean()).cpu())


def kernel_for(device: str) -> CpuKernel | TorchKernel:
    """The kernel that a method on ``device`` is timed against."""
    return CpuKernel() if device == "cpu" else TorchKernel(device)


class Calibration:
    """A kernel as a contestant."""

    def __init__(
        self, kernel: CpuKernel | TorchKernel, timed: Callable[[Callable[[], object]], float]
    ) -> None:
        """``timed`` gives the seconds that a call takes."""
        self.name = kernel.name
        self._kernel, self._timed = kernel, timed
        self._repetitions = 1

    def repeat(self, repetitions: int) -> None:
        """From now on, it is timed as the mean of so many."""
        self._repetitions = repetitions

    def run(self, index: int) -> float:
        """Seconds per kernel; every sample is the same to it."""

        def repeated() -> None:
            for _ in range(self._repetitions):
                self._kernel()

        return self._timed(repeated) / self._repetitions
