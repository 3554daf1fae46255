"""What no protocol of a run asks for is not computed."""

import dataclasses
from collections import Counter

import numpy as np
import pytest

from pytest_cpas.evaluation import measuring
from pytest_cpas.facts import all_facts, catalogue, fact
from pytest_cpas.facts import measuring as facts_measuring
from pytest_cpas.protocols import facts_of, shipped_protocol, shipped_protocols
from pytest_cpas.types import (
    Camera,
    GroundTruth,
    Hypothesis,
    MethodInfo,
    Pose,
    Prediction,
    Symmetry,
)

PARTS = frozenset({"extents", "shape"})
INFO = MethodInfo(
    name="several",
    categories=("mug",),
    needs=frozenset(),
    gives=PARTS,
    licence="MIT",
    object_frame="shapenet",
)


@pytest.fixture
def computed(monkeypatch) -> Counter:
    """How often each fact was computed; of a batch once."""
    seen: Counter = Counter()

    def counting(name: str):
        made = fact(name)

        def compute(batch):
            seen[name] += 1
            return made.compute(batch)

        return dataclasses.replace(made, compute=compute)

    monkeypatch.setattr(facts_measuring, "fact", counting)
    return seen


def a_sample() -> tuple[GroundTruth, Prediction, Camera]:
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 3))
    truth = GroundTruth(
        pose=Pose(np.eye(3), (0, 0, 1)),
        extents=np.full(3, 0.2),
        symmetry=Symmetry.none(),
        surface=points,
    )
    hypothesis = Hypothesis(
        rotation=np.eye(3), translation=(0.01, 0, 1), extents=np.full(3, 0.2), points=points
    )
    return truth, Prediction((hypothesis, hypothesis)), Camera(640, 480, 500, 500, 320, 240)


@pytest.mark.parametrize("name", shipped_protocols())
def test_facts_of_a_protocol_and_no_others(name, computed):
    truth, prediction, camera = a_sample()
    protocol = shipped_protocol(name)
    names = facts_of(protocol.columns)
    [answer] = measuring.measure(names, [truth], [prediction], INFO, [camera])
    assert computed == dict.fromkeys(names, 1)
    assert set(answer.facts) == set(names)
    assert None not in answer.facts.values()


def test_surfaces_and_models_are_left_alone(monkeypatch):
    """What only other facts need: search trees, models, boxes, further hypotheses."""
    truth, prediction, camera = a_sample()

    def refuse(*args, **kwargs):
        raise AssertionError("not asked for")

    monkeypatch.setattr("pytest_cpas.facts.answers.surface_errors", refuse)
    monkeypatch.setattr("pytest_cpas.facts.answers._model", refuse)
    monkeypatch.setattr(catalogue, "symmetric_iou", refuse)
    converted = []
    monkeypatch.setattr(
        measuring, "to_standard", lambda given, info: converted.append(given) or given
    )
    measuring.measure(["position_m", "rotation_deg"], [truth], [prediction], INFO, [camera])
    assert len(converted) == 1
    measuring.measure(["best_10deg_2cm"], [truth], [prediction], INFO, [camera])
    assert len(converted) == 3
    for name in ("iou", "fscore_1cm", "add_m"):
        with pytest.raises(AssertionError, match="not asked for"):
            measuring.measure([name], [truth], [prediction], INFO, [camera])


def test_a_distance_of_models_is_computed_once(monkeypatch):
    """ADD-S over the diameter, ADD-S, and ADD(-S) of a symmetric object are one search."""
    from pytest_cpas.facts import known_objects

    truth, prediction, camera = a_sample()
    truth = dataclasses.replace(truth, symmetry=Symmetry.about((0, 1, 0)))
    calls = []
    add_s = known_objects.add_s
    monkeypatch.setattr(known_objects, "add_s", lambda *poses: calls.append(1) or add_s(*poses))
    names = [made.name for made in all_facts() if "adds" in made.name]
    assert len(names) == 4
    measuring.measure(names, [truth], [prediction], INFO, [camera])
    assert len(calls) == 1
