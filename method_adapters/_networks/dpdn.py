"""Deep Prior Deformation Network: Lin, Wei, Ding & Jia, "Category-Level 6D Object Pose and Size
Estimation using Self-Supervised Deep Prior Deformation Networks", ECCV 2022."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from method_adapters._networks.heads import CategoryMlp, at_pixels, first_layer, pointwise
from method_adapters._networks.pointnet2 import PointNet2, of_two_clouds
from method_adapters._networks.pspnet import BottleneckPSPNet
from pytest_cpas.adapting import tap

PRIOR_POINTS = 1024


class DpdnOutput(NamedTuple):
    """``attention`` (B, N, M): logits that assign N observed points to M prior points;
    ``shape`` (B, M, 3): the deformed prior, NOCS units; ``rotation`` (B, 3, 3) object to camera;
    ``translation`` (B, 3) and ``size`` (B, 3), metres."""

    attention: Tensor
    shape: Tensor
    rotation: Tensor
    translation: Tensor
    size: Tensor


def _encoder(*radii: tuple[float, float]) -> PointNet2:
    return PointNet2(
        radii=radii,
        abstraction=tuple(((w, w, 2 * w),) * 2 for w in (16, 32, 64, 128)),
        propagation=((128, 128), (256, 256), (256, 256), (512, 512)),
        norm_name="normlayer",
        max_threads=512,
        skip_radius_squared=1e-3,
    )


def rotation_from_axes(six: Tensor) -> Tensor:
    """Rotations (B, 3, 3) from (B, 6): a vector in the plane of x and y, then the y axis,
    orthonormalised (Zhou et al., CVPR 2019)."""
    y = F.normalize(six[:, 3:], dim=1, eps=1e-8)
    z = F.normalize(torch.linalg.cross(six[:, :3], y), dim=1, eps=1e-8)
    return torch.stack([torch.linalg.cross(y, z), y, z], dim=2)


class ColourExtractor(nn.Module):
    """Holds the colour encoder under the published name."""

    def __init__(self) -> None:
        super().__init__()
        final = nn.Sequential(nn.Conv2d(64, 128, 1), nn.BatchNorm2d(128), nn.PReLU())
        self.model = BottleneckPSPNet(True, final)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) to (B, 128, H, W)."""
        y: Tensor = self.model(image)
        return y


class Deformer(nn.Module):
    """Section 3.2 of the paper: the prior deformed in feature space, and the correspondences."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for before, after in ((384, 384), (384, 256), (256, 128)):
            layers += [nn.Conv1d(before, after, 1), nn.BatchNorm1d(after), nn.ReLU()]
        # the last ReLU follows the residual
        self.deform_mlp1 = nn.Sequential(*layers[:-1])
        self.deform_mlp2 = CategoryMlp(128, 64, 64, 3)
        self.atten_mlp = CategoryMlp(384, 384, 256, PRIOR_POINTS)

    def forward(
        self, points: Tensor, colour: Tensor, prior: Tensor, category: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Features (B, 128, N), (B, 128, N), (B, 128, M) to attention (B, N, M), deformed prior
        features as attended by the observed points (B, 128, N), deformed prior (B, M, 3) and the
        same as attended (B, N, 3)."""
        points_global, colour_global = (x.mean(2, keepdim=True) for x in (points, colour))
        x = first_layer(self.deform_mlp1[0], [prior, points_global, colour_global])
        deformed = torch.relu(prior + self.deform_mlp1[1:](x))
        shape = self.deform_mlp2.of(deformed, category=category).mT  # absolute, not an offset
        both = torch.cat([points, colour], 1)
        prior_global = deformed.mean(2, keepdim=True)
        attention = self.atten_mlp.of(both, prior_global, category=category).mT
        share = attention.softmax(2)
        return attention, (share @ deformed.mT).mT, shape, share @ shape


class Estimator(nn.Module):
    """Section 3.3 of the paper: rotation, translation and size from features of both sides."""

    def __init__(self) -> None:
        super().__init__()
        self.pts_mlp1, self.pts_mlp2 = pointwise(3, 32, 64), pointwise(3, 32, 64)
        self.pose_mlp1 = pointwise(512, 256, 256)
        self.pose_mlp2 = pointwise(512, 512, 512)
        self.rotation_estimator = _regressor(6)
        self.translation_estimator = _regressor(3)
        self.size_estimator = _regressor(3)

    def forward(self, local: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(B, 512, N) to rotation (B, 3, 3), translation (B, 3) and size (B, 3)."""
        x = self.pose_mlp1(local)
        x = torch.cat([x, x.mean(2, keepdim=True).expand_as(x)], 1)
        x = self.pose_mlp2(x).mean(2)
        rotation = rotation_from_axes(self.rotation_estimator(x))
        return rotation, self.translation_estimator(x), self.size_estimator(x)


def _regressor(outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(512, 512), nn.ReLU(), nn.Linear(512, 256), nn.ReLU(), nn.Linear(256, outputs)
    )


class PoseNet(nn.Module):
    """Holds deformer and estimator under the published names."""

    def __init__(self) -> None:
        super().__init__()
        self.deformer, self.estimator = Deformer(), Estimator()


class DpdnNet(nn.Module):
    """Pose and size by regression from correspondences with the deformed prior."""

    def __init__(self) -> None:
        super().__init__()
        self.rgb_extractor = ColourExtractor()
        self.pts_extractor = _encoder((0.01, 0.02), (0.02, 0.04), (0.04, 0.08), (0.08, 0.16))
        self.prior_extractor = _encoder((0.05, 0.10), (0.10, 0.20), (0.20, 0.30), (0.30, 0.40))
        self.posenet = PoseNet()

    def forward(
        self, points: Tensor, image: Tensor, choose: Tensor, category: Tensor, prior: Tensor
    ) -> DpdnOutput:
        """As :meth:`method_adapters._networks.spd.SpdNet.forward`."""
        centre = points.mean(1, keepdim=True)
        points = tap("network.centred", points - centre)
        colour = at_pixels(self.rgb_extractor(image), choose)
        local, of_prior = of_two_clouds((self.pts_extractor, self.prior_extractor), (points, prior))
        deformer, estimator = self.posenet.deformer, self.posenet.estimator
        attention, attended, shape, coordinates = deformer(local, colour, of_prior, category)
        stacked = [
            colour,
            estimator.pts_mlp1(points.mT),
            local,
            estimator.pts_mlp2(coordinates.mT),
            attended,
        ]
        rotation, translation, size = estimator(torch.cat(stacked, 1))
        return DpdnOutput(attention, shape, rotation, translation + centre[:, 0], size)
