"""``dpdn``: Deep Prior Deformation Network (Lin, Wei, Ding & Jia, ECCV 2022)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from method_adapters._assets import MEAN_SHAPES, NOCS_TERMS
from method_adapters._crop import POINT_COUNT, NoAnswerError
from method_adapters._declaration import port_info
from method_adapters._network_method import Array
from method_adapters._prior_method import Inputs, PriorMethod, prior_offset
from pytest_cpas.adapting import Asset, Hypothesis, Observation

if TYPE_CHECKING:
    from torch import Tensor, nn


class Dpdn(PriorMethod):
    """DPDN as a :class:`pytest_cpas.types.Method`."""

    info = port_info(
        "dpdn",
        Asset(
            path="dpdn/log/supervised/epoch_30.pth",
            url="https://drive.google.com/file/d/1hWkbH4Z0RXQeYLxC_kOINxdTnDLtm9SX (a zip; unpack"
            " it below dpdn/)",
            licence=f"MIT; {NOCS_TERMS}",
        ),
        MEAN_SHAPES,
        licence="MIT",
    )
    # ImageNet's classifier
    unused = ("rgb_extractor.model.feats.fc.",)

    _device = "cpu"

    def load(self, assets: Path | None, device: str) -> None:
        """As :meth:`PriorMethod.load`; depth is filled on the same device."""
        super().load(assets, device)
        self._device = device

    @staticmethod
    def network() -> nn.Module:
        """DPDN's network."""
        from method_adapters._networks.dpdn import DpdnNet

        return DpdnNet()

    def pick(self, count: int, generator: np.random.Generator) -> NDArray[np.int64]:
        """At random, each pixel once if there are enough."""
        return generator.choice(count, POINT_COUNT, replace=count <= POINT_COUNT)

    def depth_of(self, observation: Observation) -> NDArray[np.float32]:
        """With its holes filled and smoothed, whole image."""
        from method_adapters._depth_filling import fill_depth

        return fill_depth(observation.depth, self._device)

    def essence(self, inputs: Sequence[Tensor], outputs: Sequence[Tensor]) -> Sequence[Tensor]:
        """All but the attention."""
        return outputs[1:]

    def interpret(
        self, inputs: Inputs, outputs: tuple[Array, ...], generator: np.random.Generator
    ) -> Hypothesis:
        """The network's own pose and size; the shape is scaled by the size's diagonal."""
        shape, rotation, translation, size = outputs
        if not np.all(size > 0):  # NaN is not
            raise NoAnswerError(f"the estimated size is {size.tolist()}, not positive")
        diagonal = float(np.linalg.norm(size))
        points = shape * diagonal - prior_offset(int(inputs.category), diagonal)
        return Hypothesis(rotation=rotation, translation=translation, extents=size, points=points)
