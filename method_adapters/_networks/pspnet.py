"""The colour encoders: a ResNet-18 at an eighth of the resolution, pyramid pooling (Zhao et al.,
CVPR 2017) and three up-blocks. The published codes have two variants of pyramid and up-block."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pytest_cpas.adapting import tap

PYRAMID = (1, 2, 3, 6)


def _resized(x: Tensor, size: tuple[int, int], align_corners: bool) -> Tensor:
    return tap(
        "network.resized", F.interpolate(x, size, mode="bilinear", align_corners=align_corners)
    )


def _doubled(x: Tensor) -> Tensor:
    return _resized(x, (2 * x.shape[2], 2 * x.shape[3]), align_corners=True)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut; ``norm``: with batch norm."""

    def __init__(self, before: int, after: int, stride: int, dilation: int, norm: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(before, after, 3, stride, dilation, dilation, bias=False)
        self.conv2 = nn.Conv2d(after, after, 3, 1, dilation, dilation, bias=False)
        self.bn1 = nn.BatchNorm2d(after) if norm else nn.Identity()
        self.bn2 = nn.BatchNorm2d(after) if norm else nn.Identity()
        self.downsample = nn.Sequential()
        if before != after:
            self.downsample.append(nn.Conv2d(before, after, 1, stride, bias=False))
            if norm:
                self.downsample.append(nn.BatchNorm2d(after))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, C', H/stride, W/stride)."""
        y = F.relu(self.bn1(self.conv1(x)), inplace=True)
        return F.relu(self.bn2(self.conv2(y)) + self.downsample(x), inplace=True)


class ResNet18(nn.Module):
    """Without its classifier: (B, 3, H, W) to (B, 512, H/8, W/8).

    ``norm``: with batch norm, and then, as published, without dilation; else the second block of
    the third and fourth layer is dilated by 2 and 4.
    """

    def __init__(self, norm: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64) if norm else nn.Identity()
        before = 64
        for number, (width, stride, dilation) in enumerate(
            ((64, 1, 1), (128, 2, 1), (256, 1, 2), (512, 1, 4)), start=1
        ):
            layer = nn.Sequential(
                BasicBlock(before, width, stride, 1, norm),
                BasicBlock(width, width, 1, 1 if norm else dilation, norm),
            )
            self.add_module(f"layer{number}", layer)
            before = width

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        x = F.relu(self.bn1(self.conv1(x)), inplace=True)
        x = F.max_pool2d(x, 3, 2, 1)
        for number in range(1, 5):
            x = self.get_submodule(f"layer{number}")(x)
        return x


class Pyramid(nn.Module):
    """Pooled features of four grids beside the features, as SPD, CR-Net and SGPA have them."""

    def __init__(self) -> None:
        super().__init__()
        self.stages = nn.ModuleList(
            nn.Sequential(nn.AdaptiveAvgPool2d(size), nn.Conv2d(512, 128, 1, bias=False), nn.ReLU())
            for size in PYRAMID
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, 512, h, w) to (B, 1024, h, w), the features first."""
        size = (x.shape[2], x.shape[3])
        pooled = [_resized(stage(x), size, align_corners=True) for stage in self.stages]
        return torch.cat([x, *pooled], 1)


class BottleneckPyramid(nn.Module):
    """The same as CASS and DPDN have it: without activation in the stages, with a bottleneck."""

    def __init__(self) -> None:
        super().__init__()
        self.stages = nn.ModuleList(
            nn.Sequential(nn.AdaptiveAvgPool2d(size), nn.Conv2d(512, 512, 1, bias=False))
            for size in PYRAMID
        )
        self.bottleneck = nn.Conv2d(2560, 1024, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, 512, h, w) to (B, 1024, h, w)."""
        size = (x.shape[2], x.shape[3])
        # the bottleneck of what is resized is what is resized of the bottleneck, on fewer pixels
        *weights, last = self.bottleneck.weight.split(512, dim=1)
        y = F.conv2d(x, last, self.bottleneck.bias)
        for stage, weight in zip(self.stages, weights, strict=True):
            y += _resized(F.conv2d(stage(x), weight), size, align_corners=False)
        return F.relu(y, inplace=True)


class UpBlock(nn.Module):
    """Resolution doubled, 3x3 convolution, PReLU, as SPD, CR-Net and SGPA have it."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.conv = nn.Sequential(nn.Conv2d(before, after, 3, padding=1), nn.PReLU())

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, h, w) to (B, C', 2h, 2w)."""
        y: Tensor = self.conv(_doubled(x))
        return y


class BilinearUpBlock(nn.Module):
    """The same as CASS and DPDN have it; ``norm``: with batch norm."""

    def __init__(self, before: int, after: int, norm: bool) -> None:
        super().__init__()
        self.conv = nn.Sequential(
            nn.UpsamplingBilinear2d(scale_factor=2),  # it aligns corners
            nn.Conv2d(before, after, 3, padding=1),
            *([nn.BatchNorm2d(after)] if norm else []),
            nn.PReLU(),
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, h, w) to (B, C', 2h, 2w)."""
        y: Tensor = self.conv(x)
        return y


class PSPNet(nn.Module):
    """SPD's, CR-Net's and SGPA's: (B, 3, H, W) to (B, 32, H, W), sides divisible by 8."""

    def __init__(self) -> None:
        super().__init__()
        self.feats = ResNet18(norm=False)
        self.psp = Pyramid()
        self.up_1, self.up_2, self.up_3 = UpBlock(1024, 256), UpBlock(256, 64), UpBlock(64, 64)
        self.final = nn.Conv2d(64, 32, 1)

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        y: Tensor = self.final(self.up_3(self.up_2(self.up_1(self.psp(self.feats(x))))))
        return y


class BottleneckPSPNet(nn.Module):
    """CASS's, and with batch norm (``norm``) DPDN's: (B, 3, H, W), sides divisible by 8, to what
    ``final`` makes of (B, 64, H, W)."""

    def __init__(self, norm: bool, final: nn.Sequential) -> None:
        super().__init__()
        self.feats = ResNet18(norm)
        self.psp = BottleneckPyramid()
        self.up_1 = BilinearUpBlock(1024, 256, norm)
        self.up_2, self.up_3 = BilinearUpBlock(256, 64, norm), BilinearUpBlock(64, 64, norm)
        self.final = final

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        y: Tensor = self.final(self.up_3(self.up_2(self.up_1(self.psp(self.feats(x))))))
        return y
