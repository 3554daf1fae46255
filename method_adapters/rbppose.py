"""``rbppose``: Residual Bounding Box Projection (Zhang et al., ECCV 2022)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from method_adapters._assets import MEAN_SHAPES, NOCS_TERMS, load_priors
from method_adapters._crop import Crop, NoAnswerError, back_project, crop_of, depth_pixels
from method_adapters._declaration import port_info
from method_adapters._network_method import Array, NetworkMethod
from method_adapters._prior_method import prior_offset
from pytest_cpas.adapting import CATEGORIES, Asset, Hypothesis, Observation, draw, tap

if TYPE_CHECKING:
    from torch import nn

#: Observed points that the network takes.
POINT_COUNT = 1028
#: Side to which the crop is resampled, pixels.
CROP_SIDE = 256
#: x, y and z of the average object of each category, metres.
MEAN_SIZES = {
    "bottle": (0.087, 0.220, 0.089),
    "bowl": (0.165, 0.080, 0.165),
    "camera": (0.088, 0.128, 0.156),
    "can": (0.068, 0.146, 0.072),
    "laptop": (0.346, 0.200, 0.335),
    "mug": (0.146, 0.083, 0.114),
}
#: Categories whose x axis is not known.
SYMMETRIC = ("bottle", "bowl", "can")


class Inputs(NamedTuple):
    """What the network takes for one observation; see
    :meth:`method_adapters._networks.rbppose.RbpPoseNet.forward`."""

    points: NDArray[np.float32]
    category: NDArray[np.int64]
    prior: NDArray[np.float32]
    mean_size: NDArray[np.float32]
    kept: NDArray[np.int64]
    kept_again: NDArray[np.int64]
    prior_kept: NDArray[np.int64]
    prior_kept_again: NDArray[np.int64]


class RbpPose(NetworkMethod[Inputs]):
    """RBP-Pose as a :class:`pytest_cpas.types.Method`."""

    info = port_info(
        "rbppose",
        Asset(
            path="rbppose/model_149.pth",
            url="https://drive.google.com/file/d/1XQDLrmvlB6qvv26OZo0R_TZf34w1kX7U",
            licence=f"no licence stated; {NOCS_TERMS}",
        ),
        MEAN_SHAPES,
        needs=frozenset({"depth"}),
    )
    # what inference does not use: colours, the assignment, the residual projections, an encoder
    unused = (
        "seman_encoder.",
        "posenet.assignment.",
        "posenet.face_recon.",
        "posenet.pcl_encoder_prior.",
    )

    @staticmethod
    def network() -> nn.Module:
        """RBP-Pose's network."""
        from method_adapters._networks.rbppose import RbpPoseNet

        return RbpPoseNet()

    def load(self, assets: Path | None, device: str) -> None:
        """As :meth:`NetworkMethod.load`, and the priors."""
        super().load(assets, device)
        self._priors = load_priors(assets)

    def prepare(self, observation: Observation, generator: np.random.Generator) -> Inputs:
        """What the network sees of an observation; raises :class:`NoAnswerError`."""
        category = self.category_index(observation)
        prior = self._priors[category]
        crop = crop_of(observation.mask)
        tap("crop", crop.limits)
        depth_pixels(observation.mask, observation.depth, crop)  # are there enough
        v, u = resampled_pixels(observation.mask & (observation.depth > 0), crop)
        if len(v) == 0:
            raise NoAnswerError("the pixels with a depth are too scattered: resampling meets none")
        tap("resampled", (v, u))
        picked = draw("picked", generator.choice(len(v), POINT_COUNT, replace=len(v) < POINT_COUNT))
        depth = tap("depth", observation.depth)
        return Inputs(
            back_project(v[picked], u[picked], depth, observation.camera),
            np.array(category),
            prior,
            np.array(MEAN_SIZES[observation.category], np.float32),
            *draw("kept", thinning(POINT_COUNT, generator)),
            *draw("prior_kept", thinning(len(prior), generator)),
        )

    def interpret(
        self, inputs: Inputs, outputs: tuple[Array, ...], generator: np.random.Generator
    ) -> Hypothesis:
        """The network's own pose and size; the shape is scaled by the size's diagonal."""
        green, red, sure_green, sure_red, translation, size, deltas = outputs
        if not np.all(size > 0):  # NaN is not
            raise NoAnswerError(f"the estimated size is {size.tolist()}, not positive")
        category = int(inputs.category)
        turns = CATEGORIES[category] in SYMMETRIC
        rotation = rotation_between(green, red, float(sure_green), 0 if turns else float(sure_red))
        diagonal = float(np.linalg.norm(size))
        offset = prior_offset(category, diagonal)
        points = tap("shape", inputs.prior + deltas) * diagonal - offset
        return Hypothesis(
            rotation=rotation,
            translation=translation + rotation @ offset,
            extents=size,
            points=points,
        )


def resampled_pixels(
    valid: NDArray[np.bool_], crop: Crop
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the image's pixels that are ``valid`` (H, W), as a nearest-neighbour
    resampling of the crop to 256 x 256 meets them, row-major.

    Halves are rounded up, and centres of pixels are not aligned: the last pixel of the resampled
    crop may be the first behind the crop.
    """
    steps = np.arange(CROP_SIDE) * crop.width / CROP_SIDE
    rows, columns = (
        np.floor(first + steps + 0.5).astype(np.int64) for first in (crop.row, crop.column)
    )
    rows, columns = rows[rows < valid.shape[0]], columns[columns < valid.shape[1]]
    at_row, at_column = np.nonzero(valid[np.ix_(rows, columns)])
    return rows[at_row], columns[at_column]


def thinning(
    count: int, generator: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Which quarter of ``count`` points to keep, and which quarter of those, at random."""
    quarter = count // 4
    return (
        generator.permutation(count)[:quarter],
        generator.permutation(quarter)[: quarter // 4],
    )


def rotation_between(green: Array, red: Array, sure_green: float, sure_red: float) -> Array:
    """The rotation (3, 3) whose y and x axis are ``green`` and ``red`` (3,), turned in their
    plane until they are at a right angle, each by a share that is the other's confidence.

    Raises :class:`NoAnswerError` for axes that span no plane.
    """
    normal = np.cross(green, red)
    length, certainty = np.linalg.norm(normal), sure_green + sure_red
    if not (length > 1e-6 and certainty > 0):  # NaN is not
        raise NoAnswerError(
            f"the estimated axes are {green.tolist()} and {red.tolist()}, with confidences"
            f" {sure_green:.3g} and {sure_red:.3g}: they define no rotation"
        )
    across = np.cross(normal, green) / length / np.linalg.norm(green)
    excess = np.arctan2(length, green @ red) - np.pi / 2
    angle = excess * sure_red / certainty
    x = np.cos(angle) * across - np.sin(angle) * green
    y = np.cos(angle) * green + np.sin(angle) * across
    return np.stack([x, y, np.cross(x, y)], axis=1)
