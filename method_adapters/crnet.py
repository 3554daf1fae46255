"""``crnet``: Cascaded Relation and Recurrent Reconstruction (Wang, Chen & Dou, IROS 2021)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from method_adapters._assets import NOCS_TERMS
from method_adapters._prior_method import (
    Array,
    Inputs,
    PriorMethod,
    method_info,
    pose_from_assignment,
)
from pytest_cpas.types import Asset, Hypothesis

if TYPE_CHECKING:
    from torch import nn


class CrNet(PriorMethod):
    """CR-Net as a :class:`pytest_cpas.types.Method`."""

    info = method_info(
        "crnet",
        Asset(
            "crnet/real.pth",
            "https://github.com/JeremyWANGJZ/Category-6D-Pose/raw/main/models/real.pth",
            f"no licence stated; {NOCS_TERMS}",
        ),
        "MIT (this port; the weights state no licence)",
    )

    @staticmethod
    def network() -> nn.Module:
        """CR-Net's network."""
        from method_adapters._networks.crnet import CrNet

        return CrNet()

    def interpret(
        self, inputs: Inputs, outputs: tuple[Array, ...], generator: np.random.Generator
    ) -> Hypothesis:
        """From assignment and deformation."""
        assign, deltas = outputs
        return pose_from_assignment(inputs, assign, deltas, generator)
