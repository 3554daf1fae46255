"""``crnet``: Cascaded Relation and Recurrent Reconstruction (Wang, Chen & Dou, IROS 2021)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from method_adapters._assets import MEAN_SHAPES, NOCS_TERMS
from method_adapters._declaration import port_info
from method_adapters._prior_method import PriorMethod
from pytest_cpas.adapting import Asset

if TYPE_CHECKING:
    from torch import nn


class CrNet(PriorMethod):
    """CR-Net as a :class:`pytest_cpas.types.Method`."""

    info = port_info(
        "crnet",
        Asset(
            path="crnet/real.pth",
            url="https://github.com/JeremyWANGJZ/Category-6D-Pose/raw/main/models/real.pth",
            licence=f"no licence stated; {NOCS_TERMS}",
        ),
        MEAN_SHAPES,
    )

    @staticmethod
    def network() -> nn.Module:
        """CR-Net's network."""
        from method_adapters._networks.crnet import CrNet

        return CrNet()
