"""``sgpa``: Structure-Guided Prior Adaptation (Chen & Dou, ICCV 2021)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from method_adapters._assets import NOCS_TERMS
from method_adapters._prior_method import PriorMethod, method_info
from pytest_cpas.types import Asset

if TYPE_CHECKING:
    from torch import nn


class Sgpa(PriorMethod):
    """SGPA as a :class:`pytest_cpas.types.Method`."""

    info = method_info(
        "sgpa",
        Asset(
            "sgpa/real.pth",
            "https://drive.google.com/file/d/1drBp3naBrNdazah1zTdgydjchE-LysdI",
            f"no licence stated; {NOCS_TERMS}",
        ),
        "MIT (this port; the weights state no licence)",
    )
    # a classifier of points that only training uses
    unused = ("instance_geometry.cls_layer.", "category_local.cls_layer.")

    @staticmethod
    def network() -> nn.Module:
        """SGPA's network."""
        from method_adapters._networks.sgpa import SgpaNet

        return SgpaNet()
