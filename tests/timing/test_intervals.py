"""The statistics of run times against independent truths."""

import numpy as np
import pytest
import scipy.stats

from pytest_cpas.timing.intervals import (
    ERROR,
    LOOK_CONFIDENCE,
    LOOKS,
    Interval,
    decide,
    median_interval,
    quotient,
    relative_to_others,
)
from pytest_cpas.timing.records import SpeedRecord
from pytest_cpas.timing.verdicts import parse_limit


@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.99, LOOK_CONFIDENCE])
def test_interval_is_made_of_the_order_statistics_that_the_binomial_gives(confidence):
    for count in range(12, 120):
        found = median_interval([float(i) for i in range(count)], confidence)
        lower, upper = int(found.lower), int(found.upper)
        assert upper == count - 1 - lower
        # the chance that no more than `lower` of the values lie below the median, on both sides
        assert 2 * scipy.stats.binom.cdf(lower, count, 0.5) <= 1 - confidence + 1e-12
        assert 2 * scipy.stats.binom.cdf(lower + 1, count, 0.5) > 1 - confidence
        assert found.median == np.median(range(count))


def test_interval_needs_enough_values():
    assert median_interval([3.0, 1.0, 2.0, 5.0, 4.0], 0.93).lower == 1.0
    with pytest.raises(ValueError, match=r"5 values hold their median with less than 0\.95"):
        median_interval([1.0, 2.0, 3.0, 4.0, 5.0], 0.95)


@pytest.mark.parametrize("count", [12, 24, 48])
@pytest.mark.parametrize("distribution", ["lognormal", "cauchy", "bimodal"])
def test_interval_holds_the_true_median_as_often_as_it_says(count, distribution):
    generator = np.random.default_rng(count)
    draws = {
        "lognormal": lambda: generator.lognormal(0, 1, count),
        "cauchy": lambda: 1 + generator.standard_cauchy(count),
        # the median is where there is nearly nothing
        "bimodal": lambda: 1 + generator.choice([-3, 3], count) + generator.normal(0, 1, count),
    }
    trials, confidence = 3000, 0.95
    held = 0
    for _ in range(trials):
        found = median_interval(draws[distribution]().tolist(), confidence)
        held += found.lower <= 1 <= found.upper
    assert scipy.stats.binomtest(held, trials, confidence, "less").pvalue > 1e-4


def test_looking_several_times_is_paid_for():
    """At the limit itself, SLOWER at any look is wrong; its share of the error is one half."""
    generator = np.random.default_rng(0)
    trials, wrong = 4000, 0
    for ratios in 1.2 * generator.lognormal(0, 0.3, (trials, LOOKS[-1])):
        found = "undecided"
        for look in LOOKS:
            if found == "undecided":
                found = decide(median_interval(ratios[:look].tolist(), LOOK_CONFIDENCE), 1.2)
        wrong += found == "slower"
    assert scipy.stats.binomtest(wrong, trials, ERROR / 2, "greater").pvalue > 1e-4


def test_decisions():
    def of(lower, upper):
        return decide(Interval(1.0, lower, upper, 0.99), 1.2)

    assert of(1.21, 1.5) == "slower"
    assert of(1.2, 1.5) == of(1.0, 1.21) == "undecided"
    assert of(0.5, 1.2) == of(0.9, 1.1) == "not slower"
    assert of(0.5, 0.83) == "faster"


def test_quotient_covers_the_worst_of_both():
    over, under = Interval(3.0, 2.0, 4.0, 0.99), Interval(1.5, 1.0, 2.0, 0.98)
    found = quotient(over, under)
    assert (found.median, found.lower, found.upper) == (2.0, 1.0, 4.0)
    assert found.confidence == pytest.approx(0.97)


def test_relative_to_others_leaves_a_value_out_of_its_own_measure():
    found = relative_to_others([[2.0, 4.0], [5.0, 1.0, 2.0]])
    assert found == pytest.approx([0.5, 2.0, 5.0 / 1.5, 1 / 3.5, 2 / 3])


@pytest.mark.parametrize("planted", [1.0, 1.3])
def test_a_record_and_a_run_of_it_hold_the_slowdown(planted):
    """Samples differ by a factor of ten; how often the interval misses the planted slow-down."""
    generator = np.random.default_rng(7)
    trials, held = 300, 0
    for _ in range(trials):
        level = generator.uniform(1, 10, 12)
        names = [f"s{i}" for i in range(12)]
        before = [(level[i] * generator.lognormal(0, 0.1, 4)).tolist() for i in range(12)]
        record = SpeedRecord.of(names, before, {}, {})
        now = planted * level * generator.lognormal(0, 0.1, 12)
        found = record.slowdown(list(zip(names, now.tolist(), strict=True)))
        held += found.lower <= planted <= found.upper
    assert scipy.stats.binomtest(held, trials, 1 - ERROR, "less").pvalue > 1e-3


@pytest.mark.parametrize(
    ("text", "factor"), [("20%", 1.2), ("0.2", 1.2), (" 5 %", 1.05), ("150%", 2.5), ("1e-2", 1.01)]
)
def test_limit(text, factor):
    assert parse_limit(text) == pytest.approx(factor)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("much", "expected by how much longer is too much, such as 20% or 0.2"),
        ("", "is '', expected"),
        ("%", "is '%', expected"),
        ("-20%", "expected"),
        ("0", "expected"),
        ("nan", "expected"),
        ("inf", "expected"),
        ("20", "which is 2000 %: write 20%, or 2000% if that is meant"),
    ],
)
def test_limit_that_is_none(text, message):
    with pytest.raises(ValueError, match=message):
        parse_limit(text)
