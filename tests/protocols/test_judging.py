"""Facts in, judgements out: against the metrics' own functions."""

import math

import numpy as np
import pytest

from pytest_cpas.facts import fact
from pytest_cpas.metrics.precision import (
    PAPER_THRESHOLDS,
    Count,
    Errors,
    JointThreshold,
    count,
    iou_auc,
    pose_vus,
)
from pytest_cpas.protocols import (
    Protocol,
    Score,
    count_columns,
    count_table,
    judge_outcomes,
    score_columns,
    score_table,
    shipped_protocol,
)

#: What the facts of a column are called as limits of a joint threshold.
LIMITS = {
    "position_m": "position_m",
    "rotation_deg": "rotation_deg",
    "iou": "iou",
    "fscore_1cm": "fscore",
    "nad": "nad",
}


def random_facts(count: int, *, known: bool = False) -> list[dict[str, float | None]]:
    """Of answers good and bad, on the limits, n/a in places and failed in others."""
    rng = np.random.default_rng(0)
    drawn = {
        "position_m": rng.choice([0.0, 0.01, 0.02, 0.05, *rng.uniform(0, 0.06, 20)], count),
        "rotation_deg": rng.choice([0.0, 5.0, 10.0, *rng.uniform(0, 15, 20)], count),
        "iou": rng.choice([0.0, 0.25, 0.5, 0.75, 1.0, *rng.uniform(0, 1, 20)], count),
        "fscore_1cm": rng.choice([0.0, 0.6, 0.8, 1.0, *rng.uniform(0, 1, 20)], count),
        "nad": rng.uniform(0, 0.3, count),
    }
    facts: list[dict[str, float | None]] = []
    for index in range(count):
        failed = rng.random() < 0.1
        facts.append(
            {
                name: fact(name).failed
                if failed
                else None
                if rng.random() < 0.15 and not known
                else float(values[index])
                for name, values in drawn.items()
            }
        )
    return facts


def test_counts_are_those_of_the_metrics():
    facts = random_facts(500)
    columns = count_columns([shipped_protocol("cpas")])
    table = count_table(columns, [("mug", outcome) for outcome in judge_outcomes(columns, facts)])
    errors = Errors.from_rows(
        [{LIMITS[name]: value for name, value in given.items()} for given in facts]
    )
    for column in columns:
        names = {name: LIMITS[name] for name in column.limits}
        threshold = JointThreshold(**{_argument(names[n]): v for n, v in column.limits.items()})
        expected = count(errors, threshold)
        assert expected is not None
        assert 0 < expected.correct < expected.total < 500
        assert table["mug"][column.key] == table["all"][column.key] == expected


def _argument(limit: str) -> str:
    return limit


def test_read_columns_are_the_thresholds_of_the_paper():
    read = [column for column in shipped_protocol("cpas").counts if not column.guard]
    assert [column.label for column in read] == [each.label for each in PAPER_THRESHOLDS]
    for column, threshold in zip(read, PAPER_THRESHOLDS, strict=True):
        assert {LIMITS[name]: v for name, v in column.limits.items()} == dict(threshold.limits)


def test_scores_are_those_of_the_metrics():
    facts = random_facts(300, known=True)
    protocols = [shipped_protocol("omni6dpose"), shipped_protocol("omni6dpose-printed")]
    table = score_table(score_columns(protocols), ["mug"] * 300, facts)
    column = {name: [given[name] for given in facts] for name in facts[0]}
    seen = 0
    for score in score_columns(protocols):
        assert bool(score.bins) == (score.protocol == "omni6dpose-printed")
        bins = score.bins or None
        if set(score.areas) == {"iou"}:
            expected = iou_auc(column["iou"], score.areas["iou"][0], bins=bins)
        else:
            ends = score.areas["rotation_deg"][1], score.areas["position_m"][1]
            expected = pose_vus(column["rotation_deg"], column["position_m"], *ends, bins=bins)
        found = table["mug"][score.key]
        assert found is not None
        assert found.samples == 300
        assert found.value == pytest.approx(expected, abs=1e-12)
        assert 0 < found.value < 1
        seen += 1
    assert seen == 14


def test_scores_are_of_those_that_are_known():
    facts = random_facts(200)
    (column,) = shipped_protocol("cpas").scores
    table = score_table([column], ["mug", "can"] * 100, facts)
    for name, among in (("mug", facts[::2]), ("can", facts[1::2]), ("all", facts)):
        known = [given["nad"] for given in among if given["nad"] is not None]
        assert 0 < len(known) < len(among)
        assert table[name][column.key] == Score(pytest.approx(np.median(known)), len(known))


def test_what_is_known_of_nobody_is_no_score():
    (column,) = shipped_protocol("cpas").scores
    assert score_table([column], ["mug"], [{"nad": None}])["mug"] == {column.key: None}
    assert score_table([column], ["mug"], [{}])["mug"] == {column.key: None}
    assert score_table([column], [], []) == {}
    failed = score_table([column], ["mug"], [{"nad": math.inf}])["mug"][column.key]
    assert failed == Score(math.inf, 1)


def test_counts_of_categories_and_of_what_is_not_applicable():
    columns = count_columns([shipped_protocol("cpas")])
    facts = [{"position_m": 0.01, "rotation_deg": 1.0}, {"position_m": 1.0, "rotation_deg": 1.0}]
    outcomes = judge_outcomes(columns, facts)
    assert outcomes == ["1-1-11-----", "0-0-00-----"]
    table = count_table(columns, zip(["can", "mug"], outcomes, strict=True))
    assert table["can"]["cpas.5deg_1cm"] == Count(1, 1)
    assert table["all"]["cpas.5deg_1cm"] == Count(1, 2)
    assert table["all"]["cpas.iou_25"] is None
    assert judge_outcomes(columns, []) == []
    assert judge_outcomes([], facts) == ["", ""]


def test_thresholds_of_a_midpoint_sum_lie_in_the_middles():
    """By counting them."""
    content = {
        "name": "x",
        "columns": [{"id": "a", "area": {"iou": [0.2, 0.7]}, "bins": 7}],
    }
    columns = score_columns([Protocol.parse(content, "here")])
    middles = 0.2 + 0.5 * (np.arange(7) + 0.5) / 7
    for iou in np.random.default_rng(0).uniform(0, 1, 50):
        (score,) = score_table(columns, ["mug"], [{"iou": iou}])["mug"].values()
        assert score is not None
        assert score.value == pytest.approx((middles < iou).mean(), abs=1e-12)


def test_average_recall_is_that_of_bop():
    """The mean of the recalls at the listed limits, each strictly below it."""
    columns = score_columns([shipped_protocol("bop")])
    mssd, mspd = (column for column in columns if column.levels)
    assert mssd.levels["mssd_relative"] == pytest.approx(np.arange(0.05, 0.51, 0.05))
    assert mspd.levels["mspd_px"] == pytest.approx(np.arange(5, 51, 5))
    errors = [0.0, 5.0, 7.0, 50.0, 49.9, 1e9, math.inf, None]
    facts = [{"mspd_px": error, "mssd_relative": error and error / 100} for error in errors]
    expected = np.mean([np.mean([e < limit for e in errors[:-1]]) for limit in range(5, 51, 5)])
    table = score_table([mspd, mssd], ["a"] * len(facts), facts)["a"]
    assert table["bop.ar_mspd"] == Score(pytest.approx(expected), 7)
    assert table["bop.ar_mssd"] == Score(pytest.approx(expected), 7)


def test_levels_of_what_is_better_when_it_is_larger():
    content = {"name": "x", "columns": [{"id": "a", "levels": {"iou": [0.25, 0.5, 0.75]}}]}
    columns = score_columns([Protocol.parse(content, "here")])
    for iou, share in ((0.25, 0), (0.3, 1 / 3), (0.75, 2 / 3), (1, 1), (-math.inf, 0)):
        (score,) = score_table(columns, ["mug"], [{"iou": iou}])["mug"].values()
        assert score == Score(pytest.approx(share), 1)


def test_areas_of_bop_are_those_of_the_curve_to_ten_centimetres():
    facts = [{"add_m": x} for x in np.random.default_rng(0).uniform(0, 0.2, 40)]
    (column,) = (c for c in shipped_protocol("bop").scores if set(c.areas) == {"add_m"})
    found = score_table([column], ["a"] * 40, facts)["a"][column.key]
    limits = np.linspace(0, 0.1, 100_001)
    curve = [np.mean([given["add_m"] <= limit for given in facts]) for limit in limits[::100]]
    assert found is not None
    assert found.value == pytest.approx(np.mean(curve), abs=1e-3)


#: What DetectMatch.metrics of cutoop 0.1.0 gives for these forty answers of one class.
CUTOOP = {
    "auc_iou_25": 0.37,
    "auc_iou_50": 0.24675,
    "auc_iou_75": 0.12625,
    "vus_5deg_2cm": 0.0585425,
    "vus_5deg_5cm": 0.1182225,
    "vus_10deg_2cm": 0.08883,
    "vus_10deg_5cm": 0.1999325,
}


def test_printed_areas_are_those_of_cutoop():
    index = np.arange(40)
    columns = {
        "iou": (index * 37 % 101) / 101,
        "rotation_deg": (index * 53 % 97) / 97 * 12,
        "position_m": (index * 29 % 89) / 89 * 0.06,
    }
    facts = [{name: values[i] for name, values in columns.items()} for i in index]
    printed = shipped_protocol("omni6dpose-printed").scores
    scores = score_table(printed, ["mug"] * 40, facts)["mug"]
    found = {column.id: scores[column.key] for column in printed}
    for name, value in CUTOOP.items():
        assert found.pop(name) == Score(pytest.approx(value, abs=1e-6), 40)
    assert not found
