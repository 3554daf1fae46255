"""CASS: Chen, Li, Wang & Xu, "Learning Canonical Shape Space for Category-Level 6D Object Pose and
Size Estimation", CVPR 2020, with DenseFusion's features (Wang et al., CVPR 2019) and FoldingNet's
decoder (Yang et al., CVPR 2018)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from method_adapters._networks.heads import PerCategory, at_pixels, first_layer
from method_adapters._networks.pspnet import BottleneckPSPNet

#: Points that are observed, and that are reconstructed.
POINT_COUNT = 500
LOCAL, SHARED = 384, 1024
#: Coordinates of the folding grid: those of a box, a cylinder and a sphere.
GRID = 9


class CassOutput(NamedTuple):
    """What every observed point says: ``quaternion`` (B, N, 4), scalar first, not normalised;
    ``offset`` (B, N, 3) from the point to the object's origin, metres; ``confidence`` (B, N),
    0..1. ``shape`` (B, 500, 3): object frame, metres."""

    quaternion: Tensor
    offset: Tensor
    confidence: Tensor
    shape: Tensor


class Features(NamedTuple):
    """Of every point (B, 384, N), and of all points together (B, 1024, 1)."""

    local: Tensor
    shared: Tensor


class ColourEncoder(nn.Module):
    """Holds the colour encoder under the published name."""

    def __init__(self) -> None:
        super().__init__()
        self.model = BottleneckPSPNet(
            False, nn.Sequential(nn.Conv2d(64, 32, 1), nn.LogSoftmax(dim=1))
        )

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) to (B, 32, H, W)."""
        y: Tensor = self.model(image)
        return y


class DenseFusion(nn.Module):
    """Features of points and of their colours, two levels beside each other and pooled."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.conv2 = nn.Conv1d(3, 64, 1), nn.Conv1d(64, 128, 1)
        self.e_conv1, self.e_conv2 = nn.Conv1d(32, 64, 1), nn.Conv1d(64, 128, 1)
        self.conv5, self.conv6 = nn.Conv1d(256, 512, 1), nn.Conv1d(512, SHARED, 1)

    def forward(self, points: Tensor, colour: Tensor) -> Features:
        """(B, 3, N) and (B, 32, N)."""
        x, y = torch.relu(self.conv1(points)), torch.relu(self.e_conv1(colour))
        first = torch.cat([x, y], 1)
        x, y = torch.relu(self.conv2(x)), torch.relu(self.e_conv2(y))
        second = torch.cat([x, y], 1)
        z = torch.relu(self.conv6(torch.relu(self.conv5(second))))
        return Features(torch.cat([first, second], 1), z.mean(2, keepdim=True))


class Encoder(nn.Module):
    """Section 3.1 of the paper: an image and points to features of the points."""

    def __init__(self) -> None:
        super().__init__()
        self.cnn, self.feat = ColourEncoder(), DenseFusion()

    def forward(self, image: Tensor, points: Tensor, choose: Tensor) -> Features:
        """(B, 3, H, W), (B, N, 3) and pixel indices (B, N)."""
        features: Features = self.feat(points.mT, at_pixels(self.cnn(image), choose))
        return features


class PoseHead(nn.Module):
    """Per point and category: rotation, offset and confidence."""

    def __init__(self) -> None:
        super().__init__()
        for name, outputs in (("r", 4), ("t", 3), ("c", 1)):
            self.add_module(f"conv1_{name}", nn.Conv1d(2 * (LOCAL + SHARED), 640, 1))
            self.add_module(f"conv2_{name}", nn.Conv1d(640, 256, 1))
            self.add_module(f"conv3_{name}", nn.Conv1d(256, 128, 1))
            self.add_module(f"conv4_{name}", PerCategory(128, outputs))

    def forward(self, name: str, pose: Features, shape: Features, category: Tensor) -> Tensor:
        """(B, N, K): the part ``name``, one of r, t and c."""
        layers: list[Any] = [self.get_submodule(f"conv{i}_{name}") for i in range(1, 5)]
        x = first_layer(layers[0], [pose.local, pose.shared, shape.local, shape.shared])
        x = torch.relu(layers[2](torch.relu(layers[1](torch.relu(x)))))
        y: Tensor = layers[3].of(x, category)
        return y.mT


class PoseEstimator(nn.Module):
    """Holds encoder and head of the pose under the published names."""

    def __init__(self) -> None:
        super().__init__()
        self.encoding, self.posing = Encoder(), PoseHead()


class Fold(nn.Module):
    """Moves each point by a code of its own."""

    def __init__(self, coordinates: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(coordinates + LOCAL + SHARED, 512),
            nn.ReLU(),
            nn.Linear(512, 512),
            nn.ReLU(),
            nn.Linear(512, 3),
        )

    def forward(self, points: Tensor, code: Features) -> Tensor:
        """Points ((B,) M, K), as many as the code has, to (B, M, 3)."""
        first: Any = self.mlp[0]
        weights = first.weight.split([points.shape[-1], LOCAL, SHARED], dim=1)
        x = F.linear(points, weights[0], first.bias)
        x = x + F.linear(code.local.mT, weights[1]) + F.linear(code.shared.mT, weights[2])
        y: Tensor = self.mlp[1:](x)
        return y


class Folding(nn.Module):
    """A fixed grid folded twice; the grid comes with the weights. Grid point i takes the features
    of observed point i, so there must be 500 of these too."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("grid_buf", torch.zeros(POINT_COUNT, GRID))
        self.Fold1, self.Fold2 = Fold(GRID), Fold(3)

    def forward(self, code: Features) -> Tensor:
        """The shape (B, 500, 3)."""
        y: Tensor = self.Fold2(self.Fold1(self.grid_buf, code), code)
        return y


class FoldingNet(nn.Module):
    """Holds encoder and decoder of the shape under the published names."""

    def __init__(self) -> None:
        super().__init__()
        self.encoding, self.reconstructing = Encoder(), Folding()


class CassNet(nn.Module):
    """Pose and shape from two encoders."""

    def __init__(self) -> None:
        super().__init__()
        self.estimator, self.foldingnet = PoseEstimator(), FoldingNet()

    def forward(
        self, points: Tensor, image: Tensor, choose: Tensor, category: Tensor
    ) -> CassOutput:
        """Observed ``points`` (B, 500, 3) metres, ``image`` (B, 3, H, W) normalised, their pixels
        ``choose`` (B, 500), ``category`` (B,)."""
        pose = self.estimator.encoding(image, points, choose)
        shape = self.foldingnet.encoding(image, points, choose)
        r, t, c = (self.estimator.posing(name, pose, shape, category) for name in "rtc")
        return CassOutput(r, t, c[..., 0].sigmoid(), self.foldingnet.reconstructing(shape))
