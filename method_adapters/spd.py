"""``spd``: Shape Prior Deformation (Tian, Ang & Lee, ECCV 2020)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from method_adapters._assets import NOCS_TERMS
from method_adapters._prior_method import PriorMethod, method_info
from pytest_cpas.types import Asset

if TYPE_CHECKING:
    from torch import nn


class Spd(PriorMethod):
    """SPD as a :class:`pytest_cpas.types.Method`."""

    info = method_info(
        "spd",
        Asset(
            "spd/deformnet_eval/real/model_50.pth",
            "https://drive.google.com/file/d/1p72NdY4Bie_sra9U8zoUNI4fTrQZdbnc (a zip; unpack it"
            " below spd/)",
            f"MIT; {NOCS_TERMS}",
        ),
        "MIT",
    )

    @staticmethod
    def network() -> nn.Module:
        """SPD's network."""
        from method_adapters._networks.spd import SpdNet

        return SpdNet()
