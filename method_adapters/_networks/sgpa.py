"""Structure-Guided Prior Adaptation: Chen & Dou, "SGPA: Structure-Guided Prior Adaptation for
Category-Level 6D Object Pose Estimation", ICCV 2021."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from method_adapters._networks.attention import MultiHeadAttention
from method_adapters._networks.heads import CategoryMlp, at_pixels, pointwise
from method_adapters._networks.pointnet2 import PointNet2, of_two_clouds
from method_adapters._networks.pspnet import PSPNet

PRIOR_POINTS = 1024
STRUCTURE_POINTS = 256


class SgpaOutput(NamedTuple):
    """``structure`` (B, 256, 3): structure points, metres; the rest as
    :class:`method_adapters._networks.heads.Deformed`."""

    structure: Tensor
    assign: Tensor
    deltas: Tensor


def _encoder() -> PointNet2:
    return PointNet2(
        radii=((0.01, 0.02), (0.02, 0.04), (0.04, 0.08), (0.08, 0.16)),
        abstraction=(
            ((16, 16, 32), (32, 32, 64)),
            ((64, 64, 128), (64, 96, 128)),
            ((128, 196, 256), (128, 196, 256)),
            ((256, 256, 512), (256, 384, 512)),
        ),
        propagation=((64, 64), (128, 128), (256, 256), (512, 512)),
        norm_name="bn",
        max_threads=1024,
    )


class PriorAdapter(nn.Module):
    """Attention of the prior's points to the structure points (section 3.3 of the paper)."""

    def __init__(self) -> None:
        super().__init__()
        self.enricher = MultiHeadAttention(64, 4)

    def forward(self, prior: Tensor, structure: Tensor, colour: Tensor) -> Tensor:
        """Features (B, 64, M) of the prior, points and colours at the structure points (B, 64, S)
        to (B, 64, M)."""
        adapted: Tensor = self.enricher(prior.mT, structure.mT, colour.mT)
        return adapted.mT


class SgpaNet(nn.Module):
    """SPD's layout with PointNet++ features and a prior that is adapted before it is deformed."""

    def __init__(self) -> None:
        super().__init__()
        self.psp = PSPNet()
        self.instance_color = pointwise(32, 64)
        self.instance_geometry = _encoder()
        self.conv1d_stpts_prob = nn.Sequential(
            *pointwise(128, 256), nn.Conv1d(256, STRUCTURE_POINTS, 1), nn.Softmax(dim=2)
        )
        self.instance_global = pointwise(128, 128, 1024).append(nn.AdaptiveAvgPool1d(1))
        self.category_local = _encoder()
        self.prior_enricher = PriorAdapter()
        self.category_global = pointwise(128, 128, 1024).append(nn.AdaptiveAvgPool1d(1))
        self.assignment = CategoryMlp(2176, 512, 256, PRIOR_POINTS)
        self.deformation = CategoryMlp(2176, 512, 256, 3)

    def forward(
        self, points: Tensor, image: Tensor, choose: Tensor, category: Tensor, prior: Tensor
    ) -> SgpaOutput:
        """As :meth:`method_adapters._networks.spd.SpdNet.forward`."""
        colour = self.instance_color(at_pixels(self.psp(image), choose))
        geometry, local = of_two_clouds(
            (self.instance_geometry, self.category_local), (points, prior)
        )
        instance = torch.cat([geometry, colour], 1)
        share = self.conv1d_stpts_prob(instance)
        instance_global = self.instance_global(instance)
        adapted = self.prior_enricher(local, (share @ geometry.mT).mT, (share @ colour.mT).mT)
        local = torch.cat([local, adapted], 1)
        category_global = self.category_global(local)
        assign = self.assignment.of(instance, instance_global, category_global, category=category)
        deltas = self.deformation.of(local, category_global, instance_global, category=category)
        return SgpaOutput(share @ points, assign.mT, deltas.mT)
