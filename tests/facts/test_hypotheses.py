"""What is about all hypotheses of an answer, against the metrics' own best_and_worst."""

import numpy as np
import pytest

from pytest_cpas.evaluation.measuring import measure
from pytest_cpas.facts import FactError, fact, in_order, measure_facts
from pytest_cpas.metrics.precision import PAPER_THRESHOLDS, best_and_worst
from pytest_cpas.protocols import (
    count_columns,
    count_table,
    facts_of,
    judge_outcomes,
    shipped_protocol,
)
from pytest_cpas.types import (
    GroundTruth,
    Hypothesis,
    MethodInfo,
    Pose,
    Prediction,
    Symmetry,
)
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET

PAPER, BEST = shipped_protocol("cpas"), shipped_protocol("best-of-n")
#: From NOCS' object axes to ours.
NOCS = NOCS_FROM_SHAPENET

INFO = MethodInfo(
    name="several",
    categories=("mug",),
    needs=frozenset(),
    gives=frozenset({"shape"}),
    licence="MIT",
    object_frame="nocs",
)


def guesses(seed: int) -> tuple[list[GroundTruth], list[Prediction]]:
    """Answers of no, one, and several hypotheses, in NOCS axes."""
    rng = np.random.default_rng(seed)
    truths, predictions = [], []
    for index in range(60):
        points = rng.uniform(-0.05, 0.05, (100, 3))
        truths.append(
            GroundTruth(
                pose=Pose(np.eye(3), rng.normal(size=3)),
                extents=np.full(3, 0.1),
                symmetry=Symmetry.none(),
                surface=points,
            )
        )
        hypotheses = [
            Hypothesis(
                rotation=about_y(rng.choice([1, 4, 8, 30])) @ NOCS.T,
                translation=truths[-1].pose.translation
                + np.array((rng.choice([0.001, 0.008, 0.015, 0.1]), 0, 0)),
                points=points @ NOCS.T * rng.choice([1, 1, 1.5]),
            )
            for _ in range(index % 4)
        ]
        predictions.append(
            Prediction(tuple(hypotheses)) if hypotheses else Prediction.failed("nothing seen")
        )
    return truths, predictions


def about_y(degrees: float) -> np.ndarray:
    sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def counts(protocol, truths, predictions) -> list:
    columns = count_columns([protocol])
    answers = measure(facts_of(columns), truths, predictions, INFO)
    outcomes = judge_outcomes(columns, [answer.facts for answer in answers])
    table = count_table(columns, [("mug", outcome) for outcome in outcomes])["mug"]
    return [table[column.key] for column in columns]


def test_best_and_worst_are_those_of_the_metrics():
    truths, predictions = guesses(0)
    names = ["rotation_deg", "position_m", "fscore_1cm"]
    rows = []
    for truth, prediction in zip(truths, predictions, strict=True):
        alone = [Prediction((hypothesis,)) for hypothesis in prediction.hypotheses]
        answers = measure(names, [truth] * len(alone), alone, INFO)
        rows.append(
            [
                {name.removesuffix("_1cm"): value for name, value in answer.facts.items()}
                for answer in answers
            ]
        )
    expected = [best_and_worst(rows, threshold) for threshold in PAPER_THRESHOLDS]
    found = counts(BEST, truths, predictions)
    assert found == [best for best, _ in expected] + [worst for _, worst in expected]
    for best, worst in expected:
        assert 0 < worst.correct < best.correct < best.total == 60


def test_one_hypothesis_is_the_best_and_the_worst():
    truths, predictions = guesses(1)
    alone = [
        Prediction(prediction.hypotheses[:1]) if prediction.hypotheses else prediction
        for prediction in predictions
    ]
    read = counts(PAPER, truths, alone)[:4]
    assert counts(BEST, truths, alone) == read + read


def test_order_of_hypotheses_is_seen_by_what_reads_the_first():
    """The best hypothesis no longer first: the paper's columns flip, best-of-n's do not."""
    truths, predictions = guesses(2)
    turned = [
        Prediction(prediction.hypotheses[::-1]) if prediction.hypotheses else prediction
        for prediction in predictions
    ]
    assert counts(BEST, truths, turned) == counts(BEST, truths, predictions)
    columns = count_columns([PAPER])
    before, after = (
        judge_outcomes(columns, [a.facts for a in measure(facts_of(columns), truths, p, INFO)])
        for p in (predictions, turned)
    )
    flipped = [index for index in range(60) if before[index] != after[index]]
    assert len(flipped) > 10
    assert all(len(predictions[index].hypotheses) > 1 for index in flipped)


def test_margin_is_the_largest_share_of_a_limit():
    truth = GroundTruth(
        pose=Pose(np.eye(3), (0, 0, 1)), extents=np.ones(3), symmetry=Symmetry.none()
    )
    first, second = (
        Hypothesis(rotation=about_y(degrees), translation=(metres, 0, 1))
        for degrees, metres in ((15, 0.01), (5, 0.016))
    )
    names = ["best_10deg_2cm", "worst_10deg_2cm", "best_10deg_20mm", "best_10deg_2cm_f60"]
    (facts,) = measure_facts(names, [truth], [first], {"shape"}, others=[[second]])
    assert facts["best_10deg_2cm"] == pytest.approx(0.8)
    assert facts["worst_10deg_2cm"] == pytest.approx(1.5)
    assert facts["best_10deg_20mm"] == facts["best_10deg_2cm"]
    assert facts["best_10deg_2cm_f60"] is None
    (facts,) = measure_facts(names[:2], [truth], [first], set())
    assert facts["best_10deg_2cm"] == facts["worst_10deg_2cm"] == pytest.approx(1.5)


def test_margin_is_at_most_one_exactly_where_limits_are_met():
    """A value on a limit meets it, the next number beyond does not."""
    for limit in (
        *range(1, 181),
        *(n / 100 for n in range(1, 101)),
        *(n / 1000 for n in range(1, 99)),
    ):
        assert np.float64(limit) / limit <= 1 < np.nextafter(limit, np.inf) / limit
        assert limit / np.float64(limit) <= 1 < limit / np.nextafter(limit, 0)


def test_names_of_margins():
    made = fact("worst_5deg_1cm_f80")
    assert made.definition == "joint_margin:worst-hypothesis:1[limits=5deg;1cm;F0.8]"
    assert made.needs == made.knows == {"shape"}
    assert not fact("best_180deg_999mm").needs
    assert in_order(["best_5deg_1cm", "nad"]) == ["nad", "best_5deg_1cm"]
    for name in ("best_0deg_1cm", "best_181deg_1cm", "mean_5deg_1cm", "best_5deg_1cm_f101", "best"):
        with pytest.raises(FactError, match="best_10deg_2cm or worst_5deg_1cm_f80"):
            fact(name)
