from fractions import Fraction
from math import comb

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_cpas.metrics.precision import (
    FAILED,
    METRICS,
    PAPER_THRESHOLDS,
    Count,
    Errors,
    JointThreshold,
    best_and_worst,
    count,
    count_by_category,
    curve,
    iou_auc,
    mean_over_categories,
    pose_vus,
)
from pytest_cpas.types import ContractError

GOOD = {"rotation_deg": 1.0, "position_m": 0.001, "iou": 0.9, "fscore": 0.95, "nad": 0.01}


class TestJointThreshold:
    def test_the_papers_thresholds(self) -> None:
        assert [t.label for t in PAPER_THRESHOLDS] == [
            "10 deg, 2 cm",
            "10 deg, 2 cm, F 0.6",
            "5 deg, 1 cm",
            "5 deg, 1 cm, F 0.8",
        ]

    def test_labels_of_other_thresholds(self) -> None:
        threshold = JointThreshold(rotation_deg=7.5, position_m=0.0035, iou=0.25, nad=0.1)
        assert threshold.label == "7.5 deg, 0.35 cm, IoU 0.25, NAD 0.1"

    @pytest.mark.parametrize("name", METRICS)
    def test_the_limit_itself_is_met(self, name: str) -> None:
        threshold = JointThreshold(**{name: 0.3})
        worse = np.nextafter(0.3, 0 if METRICS[name] else 1)
        better = np.nextafter(0.3, 1 if METRICS[name] else 0)
        verdicts = [threshold.is_correct(**{name: x}) for x in (worse, 0.3, better)]
        assert verdicts == [False, True, True]

    @pytest.mark.parametrize("name", METRICS)
    def test_every_limit_must_be_met(self, name: str) -> None:
        threshold = JointThreshold(rotation_deg=2, position_m=0.01, iou=0.5, fscore=0.6, nad=0.1)
        assert threshold.is_correct(**GOOD) is True
        assert threshold.is_correct(**(GOOD | {name: FAILED[name]})) is False

    def test_what_is_missing_is_not_judged(self) -> None:
        with_shape, without = PAPER_THRESHOLDS[1], PAPER_THRESHOLDS[0]
        assert with_shape.is_correct(**(GOOD | {"fscore": None})) is None
        assert with_shape.is_correct(rotation_deg=1, position_m=0.001) is None
        assert without.is_correct(rotation_deg=1, position_m=0.001) is True
        # also when another limit is already broken
        assert with_shape.is_correct(rotation_deg=90, position_m=0.001) is None

    @pytest.mark.parametrize("name", METRICS)
    def test_a_failed_sample_meets_nothing(self, name: str) -> None:
        largest = 0.0 if METRICS[name] else 1e300
        assert JointThreshold(**{name: largest}).is_correct(**FAILED) is False
        assert JointThreshold(**{name: largest}).is_correct(**{name: 0.5}) is True

    def test_refusals(self) -> None:
        with pytest.raises(ContractError, match="at least one"):
            JointThreshold()
        for bad in (float("nan"), float("inf"), -1.0):
            with pytest.raises(ContractError, match="rotation_deg"):
                JointThreshold(rotation_deg=bad)
        with pytest.raises(ContractError, match=r"unknown metrics \['angle'\]"):
            PAPER_THRESHOLDS[0].is_correct(angle=3)


class TestCounting:
    @settings(deadline=None)
    @given(
        st.lists(
            st.fixed_dictionaries(
                {
                    "rotation_deg": st.none() | st.integers(0, 4),
                    "fscore": st.none() | st.integers(0, 4).map(lambda n: n / 4),
                }
            ),
            min_size=1,
        ),
        st.integers(0, 4),
        st.integers(0, 4).map(lambda n: n / 4),
    )
    def test_agrees_with_counting_one_by_one(
        self, rows: list[dict[str, float | None]], rotation: int, fscore: float
    ) -> None:
        got = count(Errors.from_rows(rows), JointThreshold(rotation_deg=rotation, fscore=fscore))
        judged = [r for r in rows if r["rotation_deg"] is not None and r["fscore"] is not None]
        good = [r for r in judged if r["rotation_deg"] <= rotation and r["fscore"] >= fscore]  # type: ignore[operator]
        assert got == (Count(len(good), len(judged)) if judged else None)

    def test_rows_and_columns_agree(self) -> None:
        rng = np.random.default_rng(0)
        columns = {"rotation_deg": rng.random(50), "iou": rng.random(50)}
        rows = [{name: float(column[i]) for name, column in columns.items()} for i in range(50)]
        for threshold in (JointThreshold(rotation_deg=0.5), JointThreshold(iou=0.3)):
            by_column = count(Errors(columns), threshold)
            assert by_column == count(Errors.from_rows(rows), threshold)
            assert by_column is not None
            assert 0 < by_column.correct < 50

    def test_categories_absent_and_present(self) -> None:
        errors = Errors({"rotation_deg": [1, 20, 3, 4], "fscore": [None, None, 0.9, 0.1]})
        categories = ["mug", "mug", "can", "can"]
        by_rotation = count_by_category(
            errors, categories, JointThreshold(rotation_deg=10), ("can", "mug", "bowl")
        )
        assert by_rotation == {"can": Count(2, 2), "mug": Count(1, 2), "bowl": None}
        assert mean_over_categories(by_rotation) == 0.75
        by_shape = count_by_category(
            errors, categories, JointThreshold(rotation_deg=10, fscore=0.5), ("can", "mug")
        )
        assert by_shape == {"can": Count(1, 2), "mug": None}
        assert mean_over_categories(by_shape) == 0.5
        assert mean_over_categories({"bowl": None}) is None

    def test_mean_over_categories_is_not_the_overall_precision(self) -> None:
        counts = {"mug": Count(1, 1), "can": Count(0, 3)}
        assert mean_over_categories(counts) == 0.5
        assert (counts["mug"] + counts["can"]).precision == 0.25

    def test_curve(self) -> None:
        errors = Errors({"position_m": [0, 0.01, 0.02, None]})
        assert curve(errors, "position_m", [0, 0.005, 0.01, 1]) == [
            Count(1, 3),
            Count(1, 3),
            Count(2, 3),
            Count(3, 3),
        ]
        assert curve(errors, "nad", [0.1]) is None

    def test_best_and_worst_of_several_hypotheses(self) -> None:
        good, bad = {"rotation_deg": 1.0}, {"rotation_deg": 90.0}
        threshold = JointThreshold(rotation_deg=10)
        hypotheses = [[good, bad], [bad, bad, bad], [good], [], [bad, good, {"iou": 1.0}]]
        assert best_and_worst(hypotheses, threshold) == (Count(2, 4), Count(1, 4))
        assert best_and_worst([], threshold) is None
        assert best_and_worst([[{"iou": 1.0}]], threshold) is None

    def test_refusals(self) -> None:
        with pytest.raises(ContractError, match="1 values of iou are NaN"):
            Errors({"iou": [float("nan"), None]})
        with pytest.raises(ContractError, match="different lengths"):
            Errors({"iou": [1.0], "nad": [1.0, 2.0]})
        with pytest.raises(ContractError, match=r"shape \(1, 2\)"):
            Errors({"iou": np.ones((1, 2))})
        for correct, total in ((2, 1), (-1, 3), (0, 0)):
            with pytest.raises(ContractError, match="impossible"):
                Count(correct, total)


class TestInterval:
    @pytest.mark.parametrize(
        ("k", "n"), [(0, 25), (1, 25), (5, 25), (24, 25), (25, 25), (300, 500)]
    )
    @pytest.mark.parametrize("confidence", [0.95, 0.99])
    def test_tails_in_exact_arithmetic(self, k: int, n: int, confidence: float) -> None:
        """The ends are where at most (1 - confidence) / 2 lies beyond the count."""

        def tail(p: float, counts: range) -> float:
            exact = Fraction(p)
            return float(sum(comb(n, i) * exact**i * (1 - exact) ** (n - i) for i in counts))

        low, high = Count(k, n).interval(confidence)
        if k == 0:
            assert low == 0
        else:
            assert tail(low, range(k, n + 1)) == pytest.approx((1 - confidence) / 2, rel=1e-9)
        if k == n:
            assert high == 1
        else:
            assert tail(high, range(k + 1)) == pytest.approx((1 - confidence) / 2, rel=1e-9)

    def test_refusal(self) -> None:
        with pytest.raises(ContractError, match="confidence"):
            Count(1, 2).interval(95)


class TestAreas:
    rng = np.random.default_rng(1)
    iou = rng.random(60)
    rotation = 12 * rng.random(60)
    position = 0.06 * rng.random(60)

    @pytest.mark.parametrize("lower", [0.25, 0.5, 0.75])
    def test_iou_area_is_the_curves(self, lower: float) -> None:
        limits = lower + (1 - lower) * (np.arange(20_000) + 0.5) / 20_000
        points = curve(Errors({"iou": self.iou}), "iou", limits)
        assert points is not None
        mean = np.mean([point.precision for point in points])
        assert iou_auc(self.iou, lower) == pytest.approx(mean, abs=1e-4)

    @pytest.mark.parametrize(("lower", "step"), [(0.25, 0.075), (0.5, 0.005), (0.75, 0.0025)])
    def test_iou_midpoints_of_omni6dpose(self, lower: float, step: float) -> None:
        limits = np.arange(lower, 1, step) + step / 2
        expected = np.mean([np.mean(self.iou > limit) for limit in limits])
        assert iou_auc(self.iou, lower, bins=len(limits)) == pytest.approx(expected, rel=1e-12)
        assert len(limits) == (10 if lower == 0.25 else 100)

    @pytest.mark.parametrize(("degrees", "metres"), [(5, 0.02), (5, 0.05), (10, 0.02), (10, 0.05)])
    def test_volume_is_the_surfaces(self, degrees: float, metres: float) -> None:
        def mean_over_grid(n: int) -> float:
            middles = (np.arange(n) + 0.5) / n
            met = self.rotation < degrees * middles[:, None, None]
            return float(np.mean(met & (self.position < metres * middles[:, None])))

        exact = pose_vus(self.rotation, self.position, degrees, metres)
        assert exact == pytest.approx(mean_over_grid(500), abs=2e-3)
        assert exact != mean_over_grid(100)
        binned = pose_vus(self.rotation, self.position, degrees, metres, bins=100)
        assert binned == pytest.approx(mean_over_grid(100), rel=1e-12)

    def test_ends(self) -> None:
        assert iou_auc([1.0, 1.0], 0.5) == 1
        assert iou_auc([0.5, 0.0, -np.inf], 0.5) == 0
        assert iou_auc([0.75], 0.5) == 0.5
        assert pose_vus([0.0], [0.0], 5, 0.02) == 1
        assert pose_vus([2.5], [0.005], 5, 0.02) == 0.5 * 0.75
        assert pose_vus([np.inf, 1.0, 5.0], [np.inf, 0.02, 0.0], 5, 0.02) == 0
        assert iou_auc([], 0.5) is None
        assert pose_vus([], [], 5, 0.02) is None

    def test_refusals(self) -> None:
        with pytest.raises(ContractError, match="NaN"):
            iou_auc([np.nan], 0.5)
        with pytest.raises(ContractError, match="lower is 1"):
            iou_auc([0.3], 1)
        with pytest.raises(ContractError, match="2 rotations but 1 positions"):
            pose_vus([1, 2], [1], 5, 0.02)
        with pytest.raises(ContractError, match="the largest"):
            pose_vus([1], [1], 0, 0.02)
