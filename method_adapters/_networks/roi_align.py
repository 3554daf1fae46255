"""RoIAlign (He et al., Mask R-CNN, ICCV 2017) with the conventions of its first published codes:
no half-pixel shift, regions at least one pixel wide, as many samples per bin as it has pixels."""

from __future__ import annotations

import torch
from torch import Tensor


def roi_align(image: Tensor, rois: Tensor, side: int) -> Tensor:
    """Crops (K, C, ``side``, ``side``) of an image (C, H, W): the mean of bilinear samples in
    every bin of the regions ``rois`` (K, 4), x0 y0 x1 y1 in pixels, which may leave the image.

    Samples more than a pixel outside the image are 0. Bilinear weights are products of those of
    the axes, so a crop is two matrix products; the regions go through together.
    """
    _, height, width = image.shape
    across = _axis_weights(rois[:, 0], rois[:, 2], width, side)
    down = _axis_weights(rois[:, 1], rois[:, 3], height, side)
    return torch.einsum("kyh,chw,kxw->kcyx", down, image, across)


def _axis_weights(low: Tensor, high: Tensor, size: int, bins: int) -> Tensor:
    """Weights (K, ``bins``, ``size``) of an axis' pixels in the bins from ``low`` to ``high``."""
    length = (high - low).clamp(min=1)
    samples = torch.ceil(length / bins)
    most = int(samples.max())
    place = torch.arange(most, device=low.device)
    start = torch.arange(bins, device=low.device)[:, None]
    width = (length / bins)[:, None, None]
    # (K, bins, most)
    at = low[:, None, None] + width * (start + (place + 0.5) / samples[:, None, None])
    share = ((place < samples[:, None, None]) & (at >= -1) & (at <= size)) / samples[:, None, None]
    at = at.clamp(0, size - 1)
    below = at.floor().long()
    above = (below + 1).clamp(max=size - 1)
    part = at - below
    weights = torch.zeros((*at.shape[:2], size), dtype=at.dtype, device=at.device)
    weights.scatter_add_(2, below, share * (1 - part))
    weights.scatter_add_(2, above, share * part)
    return weights
