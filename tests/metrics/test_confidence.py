"""Intervals per sample and by scene, against enumeration, simulation and scipy."""

from itertools import product

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtr, stdtrit

from pytest_cpas.metrics import Count
from pytest_cpas.metrics.intervals import (
    FEWEST_SCENES,
    mean_interval,
    median_interval,
    scene_mean_intervals,
    scene_median_interval,
)
from pytest_cpas.types import ContractError

SCENES = {
    3: ["a"] * 4 + ["b"] * 2 + ["c"] * 7,
    4: ["a"] * 4 + ["b"] * 2 + ["c"] * 7 + ["d"] * 3,
}


def low_median(values):
    return np.sort(values)[(len(values) - 1) // 2]


def enumerated(values, scenes, statistic):
    """The statistic of every equally likely draw of scenes, ranked."""
    groups = [values[scenes == name] for name in np.unique(scenes)]
    draws = product(range(len(groups)), repeat=len(groups))
    return np.sort([statistic(np.concatenate([groups[i] for i in draw])) for draw in draws])


@pytest.mark.parametrize(("count", "confidence"), [(3, 0.5), (3, 0.68), (4, 0.5), (4, 0.8)])
@pytest.mark.parametrize("statistic", ["mean", "median"])
def test_interval_by_scene_is_that_of_all_draws(count, statistic, confidence):
    scenes = np.array(SCENES[count])
    values = np.random.default_rng(count).uniform(size=len(scenes)).round(3)
    if statistic == "mean":
        (found,) = scene_mean_intervals(values[:, None], scenes, confidence)
        every = enumerated(values, scenes, np.mean)
    else:
        found = scene_median_interval(values, scenes, confidence)
        every = enumerated(values, scenes, low_median)
    level = ndtr(np.sqrt(count / (count - 1)) * stdtrit(count - 1, (1 - confidence) / 2))
    # 4000 draws: a quantile lies within four standard deviations of its level
    slack = 4 * np.sqrt(level * (1 - level) / 4000) + 1e-9

    def between(value, at):
        below, through = np.mean(every < value - 1e-9), np.mean(every <= value + 1e-9)
        return below - slack <= at <= through + slack

    for end, at in ((found.low, level), (found.high, 1 - level)):
        assert np.isclose(every, end).any()
        assert between(end, at)


def simulated(scenes, rng, share=0.7, correlation=0.15, size=60):
    """Outcomes (N,) of clusters of about ``size``, and their scenes."""
    spread = (1 - correlation) / correlation
    sizes = rng.integers(size // 2, size + size // 2, scenes)
    shares = rng.beta(share * spread, (1 - share) * spread, scenes)
    codes = np.repeat(np.arange(scenes), sizes)
    return rng.random(len(codes)) < shares[codes], codes


def test_samples_of_one_scene_make_intervals_per_sample_too_narrow():
    rng = np.random.default_rng(0)
    held = np.zeros(2)
    for _ in range(200):
        outcomes, codes = simulated(20, rng)
        (by_scene,) = scene_mean_intervals(outcomes[:, None], codes)
        low, high = Count(int(outcomes.sum()), len(outcomes)).interval()
        held += by_scene.low <= 0.7 <= by_scene.high, low <= 0.7 <= high
    assert held[0] >= 180  # 95 % of 200 are 190
    assert held[1] < 120


def test_independent_samples_have_about_the_same_interval_either_way():
    rng = np.random.default_rng(1)
    outcomes, codes = rng.random(6000) < 0.7, np.repeat(np.arange(100), 60)
    (by_scene,) = scene_mean_intervals(outcomes[:, None], codes)
    low, high = Count(int(outcomes.sum()), 6000).interval()
    assert (by_scene.high - by_scene.low) / (high - low) == pytest.approx(1, abs=0.25)


def test_intervals_per_sample_are_those_of_scipy():
    values = np.random.default_rng(2).normal(3, 2, 41)
    told = mean_interval([*values, np.nan])
    expected = stats.t.interval(0.95, 40, values.mean(), stats.sem(values))
    assert (told.low, told.high) == pytest.approx(expected)
    told = median_interval([*values, np.nan])
    expected = stats.quantile_test(values).confidence_interval(0.95)
    assert (told.low, told.high) == pytest.approx((expected.low, expected.high))
    assert median_interval([1.0] * 4 + [np.inf] * 10).high == np.inf


def test_what_says_nothing_has_no_interval():
    assert mean_interval([1.0]) is None is mean_interval([2.0, 2.0])
    assert median_interval(range(5)) is None  # 1/16 lies outside of all five
    column = np.array([[0.0], [1], [1], [0]])
    assert scene_mean_intervals(column, ["a"] * 4) == [None]  # one scene
    assert scene_mean_intervals(column, list("abcd")) == [None]  # one sample each
    assert scene_mean_intervals(np.tile(column, (5, 1)), list("aabbccddee" * 2)) == [None]  # agree
    assert scene_median_interval(column[:, 0], ["a"] * 4) is None
    assert scene_median_interval(column[:, 0], list("abcd")) is None
    alike = [1.0, 1, 1, 2, 1, 1] * 5
    assert scene_median_interval(alike, np.repeat(range(10), 3)) is None  # medians agree
    assert scene_mean_intervals(np.zeros((0, 1)), []) == [None]
    assert scene_median_interval([], []) is None is median_interval([])


def test_fewer_than_five_scenes_are_not_95_percent_sure():
    rng = np.random.default_rng(5)
    for scenes in range(2, 8):
        values, codes = rng.normal(size=60), np.arange(60) % scenes
        told = scene_mean_intervals(values[:, None], codes)[0], scene_median_interval(values, codes)
        assert [each is None for each in told] == [scenes < FEWEST_SCENES] * 2


def test_scenes_in_which_a_column_is_unknown_take_no_part():
    rng = np.random.default_rng(3)
    outcomes, codes = simulated(8, rng)
    values = outcomes.astype(float)
    unknown = np.where(codes < 3, np.nan, values)
    both = scene_mean_intervals(np.stack([values, unknown], axis=1), codes)
    part = codes >= 3
    assert both == [
        *scene_mean_intervals(values[:, None], codes),
        *scene_mean_intervals(values[part, None], codes[part]),
    ]


def test_many_scenes_are_drawn_in_parts_with_the_same_result(monkeypatch):
    rng = np.random.default_rng(4)
    outcomes, codes = simulated(12, rng, size=10)
    scores = rng.normal(size=len(codes))

    def intervals():
        return scene_mean_intervals(outcomes[:, None], codes), scene_median_interval(scores, codes)

    whole = intervals()
    monkeypatch.setattr("pytest_cpas.metrics.intervals._AT_ONCE", 20_000)
    assert intervals() == whole


@pytest.mark.parametrize(
    "call",
    [
        lambda: mean_interval([[1.0]]),
        lambda: median_interval(3.0),
        lambda: median_interval([1.0, 2], confidence=1),
        lambda: scene_mean_intervals([1.0, 2], ["a", "b"]),
        lambda: scene_mean_intervals([[1.0], [2]], ["a"]),
        lambda: scene_median_interval([1.0, 2], [["a", "b"]]),
    ],
)
def test_other_shapes_and_levels_are_refused(call):
    with pytest.raises(ContractError, match="expected"):
        call()
