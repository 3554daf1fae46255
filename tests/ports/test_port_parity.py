"""Every port against a recorded trace of itself, and the stage at which planted faults are."""

import itertools
import timeit

import cases
import further_faults
import numpy as np
import parity_cases
import pytest

from pytest_cpas.stages import TorchTaps, hearing, tap
from pytest_cpas.traces.comparing import compare
from pytest_cpas.traces.parity import ParityWord, SampleParity, judge_parity
from pytest_cpas.traces.recording import Recorder

FAULTS = [
    pytest.param(*fault, id=f"{family}-{fault[0]}-{fault[1]}")
    for family, faults in parity_cases.FAULTS.items()
    for fault in faults
]


def verdict(own, theirs):
    return judge_parity([SampleParity.of("case", compare(own, theirs))], "the reference")


#: iCaps takes its time.
NAMES = [
    pytest.param(name, marks=pytest.mark.minutes) if name == "icaps" else name
    for name in parity_cases.NAMES
]


@pytest.mark.parametrize("name", NAMES)
def test_port_is_as_recorded(name):
    found = verdict(parity_cases.trace(name), parity_cases.recorded(name).trace)
    assert found.word in (ParityWord.EXACT, ParityWord.FLOAT_NOISE), str(found)
    # every value of the trace is still named
    assert "named by the reference alone" not in found.details, str(found)


def test_thirty_faults():
    assert [len(faults) for faults in parity_cases.FAULTS.values()] == [10, 10, 10]
    faults = itertools.chain.from_iterable(parity_cases.FAULTS.values())
    assert {fault[0] for fault in faults} == set(parity_cases.NAMES)


def test_idle_taps_cost_less_than_a_hundredth(monkeypatch):
    """The quickest of the networks; of the others it is less."""
    heard = Recorder()
    method, seen = parity_cases.method("asmnet"), parity_cases.observation("asmnet")
    monkeypatch.setattr(TorchTaps, "__enter__", lambda self: tap("entered", np.zeros(1)))
    with hearing(heard):
        method.predict([seen], 0)
    monkeypatch.undo()
    names = [value.name for value in heard.values]
    assert names.count("entered") == 1
    idle = min(timeit.repeat(lambda: tap("x", names), number=1000, repeat=5)) / 1000
    entering = min(timeit.repeat(TorchTaps(None).__enter__, number=1000, repeat=5)) / 1000
    takes = min(timeit.repeat(lambda: method.predict([seen], 0), number=1, repeat=3))
    assert len(names) * idle + entering < 0.01 * takes


@pytest.mark.minutes
@pytest.mark.parametrize(("name", "fault", "plant", "place"), FAULTS)
def test_fault_is_located(monkeypatch, name, fault, plant, place):
    theirs = parity_cases.reference(name)
    plant(monkeypatch.setattr)
    first = str(verdict(parity_cases.trace(name), theirs)).partition("\n")[0]
    assert first.startswith(f"PARTS AT {place}: "), first


@pytest.mark.minutes
@pytest.mark.parametrize(
    ("name", "plant", "place", "words"),
    [pytest.param(*fault, id=f"{fault[0]}-{fault[1].__name__}") for fault in further_faults.FAULTS],
)
def test_further_fault_is_located(monkeypatch, name, plant, place, words):
    """And explained, where it can be."""
    theirs = parity_cases.reference(name)
    plant(monkeypatch.setattr)
    told = str(verdict(parity_cases.trace(name), theirs))
    assert told.startswith(f"PARTS AT {place}: "), told
    explained = [line.strip() for line in told.splitlines() if "explained by" in line]
    assert any(words in line for line in explained) if words else not explained, told


def test_fault_is_located_by_the_recorded_trace(monkeypatch):
    """Thinned as that is."""
    cases.network("spd")
    parity_cases.aligned_corners(monkeypatch.setattr)
    found = verdict(parity_cases.trace("spd"), parity_cases.recorded("spd").trace)
    assert str(found).startswith("PARTS AT network.resized: ")
