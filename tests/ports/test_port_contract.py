"""CASS and RBP-Pose keep what their declarations demand."""

import cases
import numpy as np
import plausible
import pytest

from method_adapters._networks.running import Runner
from pytest_cpas.checks.contract import CONTRACT, MethodSubject, check_contract
from pytest_cpas.types import GroundTruth, Pose, Sample, SampleRef, Symmetry

#: All of them together.
pytestmark = pytest.mark.minutes


def loaded(name):
    method, network = cases.METHODS[name](), cases.METHODS[name].network()
    network.load_state_dict(plausible.weights(name))
    method._priors = plausible.priors().astype(np.float32)
    method._run = Runner(network, "cpu")
    return method


@pytest.fixture(scope="module", params=["cass", "rbppose"])
def subject(request):
    truth = GroundTruth(
        pose=Pose(np.eye(3), np.array([0, 0, 0.8])),
        extents=np.full(3, 0.1),
        symmetry=Symmetry.full(),
    )
    seen = [cases.observation("mug", (300, 200), 32), cases.observation("bowl", (200, 300), 36)]
    samples = [
        Sample(SampleRef(id=str(i), category=each.category, scene="0"), each, truth)
        for i, each in enumerate(seen)
    ]
    return MethodSubject(
        loaded(request.param), samples, seed=1, fresh=lambda: loaded(request.param)
    )


@pytest.mark.parametrize("name", CONTRACT)
def test_contract(subject, name):
    check = CONTRACT[name]
    if check.demanded(subject.info) and check.applies(subject.info):
        result = check_contract(subject, check)
        assert result.outcome == "passed", result.message
