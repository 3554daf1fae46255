"""Average precision of detections by the NOCS protocol (Wang et al. 2019, "mAP").

Per category over all images: predictions by descending score; each is matched to the free ground
truth of its image and category that fits best, if it fits well enough; AP is the area under the
interpolated precision-recall curve; mAP is the mean over the categories.

Everything works on candidate pairs (prediction, ground truth of the same image and category), so
that any IoU and any pose error can be ranked. Ties never depend on the order of the input:
predictions with equal scores enter the curve together, and in an image the better fit goes first.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pytest_cpas.types import ContractError
from pytest_cpas.types._arrays import MAX, checked_number, finite_array

__all__ = ["POSE_MATCH_IOU", "AveragePrecision", "Detections", "Matches", "interpolated_area"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Pairs of a prediction and a ground truth of its image and category. REAL275 has some 20,000.
MOST_PAIRS = 4_000_000

#: IoU at which "use matches for pose" pairs predictions with ground truth.
POSE_MATCH_IOU = 0.1


@dataclass(frozen=True)
class AveragePrecision:
    """AP of each category (None: it has no ground truth) and their mean."""

    by_category: dict[int, float | None]

    def __post_init__(self) -> None:
        for category, value in self.by_category.items():
            if value is not None:
                checked_number(value, f"AP of category {category!r}", 0, 1 + 1e-9)

    @property
    def mean(self) -> float | None:
        """mAP: mean over the categories that have ground truth; None (n/a) if none has."""
        present = [value for value in self.by_category.values() if value is not None]
        return float(np.mean(present)) if present else None


@dataclass(frozen=True, eq=False)
class Matches:
    """Which predictions are right, and what of both sides takes part.

    ``matched`` and ``taking_part`` (P,) of the predictions, ``counted`` (G,) of the ground truth.
    """

    matched: NDArray[np.bool_]
    taking_part: NDArray[np.bool_]
    counted: NDArray[np.bool_]


class Detections:
    """Predictions and ground truth of a data set, and the pairs that can match.

    ``pred_image``, ``pred_category``, ``pred_score`` (P,) and ``true_image``, ``true_category``
    (G,). ``pairs`` (K, 2) holds all (prediction, ground truth) indices of equal image and
    category; errors are given in its order. ``categories``: those that are judged.
    """

    def __init__(
        self,
        pred_image: ArrayLike,
        pred_category: ArrayLike,
        pred_score: ArrayLike,
        true_image: ArrayLike,
        true_category: ArrayLike,
        categories: Sequence[int],
    ) -> None:
        self.scores = finite_array(pred_score, "detections: scores", MAX)
        self.pred_category = _names(pred_category, "categories of the predictions")
        self.true_category = _names(true_category, "categories of the ground truth")
        if not isinstance(categories, Iterable) or not all(
            isinstance(name, int | str | np.integer) for name in categories
        ):
            raise ContractError(f"detections: categories {categories!r:.100}, expected integers")
        self.categories = tuple(categories)
        images = tuple(
            _names(image, f"images of the {what}")
            for what, image in (("predictions", pred_image), ("ground truth", true_image))
        )
        if self.scores.ndim != 1:
            raise ContractError(f"detections: scores of shape {self.scores.shape}, expected (P,)")
        for what, expected, arrays in (
            ("predictions", len(self.scores), (images[0], self.pred_category)),
            ("ground truth", len(self.true_category), (images[1],)),
        ):
            if any(array.shape != (expected,) for array in arrays):
                raise ContractError(
                    f"detections: the arrays of the {what} have shapes"
                    f" {[array.shape for array in arrays]}, expected ({expected},)"
                )
        keys = [
            np.stack([image, category], axis=1)
            for image, category in zip(
                images, (self.pred_category, self.true_category), strict=True
            )
        ]
        _, group = np.unique(np.concatenate(keys), axis=0, return_inverse=True)
        self.pairs = _equal_pairs(group[: len(self.scores)], group[len(self.scores) :])

    def iou_ap(self, iou: ArrayLike, threshold: float) -> AveragePrecision:
        """AP at an IoU threshold. ``iou`` (K,) of the pairs; a match is **above** the threshold."""
        return self.average_precision(self.iou_matches(iou, threshold))

    def iou_matches(self, iou: ArrayLike, threshold: float) -> Matches:
        """What :meth:`iou_ap` ranks."""
        iou = self._per_pair(iou, "iou", 1 + 1e-9)
        threshold = checked_number(threshold, "iou_ap: threshold", 0, 1)
        matched, _ = self._match(-iou, iou > threshold)
        everything = np.ones(len(self.scores), dtype=bool), np.ones(len(self.true_category), bool)
        return Matches(matched, *everything)

    def pose_ap(
        self,
        rotation_deg: ArrayLike,
        position_m: ArrayLike,
        max_rotation_deg: float,
        max_position_m: float,
        *,
        match_iou: ArrayLike | None = None,
    ) -> AveragePrecision:
        """AP at a joint pose threshold, met by errors up to and including both limits.

        ``rotation_deg``, ``position_m`` (K,) of the pairs; matched is what has the least sum of
        degrees and centimetres. ``match_iou`` (K,) switches to "use matches for pose", which the
        literature prints: only predictions and ground truth matched at IoU 0.1 take part.
        """
        limits = max_rotation_deg, max_position_m
        return self.average_precision(
            self.pose_matches(rotation_deg, position_m, *limits, match_iou=match_iou)
        )

    def pose_matches(
        self,
        rotation_deg: ArrayLike,
        position_m: ArrayLike,
        max_rotation_deg: float,
        max_position_m: float,
        *,
        match_iou: ArrayLike | None = None,
    ) -> Matches:
        """What :meth:`pose_ap` ranks."""
        rotation = self._per_pair(rotation_deg, "rotation_deg")
        position = self._per_pair(position_m, "position_m")
        checked_number(max_rotation_deg, "pose_ap: max_rotation_deg", 0, MAX)
        checked_number(max_position_m, "pose_ap: max_position_m", 0, MAX)
        with np.errstate(over="ignore"):  # what is so far off is near nothing
            cost = rotation + 100 * position
        near = (rotation <= max_rotation_deg) & (position <= max_position_m)
        taking_part = np.ones(len(self.scores), dtype=bool)
        counted = np.ones(len(self.true_category), dtype=bool)
        if match_iou is not None:
            iou = self._per_pair(match_iou, "match_iou", 1 + 1e-9)
            taking_part, counted = self._match(-iou, iou > POSE_MATCH_IOU)
            near &= taking_part[self.pairs[:, 0]] & counted[self.pairs[:, 1]]
        matched, _ = self._match(cost, near)
        return Matches(matched, taking_part, counted)

    def average_precision(self, matches: Matches) -> AveragePrecision:
        """AP of each category."""
        counted = self.true_category[matches.counted]
        areas: dict[int, float | None] = {}
        for category in self.categories:
            if not np.any(self.true_category == category):
                areas[category] = None
                continue
            chosen = matches.taking_part & (self.pred_category == category)
            truths = int(np.count_nonzero(counted == category))
            areas[category] = interpolated_area(
                self.scores[chosen], matches.matched[chosen], truths
            )
        return AveragePrecision(areas)

    def _per_pair(self, value: ArrayLike, name: str, most: float = np.inf) -> Array:
        """An error, infinite for a failed prediction, or an IoU up to ``most`` for each pair."""
        values = finite_array(value, name, np.inf)
        if values.shape != (len(self.pairs),):
            raise ContractError(
                f"{name}: shape {values.shape}, expected ({len(self.pairs)},), one for each of the"
                " pairs"
            )
        if values.size and not (values.min() >= 0 and values.max() <= most):
            limit = "" if most == np.inf else ", 1 at most"
            raise ContractError(
                f"{name}: from {values.min():g} to {values.max():g}, expected 0 or more{limit}"
            )
        return values

    def _match(
        self, cost: Array, allowed: NDArray[np.bool_]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which predictions and which ground truth are matched, greedily by descending score.

        Every prediction takes the free ground truth of least ``cost`` among the ``allowed`` pairs.
        """
        pred, true = self.pairs[allowed].T
        cost = cost[allowed]
        least = np.full(len(self.scores), np.inf)
        np.minimum.at(least, pred, cost)
        order = np.lexsort((true, cost, pred, least[pred], -self.scores[pred]))
        pred, true = pred[order], true[order]
        pred_matched = np.zeros(len(self.scores), dtype=bool)
        true_matched = np.zeros(len(self.true_category), dtype=bool)
        pred_free, true_free = [True] * len(pred_matched), [True] * len(true_matched)
        for prediction, truth in zip(pred.tolist(), true.tolist(), strict=True):
            if pred_free[prediction] and true_free[truth]:
                pred_free[prediction] = true_free[truth] = False
                pred_matched[prediction] = true_matched[truth] = True
        return pred_matched, true_matched


def _names(value: ArrayLike, what: str) -> NDArray[np.generic]:
    """Integers or texts by which images or categories are told apart."""
    try:
        names = np.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ContractError(f"detections: {what} are no names ({error})") from None
    if names.ndim == 1 and names.size == 0:
        return names.astype(np.int64)
    if names.dtype.kind == "f":
        names = names.astype(np.float64)
    if (
        names.dtype.kind == "f"
        and (np.abs(names) < 2**53).all()
        and (names == np.floor(names)).all()
    ):
        names = names.astype(np.int64)
    if names.ndim != 1 or names.dtype.kind not in "iuU":
        raise ContractError(
            f"detections: {what} are {names.shape} of {names.dtype}, expected (N,) integers or"
            " texts"
        )
    return names


def _equal_pairs(left: Indices, right: Indices) -> Indices:
    """All (i, j) with ``left[i] == right[j]``, as (K, 2), in the order of i, then j."""
    order = np.argsort(right, kind="stable")
    start = np.searchsorted(right[order], left, side="left")
    stop = np.searchsorted(right[order], left, side="right")
    lengths = stop - start
    if (count := int(lengths.sum())) > MOST_PAIRS:
        raise ContractError(
            f"detections: {count} pairs of a prediction and a ground truth of one image and"
            f" category, at most {MOST_PAIRS} are matched; give each image a name of its own, or"
            " leave out the predictions with the lowest scores"
        )
    i = np.repeat(np.arange(len(left)), lengths)
    within = np.arange(len(i)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return np.stack([i, order[start[i] + within]], axis=1)


def interpolated_area(scores: Array, correct: NDArray[np.bool_], truths: int) -> float:
    """Area under the interpolated precision-recall curve; 0 if nothing is correct.

    ``scores`` (P,) and ``correct`` (P,) of the predictions of a category, of which there are
    ``truths`` to find. Predictions with equal scores enter together.
    """
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(correct[order])
    if truths == 0 or len(hits) == 0 or hits[-1] == 0:
        return 0.0
    ranked = scores[order]
    last_of_tie = np.append(ranked[1:] != ranked[:-1], True)
    hits = hits[last_of_tie]
    precision = hits / (np.flatnonzero(last_of_tie) + 1)
    # the precision at a recall is the best at that recall or any larger one
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(np.diff(hits, prepend=0) * envelope) / truths)
