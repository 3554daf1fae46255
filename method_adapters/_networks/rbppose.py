"""RBP-Pose: Zhang, Di, Lou, Manhardt, Tombari & Ji, "RBP-Pose: Residual Bounding Box Projection
for Category-Level Pose Estimation", ECCV 2022. The part that inference uses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from method_adapters._networks.gcn3d import (
    GraphConvolution,
    Neighbourhood,
    SurfaceConvolution,
    at_points,
    nearest,
)
from method_adapters._networks.heads import CATEGORY_COUNT, CategoryMlp, first_layer
from pytest_cpas.adapting import tap

#: Features of every point: of five levels, and the category.
LOCAL = 128 + 128 + 256 + 256 + 512 + CATEGORY_COUNT
#: Features of the whole cloud.
SHARED = 512
#: Features of colour, which the published configuration leaves out: zeros.
COLOUR = 32
NEIGHBOURS = 10


class RbpPoseOutput(NamedTuple):
    """``green``, ``red`` (B, 3): the object's y and x axis in the camera frame, of length 1, and
    how sure they are, ``green_confidence``, ``red_confidence`` (B,), 0..1; ``translation`` and
    ``size`` (B, 3), metres; ``deltas`` (B, M, 3): what to add to the prior, NOCS units."""

    green: Tensor
    red: Tensor
    green_confidence: Tensor
    red_confidence: Tensor
    translation: Tensor
    size: Tensor
    deltas: Tensor


class Encoder(nn.Module):
    """Five levels of graph convolution, the cloud being thinned twice to points that are given."""

    def __init__(self) -> None:
        super().__init__()
        self.conv_0 = SurfaceConvolution(128)
        self.conv_1, self.bn1 = GraphConvolution(128, 128), nn.BatchNorm1d(128)
        self.conv_2, self.bn2 = GraphConvolution(128, 256), nn.BatchNorm1d(256)
        self.conv_3, self.bn3 = GraphConvolution(256, 256), nn.BatchNorm1d(256)
        self.conv_4 = GraphConvolution(256, 512)

    def forward(
        self, xyz: Tensor, category: Tensor, kept: Tensor, kept_again: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Points (B, N, 3), of them indices (B, N / 4), of those (B, N / 16), to features of every
        point (B, N, 1286) and of all (B, 512)."""
        near = _neighbourhood(xyz)
        x0 = torch.relu(self.conv_0(near))
        x1 = torch.relu(self.bn1(self.conv_1(near, x0).mT).mT)
        fewer, x = at_points(xyz, kept), near.pooled(x1, kept)
        near = _neighbourhood(fewer)
        x2 = torch.relu(self.bn2(self.conv_2(near, x).mT).mT)
        x3 = torch.relu(self.bn3(self.conv_3(near, x2).mT).mT)
        fewest, x = at_points(fewer, kept_again), near.pooled(x3, kept_again)
        x4 = self.conv_4(_neighbourhood(fewest), x)
        to_fewer, to_fewest = nearest(xyz, fewer), nearest(xyz, fewest)
        # torch's own looks whether every category is one
        one_hot = category[:, None] == torch.arange(CATEGORY_COUNT, device=category.device)
        one_hot = one_hot[:, None].expand(-1, xyz.shape[1], -1)
        features = [x0, x1, at_points(x2, to_fewer), at_points(x3, to_fewer)]
        features += [at_points(x4, to_fewest), one_hot.to(xyz.dtype)]
        return torch.cat(features, 2), x4.amax(1)


def _neighbourhood(xyz: Tensor) -> Neighbourhood:
    return Neighbourhood(xyz, min(NEIGHBOURS, xyz.shape[1] // 8))


class Head(nn.Module):
    """A few numbers from the features of all points, the largest of which go on."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv1d(before, 1024, 1), nn.BatchNorm1d(1024)
        self.conv2, self.bn2 = nn.Conv1d(1024, 256, 1), nn.BatchNorm1d(256)
        self.conv3, self.bn3 = nn.Conv1d(256, 256, 1), nn.BatchNorm1d(256)
        self.conv4 = nn.Conv1d(256, after, 1)

    def forward(self, parts: Sequence[Tensor]) -> Tensor:
        """Features (B, C, N), or (B, C, 1) if all points share them, to (B, K)."""
        x = torch.relu(self.bn1(first_layer(self.conv1, parts)))
        x = torch.relu(self.bn2(self.conv2(x))).amax(2, keepdim=True)
        y: Tensor = self.conv4(torch.relu(self.bn3(self.conv3(x)))).squeeze(2)
        return y


class PoseNet(nn.Module):
    """Section 3.2 of the paper: the direct regression of pose and size, and the deformed prior."""

    def __init__(self) -> None:
        super().__init__()
        self.pcl_encoder_obs = Encoder()
        self.rot_green = Head(LOCAL + SHARED + COLOUR, 4)
        self.rot_red = Head(LOCAL + SHARED + COLOUR, 4)
        self.ts = Head(LOCAL + SHARED + COLOUR + 3, 6)
        self.deformation = CategoryMlp(LOCAL + SHARED + COLOUR + SHARED, 512, 256, 3)


class RbpPoseNet(nn.Module):
    """Axes, position and size from the points; the shape from points and prior."""

    def __init__(self) -> None:
        super().__init__()
        self.posenet = PoseNet()

    def forward(
        self,
        points: Tensor,
        category: Tensor,
        prior: Tensor,
        mean_size: Tensor,
        kept: Tensor,
        kept_again: Tensor,
        prior_kept: Tensor,
        prior_kept_again: Tensor,
    ) -> RbpPoseOutput:
        """Observed ``points`` (B, N, 3) metres, ``category`` (B,), ``prior`` (B, M, 3) NOCS
        units, the category's ``mean_size`` (B, 3) metres, and which points the encoder keeps, see
        :meth:`Encoder.forward`."""
        net = self.posenet
        centre = points.mean(1, keepdim=True)
        points = tap("network.centred", points - centre)
        local, shared = net.pcl_encoder_obs(points, category, kept, kept_again)
        shared, colour = shared[..., None], points.new_zeros(len(points), COLOUR, 1)
        parts = [local.mT, shared, colour]
        green, red = net.rot_green(parts), net.rot_red(parts)
        translation, size = net.ts([*parts, points.mT]).split(3, dim=1)
        of_prior, all_prior = net.pcl_encoder_obs(prior, category, prior_kept, prior_kept_again)
        deltas = net.deformation.of(
            of_prior.mT, all_prior[..., None], colour, shared, category=category
        )
        return RbpPoseOutput(
            F.normalize(green[:, 1:], dim=1),
            F.normalize(red[:, 1:], dim=1),
            green[:, 0].sigmoid(),
            red[:, 0].sigmoid(),
            translation + centre[:, 0],
            size + mean_size,
            deltas.mT,
        )
