"""What SPD, CR-Net, SGPA and DPDN share as methods."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from method_adapters._assets import MEAN_SHAPES, asset_path, load_priors, require_torch
from method_adapters._crop import (
    NoAnswerError,
    back_project,
    crop_of,
    depth_pixels,
    feature_index,
    network_image,
    subset_in_order,
)
from method_adapters._similarity import robust_umeyama
from pytest_cpas.types import CATEGORIES, Asset, Hypothesis, MethodInfo, Observation, Prediction

if TYPE_CHECKING:
    from torch import nn

require_torch()

Array = NDArray[np.float64]

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


def method_info(name: str, weights: Asset, licence: str) -> MethodInfo:
    """The declaration of a method that deforms the shared priors."""
    return MethodInfo(
        name=name,
        categories=CATEGORIES,
        needs=frozenset({"rgb", "depth"}),
        gives=frozenset({"extents", "shape"}),
        licence=licence,
        object_frame="nocs",
        assets=(weights, MEAN_SHAPES),
    )


class PriorMethod(ABC):
    """A :class:`pytest_cpas.types.Method`: crop, network, pose.

    A batch goes through the network together. Every observation has a generator of its own made
    from the seed, so that it gets the same points in any batch.
    """

    info: ClassVar[MethodInfo]
    #: Parts of the checkpoint that the network does not have.
    unused: ClassVar[tuple[str, ...]] = ()

    @staticmethod
    @abstractmethod
    def network() -> nn.Module:
        """The network, not yet filled; torch is imported here."""

    @abstractmethod
    def interpret(
        self, inputs: Inputs, outputs: tuple[Array, ...], generator: np.random.Generator
    ) -> Hypothesis:
        """The answer from one sample's inputs and outputs; raises :class:`NoAnswerError`."""

    def load(self, assets: Path | None, device: str) -> None:
        """Read weights and priors below the folder ``assets``.

        Raises FileNotFoundError, :class:`method_adapters._assets.AssetError`, or ValueError for a
        device that is not there.
        """
        from method_adapters._networks.running import Runner, load_weights

        network = self.network()
        load_weights(network, asset_path(assets, self.info.assets[0]), self.unused)
        self._priors = load_priors(assets)
        self._run = Runner(network, device)

    def predict(self, batch: Sequence[Observation], seed: int) -> list[Prediction]:
        """One prediction per observation."""
        generators = [np.random.default_rng(seed) for _ in batch]
        predictions: dict[int, Prediction] = {}
        inputs: dict[int, Inputs] = {}
        for i, observation in enumerate(batch):
            try:
                inputs[i] = self.prepare(observation, generators[i])
            except NoAnswerError as error:
                predictions[i] = Prediction.failed(str(error))
        if inputs:
            stacked = [np.stack(part) for part in zip(*inputs.values(), strict=True)]
            outputs = self._run(*stacked)
            for row, (i, given) in enumerate(inputs.items()):
                try:
                    found = self.interpret(given, tuple(x[row] for x in outputs), generators[i])
                    predictions[i] = Prediction((found,))
                except NoAnswerError as error:
                    predictions[i] = Prediction.failed(str(error))
        return [predictions[i] for i in range(len(batch))]

    def prepare(self, observation: Observation, generator: np.random.Generator) -> Inputs:
        """What the network sees of an observation; raises :class:`NoAnswerError`."""
        if observation.category not in CATEGORIES:
            raise NoAnswerError(
                f"category {observation.category!r}: {self.info.name} knows {', '.join(CATEGORIES)}"
            )
        category = CATEGORIES.index(observation.category)
        crop = crop_of(observation.mask)
        rows, columns = depth_pixels(observation.mask, observation.depth, crop)
        picked = self.pick(len(rows), generator)
        rows, columns = rows[picked], columns[picked]
        depth = self.depth_of(observation)
        return Inputs(
            back_project(rows, columns, depth, crop, observation.camera),
            network_image(observation.rgb, crop),
            feature_index(rows, columns, crop),
            np.array(category),
            self._priors[category],
        )

    def pick(self, count: int, generator: np.random.Generator) -> NDArray[np.int64]:
        """Which of ``count`` pixels are used."""
        return subset_in_order(count, generator)

    def depth_of(self, observation: Observation) -> NDArray[np.float32]:
        """The depth image that points are taken from."""
        return observation.depth


def pose_from_assignment(
    inputs: Inputs, assign: Array, deltas: Array, generator: np.random.Generator
) -> Hypothesis:
    """SPD's, CR-Net's and SGPA's answer: a similarity from the coordinates that the assignment
    (N, M) gives the observed points to the points themselves (section 3.4 of SPD's paper)."""
    shape = inputs.prior + deltas
    share = np.exp(assign - assign.max(axis=1, keepdims=True))
    coordinates = share @ shape / share.sum(axis=1, keepdims=True)
    _, distinct = np.unique(inputs.choose, return_index=True)
    found = robust_umeyama(coordinates[distinct], inputs.points[distinct].astype(float), generator)
    points = shape * found.scale
    translation = found.translation
    if CATEGORIES[int(inputs.category)] == "mug":
        offset = np.array([MUG_OFFSET * float(found.scale), 0, 0])
        points = points - offset
        translation = translation + found.rotation @ offset
    return Hypothesis(found.rotation, translation, 2 * np.abs(points).max(axis=0), points=points)
