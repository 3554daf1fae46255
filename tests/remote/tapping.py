"""Methods that name what they do inside, for a worker and for this interpreter, Python 3.6 too."""

# ruff: noqa: RUF012 - as such methods are written
import numpy as np

try:
    from cpas_worker import draw, stage, tap
except ImportError:
    from pytest_cpas.adapting import draw, stage, tap


class Tapping(object):  # noqa: UP004 - as old code has it
    info = {
        "name": "tapping",
        "categories": ["bowl", "mug"],
        "needs": ["depth"],
        "gives": [],
        "licence": "MIT",
    }
    other = 0

    def load(self, assets, device):
        pass

    def predict(self, batch, seed):
        return [self.answer(seen, seed) for seen in batch]

    def answer(self, seen, seed):
        with stage("pre-processing"):
            depth = tap("input.depth", seen["depth"] * np.float32(2))
            generator = np.random.RandomState(seed + self.other)
            chosen = draw("chosen", generator.permutation(depth.size)[:10])
        with stage("network"):
            points = depth.ravel()[chosen] + chosen
            tap("features", {"points": points, "pair": (points[::2], points > 3)})
        return {"rotation": np.eye(3), "translation": [0.001 * points.mean(), 0, 0.8]}


class OtherSeed(Tapping):
    other = 1


class OtherInside(Tapping):
    def answer(self, seen, seed):
        return Tapping.answer(self, dict(seen, depth=seen["depth"] + np.float32(0.1)), seed)


class TooMany(Tapping):
    def answer(self, seen, seed):
        for _ in range(9000):
            tap("x", np.zeros(1))
        return Tapping.answer(self, seen, seed)
