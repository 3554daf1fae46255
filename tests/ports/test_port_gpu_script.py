"""The script for a GPU, tried on a CPU: minutes with one are not to find its mistakes."""

import gpu
import numpy as np
import pytest
import torch

from pytest_cpas.types import Hypothesis, Prediction


@pytest.fixture(autouse=True)
def as_it_was():
    yield
    torch.use_deterministic_algorithms(False)
    torch.utils.deterministic.fill_uninitialized_memory = True
    torch.backends.cudnn.allow_tf32 = True


def tried(ports, *more):
    small = ("--batch=2", "--repeats=1", "--iterations=1", "--rotations=500")
    return gpu.main(["--device=cpu", f"--ports={ports}", *small, *more])


def test_asmnet(capsys, monkeypatch):
    monkeypatch.setitem(gpu.GOALS, ("asmnet", "predict", 2), 1e-3)
    assert tried("asmnet") == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert rows[-1][-2:] == ["failed:", "nothing"]
    timed = {" ".join(row[1:4]): row for row in rows if "batch" in row and "ms" in row[4:6]}
    assert {f"{what}, batch {n}" for what in ("network", "predict") for n in (1, 2)} == set(timed)
    assert timed["predict, batch 2"][-4:] == ["goal", "0.001", "ms", "missed"]
    assert [row[0] for row in rows].count("asmnet") == 7


@pytest.mark.minutes
@pytest.mark.parametrize("ports", ["sdfest,cass", "icaps"])
def test_others(ports):
    assert tried(ports) == 0


def test_what_differs_fails(capsys, monkeypatch):
    monkeypatch.setattr(gpu, "apart", lambda a, b: (0.1, 0.0))
    monkeypatch.setattr(gpu, "same", lambda a, b: False)
    monkeypatch.setattr(gpu, "CONTRACT", {})
    assert tried("asmnet") == 1
    told = capsys.readouterr().out.splitlines()[-1]
    assert told.endswith(
        "failed: asmnet: CPU and device, asmnet: batch of 2 and of 1, asmnet: same seed again"
    )


def test_answers_apart():
    def answer(angle, shift):
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0]])
        rotation = np.concatenate([turn, [[0, 0, 1]]])
        return Prediction((Hypothesis(rotation=rotation, translation=np.array([shift, 0, 1.0])),))

    found = gpu.apart([answer(0, 0), answer(0.1, 0)], [answer(0, 0.002), answer(0, 0)])
    assert found == pytest.approx((np.degrees(0.1), 2))
    assert gpu.apart([answer(0, 0)], [Prediction.failed("none")]) == (np.inf, np.inf)
    assert gpu.same([answer(0, 0)], [answer(0, 0)])
    assert not gpu.same([answer(0, 0)], [answer(0, 1e-12)])


def test_without_a_gpu(capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert gpu.main([]) == 2
    assert "sees no GPU: nothing was checked" in capsys.readouterr().out
