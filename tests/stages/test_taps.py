"""Stages, taps and draws, and who hears of them."""

import timeit

import numpy as np
import pytest
import torch
from torch import nn

from pytest_cpas.stages import StageClock, TorchTaps, draw, hearing, listening, stage, tap


class Ear:
    """Hears of everything."""

    def __init__(self, wide=False, other=None):
        self.wide, self.other = wide, other
        self.heard, self.widened_parts, self.replay = [], {}, {}

    def tapped(self, name, value):
        self.heard.append((name, value))

    def drawn(self, name, value):
        self.heard.append((name, value))
        return value if self.other is None else self.other

    def widened(self, name, problem):
        self.widened_parts[name] = problem


class Net(nn.Module):
    def __init__(self):
        super().__init__()
        self.first, self.act = nn.Linear(3, 4), nn.ReLU(inplace=True)
        self.block = nn.Sequential(nn.Linear(4, 4), nn.Tanh())

    def forward(self, x, scale=1.0):
        y = self.block(self.act(self.first(x)))
        return y * scale, y.argmax(1)


def test_nobody_hears():
    value = np.ones(3)
    assert tap("x", value) is value
    assert draw("x", value) is value
    with stage("network"), TorchTaps(Net()) as taps:
        assert taps._undo is None


def test_values_are_heard_and_draws_replaced():
    ear = Ear(other="theirs")
    with hearing(ear):
        assert tap("x", 1) == 1
        assert draw("y", 2) == "theirs"
        with hearing(None):
            tap("z", 3)
    tap("after", 4)
    assert ear.heard == [("x", 1), ("y", 2)]


def test_one_listens_to_stages():
    clock = StageClock(lambda: 0.0, lambda: None)
    with listening(clock):
        with stage("network"):
            pass
        with pytest.raises(RuntimeError, match="timed already"), clock.listening():
            pass
    assert clock.seconds == {"network": 0.0}


@pytest.mark.parametrize(
    ("patterns", "expected"),
    [
        ({}, ["n.first", "n.act", "n.block.0", "n.block.1", "n.block", "n"]),
        ({"include": ["block*"]}, ["n.block.0", "n.block.1", "n.block"]),
        ({"include": [""]}, ["n"]),
        ({"exclude": ["", "*.?"]}, ["n.first", "n.act", "n.block"]),
    ],
)
def test_submodules_are_tapped_in_the_order_in_which_they_end(patterns, expected):
    ear, net = Ear(), Net()
    with hearing(ear), TorchTaps(net, "n", **patterns):
        net(torch.ones(2, 3))
    net(torch.ones(2, 3))  # no hook is left
    assert [name for name, _ in ear.heard] == expected


def test_networks_compute_in_float64_for_a_while():
    ear, net = Ear(wide=True), Net()
    before = {key: value.clone() for key, value in net.state_dict().items()}
    with hearing(ear), TorchTaps(net):
        y, index = net(torch.ones(2, 3), scale=torch.tensor(2.0))
    assert (y.dtype, index.dtype) == (torch.float64, torch.int64)
    assert ear.widened_parts == {"network": ""}
    assert net(torch.ones(2, 3))[0].dtype == torch.float32
    assert all(torch.equal(value, before[key]) for key, value in net.state_dict().items())


def test_what_cannot_be_widened_is_told():
    ear, net = Ear(wide=True), Net().half()
    with hearing(ear), TorchTaps(net):
        pass
    assert ear.widened_parts == {"network": "it holds torch.float16, not torch.float32 alone"}
    assert net.first.weight.dtype == torch.float16


def test_hooks_go_when_the_network_fails():
    ear, net = Ear(wide=True), Net()
    with pytest.raises(RuntimeError), hearing(ear), TorchTaps(net):
        net(torch.ones(2, 5))
    assert not net.first._forward_hooks
    assert net.first.weight.dtype == torch.float32


def test_an_idle_tap_costs_next_to_nothing():
    """Of 200 of them in a network of 20 ms this is less than 1 %."""
    value, net = np.ones(3), Net()
    with_taps = min(timeit.repeat(lambda: tap("x", value), number=1000, repeat=5)) / 1000
    of_network = (
        min(timeit.repeat(lambda: TorchTaps(net).__enter__(), number=1000, repeat=5)) / 1000
    )
    assert with_taps < 1e-6
    assert of_network < 1e-5
