"""ASM-Net: Akizuki & Hashimoto, "ASM-Net: Category-level Pose and Shape Estimation Using
Parametric Deformation", BMVC 2021. A PointNet (Qi et al., CVPR 2017) with two heads."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pytest_cpas.adapting import tap

#: Deformation coefficients of the active shape model that are estimated.
COEFFICIENTS = 3


class AsmNetOutput(NamedTuple):
    """``shape`` (B, 4): three coefficients of the active shape model, in its units, and the scale
    relative to the input cloud's; ``quaternion`` (B, 4): unit, scalar first."""

    shape: Tensor
    quaternion: Tensor


class SpatialTransformer(nn.Module):
    """A 3x3 matrix from all points: the identity plus what is learned."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv1d(3, 64, 1)
        self.conv2 = nn.Conv1d(64, 128, 1)
        self.conv3 = nn.Conv1d(128, 1024, 1)
        self.fc1 = nn.Linear(1024, 512)
        self.fc2 = nn.Linear(512, 256)
        self.fc3 = nn.Linear(256, 9)
        self.bn1 = nn.BatchNorm1d(64)
        self.bn2 = nn.BatchNorm1d(128)
        self.bn3 = nn.BatchNorm1d(1024)
        self.bn4 = nn.BatchNorm1d(512)
        self.bn5 = nn.BatchNorm1d(256)

    def forward(self, points: Tensor) -> Tensor:
        """(B, 3, N) to (B, 3, 3)."""
        x = F.relu(self.bn1(self.conv1(points)))
        x = F.relu(self.bn2(self.conv2(x)))
        x = F.relu(self.bn3(self.conv3(x))).amax(-1)
        x = F.relu(self.bn4(self.fc1(x)))
        x = F.relu(self.bn5(self.fc2(x)))
        matrix: Tensor = self.fc3(x).view(-1, 3, 3) + torch.eye(3, device=x.device)
        return matrix


class PointFeatures(nn.Module):
    """One feature of the whole cloud, after a spatial transformer."""

    def __init__(self) -> None:
        super().__init__()
        self.stn = SpatialTransformer()
        self.conv1 = nn.Conv1d(3, 64, 1)
        self.conv2 = nn.Conv1d(64, 128, 1)
        self.conv3 = nn.Conv1d(128, 1024, 1)
        self.bn1 = nn.BatchNorm1d(64)
        self.bn2 = nn.BatchNorm1d(128)
        self.bn3 = nn.BatchNorm1d(1024)

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(B, 3, N) to (B, 1024) and the transformer's matrix (B, 3, 3)."""
        matrix = self.stn(points)
        # points are rows to the published transformer
        x = tap("network.aligned", matrix.mT @ points)
        x = F.relu(self.bn1(self.conv1(x)))
        x = F.relu(self.bn2(self.conv2(x)))
        return self.bn3(self.conv3(x)).amax(-1), matrix


class AsmNet(nn.Module):
    """Coefficients, scale and orientation from the normalised cloud of one category's object."""

    def __init__(self) -> None:
        super().__init__()
        self.feat = PointFeatures()
        for head, outputs in (("ssm", COEFFICIENTS + 1), ("pose", 4)):
            self.add_module(f"{head}_fc1", nn.Linear(1024, 512))
            self.add_module(f"{head}_fc2", nn.Linear(512, 256))
            self.add_module(f"{head}_fc3", nn.Linear(256, outputs))
            self.add_module(f"{head}_bn1", nn.BatchNorm1d(512))
            self.add_module(f"{head}_bn2", nn.BatchNorm1d(256))

    def forward(self, points: Tensor) -> AsmNetOutput:
        """``points`` (B, 3, N): centred, the farthest at distance 1."""
        features, _ = self.feat(points)
        return AsmNetOutput(
            self._head("ssm", features), F.normalize(self._head("pose", features), dim=1)
        )

    def _head(self, name: str, features: Tensor) -> Tensor:
        fc1, fc2, fc3, bn1, bn2 = (
            self.get_submodule(f"{name}_{part}") for part in ("fc1", "fc2", "fc3", "bn1", "bn2")
        )
        x = F.relu(bn1(fc1(features)))
        x = F.relu(bn2(fc2(x)))
        outputs: Tensor = fc3(x)
        return outputs
