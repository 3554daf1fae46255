"""Which rotations of iCaps' codebook the crops around positions in a depth image look like."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from method_adapters._assets import AssetError, told_of_asset
from method_adapters._networks.graphs import queued
from method_adapters._networks.icaps import CODE_SIZE, CROP_SIDE, AutoEncoder
from method_adapters._networks.roi_align import roi_align
from method_adapters._networks.running import full_precision
from pytest_cpas.adapting import TorchTaps, read_tensors, tap

Array = NDArray[np.float64]

#: Rotations of the codebook: elevations x azimuths x turns in the image.
ROTATIONS = 37 * 72 * 72
#: Crops that go through the encoder together on a CPU: their features stay in the cache.
CHUNK = 20
#: Value of a crop where there is no object: as far behind it as a crop reaches.
BACKGROUND = 1.0


class Codebook:
    """Codes of a category's canonical object in all rotations."""

    def __init__(self, path: Path, device: torch.device) -> None:
        """From a published file: a tuple of codes (R, 128) and poses (R, 7), position and unit
        quaternion, scalar first. Raises :class:`AssetError`."""
        with told_of_asset():
            content = read_tensors(path)
        expected = f"expected a pair of codes ({ROTATIONS}, {CODE_SIZE}) and poses ({ROTATIONS}, 7)"
        if not isinstance(content, (tuple, list)) or len(content) != 2:
            raise AssetError(f"{path}: it holds a {type(content).__name__}; {expected}")
        try:
            codes, poses = (torch.as_tensor(x) for x in content)
        except (TypeError, ValueError, RuntimeError) as error:
            raise AssetError(f"{path}: it holds no tensors ({error}); {expected}") from error
        if not (codes.ndim and codes.numel() and poses.ndim and poses.numel()):
            raise AssetError(f"{path}: it holds empty tensors; {expected}")
        # the published codes have axes of length 1 that say nothing
        codes = codes.reshape(-1, codes.shape[-1]).float()
        poses = poses.reshape(-1, poses.shape[-1]).double()
        if codes.shape[1] != CODE_SIZE or poses.shape != (len(codes), 7):
            shapes = f"{tuple(codes.shape)} and {tuple(poses.shape)}"
            raise AssetError(f"{path}: it holds {shapes}; {expected}")
        lengths = poses[:, 3:].norm(dim=1)
        if not bool(torch.all((lengths - 1).abs() < 1e-3)) or not bool(codes.isfinite().all()):
            raise AssetError(
                f"{path}: quaternions of lengths {lengths.min():g} to {lengths.max():g}, expected"
                " 1, and finite codes"
            )
        self.codes = F.normalize(codes, dim=1).to(device)
        #: Unit quaternions (R, 4), scalar first: the object's axes in the camera's, seen along
        #: the optical axis.
        self.quaternions: Array = F.normalize(poses[:, 3:], dim=1).numpy()


class Matcher:
    """Compares crops of a depth image with a codebook."""

    def __init__(self, network: AutoEncoder, codebook: Codebook) -> None:
        encoder: Any = network.eval().encoder  # torch declares no layouts of modules
        self._encoder = encoder.to(codebook.codes.device, memory_format=torch.channels_last)
        self.codebook = codebook

    def __call__(self, depth: NDArray[np.float32], rois: Array, z: Array, radius: Array) -> Tensor:
        """Cosine similarities (K, R) of K crops with all codes, where these are.

        ``depth`` (H, W): metres, 0 off the object. ``rois`` (K, 4): x0 y0 x1 y1, pixels. A crop's
        depth is normalised so that ``z`` (K,) becomes 0.5, and ``radius`` (K,) more 1, metres.
        """
        device = self.codebook.codes.device
        image = torch.from_numpy(np.stack([depth, depth > 0]).astype(np.float32)).to(device)
        given = [torch.from_numpy(x.astype(np.float32)).to(device) for x in (rois, z, radius)]
        with torch.no_grad(), full_precision():  # it is changed in place by who gets it
            chunk = len(rois) if queued(image) else CHUNK
            first, *others = zip(*(torch.split(x, chunk) for x in given), strict=True)
            # of the first part alone: what the layers make of all is too much
            with TorchTaps(self._encoder, "encoder"):
                parts = [self._encoder(tap("crops", normalised_crops(image, *first)))]
            parts += [self._encoder(normalised_crops(image, *part)) for part in others]
            codes: Tensor = tap("codes", F.normalize(torch.cat(parts), dim=1))
            return codes @ self.codebook.codes.T


def normalised_crops(image: Tensor, rois: Tensor, z: Tensor, radius: Tensor) -> Tensor:
    """Crops (K, 1, 128, 128), 0..1, of an image (2, H, W) of depth and of where there is one."""
    depth, share = roi_align(image, rois, CROP_SIDE).unbind(1)
    # mixed with nothing the depth of an edge would be nearer
    mean = depth / share.clamp(min=1e-6)
    crops = 0.5 + (mean - z[:, None, None]) / (2 * radius[:, None, None])
    return torch.where(share > 0.5, crops.clamp(0, 1), BACKGROUND)[:, None]
