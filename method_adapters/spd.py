"""``spd``: Shape Prior Deformation (Tian, Ang & Lee, ECCV 2020)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from method_adapters._assets import MEAN_SHAPES, NOCS_TERMS
from method_adapters._declaration import port_info
from method_adapters._prior_method import PriorMethod
from pytest_cpas.adapting import Asset

if TYPE_CHECKING:
    from torch import nn


class Spd(PriorMethod):
    """SPD as a :class:`pytest_cpas.types.Method`."""

    info = port_info(
        "spd",
        Asset(
            path="spd/deformnet_eval/real/model_50.pth",
            url="https://drive.google.com/file/d/1p72NdY4Bie_sra9U8zoUNI4fTrQZdbnc (a zip; unpack"
            " it below spd/)",
            licence=f"MIT; {NOCS_TERMS}",
        ),
        MEAN_SHAPES,
        licence="MIT",
    )

    @staticmethod
    def network() -> nn.Module:
        """SPD's network."""
        from method_adapters._networks.spd import SpdNet

        return SpdNet()
