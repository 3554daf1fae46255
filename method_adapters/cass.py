"""``cass``: Canonical Shape Space (Chen, Li, Wang & Xu, CVPR 2020)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from method_adapters._assets import NOCS_TERMS
from method_adapters._crop import (
    Crop,
    Image,
    NoAnswerError,
    back_project,
    depth_pixels,
    mask_limits,
    placed,
    subset_in_order,
    whole_forties,
)
from method_adapters._declaration import port_info
from method_adapters._network_method import Array, NetworkMethod
from pytest_cpas.adapting import Asset, Hypothesis, Observation, draw, tap

if TYPE_CHECKING:
    from torch import nn

#: Observed points that the network takes.
POINT_COUNT = 500
#: Of blue, green and red.
MEAN = np.array([0.51, 0.47, 0.44], np.float32)
DEVIATION = np.array([0.29, 0.27, 0.28], np.float32)
#: The network's camera has x left and y up; its own inverse.
FLIP = np.diag([-1.0, -1.0, 1.0])


class Inputs(NamedTuple):
    """What the network takes for one observation; see
    :meth:`method_adapters._networks.cass.CassNet.forward`."""

    points: NDArray[np.float32]
    image: NDArray[np.float32]
    choose: NDArray[np.int64]
    category: NDArray[np.int64]


class Cass(NetworkMethod[Inputs]):
    """CASS as a :class:`pytest_cpas.types.Method`."""

    info = port_info(
        "cass",
        Asset(
            path="cass/cass_best.pth",
            url="https://drive.google.com/file/d/14K1a-Ft-YO9dUREEXxmWqF2ruUP4p7BZ",
            licence=f"no licence stated; {NOCS_TERMS}",
        ),
        gives=frozenset({"extents", "shape", "score"}),
    )
    # a refinement and classifiers that inference does not use, layers that nothing uses
    unused = (
        "refiner.",
        "estimator.encoding.cnn.model.classifier.",
        "foldingnet.encoding.cnn.model.classifier.",
        "foldingnet.reconstructing.fc.",
        "foldingnet.reconstructing.var.",
    )

    @staticmethod
    def network() -> nn.Module:
        """CASS's network."""
        from method_adapters._networks.cass import CassNet

        return CassNet()

    def prepare(self, observation: Observation, generator: np.random.Generator) -> Inputs:
        """What the network sees of an observation; raises :class:`NoAnswerError`."""
        category = self.category_index(observation)
        valid = observation.mask & (observation.depth > 0)
        crop = crop_around(valid if valid.any() else observation.mask)
        tap("crop", crop.limits)
        rows, columns = depth_pixels(valid, observation.depth, crop)
        picked = draw("picked", subset_in_order(len(rows), generator, POINT_COUNT))
        rows, columns = rows[picked], columns[picked]
        v, u = rows + crop.row, columns + crop.column
        depth = tap("depth", observation.depth)
        points = back_project(v, u, depth, observation.camera)
        return Inputs(
            points @ FLIP.astype(np.float32),
            network_image(observation.rgb, crop),
            rows * crop.width + columns,
            np.array(category),
        )

    def interpret(
        self, inputs: Inputs, outputs: tuple[Array, ...], generator: np.random.Generator
    ) -> Hypothesis:
        """The pose that the point says which is surest of its own; the shape is metric."""
        quaternion, offset, confidence, shape = outputs
        surest = int(tap("surest", np.argmax(confidence)))
        turn = quaternion[surest, [1, 2, 3, 0]]
        if not np.linalg.norm(turn) > 0:  # NaN is not
            raise NoAnswerError(f"the estimated quaternion is {turn.tolist()}, not a rotation")
        return Hypothesis(
            rotation=FLIP @ Rotation.from_quat(turn).as_matrix(),
            translation=FLIP @ (inputs.points[surest] + offset[surest]),
            extents=2 * np.abs(shape).max(axis=0),
            points=shape,
            score=float(confidence[surest]),
        )


def crop_around(mask: NDArray[np.bool_]) -> Crop:
    """The window around a mask (H, W): each side the next multiple of 40 pixels.

    It is centred on the mask's box and shifted into the image. The published code takes any image
    for one of 480 x 640.
    """
    first, side = [], []
    for (low, high), size in zip(mask_limits(mask), mask.shape, strict=True):
        length = high + 1 - low
        side.append(min(-(-length // 40) * 40, whole_forties(size)))
        first.append(placed(low + high + 1, side[-1], size))
    return Crop(*first, *side)


def network_image(rgb: Image, crop: Crop) -> Image:
    """The crop of ``rgb`` (H, W, 3), 0..1, as (3, h, w), blue first, normalised."""
    bgr = rgb[crop.slices][..., ::-1]
    return np.ascontiguousarray(((bgr - MEAN) / DEVIATION).transpose(2, 0, 1))
