"""What the methods that are one network have in common: crop, network, pose."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from method_adapters._assets import Needy
from method_adapters._crop import NoAnswerError
from pytest_cpas.adapting import Hypothesis, MethodInfo, Observation, Prediction, stage, tap

if TYPE_CHECKING:
    from torch import Tensor, nn

Array = NDArray[np.float64]

#: A named tuple of arrays: what the network takes for one observation, without the batch axis.
InputsT = TypeVar("InputsT", bound=tuple[NDArray[Any], ...])


class NetworkMethod(Needy, ABC, Generic[InputsT]):
    """A :class:`pytest_cpas.types.Method` with one network.

    What can be stacked goes through the network together. Every observation has a generator of
    its own made from the seed, so that it gets the same random choices in any batch.
    """

    info: ClassVar[MethodInfo]
    #: Parts of the checkpoint that the network does not have.
    unused: ClassVar[tuple[str, ...]] = ()

    @staticmethod
    @abstractmethod
    def network() -> nn.Module:
        """The network, not yet filled; torch is imported here."""

    @abstractmethod
    def prepare(self, observation: Observation, generator: np.random.Generator) -> InputsT:
        """What the network sees of an observation; raises :class:`NoAnswerError`."""

    def essence(self, inputs: Sequence[Tensor], outputs: Sequence[Tensor]) -> Sequence[Tensor]:
        """What :meth:`interpret` takes of a batch, made of the network's inputs and outputs where
        these are."""
        return outputs

    @abstractmethod
    def interpret(
        self, inputs: InputsT, outputs: tuple[Array, ...], generator: np.random.Generator
    ) -> Hypothesis:
        """The answer from one sample's inputs and the essence of its outputs; raises
        :class:`NoAnswerError`."""

    def load(self, assets: Path | None, device: str) -> None:
        """Read the weights, the first of the assets, below the folder ``assets``.

        Raises FileNotFoundError, :class:`method_adapters._assets.AssetError`, or ValueError for a
        device that is not there.
        """
        from method_adapters._networks.running import Runner, load_weights

        network = self.network()
        load_weights(network, self.info.assets[0].locate(assets), self.unused)
        self._run = Runner(network, device)

    def predict(self, batch: Sequence[Observation], seed: int) -> list[Prediction]:
        """One prediction per observation."""
        from method_adapters._networks.running import arrays

        generators = [np.random.default_rng(seed) for _ in batch]
        predictions: dict[int, Prediction] = {}
        inputs: dict[int, InputsT] = {}
        alike: dict[tuple[Any, ...], list[int]] = defaultdict(list)
        with stage("pre-processing"):
            for i, observation in enumerate(batch):
                try:
                    inputs[i] = tap("input", self.prepare(observation, generators[i]))
                    alike[tuple(part.shape for part in inputs[i])].append(i)
                except NoAnswerError as error:
                    predictions[i] = Prediction.failed(str(error))
        for group in alike.values():
            with stage("network"):
                stacked = [np.stack(part) for part in zip(*(inputs[i] for i in group), strict=True)]
                given, raw = self._run.on_device(*stacked)
            with stage("post-processing"):
                outputs = arrays(self.essence(given, raw))
                for row, i in enumerate(group):
                    output = tuple(x[row] for x in outputs)
                    try:
                        found = self.interpret(inputs[i], output, generators[i])
                        predictions[i] = Prediction((found,))
                    except NoAnswerError as error:
                        predictions[i] = Prediction.failed(str(error))
        return [predictions[i] for i in range(len(batch))]

    def category_index(self, observation: Observation) -> int:
        """Where the network has the observation's category; raises :class:`NoAnswerError`."""
        known = self.info.categories
        if observation.category not in known:
            raise NoAnswerError(
                f"category {observation.category!r}: {self.info.name} knows {', '.join(known)}"
            )
        return known.index(observation.category)
