"""Cases that are tried first, and where they come from."""

import itertools
import math
from dataclasses import replace
from fractions import Fraction
from functools import partial

import budget
import faults
import mutants
import numpy as np
import pytest

from pytest_cpas.checks.metrics import PROPERTIES, as_subject, check, offer, replay
from pytest_cpas.checks.metrics import conflicts as rules
from pytest_cpas.checks.metrics.exact import rectangles_overlap, shared_volume
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.metric_subjects.cpas import METRICS

DIAMETER = PROPERTIES["diameter.largest_of_all_pairs"]


def test_corners_are_tried_first_whatever_the_seed_is():
    seen = []

    def diameter(points):
        seen.append(len(points))
        return METRICS["diameter"].function(points)

    subject = as_subject("mine", {"diameter": offer(diameter)})
    corners = [{"cloud": [[0.0, 0.0, 0.0]] * n} for n in (31, 32)]
    prop = replace(DIAMETER, corners=lambda: corners)
    for seed in (0, 1):
        seen.clear()
        result = check(subject, prop, seed=seed, examples=3)
        assert seen[:2] == [31, 32]
        assert len(seen) == result.examples == 5


def test_what_a_corner_shows_is_the_counterexample():
    subject = as_subject("mine", {"diameter": offer(lambda points: float(len(points) > 30))})
    corner = {"cloud": [[0.0, 0.0, 0.0]] * 31}
    prop = replace(DIAMETER, corners=lambda: [corner])
    result = check(subject, prop, examples=3)
    assert result.outcome is Outcome.VIOLATED
    assert (result.examples, "value is 1.0" in result.message) == (1, True)
    assert replay(subject, prop, result.case).message == result.message


def test_what_an_implementation_draws_repeats_in_corners():
    drawn = []

    def diameter(points):
        drawn.append(np.random.rand())  # noqa: NPY002
        return 0.0

    prop = replace(DIAMETER, corners=lambda: [{"cloud": [[0.0, 0.0, 0.0]]}])
    for _ in range(2):
        np.random.seed(7)  # noqa: NPY002
        check(as_subject("mine", {"diameter": offer(diameter)}), prop, examples=1)
    assert drawn[0] == drawn[2]


@pytest.mark.parametrize("name", sorted(PROPERTIES))
def test_corners_are_plain_values_of_the_property(name):
    """They are recorded as JSON, and take the place of what is drawn."""
    import json

    prop = PROPERTIES[name]
    for case in itertools.islice(prop.corners(), 3):
        assert set(case) == set(prop.given)
        json.dumps(case, allow_nan=False)


@pytest.mark.parametrize("name", sorted(rules.WRONG))
def test_each_wrong_rule_shows_in_some_scene(name):
    areas = [
        (rules._area(rules.WRONG[name], scene), rules._area(rules.RIGHT, scene))
        for scene in rules.conflicts()
    ]
    assert sum(abs(wrong - right) > 1e-9 for wrong, right in areas) >= 3


def test_rectangles_overlap_as_boxes_do():
    # a turn by the angle of the 3-4-5 triangle: quaternion (0, 0, 1, 3)
    angle = 2 * math.atan2(1, 3)
    for shift in ((0, 0), (20, 7), (40, -31), (90, 0)):
        flat = shared_volume(
            tuple(list(map(Fraction, p)) for p in ((0, 0, 1, 3), (*shift, 0), (64, 30, 1))),
            tuple(list(map(Fraction, p)) for p in ((0, 0, 0, 1), (0, 0, 0), (50, 44, 1))),
        )
        area = rectangles_overlap([64, 30], [50, 44], shift, angle)
        assert area == pytest.approx(float(flat), abs=1e-9)


@pytest.mark.parametrize("bins", [10, 100])
def test_sums_over_bins_are_judged_to_the_bin(bins):
    from pytest_cpas import metrics as m

    def shifted(iou, lower):
        margins = (iou - lower) / (1 - lower)
        return float((np.arange(bins)[None] / bins < margins[:, None]).mean())

    def shifted_volume(rotation, position, most, farthest):
        return shifted(1 - rotation / most, 0.0) * shifted(1 - position / farthest, 0.0)

    for metric, ours, wrong in (
        ("iou_auc", m.iou_auc, shifted),
        ("pose_vus", m.pose_vus, shifted_volume),
    ):
        prop = PROPERTIES[f"{metric}.sum_over_bins"]
        right = as_subject("ours", {metric: offer(partial(ours, bins=bins), bins=bins)})
        faulty = as_subject("mine", {metric: offer(wrong, bins=bins)})
        assert check(right, prop, examples=20).outcome is Outcome.PASSED
        assert check(faulty, prop, examples=20).outcome is Outcome.VIOLATED


def test_budget_tells_what_is_enumerated_from_what_is_drawn():
    """Corners are tried once, and what is drawn with every seed."""
    names = [f"{fault.metric}: {fault.name}" for fault in faults.FAULTS]
    shown = budget.budget(names.index("precision: a limit of 0 is none"), 3)
    assert (shown.by.partition(".")[0], shown.tries) == ("precision", 1)
    drawn = budget.budget(names.index("translation_error: squared"), 3)
    assert (drawn.any_share, drawn.tries) == (3, 3)


def test_what_nothing_catches_is_seen_in_the_budget(monkeypatch):
    right = faults.Fault("diameter", "none", lambda f: f, {})
    monkeypatch.setattr(faults, "FAULTS", [right])
    assert budget.budget(0, 2) == budget.Budget("diameter: none", "-", 0, 0, 2)


def test_mutants_are_of_what_computes_and_survivors_of_what_is_there():
    made = mutants.mutants("pose")
    assert any("np.arctan2" in mutant.source for mutant in made)
    assert not any("ContractError" in mutant.change for mutant in made)
    sampled = {f"{mutant.module}: {mutant.change}" for mutant in mutants.sample(320, 0)}
    assert set(mutants.explained()) <= sampled


def test_a_mutant_is_caught_and_what_changes_nothing_is_not():
    changes = {mutant.change: mutant for mutant in mutants.mutants("pose")}
    (wrong,) = (m for change, m in changes.items() if change.endswith("-> estimate + truth"))
    right = mutants.Mutant("pose", "none", (mutants.ROOT / "pose.py").read_text(encoding="utf-8"))
    found = [mutants._in_a_process((mutant, 2, 60)) for mutant in (wrong, right)]
    assert found[0].startswith("translation_error.")
    assert found[1] == ""
