"""Properties of average precision by poses, and of its mean over categories."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pytest_cpas.checks.metrics import exact
from pytest_cpas.checks.metrics.average_precision import FINE
from pytest_cpas.checks.metrics.conflicts import conflicts
from pytest_cpas.checks.metrics.detections import by_hand, scenes
from pytest_cpas.checks.metrics.properties import close, expect, prop
from pytest_cpas.checks.metrics.subject import Subject

MEAN = "mean_detection_ap"
POSE = "pose_ap"
MATCHED = "matched_pose_ap"

#: Limits on the pose, and the IoU above which a detection is that of an object.
_DEGREES, _METRES, _MATCH = 10.0, 0.05, 0.1


def _same(value: Any, expected: float | None) -> None:
    if expected is None:
        expect(value is None, f"the AP is {value!r}, but nothing is to be found: None")
    else:
        close(value, expected, FINE, "the AP")


def _arrays(scene: list[Any]) -> list[Any]:
    pred_images, pred_categories, true_images, true_categories, _, order = scene
    scores = (np.array(order, dtype=float) + 1) / (len(order) + 1)
    whole = [np.array(x, dtype=int) for x in (pred_images, pred_categories)]
    true = [np.array(x, dtype=int) for x in (true_images, true_categories)]
    return [*whole, scores, *true]


# -- mean over categories ----------------------------------------------------------------------


@prop(MEAN, reason="a category without ground truth has no AP, one without detections has 0",
      given={
          "scene": scenes(),
          "categories": st.lists(st.integers(0, 3), min_size=1, max_size=4, unique=True),
      }, corners=lambda: (
          {"scene": [[0, 0, 1], [0, 1, 0], [0, 0, 1], [0, 1, 2],
                     [[0.9, 0.8, 0], [0.7, 0.4, 0], [0, 0, 0.8]], [2, 1, 0]],
           "categories": categories}
          for categories in ([0, 1, 2], [2, 1, 0], [0], [0, 3], [3], [2], [1, 2], [0, 1])
      ))  # fmt: skip
def mean_of_the_present(subject: Subject, scene: list[Any], categories: list[int]) -> None:
    """It is the mean of the APs of the categories with ground truth, None without any."""
    strict = subject.defines(MEAN, "boundary") == "strict"
    present = [c for c in categories if c in scene[3]]
    parts = [by_hand(scene, 0.45, category, strict) for category in present]
    if None in parts:
        return
    pairs = np.array(scene[4], dtype=float)
    value = subject(MEAN, *_arrays(scene), pairs, 0.45, list(categories))
    _same(value, sum(p or 0 for p in parts) / len(parts) if parts else None)


# -- by poses ----------------------------------------------------------------------------------


def _of_costs(scene: list[Any], overlap: Any) -> tuple[Any, Any]:
    """Degrees and metres such that their sum in centimetres falls with the overlap.

    Above an overlap of 0.5 both are within their limits; below, one of the two is not.
    """
    overlap = np.array(overlap, dtype=float).reshape(len(scene[0]), len(scene[2]))
    index = np.arange(overlap.size).reshape(overlap.shape)
    near = overlap > 0.5
    cost = np.where(near, (1 - overlap) * 20, 12 + 4 * (1 - overlap))
    # of what is near the cost is split in different ways, so that neither part alone ranks alike
    share = np.where(near, 0.2 + 0.6 * (index % 3) / 2, 0.9 * (index % 2))
    degrees = np.where(near, np.minimum(cost * share, 9.0), cost * share)
    metres = (cost - degrees) / 100
    metres = np.where(near & (metres > 0.049), 0.049, metres)
    return degrees, metres


def _flags(
    scene: list[Any], fits: Any, cost: Any, category: int, order: list[int]
) -> tuple[dict[int, int], bool]:
    """Each detection's ground truth, by descending score and least cost; are there equal costs."""
    free = {g for g, name in enumerate(scene[3]) if name == category}
    chosen: dict[int, int] = {}
    tied = False
    for p in order:
        near = [(cost[p][g], g) for g in free if scene[2][g] == scene[0][p] and fits[p][g]]
        tied |= len({round(c, 9) for c, _ in near}) < len(near)
        if near:
            chosen[p] = min(near)[1]
            free.discard(chosen[p])
    return chosen, tied


def _expected(scene: list[Any], degrees: Any, metres: Any, iou: Any) -> float | None:
    """The AP of category 0 by hand; None if two fits are equally good."""
    order = sorted(range(len(scene[0])), key=lambda p: -scene[5][p])
    order = [p for p in order if scene[1][p] == 0]
    truths = [g for g, name in enumerate(scene[3]) if name == 0]
    fits = (degrees <= _DEGREES) & (metres <= _METRES)
    if iou is not None:
        matched, tied = _flags(scene, iou > _MATCH, -iou, 0, order)
        if tied:
            return None
        order, truths = [p for p in order if p in matched], sorted(matched.values())
        fits = fits & np.isin(np.arange(fits.shape[1]), truths)[None]
    chosen, tied = _flags(scene, fits, degrees + 100 * metres, 0, order)
    if tied:
        return None
    if not truths:
        return 0.0
    scores = [float(len(order) - i) for i in range(len(order))]
    return exact.average_precision(scores, [p in chosen for p in order], len(truths), True)


def _detect(subject: Subject, metric: str, scene: list[Any], iou: Any) -> None:
    degrees, metres = _of_costs(scene, scene[4])
    expected = _expected(scene, degrees, metres, iou)
    if 0 in scene[3] and expected is not None:
        args = [*_arrays(scene), degrees, metres, _DEGREES, _METRES, 0]
        _same(subject(metric, *args, *([] if iou is None else [iou])), expected)


def _conflicts() -> Iterator[dict[str, Any]]:
    for overlap in conflicts():
        count, truths = len(overlap), len(overlap[0])
        order = list(range(count))[::-1]
        scene: list[list[Any]] = [[0] * count, [0] * count, [0] * truths, [0] * truths]
        yield {"scene": [*scene, overlap, order]}
        # a sure detection of another image, and of another category, beside
        for image, category in ((1, 0), (0, 1)):
            rows = [[*row, 0.97] for row in overlap] + [[0.96] * truths + [0.95]]
            names = [
                [*whole, other] for whole, other in zip(scene, (image, category) * 2, strict=True)
            ]
            yield {"scene": [*names, rows, [*order, count]]}


@prop(POSE, reason="greedy by descending score, each to the free ground truth that is nearest in "
      "degrees plus centimetres among those within both limits",
      given={"scene": scenes()}, corners=_conflicts, weight=0.5)  # fmt: skip
def matched_by_pose(subject: Subject, scene: list[Any]) -> None:
    """It is the area for the greedy matching by pose."""
    _detect(subject, POSE, scene, None)


@prop(POSE, reason="a pose that is on a limit meets it, one beside it does not",
      given={"degrees": st.sampled_from([9.999, 10.0, 10.001])}, weight=0.1, corners=lambda: (
          {"degrees": degrees} for degrees in (0.0, 9.999, 10.0, 10.001)
      ))  # fmt: skip
def limits_are_inclusive(subject: Subject, degrees: float) -> None:
    """Either limit is met by what equals it, and both must be met."""
    zero = np.array([0])
    one = [zero, zero, np.array([0.5]), zero, zero]
    for metres, near in ((0.0499, True), (0.05, True), (0.0501, False)):
        value = subject(POSE, *one, np.array([[degrees]]), np.array([[metres]]), 10.0, 0.05, 0)
        _same(value, float(near and degrees <= 10))
    _same(subject(POSE, *one, np.array([[1.0]]), np.array([[0.01]]), 10.0, 0.05, 3), None)


@prop(MATCHED, reason="detections and ground truths that are not matched at IoU 0.1 take no part: "
      "neither do they count as wrong, nor as missed",
      given={"scene": scenes(), "seed": st.integers(0, 99)}, weight=0.5, corners=lambda: (
          {"scene": case["scene"], "seed": i % 7} for i, case in enumerate(_conflicts())
      ))  # fmt: skip
def matched_by_iou_first(subject: Subject, scene: list[Any], seed: int) -> None:
    """It is the area for the greedy matching by pose, of what is matched by IoU."""
    rng = np.random.default_rng(seed)
    shape = len(scene[0]), len(scene[2])
    iou = (rng.permutation(shape[0] * shape[1]).reshape(shape) + 0.5) / (1.6 * shape[0] * shape[1])
    iou = np.where(rng.random(shape) < 0.4, iou * 0.1, iou)
    _detect(subject, MATCHED, scene, iou)
