"""What SPD, CR-Net, SGPA and DPDN share as methods."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from method_adapters._assets import load_priors
from method_adapters._crop import (
    NoAnswerError,
    back_project,
    crop_of,
    depth_pixels,
    feature_index,
    network_image,
    subset_in_order,
)
from method_adapters._network_method import Array, NetworkMethod
from pytest_cpas.adapting import (
    CATEGORIES,
    Hypothesis,
    NoSimilarityError,
    Observation,
    draw,
    robust_umeyama,
    tap,
)

if TYPE_CHECKING:
    from torch import Tensor

#: x of the middle of the mug's mean shape, NOCS units: its handle pulls it off the origin.
MUG_OFFSET = 0.08943803608


class Inputs(NamedTuple):
    """What the networks take for one observation; see
    :meth:`method_adapters._networks.spd.SpdNet.forward`."""

    points: NDArray[np.float32]
    image: NDArray[np.float32]
    choose: NDArray[np.int64]
    category: NDArray[np.int64]
    prior: NDArray[np.float32]


class PriorMethod(NetworkMethod[Inputs]):
    """Crop, network with the category's prior, pose."""

    def load(self, assets: Path | None, device: str) -> None:
        """As :meth:`NetworkMethod.load`, and the priors."""
        super().load(assets, device)
        self._priors = load_priors(assets)

    def prepare(self, observation: Observation, generator: np.random.Generator) -> Inputs:
        """What the network sees of an observation; raises :class:`NoAnswerError`."""
        category = self.category_index(observation)
        crop = crop_of(observation.mask)
        tap("crop", crop.limits)
        rows, columns = depth_pixels(observation.mask, observation.depth, crop)
        picked = draw("picked", self.pick(len(rows), generator))
        rows, columns = rows[picked], columns[picked]
        depth = tap("depth", self.depth_of(observation))
        return Inputs(
            back_project(rows + crop.row, columns + crop.column, depth, observation.camera),
            network_image(observation.rgb, crop),
            feature_index(rows, columns, crop),
            np.array(category),
            self._priors[category],
        )

    def essence(self, inputs: Sequence[Tensor], outputs: Sequence[Tensor]) -> Sequence[Tensor]:
        """Coordinates and deformation, from the last two outputs, assignment and deformation."""
        from method_adapters._networks.heads import assigned

        *_, assign, deltas = outputs
        return assigned(assign, inputs[-1], deltas), deltas

    def interpret(
        self, inputs: Inputs, outputs: tuple[Array, ...], generator: np.random.Generator
    ) -> Hypothesis:
        """From coordinates and deformation."""
        coordinates, deltas = outputs
        return pose_from_coordinates(inputs, coordinates, deltas, generator)

    def pick(self, count: int, generator: np.random.Generator) -> NDArray[np.int64]:
        """Which of ``count`` pixels are used."""
        return subset_in_order(count, generator)

    def depth_of(self, observation: Observation) -> NDArray[np.float32]:
        """The depth image that points are taken from."""
        return observation.depth


def pose_from_coordinates(
    inputs: Inputs, coordinates: Array, deltas: Array, generator: np.random.Generator
) -> Hypothesis:
    """SPD's, CR-Net's and SGPA's answer: a similarity from the coordinates (N, 3) that the network
    gives the observed points to the points themselves (section 3.4 of SPD's paper)."""
    shape = tap("shape", inputs.prior + deltas)
    tap("coordinates", coordinates)
    _, distinct = np.unique(inputs.choose, return_index=True)
    try:
        found = robust_umeyama(
            coordinates[distinct], inputs.points[distinct].astype(float), generator
        )
    except NoSimilarityError as error:
        raise NoAnswerError(str(error)) from None
    tap("similarity", {name: getattr(found, name) for name in ("scale", "rotation", "translation")})
    offset = prior_offset(int(inputs.category), float(found.scale))
    points = shape * found.scale - offset
    translation = found.translation + found.rotation @ offset
    return Hypothesis(
        rotation=found.rotation,
        translation=translation,
        extents=2 * np.abs(points).max(axis=0),
        points=points,
    )


def prior_offset(category: int, scale: float) -> Array:
    """How far (3,) the middle of a prior of size ``scale`` is taken to be from its origin: the
    other categories' are up to 0.0075 off and are left."""
    return np.array([MUG_OFFSET * scale if CATEGORIES[category] == "mug" else 0.0, 0.0, 0.0])
