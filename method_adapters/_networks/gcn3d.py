"""Graph convolution on points: Lin, Huang & Wang, "Convolution in the Cloud: Learning Deformable
Kernels in 3D Graph Convolution Networks for Point Cloud Analysis", CVPR 2020.

Points are (B, N, 3), features (B, N, C).
"""

from __future__ import annotations

from functools import reduce

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pytest_cpas.adapting import tap

#: Directions of a kernel, beside its centre.
SUPPORTS = 7
#: Neighbours that pooling looks at.
POOLED = 4


def squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """Squared distances (B, M, N) of (B, M, 3) and (B, N, 3), as the published code rounds them:
    a more exact formula would choose other neighbours."""
    product = a @ b.mT
    return product * -2 + b.square().sum(2)[:, None] + a.square().sum(2)[:, :, None]


def neighbours(xyz: Tensor, count: int) -> Tensor:
    """Indices (B, N, ``count``) of the nearest points, without the very nearest, which is the
    point itself where no other is in the same place."""
    with_itself = squared_distances(xyz, xyz).topk(count + 1, largest=False).indices
    return with_itself[..., 1:]


def nearest(xyz: Tensor, others: Tensor) -> Tensor:
    """Indices (B, N) of the nearest of ``others`` (B, M, 3)."""
    return squared_distances(xyz, others).argmin(2)


def at_points(x: Tensor, index: Tensor) -> Tensor:
    """The rows (B, ..., C) of (B, N, C) at ``index`` (B, ...)."""
    samples = torch.arange(len(x), device=x.device).view(-1, *[1] * (index.ndim - 1))
    return x[samples, index]


class Neighbourhood:
    """For each point the nearest others, ``index`` (B, N, K), and the unit ``directions``
    (B, N, K, 3) to them."""

    def __init__(self, xyz: Tensor, count: int) -> None:
        self.index = tap("network.neighbours", neighbours(xyz, count))
        self.directions = F.normalize(at_points(xyz, self.index) - xyz[:, :, None], dim=3)

    def pooled(self, features: Tensor, kept: Tensor) -> Tensor:
        """Of the points ``kept`` (B, M), the largest features among their next four others."""
        around = at_points(self.index, kept)[..., :POOLED]
        return tap("network.pooled", at_points(features, around).amax(2))

    def responses(self, kernel: Tensor, supports: Tensor | None = None) -> Tensor:
        """How the neighbours lie in the directions ``kernel`` (3, 7 C): the cosine, if positive,
        times what the neighbour has in ``supports`` (B, N, 7 C); the largest over the neighbours,
        summed over the 7 directions, (B, N, C)."""
        kernel = F.normalize(kernel, dim=0)

        def response(index: Tensor, directions: Tensor) -> Tensor:
            cosine = torch.relu(directions @ kernel)
            return cosine if supports is None else cosine * at_points(supports, index)

        # one neighbour at a time: all together would not fit into the cache
        largest = reduce(
            torch.maximum, map(response, self.index.unbind(2), self.directions.unbind(2))
        )
        return largest.view(*largest.shape[:2], SUPPORTS, -1).sum(2)


class SurfaceConvolution(nn.Module):
    """From the neighbours' directions alone (section 3.2 of the paper)."""

    def __init__(self, after: int) -> None:
        super().__init__()
        self.directions = nn.Parameter(torch.zeros(3, SUPPORTS * after))

    def forward(self, near: Neighbourhood) -> Tensor:
        """To (B, N, C')."""
        return near.responses(self.directions)


class GraphConvolution(nn.Module):
    """The same with features; the kernel has a centre too."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.after = after
        self.weights = nn.Parameter(torch.zeros(before, (1 + SUPPORTS) * after))
        self.bias = nn.Parameter(torch.zeros((1 + SUPPORTS) * after))
        self.directions = nn.Parameter(torch.zeros(3, SUPPORTS * after))

    def forward(self, near: Neighbourhood, features: Tensor) -> Tensor:
        """Features (B, N, C) to (B, N, C')."""
        x = features @ self.weights + self.bias
        centre, supports = x[..., : self.after], x[..., self.after :]
        return centre + near.responses(self.directions, supports)
