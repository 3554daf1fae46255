"""Objects of several sizes, and methods whose boxes are wrong; copied beside the run of them.

All else of what they answer is right: nothing but the IoU shows it.
"""

from dataclasses import replace

import numpy as np
from tiny import COUNT, EXTENTS, Perfect, Tiny, truth

from pytest_cpas.types import GroundTruth, Prediction, Sample, SampleRef

#: Of each object, metres.
SIZES = EXTENTS * np.random.default_rng(0).uniform(0.6, 1.6, (COUNT, 3))

#: How much too large the boxes of a method that is as good as it was are.
USUAL = np.linspace(0.96, 1.06, COUNT)


class Sizes(Tiny):
    name = "sizes"
    digest = "sizes-1"

    def load(self, ref: SampleRef) -> Sample:
        sample = super().load(ref)
        index = int(ref.id.split("/")[1])
        return replace(sample, truth=sized(index, SIZES[index]))


def sized(index: int, size: np.ndarray) -> GroundTruth:
    return replace(truth(index), extents=size)


class Usual(Perfect):
    info = replace(Perfect.info, name="boxed")

    def answer(self, index: int) -> Prediction:
        (best,) = super().answer(index).hypotheses
        return Prediction((replace(best, extents=self.size(index)),))

    def size(self, index: int) -> np.ndarray:
        return SIZES[index] * USUAL[index]


class Larger(Usual):
    def size(self, index: int) -> np.ndarray:
        return 1.08 * super().size(index)


class Thrice(Usual):
    def size(self, index: int) -> np.ndarray:
        return 3 * super().size(index)


class Tiniest(Usual):
    def size(self, index: int) -> np.ndarray:
        return 1e-3 * super().size(index)


class Shuffled(Usual):
    def size(self, index: int) -> np.ndarray:
        return super().size((index + 2) % COUNT)


class Mean(Usual):
    def size(self, index: int) -> np.ndarray:
        return np.mean([super(Mean, self).size(i) for i in range(index % 2, COUNT, 2)], axis=0)
