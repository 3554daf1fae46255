"""Facts of answers: named, known only where there is something to know, the same one by one."""

import math
from dataclasses import replace

import numpy as np
import pytest
import tiny

from pytest_cpas.facts import FactError, all_facts, fact, failed_facts, in_order, measure_facts
from pytest_cpas.metrics.definitions import definition
from pytest_cpas.types import AnswerError

NAMES = tuple(made.name for made in all_facts())
EVERYTHING = ("extents", "shape")


def answers(count: int = 6):
    """Truths, of both symmetries in turn, and estimates that are all a little off."""
    truths = [tiny.truth(index) for index in range(count)]
    rng = np.random.default_rng(0)
    estimates = []
    for index in range(count):
        (best,) = tiny.Biased().answer(index).hypotheses
        moved = best.translation + 0.01 * rng.random(3)
        estimates.append(replace(best, translation=moved, extents=1.1 * best.extents))
    return truths, estimates


def test_batch_is_as_one_by_one():
    truths, estimates = answers()
    together = measure_facts(NAMES, truths, estimates, EVERYTHING)
    for truth, estimate, facts in zip(truths, estimates, together, strict=True):
        assert list(facts) == list(NAMES)
        (alone,) = measure_facts(NAMES, [truth], [estimate], EVERYTHING)
        assert facts == pytest.approx(alone, rel=1e-9)
        assert all(value is not None and math.isfinite(value) for value in facts.values())


def test_known_values():
    truths, estimates = answers()
    for index, facts in enumerate(measure_facts(NAMES, truths, estimates, EVERYTHING)):
        moved = np.linalg.norm(estimates[index].translation - truths[index].pose.translation)
        assert facts["position_m"] == pytest.approx(moved)
        assert facts["rotation_deg"] == pytest.approx(7.0 if index % 2 else 0.0, abs=1e-6)
        assert facts["iou"] < 1 / 1.1**3 + 1e-9


def test_what_a_method_does_not_give_is_not_known():
    truths, estimates = answers(2)
    (facts, _) = measure_facts(NAMES, truths, estimates, ())
    for name, value in facts.items():
        assert (value is None) == bool(fact(name).needs)
    without = [replace(truth, surface=None) for truth in truths]
    (facts, _) = measure_facts(NAMES, without, estimates, EVERYTHING)
    for name, value in facts.items():
        assert (value is None) == ("shape" in fact(name).needs)
    lacking = [replace(estimate, extents=None) for estimate in estimates]
    with pytest.raises(AnswerError, match=r"extents is None, but info\.gives has 'extents'"):
        measure_facts(["iou"], truths, lacking, EVERYTHING)
    assert measure_facts(["rotation_deg"], truths, lacking, EVERYTHING)


def test_failed_answer_meets_no_limit():
    truth = tiny.truth(0)
    for name, value in failed_facts(NAMES, truth, EVERYTHING).items():
        made = fact(name)
        assert not made.meets(np.array([value]), 0.0 if made.better == "higher" else 1e300)[0]
    shapeless = failed_facts(NAMES, replace(truth, surface=None), EVERYTHING)
    assert {name for name in NAMES if shapeless[name] is None} == {
        name for name in NAMES if "shape" in fact(name).needs
    }


def test_names_and_definitions():
    for made in all_facts():
        assert fact(made.name).definition == made.definition
    assert fact("fscore_1cm").definition == fact("fscore_10mm").definition
    assert fact("fscore_5mm").definition != fact("fscore_1cm").definition
    assert fact("rotation_deg").definition == definition("rotation_error", "symmetry-group").id()
    for name in ("fscore", "fscore_0cm", "fscore_1km", "fscore_1cm ", "Iou", ""):
        with pytest.raises(FactError, match="there is no fact"):
            fact(name)
    assert in_order(["nad", "fscore_5mm", "iou", "nad"]) == ["iou", "nad", "fscore_5mm"]
