"""The spread of a method's values, measured on the method itself."""

import math

import numpy as np
import torch
from torch import nn

from pytest_cpas.stages import TorchTaps, tap
from pytest_cpas.traces.files import Header, read_sample, samples_in, write_sample
from pytest_cpas.traces.recording import record
from pytest_cpas.traces.spread import other_threads, touched, with_spread
from pytest_cpas.types import Camera, Hypothesis, MethodInfo, Observation, Prediction

RANDOM = np.random.default_rng(0)
SEEN = Observation(
    category="mug",
    rgb=RANDOM.uniform(0, 1, (12, 16, 3)).astype(np.float32),
    depth=RANDOM.uniform(0.5, 1, (12, 16)).astype(np.float32),
    mask=np.ones((12, 16), bool),
    camera=Camera(16, 12, 20.0, 20.0, 7.5, 5.5),
)


class Method:
    """A network on the depth; ``choice``: of what index a choice is made."""

    info = MethodInfo(name="m", categories=("mug",), needs=(), gives=(), licence="MIT")

    def __init__(self, choice=None):
        torch.manual_seed(0)
        self.network, self.choice = nn.Sequential(nn.Linear(192, 300), nn.Tanh()), choice

    def predict(self, batch, seed):
        depths = np.stack([seen.depth.ravel() for seen in batch])
        with TorchTaps(self.network), torch.inference_mode():
            y = self.network(torch.from_numpy(depths))
        if self.choice is not None:
            tap("chosen", self.choice(y))
            tap("after", y)
        turn = Hypothesis(rotation=np.eye(3), translation=[0, 0, 1])
        return [Prediction((turn,)) for _ in batch]


def measured(**keywords):
    method = Method(**keywords)
    made, told = with_spread(method, SEEN, 0, record(method, [SEEN], 0))
    return {value.name: value.spread for value in made.values}, told, made


def test_every_condition_is_measured():
    spread, told, _ = measured()
    assert set(told) == {"threads", "batch", "noise", "float64"}
    assert all(0 <= float(size) < 1e-5 for size in told.values())
    assert min(float(told["noise"]), float(told["float64"])) > 0
    assert 0 < spread["network"] < 1e-5
    assert spread["observation.depth"] is None
    assert spread["answer.translation"] == 0


def test_choice_that_touched_inputs_change_ends_what_they_measure():
    spread, told, _ = measured(choice=lambda y: int(np.float64(y.sum()).view(np.int64)))
    assert "before chosen, where another choice is made" in told["noise"]
    assert spread["chosen"] is None or math.isinf(spread["chosen"])


def test_choice_that_threads_change_leaves_the_rest_open(tmp_path):
    spread, told, made = measured(choice=lambda y: torch.get_num_threads())
    assert told["threads"].endswith(
        "before chosen, where another choice is made, so that nothing is compared from there on"
    )
    assert spread["chosen"] == spread["after"] == spread["answer.rotation"] == math.inf
    assert spread["network"] < 1e-5
    header = Header(method="m", dataset="d", sample="s", category="mug", seed=0)
    write_sample(tmp_path, header, made)
    read = read_sample(samples_in(tmp_path)["s"]).trace
    assert {value.name: value.spread for value in read.values} == spread


def test_what_touches_is_no_more_than_rounding():
    other = touched(SEEN, 0)
    for part in ("depth", "rgb"):
        before, after = getattr(SEEN, part), getattr(other, part)
        assert not np.array_equal(before, after)
        np.testing.assert_allclose(after, before, rtol=3e-7)


def test_threads_are_put_back():
    before = torch.get_num_threads()
    with other_threads():
        assert torch.get_num_threads() != before
    assert torch.get_num_threads() == before
