"""What a contract check finds does not depend on the checks that ran before it."""

from __future__ import annotations

import random

import pytest
from method_faults import FAULTS
from planted import Planted, Scenes

from pytest_cpas.checks.contract import CONTRACT, MethodSubject, check_contract
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.session.contract_stage import smoke_samples

#: Faults that leave something behind: in the method, in what it is given, in global states.
LEAVING = (
    "seeds numpy's global generator",
    "smoothed over time",
    "the previous answer where there is none",
    "the first sample's category for all",
    "drifts with the number of samples",
    "answers kept by the mask",
    "millimetres made in place",
    "mask eroded in place",
    "batch norm in training mode",
    "empty batch raises",
    "raises without depth",
)
METHODS = {"sound": Planted} | {f.name: f.make for f in FAULTS if f.name in LEAVING}


@pytest.fixture(scope="module")
def samples():
    return smoke_samples(MethodRun(Planted(), Scenes()))


def subject(make, samples):
    def fresh():
        method = make()
        method.load(None, "cpu")
        return method

    return MethodSubject(fresh(), samples, fresh=fresh)


def found(subject, name):
    result = check_contract(subject, CONTRACT[name])
    return result.outcome, result.message


@pytest.mark.parametrize("name", METHODS)
def test_every_order_finds_what_each_check_finds_alone(name, samples):
    assert METHODS.keys() == {"sound", *LEAVING}
    make = METHODS[name]
    alone = {check: found(subject(make, samples), check) for check in CONTRACT}
    # the sound icp takes long, and has nothing to leave behind
    for seed in range(20 if name != "sound" else 3):
        order = list(CONTRACT)
        random.Random(seed).shuffle(order)
        shared = subject(make, samples)
        assert {check: found(shared, check) for check in order} == alone, order


class WritesLate(Planted):
    """Writes into a batch of several observations only."""

    def predict(self, batch, seed):
        answers = super().predict(batch, seed)
        if len(batch) > 1:
            batch[0].depth[:] = 0
        return answers


def test_what_the_calls_of_one_check_changed_is_not_held_against_another(samples):
    shared = subject(WritesLate, samples)
    for check in ("batch", "inputs_unmodified", "global_random_state_untouched"):
        assert found(shared, check) == found(subject(WritesLate, samples), check)


def test_a_method_that_cannot_be_made_again_is_judged_as_it_is(samples):
    drifts = METHODS["drifts with the number of samples"]
    method = drifts()
    method.load(None, "cpu")
    shared = MethodSubject(method, samples)
    assert check_contract(shared, CONTRACT["order"]).violated

    def gone():
        raise FileNotFoundError("weights.pth was moved")

    method = drifts()
    method.load(None, "cpu")
    assert check_contract(MethodSubject(method, samples, fresh=gone), CONTRACT["order"]).violated
