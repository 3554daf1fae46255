"""What taps in a worker, in this interpreter; with another generator."""

from tapping import OtherSeed, Tapping

from pytest_cpas.types import Hypothesis, MethodInfo, Prediction


class Here(OtherSeed):
    info = MethodInfo(**Tapping.info)

    def predict(self, batch, seed):
        answers = [self.answer({"depth": seen.depth}, seed) for seen in batch]
        return [Prediction((Hypothesis(**answer),)) for answer in answers]
