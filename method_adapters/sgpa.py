"""``sgpa``: Structure-Guided Prior Adaptation (Chen & Dou, ICCV 2021)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from method_adapters._assets import MEAN_SHAPES, NOCS_TERMS
from method_adapters._declaration import port_info
from method_adapters._prior_method import PriorMethod
from pytest_cpas.adapting import Asset

if TYPE_CHECKING:
    from torch import nn


class Sgpa(PriorMethod):
    """SGPA as a :class:`pytest_cpas.types.Method`."""

    info = port_info(
        "sgpa",
        Asset(
            path="sgpa/real.pth",
            url="https://drive.google.com/file/d/1drBp3naBrNdazah1zTdgydjchE-LysdI",
            licence=f"no licence stated; {NOCS_TERMS}",
        ),
        MEAN_SHAPES,
    )
    # a classifier of points that only training uses
    unused = ("instance_geometry.cls_layer.", "category_local.cls_layer.")

    @staticmethod
    def network() -> nn.Module:
        """SGPA's network."""
        from method_adapters._networks.sgpa import SgpaNet

        return SgpaNet()
