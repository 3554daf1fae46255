"""What the ports ask of a GPU, told from what they run on a CPU in the GPU's way."""

import device_cases
import device_operators
import parity_cases
import pytest
import torch

from method_adapters._networks import heads

#: Looks at a value in a prediction of one object; of the rest none. Of those of iCaps, with two
#: steps a round, six are Adam's, which counts on the host.
WAITS = {"sdfest": 2, "icaps": 16}
#: iCaps takes its time.
NAMES = [
    pytest.param(name, marks=pytest.mark.minutes) if name == "icaps" else name
    for name in parity_cases.NAMES
]


@pytest.fixture
def device(monkeypatch):
    for name in parity_cases.NAMES:
        if name != "icaps":
            parity_cases.method(name)  # made before, and imported
    with device_cases.as_on_a_device(monkeypatch.setattr):
        yield


@pytest.mark.parametrize("name", NAMES)
def test_operators_are_known_to_run_on_cuda(device, name):
    ran = device_operators.ran(name)
    assert device_operators.unknown(ran.seen, device_operators.read()) == []
    assert ran.waits == WAITS.get(name, 0)


def test_list_has_nothing_that_cuda_refuses():
    listed = device_operators.read()
    assert len(listed) > 100
    assert device_operators.refused(listed) == []
    assert device_operators.refused({"mm": {"float32", "int64"}}) == [
        "mm of int64: for floating types alone"
    ]
    assert device_operators.refused({"mkldnn_linear": {"float32"}}) == [
        "mkldnn_linear: torch has it not for CUDA"
    ]


def test_planted_product_of_integers_is_found(device, monkeypatch):
    real = heads.at_pixels

    def fault(feature_map, choose):
        strides = torch.ones(choose.shape[1], 1, dtype=choose.dtype)
        return real(feature_map, choose) + 0 * (choose @ strides)[..., None]

    monkeypatch.setattr("method_adapters._networks.spd.at_pixels", fault)
    ran = device_operators.ran("spd")
    found = device_operators.unknown(ran.seen, device_operators.read())
    assert "matmul of int64" in found or "mm of int64" in found, found


def test_planted_look_at_a_value_is_counted(device, monkeypatch):
    real = heads.at_pixels

    def fault(feature_map, choose):
        return real(feature_map, choose) * bool(choose.any())

    monkeypatch.setattr("method_adapters._networks.spd.at_pixels", fault)
    assert device_operators.ran("spd").waits == 1
