"""The networks of iCaps: Deng et al., "iCaps: Iterative Category-Level Object Pose and Shape
Estimation", RA-L 2022; its shape decoder is DeepSDF (Park et al., CVPR 2019)."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from method_adapters._networks.pointnet2 import Sampling, SetAbstraction, gather, tap_samples

#: Side of a depth crop, pixels, and length of its code.
CROP_SIDE, CODE_SIZE = 128, 128
#: Points that LatentNet takes.
POINT_COUNT = 4873
LATENT_SIZE = 256
#: From so many images on torch leaves 1x1 convolutions to oneDNN whatever the number of threads.
IMAGES = 16


class Encoder(nn.Module):
    """Normalised depth crops (B, 1, 128, 128) to codes (B, 128)."""

    WIDTHS = (1, 128, 256, 256, 512)

    def __init__(self) -> None:
        super().__init__()
        for i, (before, after) in enumerate(pairwise(self.WIDTHS), 1):
            convolution = nn.Conv2d(before, after, 5, stride=2, padding=2)
            self.add_module(f"layer{i}", nn.Sequential(convolution, nn.ReLU(inplace=True)))
        self.fc = nn.Linear(self.WIDTHS[-1] * 8 * 8, CODE_SIZE)

    def forward(self, crops: Tensor) -> Tensor:
        """See the class."""
        x = crops.contiguous(memory_format=torch.channels_last)
        for i in range(1, len(self.WIDTHS)):
            x = self.get_submodule(f"layer{i}")(x)
        codes: Tensor = self.fc(x.flatten(1))
        return codes


class Decoder(nn.Module):
    """Codes (B, 128) to the crops (B, 1, 128, 128) that a canonical object would give."""

    WIDTHS = (256, 128, 128, 64, 1)

    def __init__(self) -> None:
        super().__init__()
        self.fc = nn.Linear(CODE_SIZE, self.WIDTHS[0] * 8 * 8)
        for i, (before, after) in enumerate(pairwise(self.WIDTHS), 1):
            layers: list[nn.Module] = [
                nn.ConvTranspose2d(before, after, 5, stride=2, padding=2, output_padding=1)
            ]
            if after > 1:
                layers.append(nn.ReLU(inplace=True))
            self.add_module(f"layer{i}", nn.Sequential(*layers))

    def forward(self, codes: Tensor) -> Tensor:
        """See the class."""
        x = self.fc(codes).view(-1, self.WIDTHS[0], 8, 8)
        for i in range(1, len(self.WIDTHS)):
            x = self.get_submodule(f"layer{i}")(x)
        crops: Tensor = x
        return crops


class AutoEncoder(nn.Module):
    """The depth auto-encoder; poses need the encoder alone."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder()
        self.decoder = Decoder()

    def forward(self, crops: Tensor) -> tuple[Tensor]:
        """Normalised depth crops (B, 1, 128, 128) to codes (B, 128)."""
        return (self.encoder(crops),)


class LatentNet(nn.Module):
    """PointNet++ from an object's visible points to the latent code of its shape.

    The last level's features go into a fully connected layer in the order in which its points
    were sampled.
    """

    SAMPLING = Sampling((4096, 1024, 256, 64), max_threads=1024)
    RADII = ((0.1, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 4.0))
    SAMPLES = (16, 32)
    WIDTHS = (
        ((16, 16, 32), (32, 32, 64)),
        ((64, 64, 128), (64, 96, 128)),
        ((128, 196, 256), (128, 196, 256)),
        ((256, 256, 512), (256, 384, 512)),
    )

    def __init__(self) -> None:
        super().__init__()
        self.SA_modules = nn.ModuleList()
        before = 0
        for radii, mlps in zip(self.RADII, self.WIDTHS, strict=True):
            full = [[3 + before, *mlp] for mlp in mlps]
            self.SA_modules.append(SetAbstraction(radii, self.SAMPLES, full, "bn"))
            before = sum(mlp[-1] for mlp in mlps)
        hidden = nn.Sequential()
        hidden.add_module("fc", nn.Linear(before * self.SAMPLING.counts[-1], 512, bias=False))
        norm = nn.Sequential()
        norm.add_module("bn", nn.BatchNorm1d(512))
        hidden.add_module("bn", norm)
        hidden.add_module("activation", nn.ReLU(inplace=True))
        last = nn.Sequential()
        last.add_module("fc", nn.Linear(512, LATENT_SIZE))
        self.cls_layer = nn.Sequential(hidden, nn.Dropout(0.5), last)

    def forward(self, xyz: Tensor) -> tuple[Tensor]:
        """Points (B, 4873, 3), ShapeNet axes, centred, over the box's diagonal, to (B, 256)."""
        features: Any = None  # the finest level has none of its own
        samples = self.SAMPLING.levels(xyz)
        tap_samples(samples)
        for module, index in zip(self.SA_modules, samples, strict=True):
            centres = gather(xyz.mT, index).mT
            features = module(xyz, features, centres)
            xyz = centres
        return (self.cls_layer(features.flatten(1)),)


class WeightNormLinear(nn.Module):
    """A linear layer whose rows are a direction ``weight_v`` and a length ``weight_g``."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(after))
        self.weight_g = nn.Parameter(torch.ones(after, 1))
        self.weight_v = nn.Parameter(torch.ones(after, before))

    @property
    def weight(self) -> Tensor:
        """The matrix (after, before)."""
        matrix: Tensor = self.weight_v * (self.weight_g / self.weight_v.norm(dim=1, keepdim=True))
        return matrix

    def forward(self, x: Tensor) -> Tensor:
        """(B, before) to (B, after)."""
        return F.linear(x, self.weight, self.bias)


class DeepSdf(nn.Module):
    """The decoder: a latent code and a point to the signed distance, within -1 and 1."""

    WIDTH, LAYERS, LATENT_IN = 512, 9, 4

    def __init__(self) -> None:
        super().__init__()
        given = LATENT_SIZE + 3
        for i in range(self.LAYERS - 1):
            after = self.WIDTH - given if i + 1 == self.LATENT_IN else self.WIDTH
            self.add_module(f"lin{i}", WeightNormLinear(self.WIDTH if i else given, after))
        self.lin8 = nn.Linear(self.WIDTH, 1)

    def forward(self, latent: Tensor, points: Tensor) -> Tensor:
        """One code (1, 256) and points (N, 3) of the model's units to (N, 1)."""
        given = torch.cat([latent.expand(len(points), -1), points], 1)
        x = given
        for i in range(self.LAYERS - 1):
            if i == self.LATENT_IN:
                x = torch.cat([x, given], 1)
            x = F.relu(self.get_submodule(f"lin{i}")(x))
        return torch.tanh(self.lin8(x))


class Shape:
    """The signed distance function of one latent code.

    What depends on the code alone is computed once: its share of the first and the fifth layer,
    and the matrices from directions and lengths.
    """

    #: Points that go through the network together: their features stay in the cache.
    CHUNK = 4096

    def __init__(self, network: DeepSdf, latent: Tensor) -> None:
        """``latent``: (1, 256)."""
        self._weights: list[Tensor] = []
        self._biases: list[Tensor] = []
        with torch.no_grad():
            for i in range(network.LAYERS):
                layer: Any = network.get_submodule(f"lin{i}")
                weight, bias = layer.weight, layer.bias
                if i in (0, network.LATENT_IN):
                    own = weight.shape[1] - LATENT_SIZE - 3
                    bias = bias + weight[:, own:-3] @ latent[0]
                    # after the features the code comes, then the point
                    weight = torch.cat([weight[:, :own], weight[:, -3:]], 1)
                self._weights.append(weight.contiguous())
                self._biases.append(bias)
        self._transposed = [weight.T.contiguous() for weight in self._weights]
        self._latent_in = network.LATENT_IN

    @property
    def device(self) -> torch.device:
        """Where the points must be."""
        return self._weights[0].device

    def distances(self, points: Tensor) -> Tensor:
        """Signed distances (N,) at points (N, 3), model units."""
        with torch.inference_mode():
            return torch.cat([self._forward(x)[0] for x in self._chunks(points)])[: len(points)]

    def distances_and_gradients(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distances (N,) at points (N, 3) and their gradients (N, 3)."""
        with torch.inference_mode():
            parts = [self._forward_and_back(x) for x in self._chunks(points)]
            distances, gradients = (torch.cat(x)[: len(points)] for x in zip(*parts, strict=True))
            return distances, gradients

    def _chunks(self, points: Tensor) -> tuple[Tensor, ...]:
        """The points in parts, if any, filled up to what :func:`_products` takes."""
        filled = F.pad(points, (0, 0, 0, IMAGES - len(points) % IMAGES))
        return torch.split(filled, self.CHUNK)

    def _forward_and_back(self, points: Tensor) -> tuple[Tensor, Tensor]:
        distance, features = self._forward(points)
        slope = (1 - distance.square())[:, None] * self._weights[-1]
        direct = torch.zeros_like(points)
        for i in reversed(range(len(features))):
            # only where a unit is active its input matters
            slope = _products(slope * features[i].sign_(), self._transposed[i])
            if i == self._latent_in:
                direct, slope = slope[:, -3:], slope[:, :-3]
        return distance, slope + direct

    def _forward(self, points: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Signed distances, and per hidden layer its features."""
        x, features = points, []
        for i, (weight, bias) in enumerate(zip(self._weights, self._biases, strict=True)):
            if i == self._latent_in:
                x = torch.cat([x, points], 1)
            x = _products(x, weight, bias)
            if i < len(self._weights) - 1:
                features.append(x.relu_())
        return torch.tanh(x[:, 0]), features


def _products(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """``x`` (N, A), N a multiple of ``IMAGES``, times the transpose of ``weight`` (B, A).

    As a convolution over images whose channels lie side by side: for these torch calls oneDNN,
    which on some processors is twice as fast as the matrix product of MKL.
    """
    images = x.view(IMAGES, -1, 1, x.shape[1]).permute(0, 3, 1, 2)
    return F.conv2d(images, weight[:, :, None, None], bias).permute(0, 2, 3, 1).flatten(0, 2)
