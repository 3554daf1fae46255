"""``crnet``: Cascaded Relation and Recurrent Reconstruction (Wang, Chen & Dou, IROS 2021)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from method_adapters._assets import NOCS_TERMS
from method_adapters._prior_method import PriorMethod, method_info
from pytest_cpas.types import Asset

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
