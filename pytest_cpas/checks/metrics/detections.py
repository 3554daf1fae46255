"""Properties of the average precision of detections, with their matching."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pytest_cpas.checks.metrics import exact
from pytest_cpas.checks.metrics.average_precision import FINE, SCALES
from pytest_cpas.checks.metrics.conflicts import conflicts
from pytest_cpas.checks.metrics.properties import close, expect, prop
from pytest_cpas.checks.metrics.strategies import seeds
from pytest_cpas.checks.metrics.subject import Subject

DETECTION = "detection_ap"


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


def _detect(
    subject: Subject, scene: list[Any], threshold: float, category: int, scale: Any = float
) -> Any:
    pred_images, pred_categories, true_images, true_categories, iou, order = scene
    step = 1 / max(16, 1 + len(order))
    scores = np.array([scale((rank + 1) * step) for rank in order], dtype=float)
    arrays = (np.array(pred_images, dtype=int), np.array(pred_categories, dtype=int), scores)
    truths = (np.array(true_images, dtype=int), np.array(true_categories, dtype=int))
    pairs = np.array(iou, dtype=float).reshape(len(order), len(true_images))
    return subject(DETECTION, *arrays, *truths, pairs, threshold, category)


def _same(value: Any, expected: Any) -> None:
    if value is None or expected is None:
        expect(value is expected, f"the AP is {value!r}, expected {expected!r}")
    else:
        close(value, expected, FINE, "the AP")


def by_hand(scene: list[Any], threshold: float, category: int, strict: bool) -> float | None:
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
    expected = by_hand(scene, threshold, 0, strict)
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
    if 0 not in scene[3] or by_hand(scene, 0.3, 0, True) is None:
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


# -- scenes in which matching rules differ -----------------------------------------------------


def _among_others(scene: list[Any], kind: str) -> list[Any]:
    """The scene with a detection and a ground truth of another image or category in its midst."""
    pred_images, pred_categories, true_images, true_categories, iou, order = scene
    image, category = {"image": (1, 0), "category": (0, 1), "both": (1, 1)}[kind]
    # they fit everything of the scene best of all, and the detection is surest
    rows = [[*row, 0.97] for row in iou] + [[0.96] * len(true_images) + [0.95]]
    return [
        [*pred_images, image], [*pred_categories, category],
        [*true_images, image], [*true_categories, category],
        rows, [*order, len(order)],
    ]  # fmt: skip


def _conflicts() -> Iterator[dict[str, Any]]:
    for iou in conflicts():
        count, truths = len(iou), len(iou[0])
        order = list(range(count))[::-1]
        scene = [[0] * count, [0] * count, [0] * truths, [0] * truths, iou, order]
        yield {"scene": scene, "threshold": 0.5}
        for kind in ("image", "category", "both"):
            yield {"scene": _among_others(scene, kind), "threshold": 0.5}
        # the same in another order of the input
        yield {"scene": [*scene[:4], iou[::-1], order[::-1]], "threshold": 0.5}
        yield {"scene": [*scene[:4], [row[::-1] for row in iou], order], "threshold": 0.5}


@prop(DETECTION, reason="rules of matching give the same on most scenes: these are the smallest on "
      "which one of them parts from the right one",
      given={"scene": scenes(), "threshold": st.sampled_from([0.1, 0.25, 0.5, 0.75])},
      corners=_conflicts)  # fmt: skip
def where_rules_differ(subject: Subject, scene: list[Any], threshold: float) -> None:
    """It is the area for the greedy matching wherever another rule gives another area."""
    matched_by_hand(subject, scene, threshold)


_SCENE = [[0, 0, 0, 1, 1], [0, 0, 0, 0, 0], [0, 0, 1], [0, 0, 0],
          [[0.6, 0.1, 0], [0.7, 0.8, 0], [0.1, 0.9, 0], [0, 0, 0.3], [0, 0, 0.7]],
          [4, 2, 3, 1, 0]]  # fmt: skip


@prop(DETECTION, reason="scores may be logits, negative distances, or probabilities near 0 or 1",
      given={"scene": scenes(), "scale": st.sampled_from(sorted(SCALES))}, weight=0.5,
      corners=lambda: ({"scene": _SCENE, "scale": scale} for scale in SCALES))  # fmt: skip
def any_scores(subject: Subject, scene: list[Any], scale: str) -> None:
    """Negative, tiny, large and nearly equal scores rank as others do."""
    if 0 in scene[3] and (expected := by_hand(scene, 0.25, 0, True)) is not None:
        _same(_detect(subject, scene, 0.25, 0, SCALES[scale]), expected)


@prop(DETECTION, reason="the best 100 of an image are kept by evaluations of other fields; images "
      "and categories are names, not places in an array",
      given={"seed": seeds, "images": st.sampled_from([1, 3])}, weight=0.1,
      corners=lambda: (
          {"seed": seed, "images": images} for seed, images in ((0, 1), (1, 1), (2, 4), (3, 30))
      ))  # fmt: skip
def many_detections(subject: Subject, seed: int, images: int) -> None:
    """More than a hundred detections, in images with any numbers, are matched to the last one."""
    rng = np.random.default_rng(seed)
    count, truths = 130 + 20 * images, 12 + 3 * images
    names = (rng.choice(10_000, images, replace=False) * 7919).tolist()
    pred, true = rng.choice(names, count).tolist(), rng.choice(names, truths).tolist()
    categories = [1000, 7], [0.8, 0.2]
    iou = rng.permutation(count * truths).reshape(count, truths) / (count * truths)
    scene = [
        pred, rng.choice(*categories[:1], count, p=categories[1]).tolist(),
        true, [7, *rng.choice(*categories[:1], truths - 1, p=categories[1]).tolist()],
        iou.tolist(), rng.permutation(count).tolist(),
    ]  # fmt: skip
    for category in (1000, 7):
        _same(_detect(subject, scene, 0.9, category), by_hand(scene, 0.9, category, True))


@prop(DETECTION, reason="an image of which nothing is known, or in which nothing was found, is one",
      given={"copies": st.integers(1, 3)}, weight=0.1)  # fmt: skip
def nothing_in_common(subject: Subject, copies: int) -> None:
    """Detections in images without ground truth are wrong, and ground truth elsewhere is missed."""
    scene: list[Any] = [
        [0] + [1] * copies, [0] * (1 + copies), [0, 2], [0, 0],
        [[0.9, 0.9]] + [[0.95, 0.95]] * copies, list(range(1 + copies)),
    ]  # fmt: skip
    _same(_detect(subject, scene, 0.5, 0), by_hand(scene, 0.5, 0, True))
    empty: list[Any] = [[], [], [0, 2], [0, 0], np.zeros((0, 2)).tolist(), []]
    _same(_detect(subject, empty, 0.5, 0), 0)


@prop(DETECTION, reason="small integers, and single precision, take large numbers for each other",
      given={"first": st.integers(0, 100), "power": st.sampled_from([8, 16, 24]),
             "categories": st.booleans()},
      weight=0.1, corners=lambda: (
          {"first": 3, "power": power, "categories": categories}
          for power in (8, 16, 24) for categories in (False, True)
      ))  # fmt: skip
def large_numbers(subject: Subject, first: int, power: int, categories: bool) -> None:
    """Images and categories whose numbers differ by a power of two are different ones."""
    names, same = [first, first + 2**power + (power == 24)], [0, 0]
    scene: list[Any] = [names, same, names[:1], same[:1], [[0.4], [0.9]], [0, 1]]
    if categories:
        scene = [same, names, same[:1], names[:1], [[0.4], [0.9]], [0, 1]]
    category = scene[3][0]
    _same(_detect(subject, scene, 0.3, category), by_hand(scene, 0.3, category, True))
