"""What the networks that deform a category prior share."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pytest_cpas.adapting import tap

CATEGORY_COUNT = 6


class Deformed(NamedTuple):
    """``assign`` (B, N, M): logits that assign N observed points to M prior points;
    ``deltas`` (B, M, 3): what to add to the prior, NOCS units."""

    assign: Tensor
    deltas: Tensor


def pointwise(*widths: int) -> nn.Sequential:
    """1x1 convolutions on (B, C, N), each with a ReLU."""
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [nn.Conv1d(before, after, 1), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class PerCategory(nn.Conv1d):
    """A 1x1 convolution whose output channels are laid out category by category; only those of
    each sample's own category are computed."""

    def __init__(self, before: int, after: int) -> None:
        """``after``: channels of one category."""
        super().__init__(before, CATEGORY_COUNT * after, 1)

    def of(self, x: Tensor, category: Tensor) -> Tensor:
        """(B, C, N) and categories (B,) to (B, C', N)."""
        weight = self.weight.view(CATEGORY_COUNT, -1, self.in_channels)[category]
        bias = self.bias
        y = weight @ x
        return y if bias is None else y + bias.view(CATEGORY_COUNT, -1, 1)[category]


class CategoryMlp(nn.Sequential):
    """1x1 convolutions with ReLU and a last one per category."""

    def __init__(self, *widths: int) -> None:
        *hidden, last = widths
        super().__init__(*pointwise(*hidden), PerCategory(hidden[-1], last))

    def of(self, local: Tensor, *shared: Tensor, category: Tensor) -> Tensor:
        """From features of every point (B, C, N), and features that all points share (B, C, 1)
        and which follow in the input's channels, to (B, C', N)."""
        layers: list[Any] = list(self)
        first, *hidden, last = layers
        x = first_layer(first, [local, *shared])
        for layer in hidden:
            x = layer(x)
        y: Tensor = last.of(x, category)
        return y


def first_layer(layer: Any, parts: Sequence[Tensor]) -> Tensor:
    """A 1x1 convolution ``layer`` of parts that would be stacked in channels; those of length 1
    stand for all points, and go through once."""
    weights = torch.split(layer.weight, [part.shape[1] for part in parts], dim=1)
    y = F.conv1d(parts[0], weights[0], layer.bias)
    for part, weight in zip(parts[1:], weights[1:], strict=True):
        y = y + F.conv1d(part, weight)
    return tap("network.first_layer", y)


def assigned(assign: Tensor, prior: Tensor, deltas: Tensor) -> Tensor:
    """The points (B, N, 3) of the deformed prior, float64, to which the logits ``assign``
    (B, N, M) assign the observed ones; see :class:`Deformed`."""
    shape = prior.double() + deltas
    # one sample at a time: its shares take 8 MB
    return torch.stack(
        [x.softmax(1, dtype=torch.float64) @ y for x, y in zip(assign, shape, strict=True)]
    )


def at_pixels(feature_map: Tensor, choose: Tensor) -> Tensor:
    """Features (B, C, N) of (B, C, H, W) at row-major pixel indices (B, N)."""
    flat = feature_map.flatten(2)
    return tap("network.at_pixels", flat.gather(2, choose[:, None].expand(-1, flat.shape[1], -1)))
