"""SDFEst's networks: from points to a first estimate, and from a latent shape to its distances.

Bruns & Jensfelt, "SDFEst: Categorical Pose and Shape Estimation of Objects From RGB-D Using
Signed Distance Fields" (RA-L 2022). Parameters have the published names.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from method_adapters._sdfest_configuration import (
    Configuration,
    DecoderLayer,
    EncoderLayer,
    HeadLayers,
    PointNetLayers,
)
from method_adapters._so3_grid import cell_count

#: Nodes along each axis of the volume.
RESOLUTION = 64


def _mlp(inputs: Sequence[int], widths: Sequence[int]) -> nn.ModuleList:
    return nn.ModuleList(nn.Linear(a, b) for a, b in zip(inputs, widths, strict=True))


def _norms(widths: Sequence[int], wanted: bool) -> nn.ModuleList:
    return nn.ModuleList(nn.BatchNorm1d(width) if wanted else nn.Identity() for width in widths)


class _PointNet(nn.Module):
    """Points (B, N, 3) to features (B, C)."""

    def __init__(self, layers: PointNetLayers) -> None:
        super().__init__()
        self._dense, self._residual = layers.dense, layers.residual
        wider = 2 if layers.dense else 1
        inputs = [3, *(wider * width for width in layers.widths[:-1])]
        self._linear_layers = _mlp(inputs, layers.widths)
        self._bn_layers = _norms(layers.widths, layers.batch_norm)

    def forward(self, points: Tensor) -> Tensor:
        x = points
        last = len(self._linear_layers) - 1
        for i, (linear, norm) in enumerate(zip(self._linear_layers, self._bn_layers, strict=True)):
            y = functional.relu(norm(linear(x).flatten(0, 1)).unflatten(0, x.shape[:2]))
            if self._dense and i < last:
                y = torch.cat([y, y.amax(1, keepdim=True).expand_as(y)], -1)
            x = y + x if self._residual and y.shape == x.shape else y
        return x.amax(1)


class _Head(nn.Module):
    """Features (B, C) to shape, position, scale, orientation."""

    def __init__(self, inputs: int, layers: HeadLayers, latent: int) -> None:
        super().__init__()
        self._sizes = (latent, 3, 1, cell_count(layers.resolution))
        self._linear_layers = _mlp([inputs, *layers.widths[:-1]], layers.widths)
        self._bn_layers = _norms(layers.widths, layers.batch_norm)
        self._final_layer = nn.Linear(layers.widths[-1], sum(self._sizes))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        for linear, norm in zip(self._linear_layers, self._bn_layers, strict=True):
            x = functional.relu(norm(linear(x)))
        latent, position, scale, orientation = self._final_layer(x).split(self._sizes, -1)
        return latent, position, scale[:, 0], orientation


class InitNet(nn.Module):
    """The initialisation network."""

    def __init__(self, of: Configuration) -> None:
        super().__init__()
        self._backbone = _PointNet(of.point_net)
        self._head = _Head(of.point_net.widths[-1], of.head, of.latent)

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Points (B, N, 3), metres, OpenGL camera axes, less their mean, to latent shape (B, L),
        position (B, 3), metres from that mean, scale (B,), the half-width of the volume, metres,
        and a logit for each cell of orientation (B, cells)."""
        estimate: tuple[Tensor, Tensor, Tensor, Tensor] = self._head(self._backbone(points))
        return estimate


class _Encoder(nn.Module):
    def __init__(self, layers: Sequence[EncoderLayer], latent: int) -> None:
        super().__init__()
        features: list[nn.Module] = []
        side = RESOLUTION
        for layer in layers:
            features += [
                nn.Conv3d(layer.in_channels, layer.out_channels, layer.kernel_size, layer.stride),
                nn.ReLU(),
            ]
            side = (side - layer.kernel_size) // layer.stride + 1
        self._features = nn.Sequential(*features, nn.Flatten())
        width = layers[-1].out_channels * side**3
        self.linear_means = nn.Linear(width, latent)
        self.linear_log_var = nn.Linear(width, latent)

    def forward(self, distances: Tensor) -> tuple[Tensor, Tensor]:
        x = self._features(distances)
        return self.linear_means(x), self.linear_log_var(x)


# Torch's own operators for volumes take about ten times as long on a CPU as the two below, and
# on a GPU the gradient of its resizing differs from run to run.


class _Convolution(nn.Conv3d):
    """A convolution without padding, stride 1: one of slices, with every plane of the kernel, whose
    results are added."""

    def forward(self, x: Tensor) -> Tensor:
        planes = self.weight.permute(2, 0, 1, 3, 4)
        slices = x.transpose(1, 2)
        found = functional.conv2d(slices.flatten(0, 1), planes.flatten(0, 1))
        parts = found.unflatten(0, slices.shape[:2]).unflatten(2, planes.shape[:2]).unbind(2)
        depth = x.shape[2] - len(planes) + 1
        y = functools.reduce(torch.add, (part[:, k : k + depth] for k, part in enumerate(parts)))
        biased: Tensor = y.transpose(1, 2) + self.get_parameter("bias")[:, None, None, None]
        return biased


def _resized(x: Tensor, side: int) -> Tensor:
    """Trilinear interpolation to ``side`` nodes along each axis, node centres at halves."""
    if x.shape[-1] == side:
        return x
    along = _interpolation(x.shape[-1], side, x.dtype, x.device)
    y = along @ x @ along.T
    resized: Tensor = (along @ y.flatten(-2)).unflatten(-1, (side, side))
    return resized


@functools.cache
@torch.inference_mode(False)  # kept for gradients, whoever comes first
def _interpolation(old: int, new: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The matrix (``new``, ``old``) that interpolates linearly along one axis."""
    nodes = torch.eye(old)[None]
    along = functional.interpolate(nodes, size=new, mode="linear", align_corners=False)[0].T
    return along.to(device, dtype)


class _Decoder(nn.Module):
    def __init__(self, linear: Sequence[int], layers: Sequence[DecoderLayer], latent: int) -> None:
        super().__init__()
        self._fc_layers = _mlp([latent, *linear[:-1]], linear)
        self._layers = layers
        self._conv_layers = nn.ModuleList(
            _Convolution(layer.in_channels, layer.out_channels, layer.kernel_size)
            for layer in layers
        )

    def forward(self, latent: Tensor) -> Tensor:
        x = latent
        for linear in self._fc_layers:
            x = functional.relu(linear(x))
        first = self._layers[0]
        x = x.reshape(-1, first.in_channels, *(first.in_size,) * 3)
        for layer, convolution in zip(self._layers, self._conv_layers, strict=True):
            if layer.kernel_size == 1 and not layer.relu:
                # it commutes with the resizing, and leaves less to resize
                x = _resized(convolution(x), layer.in_size)
            else:
                x = convolution(_resized(x, layer.in_size))
            if layer.relu:
                x = functional.relu(x)
        return _resized(x, RESOLUTION)


class SdfVae(nn.Module):
    """The auto-encoder of signed distances on 64^3 nodes, axes x, y, z.

    Distances are in units of the volume's half-width, negative inside.
    """

    def __init__(self, of: Configuration) -> None:
        super().__init__()
        self.encoder = _Encoder(of.encoder, of.latent)
        self.decoder = _Decoder(of.linear, of.decoder, of.latent)

    def forward(self, latent: Tensor) -> Tensor:
        """Latent shapes (B, L) to distances (B, 1, 64, 64, 64)."""
        distances: Tensor = self.decoder(latent)
        return distances
