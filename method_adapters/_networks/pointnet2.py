"""PointNet++ (Qi et al., NeurIPS 2017) in pure torch: the operators, and the encoder of SGPA and
DPDN.

The operators return the indices that the CUDA kernels of the published codes return, ties
included. Clouds are (B, N, 3) float32, features (B, C, N).

On a GPU they look at no value on the host, and their launches, which are many, can be captured.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from method_adapters._networks.graphs import queued
from pytest_cpas.adapting import tap

#: Clouds up to this size are sampled with a table of all their distances, which is faster; on a
#: GPU, where it is fewer launches, up to the other.
TABLE_POINTS, QUEUED_TABLE_POINTS = 2000, 20_000
#: Distances that are computed together, so that they stay in the cache; and on a GPU, so that they
#: leave room in its memory.
CACHED, QUEUED = 1 << 17, 1 << 28


def squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """Squared distances (B, M, N) of (B, M, 3) and (B, N, 3), summed in the kernels' order."""
    table = a.new_empty((len(a), a.shape[1], b.shape[1]))
    together = QUEUED if queued(b) else CACHED
    rows = max(1, together // (len(b) * b.shape[1]))
    for centres, part in zip(a.split(rows, 1), table.split(rows, 1), strict=True):
        x, y, z = (centres[:, :, None, axis] - b[:, None, :, axis] for axis in range(3))
        torch.add(x.square_().add_(y.square_()), z.square_(), out=part)
    return table


@functools.cache
@torch.inference_mode(False)  # kept, whoever comes first
def tie_order(n: int, max_threads: int, device: torch.device) -> Tensor:
    """The indices 0..n-1 in the order in which the kernels prefer equally far points.

    Thread t of min(2^floor(log2 n), ``max_threads``) sees the points t, t + threads, ... and keeps
    its first maximum; a tree reduction over the threads keeps the lower partner. So the smallest
    bit-reversed thread wins, then the smallest index.
    """
    bits = min(n.bit_length() - 1, max_threads.bit_length() - 1)
    index = np.arange(n)
    thread = index % (1 << bits)
    reverse = sum(((thread >> bit) & 1) << (bits - 1 - bit) for bit in range(bits))
    return torch.from_numpy(np.lexsort((index, np.broadcast_to(reverse, n)))).to(device)


def farthest_points(
    xyz: Tensor, count: int, *, max_threads: int, skip_radius_squared: float | None = None
) -> Tensor:
    """Farthest point sampling: indices (B, ``count``) of (B, N, 3), the first of them 0.

    Points with a squared distance from the origin up to ``skip_radius_squared`` are never chosen,
    except index 0, which is always the first and takes the place of all if none is left (DPDN's
    kernel has 1e-3). Takes 4 B N^2 bytes where it makes a table.
    """
    batch, n, _ = xyz.shape
    order = tie_order(n, max_threads, xyz.device)
    ordered = xyz[:, order]
    # the first maximum is the one that the kernels prefer, once the points stand in their order
    by_table = n <= (QUEUED_TABLE_POINTS if queued(xyz) else TABLE_POINTS)
    table = squared_distances(ordered, ordered).flatten(0, 1) if by_table else None
    axes = ordered.mT.contiguous()
    apart = torch.empty_like(axes)
    running = torch.full((batch, n), torch.inf, device=xyz.device)
    if skip_radius_squared is not None:
        x, y, z = ordered.unbind(-1)
        near = (x * x + y * y + z * z).double() <= skip_radius_squared
        running.masked_fill_(near, -1.0)
    first_rows = n * torch.arange(batch, device=xyz.device)
    last_rows, to_last = first_rows.clone(), torch.empty_like(running)
    chosen = torch.zeros((count, batch), dtype=torch.int64, device=xyz.device)
    for last, place in pairwise(chosen.unbind(0)):
        if batch > 1:
            torch.add(last, first_rows, out=last_rows)
        else:
            last_rows = last
        if table is None:
            near_to = ordered.flatten(0, 1).index_select(0, last_rows)[..., None]
            torch.sub(axes, near_to, out=apart).square_()
            torch.add(apart[:, 0], apart[:, 1], out=to_last).add_(apart[:, 2])
        else:
            torch.index_select(table, 0, last_rows, out=to_last)
        torch.minimum(running, to_last, out=running)
        torch.argmax(running, dim=1, out=place)
    return order[chosen.T]


class Sampling(NamedTuple):
    """Farthest points of farthest points, ``counts`` of each level; see :func:`farthest_points`."""

    counts: tuple[int, ...]
    max_threads: int
    skip_radius_squared: float | None = None

    def levels(self, xyz: Tensor) -> list[Tensor]:
        """Per level the indices (B, M) of its points among those of the level before, the first
        among ``xyz`` (B, N, 3)."""
        indices = []
        for count in self.counts:
            indices.append(
                farthest_points(
                    xyz,
                    count,
                    max_threads=self.max_threads,
                    skip_radius_squared=self.skip_radius_squared,
                )
            )
            xyz = gather(xyz.mT, indices[-1]).mT
        return indices


def ball_query(distances: Tensor, radius: float, count: int) -> Tensor:
    """Indices (B, M, ``count``) of the first points nearer than ``radius``, ascending.

    ``distances``: squared distances (B, M, N) of the M centres. Places that are left hold the
    first index found, or 0 if none was.
    """
    limit = float(np.float32(radius) * np.float32(radius))
    batch, m, n = distances.shape
    rows = distances.reshape(-1, n)
    found, hits = (_first_at_once if queued(rows) else _first)(rows, limit, count)
    filled = torch.arange(count, device=rows.device) < hits[:, None]
    return torch.where(filled, found, found[:, :1]).view(batch, m, count)


def _first_at_once(rows: Tensor, limit: float, count: int) -> tuple[Tensor, Tensor]:
    """Of every row the first ``count`` columns below a limit, 0 where there are fewer, and how many
    there are; all columns are counted."""
    found_until = (rows < limit).cumsum(1, dtype=torch.int32)
    wanted = torch.arange(1, count + 1, dtype=torch.int32, device=rows.device)
    column = torch.searchsorted(found_until, wanted.expand(len(rows), -1).contiguous())
    return torch.where(column < rows.shape[1], column, 0), found_until[:, -1]


def _first(rows: Tensor, limit: float, count: int) -> tuple[Tensor, Tensor]:
    """The same, but a row is done with when it has enough."""
    n = rows.shape[1]
    # one place more than asked for takes what comes too late
    found = torch.zeros((len(rows), count + 1), dtype=torch.int64, device=rows.device)
    hits = torch.zeros(len(rows), dtype=torch.int64, device=rows.device)
    # most centres have their points long before the last column
    open_rows, begin, width = torch.arange(len(rows), device=rows.device), 0, 4 * count
    while begin < n and len(open_rows):
        part = rows[:, begin : begin + width]
        inside = (part if len(open_rows) == len(rows) else part[open_rows]) < limit
        row, column = inside.nonzero(as_tuple=True)
        new = inside.sum(1)
        rank = torch.arange(len(row), device=rows.device) - (new.cumsum(0) - new)[row]
        place = (rank + hits[open_rows][row]).clamp(max=count)
        found[open_rows[row], place] = column + begin
        hits[open_rows] += new
        open_rows = open_rows[hits[open_rows] < count]
        begin, width = begin + width, 2 * width
    return found[:, :count], hits


def three_nearest(unknown: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Squared distances and indices (B, N, 3) of the three nearest of (B, M, 3) ``known`` to
    (B, N, 3) ``unknown``, ascending, ties to the lower index."""
    distances = squared_distances(unknown, known)
    squared, indices = [], []
    for _ in range(3):
        nearest, index = distances.min(dim=-1, keepdim=True)
        distances.scatter_(-1, index, torch.inf)
        squared.append(nearest)
        indices.append(index)
    return torch.cat(squared, -1), torch.cat(indices, -1)


def gather(features: Tensor, index: Tensor) -> Tensor:
    """Features (B, C, ...) of (B, C, N) at ``index`` (B, ...)."""
    batch, channels, _ = features.shape
    flat = index.reshape(batch, 1, -1).expand(-1, channels, -1)
    return features.gather(2, flat).reshape(batch, channels, *index.shape[1:])


def interpolate(features: Tensor, squared: Tensor, index: Tensor) -> Tensor:
    """Features (B, C, N) from (B, C, M), weighted by inverse distance; see
    :func:`three_nearest`."""
    weight = 1 / (squared.sqrt() + 1e-8)
    weight = weight / weight.sum(-1, keepdim=True)
    return (gather(features, index) * weight[:, None]).sum(-1)


class SharedMlp(nn.Sequential):
    """1x1 convolutions with batch norm and ReLU, on (B, C, M, S).

    ``norm_name``: what the published code calls its wrapper of the batch norm.
    """

    def __init__(self, widths: Sequence[int], norm_name: str) -> None:
        super().__init__()
        for i, (before, after) in enumerate(pairwise(widths)):
            layer = nn.Sequential()
            layer.add_module("conv", nn.Conv2d(before, after, 1, bias=False))
            norm = nn.Sequential()
            norm.add_module("bn", nn.BatchNorm2d(after))
            layer.add_module(norm_name, norm)
            layer.add_module("activation", nn.ReLU(inplace=True))
            self.add_module(f"layer{i}", layer)


class SetAbstraction(nn.Module):
    """One level, grouping at several radii: relative coordinates before features, maximum over
    the group, scales concatenated."""

    def __init__(
        self,
        radii: Sequence[float],
        samples: Sequence[int],
        widths: Sequence[Sequence[int]],
        norm_name: str,
    ) -> None:
        super().__init__()
        self.radii, self.samples = radii, samples
        self.mlps = nn.ModuleList(SharedMlp(w, norm_name) for w in widths)

    def forward(self, xyz: Tensor, features: Tensor | None, centres: Tensor) -> Tensor:
        """(B, N, 3), (B, C, N) and (B, M, 3) to (B, C', M)."""
        distances = squared_distances(centres, xyz)
        scales = []
        for radius, count, mlp in zip(self.radii, self.samples, self.mlps, strict=True):
            index = tap("network.neighbours", ball_query(distances, radius, count))
            group = gather(xyz.mT, index) - centres.mT[..., None]
            if features is not None:
                group = torch.cat([group, gather(features, index)], 1)
            scales.append(mlp(group).amax(-1))
        return torch.cat(scales, 1)


class FeaturePropagation(nn.Module):
    """Interpolated features of the coarser level before the finer level's own."""

    def __init__(self, widths: Sequence[int], norm_name: str) -> None:
        super().__init__()
        self.mlp = SharedMlp(widths, norm_name)

    def forward(self, fine: Tensor, coarse: Tensor, skip: Tensor | None, up: Tensor) -> Tensor:
        """(B, N, 3), (B, M, 3), (B, C, N) and (B, C', M) to (B, C'', N)."""
        features = tap("network.interpolated", interpolate(up, *three_nearest(fine, coarse)))
        if skip is not None:
            features = torch.cat([features, skip], 1)
        propagated: Tensor = self.mlp(features[..., None])[..., 0]
        return propagated


def tap_samples(samples: Sequence[Tensor]) -> None:
    """Level by level."""
    for index in samples:
        tap("network.sampled", index)


class PointNet2(nn.Module):
    """The multi-scale encoder of SGPA and DPDN: (B, N, 3) to per-point features (B, C, N).

    ``abstraction``: per level the widths of its two MLPs without the input; ``propagation``: per
    level the output widths, the finest first. ``radii`` per level and scale, metres.
    """

    LEVELS = (512, 256, 128, 64)
    SAMPLES = (16, 32)

    def __init__(
        self,
        *,
        radii: Sequence[Sequence[float]],
        abstraction: Sequence[Sequence[Sequence[int]]],
        propagation: Sequence[Sequence[int]],
        norm_name: str,
        max_threads: int,
        skip_radius_squared: float | None = None,
    ) -> None:
        super().__init__()
        self.sampling = Sampling(self.LEVELS, max_threads, skip_radius_squared)
        self.SA_modules = nn.ModuleList()
        widths = [0]  # of the features of every level
        for level_radii, mlps in zip(radii, abstraction, strict=True):
            full = [[3 + widths[-1], *mlp] for mlp in mlps]
            self.SA_modules.append(SetAbstraction(level_radii, self.SAMPLES, full, norm_name))
            widths.append(sum(mlp[-1] for mlp in mlps))
        outputs = [mlp[-1] for mlp in propagation] + [widths[-1]]
        self.FP_modules = nn.ModuleList(
            FeaturePropagation([outputs[level + 1] + widths[level], *mlp], norm_name)
            for level, mlp in enumerate(propagation)
        )

    def forward(self, xyz: Tensor, samples: Sequence[Tensor]) -> Tensor:
        """Points (B, N, 3) and what ``sampling`` gives for them to features (B, C, N)."""
        tap_samples(samples)
        clouds: list[Tensor] = [xyz]
        features: list[Any] = [None]  # the finest level has none of its own
        for module, index in zip(self.SA_modules, samples, strict=True):
            clouds.append(gather(clouds[-1].mT, index).mT)
            features.append(module(clouds[-2], features[-1], clouds[-1]))
        for level in reversed(range(len(self.FP_modules))):
            features[level] = self.FP_modules[level](
                clouds[level], clouds[level + 1], features[level], features[level + 1]
            )
        finest: Tensor = features[0]
        return finest


def of_two_clouds(
    encoders: tuple[PointNet2, PointNet2], clouds: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """The features of two clouds (B, N, 3), of an encoder each that samples as the other does: both
    are sampled together, for it takes many small steps."""
    samples = encoders[0].sampling.levels(torch.cat(clouds))
    halves = zip(*(index.chunk(2) for index in samples), strict=True)
    first, second = (
        encoder(cloud, half) for encoder, cloud, half in zip(encoders, clouds, halves, strict=True)
    )
    return first, second
