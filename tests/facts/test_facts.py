"""Facts of answers and of pairs, each against the metric that it is of, one answer at a time."""

import numpy as np
import pytest

from pytest_cpas.facts import (
    Detected,
    FactError,
    all_facts,
    fact,
    failed_facts,
    in_order,
    measure_facts,
    pair_table,
)
from pytest_cpas.metrics import (
    ModelPoints,
    Surface,
    add,
    add_s,
    axis_aligned_box_iou,
    mspd,
    mssd,
    nocs_legacy_iou,
    oriented_iou,
    rotation_error,
    surface_errors,
    symmetric_iou,
    translation_error,
)
from pytest_cpas.types import AnswerError, Camera, GroundTruth, Hypothesis, Pose, Symmetry

NAMES = [made.name for made in all_facts()]
UP = (0, 1, 0)
CAMERA = Camera(1280, 960, 1000.0, 1000.0, 640.0, 480.0)


def turned(rng) -> np.ndarray:
    matrix, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return matrix * np.sign(np.linalg.det(matrix))


def a_truth(rng, symmetry=None, in_view=None, surface=True) -> GroundTruth:
    return GroundTruth(
        pose=Pose(turned(rng), rng.normal(size=3)),
        extents=rng.uniform(0.1, 0.3, 3),
        symmetry=symmetry or Symmetry.none(),
        surface=rng.uniform(-0.1, 0.1, (200, 3)) if surface else None,
        symmetry_in_view=in_view,
    )


def an_answer(rng, truth: GroundTruth) -> Hypothesis:
    small = np.linalg.qr(np.eye(3) + 0.05 * rng.normal(size=(3, 3)))[0]
    small = small * np.sign(np.diag(small))
    return Hypothesis(
        rotation=truth.pose.rotation @ small,
        translation=truth.pose.translation + 0.01 * rng.normal(size=3),
        extents=truth.extents * rng.uniform(0.8, 1.2, 3),
        points=np.asarray(truth.surface if truth.surface is not None else np.zeros((1, 3)))
        + 0.002 * rng.normal(size=3),
    )


def alone(truth: GroundTruth, answer: Hypothesis) -> dict[str, float | None]:
    """Every fact by the metric itself."""
    estimated = answer.rotation, answer.translation, answer.extents
    true = truth.pose.rotation, truth.pose.translation, truth.extents
    in_view = truth.symmetry_in_view or truth.symmetry
    spins = 20 if in_view.axis is not None else 1
    facts = {
        "position_m": translation_error(answer.translation, truth.pose.translation),
        "rotation_deg": np.degrees(rotation_error(estimated[0], true[0], truth.symmetry)),
        "rotation_in_view_deg": np.degrees(rotation_error(estimated[0], true[0], in_view)),
        "iou": symmetric_iou(*estimated, *true, truth.symmetry),
        "iou_in_view": symmetric_iou(*estimated, *true, in_view),
        "iou_axis_aligned": axis_aligned_box_iou(*estimated, *true, spins=spins),
        "iou_legacy": nocs_legacy_iou(*estimated, *true, spins=spins),
    }
    # by another way: the estimate is scaled about the camera until its diagonal is the true one
    scale = np.linalg.norm(truth.extents) / np.linalg.norm(answer.extents)
    scaled = answer.rotation, scale * answer.translation, scale * answer.extents
    gap = np.linalg.norm(scaled[1] - truth.pose.translation)
    facts["position_relative"] = gap / np.linalg.norm(truth.extents)
    facts["iou_equal_diagonals"] = symmetric_iou(*scaled, *true, truth.symmetry)
    if truth.surface is None:
        return {name: float(facts[name]) if name in facts else None for name in NAMES}
    errors = surface_errors(
        Surface(np.asarray(truth.surface)),
        np.asarray(answer.points),
        truth_pose=truth.pose,
        estimated_pose=answer.pose,
    )
    facts |= {
        "fscore_1cm": errors.fscore(0.01),
        "nad": errors.nad,
        "cd_m": errors.chamfer,
        "ad_to_estimate_m": errors.ad_truth_to_estimate,
        "ad_to_truth_m": errors.ad_estimate_to_truth,
    }
    model = ModelPoints(np.asarray(truth.surface))
    poses = answer.pose, truth.pose
    symmetric = truth.symmetry.axis is not None
    for name, distance in {
        "add": add(*poses, model),
        "adds": add_s(*poses, model),
        "add_or_adds": (add_s if symmetric else add)(*poses, model),
    }.items():
        facts |= {f"{name}_m": distance, f"{name}_relative": distance / model.diameter}
    facts["mssd_relative"] = mssd(*poses, model, truth.symmetry) / model.diameter
    facts["mspd_px"] = mspd(*poses, model, truth.symmetry, CAMERA)
    return {name: float(facts[name]) for name in NAMES}


def test_facts_are_the_metrics_of_their_names():
    """In batches of several symmetries, as each answer gives them alone."""
    rng = np.random.default_rng(1)
    symmetries = [Symmetry.none(), Symmetry.about(UP), Symmetry.none()]
    truths = [
        a_truth(rng, symmetries[i % 3], Symmetry.about(UP) if i % 3 == 2 else None, i % 4 > 0)
        for i in range(12)
    ]
    answers = [an_answer(rng, truth) for truth in truths]
    given = {"extents", "shape"}
    found = measure_facts(NAMES, truths, answers, given, [CAMERA] * 12)
    for facts, truth, answer in zip(found, truths, answers, strict=True):
        expected = alone(truth, answer)
        assert list(facts) == NAMES
        for name, value in facts.items():
            assert value == (None if expected[name] is None else pytest.approx(expected[name]))


def test_scale_agnostic_facts_do_not_know_the_scale():
    """A scene that is thrice as large, and thrice as far, looks the same."""
    rng = np.random.default_rng(7)
    truth = a_truth(rng)
    answer = an_answer(rng, truth)
    larger = Hypothesis(
        rotation=answer.rotation,
        translation=3 * answer.translation,
        extents=3 * np.asarray(answer.extents),
    )
    names = ["position_relative", "iou_equal_diagonals", "iou"]
    one, other = measure_facts(names, [truth, truth], [answer, larger], {"extents"})
    assert one["iou"] != other["iou"]
    for name in names[:2]:
        assert one[name] == pytest.approx(other[name])
    (perfect,) = measure_facts(
        names,
        [truth],
        [
            Hypothesis(
                rotation=truth.pose.rotation,
                translation=0.5 * truth.pose.translation,
                extents=0.5 * truth.extents,
            )
        ],
        {"extents"},
    )
    assert perfect["position_relative"] == pytest.approx(0, abs=1e-12)
    assert perfect["iou_equal_diagonals"] == pytest.approx(1)
    assert perfect["iou"] < 0.2


def test_what_is_not_given_is_not_known():
    rng = np.random.default_rng(2)
    truth = a_truth(rng)
    answer = an_answer(rng, truth)
    for cameras, surface, has in (
        ([CAMERA], True, {"camera", "shape"}),
        (None, True, {"shape"}),
        ([None], False, set()),
    ):
        truth = a_truth(rng, surface=surface)
        (facts,) = measure_facts(NAMES, [truth], [answer], set(), cameras)
        known = {name for name, value in facts.items() if value is not None}
        expected = {name for name in NAMES if not fact(name).needs and fact(name).knows <= has}
        assert known == expected
        failed = failed_facts(NAMES, truth, set(), cameras[0] if cameras else None)
        assert {name for name, value in failed.items() if value is not None} == expected
    bare = Hypothesis(rotation=np.eye(3), translation=np.zeros(3))
    with pytest.raises(AnswerError, match="extents is None"):
        measure_facts(["iou"], [truth], [bare], {"extents"})


def test_a_failed_answer_meets_no_limit():
    rng = np.random.default_rng(3)
    facts = failed_facts(NAMES, a_truth(rng), {"extents", "shape"}, CAMERA)
    for name, value in facts.items():
        for limit in (0.0, 1.0, 1e30):
            assert not fact(name).meets(np.array([value]), limit).any()
    shapeless = failed_facts(NAMES, a_truth(rng, surface=False), {"extents", "shape"})
    assert shapeless["fscore_1cm"] is None
    assert failed_facts(["iou"], a_truth(rng), set()) == {"iou": None}


def test_fscores_at_any_distance():
    rng = np.random.default_rng(4)
    truth = a_truth(rng)
    answer = an_answer(rng, truth)
    names = ["fscore_1cm", "fscore_10mm", "fscore_5mm", "fscore_2cm"]
    (facts,) = measure_facts(names, [truth], [answer], {"shape"})
    assert facts["fscore_1cm"] == facts["fscore_10mm"]
    assert facts["fscore_5mm"] <= facts["fscore_1cm"] <= facts["fscore_2cm"]
    assert "delta_m=0.005" in fact("fscore_5mm").definition
    for name in ("fscore", "fscore_0cm", "fscore_1m", "fscore_1.5cm", "iou_3", ""):
        with pytest.raises(FactError, match="there is no fact"):
            fact(name)
    assert in_order(["nad", "fscore_5mm", "iou", "position_m"]) == [
        "position_m",
        "iou",
        "nad",
        "fscore_5mm",
    ]


def test_pairs_are_those_of_an_image_and_category():
    rng = np.random.default_rng(5)
    truths = [("a", "mug", a_truth(rng)), ("a", "can", a_truth(rng)), ("b", "mug", a_truth(rng))]
    answer = an_answer(rng, truths[0][2])
    detected = [
        Detected(name="1", image="a", category="mug", score=0.5, hypothesis=answer),
        Detected(name="2", image="b", category="mug", score=0.7, hypothesis=None),
        Detected(name="3", image="b", category="bowl", score=0.7, hypothesis=answer),
        Detected(name="4", image="c", category="mug", score=0.1, hypothesis=answer),
    ]
    names = ["position_m", "iou", "nad", "mspd_px"]
    table = pair_table(names, detected, truths, {"extents"})
    assert table.categories == ["can", "mug"]
    assert table.detections.pairs.tolist() == [[0, 0], [1, 2]]
    estimated = answer.rotation, answer.translation, answer.extents
    true = truths[0][2]
    iou = oriented_iou(*estimated, true.pose.rotation, true.pose.translation, true.extents)
    assert table.facts["iou"].tolist() == [pytest.approx(float(iou)), 0.0]
    assert table.facts["position_m"][1] == np.inf
    assert set(table.facts) == {"position_m", "iou"}
