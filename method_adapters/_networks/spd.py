"""Shape Prior Deformation: Tian, Ang & Lee, "Shape Prior Deformation for Categorical 6D Object
Pose and Size Estimation", ECCV 2020."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from method_adapters._networks.heads import CategoryMlp, Deformed, at_pixels, pointwise
from method_adapters._networks.pspnet import PSPNet

PRIOR_POINTS = 1024


class SpdNet(nn.Module):
    """Features of image, points and prior; from them the assignment and the deformation."""

    def __init__(self) -> None:
        super().__init__()
        self.psp = PSPNet()
        self.instance_color = pointwise(32, 64)
        self.instance_geometry = pointwise(3, 64, 64, 64)
        self.instance_global = pointwise(128, 128, 1024).append(nn.AdaptiveAvgPool1d(1))
        self.category_local = pointwise(3, 64, 64, 64)
        self.category_global = pointwise(64, 128, 1024).append(nn.AdaptiveAvgPool1d(1))
        self.assignment = CategoryMlp(2176, 512, 256, PRIOR_POINTS)
        self.deformation = CategoryMlp(2112, 512, 256, 3)

    def forward(
        self, points: Tensor, image: Tensor, choose: Tensor, category: Tensor, prior: Tensor
    ) -> Deformed:
        """Observed ``points`` (B, N, 3) metres, ``image`` (B, 3, H, W) normalised, their pixels
        ``choose`` (B, N), ``category`` (B,), ``prior`` (B, M, 3) NOCS units."""
        colour = self.instance_color(at_pixels(self.psp(image), choose))
        instance = torch.cat([self.instance_geometry(points.mT), colour], 1)
        instance_global = self.instance_global(instance)
        local = self.category_local(prior.mT)
        category_global = self.category_global(local)
        assign = self.assignment.of(instance, instance_global, category_global, category=category)
        deltas = self.deformation.of(local, category_global, instance_global, category=category)
        return Deformed(assign.mT, deltas.mT)
