"""Properties of average precision: of a ranking, and of detections with their matching."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pytest_cpas.checks.metrics import exact
from pytest_cpas.checks.metrics.properties import close, expect, prop
from pytest_cpas.checks.metrics.strategies import seeds
from pytest_cpas.checks.metrics.subject import Subject

FINE = 1e-6
AP = "average_precision"
DETECTION = "detection_ap"


@st.composite
def rankings(draw: st.DrawFn, ties: bool = False) -> list[Any]:
    """[scores, correct, ground truths] in any order, with or without equal scores."""
    count = draw(st.integers(1, 10))
    correct = draw(st.lists(st.booleans(), min_size=count, max_size=count))
    if ties:
        scores = draw(st.lists(st.sampled_from([0.25, 0.5, 0.75]), min_size=count, max_size=count))
    else:
        scores = [(rank + 1) / 16 for rank in draw(st.permutations(range(count)))]
    return [scores, correct, sum(correct) + draw(st.integers(0, 3)) or 1]


def _ap(subject: Subject, scores: Any, correct: Any, truths: int) -> Any:
    return subject(AP, np.array(scores, dtype=float), np.array(correct, dtype=bool), truths)


@prop(AP, reason="an independent computation in rational numbers", given={"ranking": rankings()})
def by_definition(subject: Subject, ranking: list[Any]) -> None:
    """Without ties it is the area under the precision-recall curve, interpolated as declared."""
    scores, correct, truths = ranking
    interpolated = subject.defines(AP, "interpolated")
    expected = exact.average_precision(scores, correct, truths, interpolated)
    close(_ap(subject, *ranking), expected, FINE)


@prop(AP, reason="the ends of the scale", given={"count": st.integers(1, 8)}, weight=0.25)
def perfect_and_hopeless(subject: Subject, count: int) -> None:
    """All correct and complete gives 1, none correct gives 0."""
    scores = np.arange(1, count + 1) / 16
    close(_ap(subject, scores, [True] * count, count), 1, FINE)
    close(_ap(subject, scores, [False] * count, count), 0, FINE)


@prop(AP, reason="a share of an area", given={"ranking": rankings(ties=True)}, weight=0.5)
def in_range(subject: Subject, ranking: list[Any]) -> None:
    """The AP is in [0, 1]."""
    value = _ap(subject, *ranking)
    expect(-FINE <= value <= 1 + FINE, f"the AP is {value!r}")


@prop(AP, reason="the file's order of detections means nothing",
      given={"ranking": rankings(), "seed": seeds})  # fmt: skip
def independent_of_order(subject: Subject, ranking: list[Any], seed: int) -> None:
    """Without ties the order of the input changes nothing."""
    scores, correct, truths = ranking
    order = np.random.default_rng(seed).permutation(len(scores))
    mixed = np.array(scores)[order], np.array(correct)[order], truths
    close(_ap(subject, *mixed), _ap(subject, *ranking), FINE)


@prop(AP, reason="networks give equal scores (1.0, say) all the time; an unstable sort, or the "
      "file's order, then decides",
      given={
          "seed": seeds, "count": st.integers(2, 64),
          "scores": st.lists(st.sampled_from([0.5, 1.0]), min_size=1, max_size=2, unique=True),
      })  # fmt: skip
def independent_of_order_under_ties(
    subject: Subject, seed: int, count: int, scores: list[float]
) -> None:
    """With equal scores, too, the order of the input changes nothing."""
    rng = np.random.default_rng(seed)
    values, correct = rng.choice(scores, size=count), rng.random(count) < 0.5
    truths = max(int(correct.sum()), 1)
    one = _ap(subject, values, correct, truths)
    order = rng.permutation(count)
    close(_ap(subject, values[order], correct[order], truths), one, FINE, "in another order the AP")


@prop(AP, reason="a ranking has no scale: logits and probabilities rank alike",
      given={"ranking": rankings(ties=True)}, weight=0.5)  # fmt: skip
def monotone_scores(subject: Subject, ranking: list[Any]) -> None:
    """A monotone change of the scores changes nothing."""
    scores, correct, truths = ranking
    one = _ap(subject, scores, correct, truths)
    close(_ap(subject, [math.exp(4 * s) for s in scores], correct, truths), one, FINE)


@prop(AP, reason="recall is of all ground truths, found or not", given={"ranking": rankings()},
      weight=0.5)  # fmt: skip
def missed_truths_count(subject: Subject, ranking: list[Any]) -> None:
    """Twice as many ground truths halve the AP."""
    scores, correct, truths = ranking
    close(2 * _ap(subject, scores, correct, 2 * truths), _ap(subject, *ranking), FINE)


# -- detections --------------------------------------------------------------------------------


@st.composite
def scenes(draw: st.DrawFn) -> list[Any]:
    """Images with ground truths of two categories and predictions, all with distinct scores.

    [images, categories of predictions, images, categories of ground truths, IoU, score order].
    """
    true = draw(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 1)), min_size=1, max_size=5))
    pred = draw(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 1)), min_size=1, max_size=6))
    iou = [[draw(st.integers(0, 9)) / 10 for _ in true] for _ in pred]
    order = draw(st.permutations(range(len(pred))))
    return [
        [p[0] for p in pred], [p[1] for p in pred],
        [t[0] for t in true], [t[1] for t in true], iou, list(order),
    ]  # fmt: skip


def _detect(subject: Subject, scene: list[Any], threshold: float, category: int) -> Any:
    pred_images, pred_categories, true_images, true_categories, iou, order = scene
    scores = (np.array(order, dtype=float) + 1) / 16
    arrays = (np.array(pred_images), np.array(pred_categories), scores)
    truths = (np.array(true_images), np.array(true_categories))
    return subject(DETECTION, *arrays, *truths, np.array(iou, dtype=float), threshold, category)


def _same(value: Any, expected: Any) -> None:
    if value is None or expected is None:
        expect(value is expected, f"the AP is {value!r}, expected {expected!r}")
    else:
        close(value, expected, FINE, "the AP")


def _by_hand(scene: list[Any], threshold: float, category: int, strict: bool) -> float | None:
    """Greedy matching, written down once more; None if two fits are equally good."""
    pred_images, pred_categories, true_images, true_categories, iou, order = scene
    free = {g for g, name in enumerate(true_categories) if name == category}
    truths = len(free)
    scores, correct = [], []
    for p in sorted(range(len(order)), key=lambda p: -order[p]):
        if pred_categories[p] != category:
            continue
        fits = [
            (iou[p][g], g)
            for g in free
            if true_images[g] == pred_images[p]
            and (iou[p][g] > threshold or (iou[p][g] == threshold and not strict))
        ]
        if len({fit for fit, _ in fits}) < len(fits):
            return None
        scores.append(order[p])
        correct.append(bool(fits))
        if fits:
            free.remove(max(fits)[1])
    return exact.average_precision(scores, correct, truths, interpolated=True)


@prop(DETECTION, reason="an independent, plain matching: best score first, each ground truth once, "
      "within image and category",
      given={"scene": scenes(), "threshold": st.sampled_from([0.25, 0.5])}, weight=2)  # fmt: skip
def matched_by_hand(subject: Subject, scene: list[Any], threshold: float) -> None:
    """It is the area for the greedy matching by descending score."""
    if 0 not in scene[3]:
        return
    strict = subject.defines(DETECTION, "boundary") == "strict"
    expected = _by_hand(scene, threshold, 0, strict)
    if expected is not None:
        _same(_detect(subject, scene, threshold, 0), expected)


@prop(DETECTION, reason="ground truth as prediction is perfect", given={"scene": scenes()},
      weight=0.5)  # fmt: skip
def perfect(subject: Subject, scene: list[Any]) -> None:
    """Ground truth as prediction has AP 1."""
    if 0 in scene[3]:
        count = len(scene[3])
        iou = np.eye(count).tolist()
        same = [scene[2], scene[3], scene[2], scene[3], iou, list(range(count))]
        _same(_detect(subject, same, 0.5, 0), 1)


@prop(DETECTION, reason="a category without ground truth has no recall; as 0 it lowers the mean",
      given={"scene": scenes()}, weight=0.5)  # fmt: skip
def absent_category(subject: Subject, scene: list[Any]) -> None:
    """A category without ground truth is n/a (None)."""
    _same(_detect(subject, scene, 0.5, 7), None)


@prop(DETECTION, reason="an IoU that equals the threshold is common: 0.5 of a half box",
      given={"threshold": st.sampled_from([0.25, 0.5, 0.75])}, weight=0.25)  # fmt: skip
def boundary(subject: Subject, threshold: float) -> None:
    """An IoU on the threshold matches as the definition says."""
    inclusive = subject.defines(DETECTION, "boundary") == "inclusive"
    scene = [[0], [0], [0], [0], [[threshold]], [0]]
    _same(_detect(subject, scene, threshold, 0), float(inclusive))


@prop(DETECTION, reason="the file's order of predictions and ground truths means nothing",
      given={"scene": scenes(), "seed": seeds})  # fmt: skip
def order_of_the_input(subject: Subject, scene: list[Any], seed: int) -> None:
    """Without ties the order of predictions and ground truths changes nothing."""
    if 0 not in scene[3] or _by_hand(scene, 0.3, 0, True) is None:
        return
    rng = np.random.default_rng(seed)
    p, g = rng.permutation(len(scene[0])), rng.permutation(len(scene[2]))
    mixed = [
        np.array(scene[0])[p], np.array(scene[1])[p], np.array(scene[2])[g],
        np.array(scene[3])[g], np.array(scene[4])[p][:, g], np.array(scene[5])[p],
    ]  # fmt: skip
    _same(_detect(subject, mixed, 0.3, 0), _detect(subject, scene, 0.3, 0))


@prop(DETECTION, reason="a second detection of one object is a false positive; counted again, "
      "copies of one prediction raise the recall",
      given={"copies": st.integers(2, 4), "missed": st.integers(1, 3)}, weight=0.25)  # fmt: skip
def each_truth_once(subject: Subject, copies: int, missed: int) -> None:
    """Many detections of one of several objects find one object."""
    scene = [
        [0] * copies, [0] * copies, [0] * (1 + missed), [0] * (1 + missed),
        [[0.9] + [0.0] * missed] * copies, list(range(copies)),
    ]  # fmt: skip
    _same(_detect(subject, scene, 0.5, 0), 1 / (1 + missed))
