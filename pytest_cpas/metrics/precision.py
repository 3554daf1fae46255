"""Precision: the share of samples that meet thresholds, as counts.

A sample's errors are a mapping from a name of :data:`METRICS` to a number; ``None`` (or a name
that is left out) is n/a: the method or the data set does not give it. n/a never becomes a number:
a sample for which a threshold cannot be judged takes no part in that threshold's count.

Precision is P of Bruns & Jensfelt (2023); AUC and VUS are those of Omni6DPose (Zhang et al. 2024).
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaincinv

from pytest_cpas.types import ContractError
from pytest_cpas.types._arrays import (
    MAX,
    checked_integer,
    checked_number,
    finite_array,
)

__all__ = [
    "FAILED",
    "METRICS",
    "PAPER_THRESHOLDS",
    "Count",
    "Errors",
    "JointThreshold",
    "best_and_worst",
    "count",
    "count_by_category",
    "curve",
    "iou_auc",
    "mean_over_categories",
    "pose_vus",
]

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Row = Mapping[str, float | None]

#: The metrics that can be thresholded, and whether a larger value is the better one. Rotation in
#: degrees, position in metres, the others without unit.
METRICS: Mapping[str, bool] = MappingProxyType(
    {"rotation_deg": False, "position_m": False, "iou": True, "fscore": True, "nad": False}
)

#: The errors of a sample for which a method gave no answer: it meets no threshold, not even
#: F >= 0. Of a method that never gives a shape, leave out what stays n/a in its other samples.
FAILED: Mapping[str, float] = MappingProxyType(
    {name: -np.inf if larger_is_better else np.inf for name, larger_is_better in METRICS.items()}
)


#: By how much rounding may bring a share above 1.
_SLACK = 1e-9

#: More bins than that are a slip of the pen.
_MOST_BINS = 1_000_000


def _meets(name: str, values: Array, threshold: float) -> NDArray[np.bool_]:
    """The boundary belongs to the correct side: d <= threshold, IoU >= threshold."""
    return values >= threshold if METRICS[name] else values <= threshold


@dataclass(frozen=True)
class JointThreshold:
    """A sample is correct if it meets all of these; None is no threshold.

    ``rotation_deg`` (degrees), ``position_m`` (metres) and ``nad`` are upper limits, ``iou`` and
    ``fscore`` lower ones. A value on its limit meets it.
    """

    rotation_deg: float | None = None
    position_m: float | None = None
    iou: float | None = None
    fscore: float | None = None
    nad: float | None = None

    def __post_init__(self) -> None:
        if not self.limits:
            raise ContractError("joint threshold: no limit is given, expected at least one")
        for name, limit in self.limits.items():
            checked_number(limit, f"joint threshold: {name}", 0, MAX)

    @property
    def limits(self) -> dict[str, float]:
        """The limits that are set, by metric."""
        values = ((name, getattr(self, name)) for name in METRICS)
        return {name: value for name, value in values if value is not None}

    @property
    def label(self) -> str:
        """For tables: ``10 deg, 2 cm, F 0.6``."""
        patterns = {
            "rotation_deg": "{:.10g} deg",
            "position_m": "{:.10g} cm",
            "iou": "IoU {:.10g}",
            "fscore": "F {:.10g}",
            "nad": "NAD {:.10g}",
        }
        return ", ".join(
            patterns[name].format(100 * limit if name == "position_m" else limit)
            for name, limit in self.limits.items()
        )

    def is_correct(self, **errors: float | None) -> bool | None:
        """Whether one sample's errors meet all limits; None (n/a) if one cannot be judged."""
        judged = count(Errors.from_rows([errors]), self)
        return None if judged is None else judged.correct == 1


#: The joint thresholds of the paper's tables.
PAPER_THRESHOLDS = (
    JointThreshold(rotation_deg=10, position_m=0.02),
    JointThreshold(rotation_deg=10, position_m=0.02, fscore=0.6),
    JointThreshold(rotation_deg=5, position_m=0.01),
    JointThreshold(rotation_deg=5, position_m=0.01, fscore=0.8),
)


@dataclass(frozen=True)
class Count:
    """``correct`` of ``total`` samples; ``total`` is at least 1 (no samples at all is n/a)."""

    correct: int
    total: int

    def __post_init__(self) -> None:
        for name in ("correct", "total"):
            part = checked_integer(getattr(self, name), f"count: {name}", -(2**62))
            object.__setattr__(self, name, part)
        if not 0 <= self.correct <= self.total or self.total < 1:
            raise ContractError(f"count: {self.correct} of {self.total} is impossible")

    @property
    def precision(self) -> float:
        """The share that is correct."""
        return self.correct / self.total

    def interval(self, confidence: float = 0.95) -> tuple[float, float]:
        """The exact (Clopper-Pearson) binomial confidence interval of the precision."""
        confidence = checked_number(confidence, "confidence, between 0 and 1", 0, 1)
        if not 0 < confidence < 1:
            raise ContractError(f"confidence: {confidence}, expected a number between 0 and 1")
        tail = (1 - confidence) / 2
        wrong = self.total - self.correct
        low = betaincinv(self.correct, wrong + 1, tail) if self.correct else 0.0
        high = betaincinv(self.correct + 1, wrong, 1 - tail) if wrong else 1.0
        return float(low), float(high)

    def __add__(self, other: Count) -> Count:
        return Count(self.correct + other.correct, self.total + other.total)


class Errors:
    """The errors of N samples by metric: ``values[name]`` (N,) where ``known[name]`` (N,) is true.

    Made from columns (arrays without a NaN, or sequences with None where n/a); a metric that is
    left out, or None as a whole, is n/a for every sample. Raises :class:`ContractError` for what is
    no error: negative, an IoU or an F-score above 1, NaN.
    """

    def __init__(self, columns: Mapping[str, ArrayLike | Sequence[float | None] | None]) -> None:
        unknown = sorted(set(columns) - set(METRICS))
        if unknown:
            raise ContractError(f"errors: unknown metrics {unknown}, expected {list(METRICS)}")
        self.values: dict[str, Array] = {}
        self.known: dict[str, NDArray[np.bool_]] = {}
        for name, column in columns.items():
            if column is None:
                continue
            self.values[name], self.known[name] = _column(name, column)
        lengths = {name: len(values) for name, values in self.values.items()}
        if len(set(lengths.values())) > 1:
            raise ContractError(f"errors: the columns have different lengths, {lengths}")

    @classmethod
    def from_rows(cls, rows: Sequence[Row]) -> Errors:
        """From one mapping per sample."""
        if not all(isinstance(row, Mapping) for row in rows):
            raise ContractError("errors: expected a mapping from metrics to numbers per sample")
        names = [name for name in METRICS if any(row.get(name) is not None for row in rows)]
        for row in rows:
            if not set(row) <= set(METRICS):
                unknown = sorted(set(row) - set(METRICS))
                raise ContractError(f"errors: unknown metrics {unknown}, expected {list(METRICS)}")
        return cls({name: [row.get(name) for row in rows] for name in names})

    def judge(
        self, threshold: JointThreshold
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]] | None:
        """Per sample: is it correct, and can it be judged; None if none can be."""
        limits = threshold.limits
        if not set(limits) <= set(self.values):
            return None
        known = np.logical_and.reduce([self.known[name] for name in limits])
        correct = np.logical_and.reduce(
            [_meets(name, self.values[name], limit) for name, limit in limits.items()]
        )
        # what is unknown is NaN here and meets no limit
        return correct, known


def _column(name: str, column: ArrayLike | Sequence[float | None]) -> tuple[Array, Flags]:
    """Values (N,), NaN where n/a, and where they are known; :class:`ContractError`."""
    try:
        given = np.asarray(column)
        known = np.ones(given.shape, dtype=bool)
        if given.dtype == object:
            known = np.array([entry is not None for entry in given.flat], dtype=bool)
            if not all(isinstance(entry, Real) for entry in given[known].flat):
                raise TypeError("not all of it are numbers or None")
        elif given.dtype.kind not in "biuf":
            raise TypeError(f"of {given.dtype}")
        with np.errstate(over="ignore"):  # it becomes infinite, which is judged below
            values = given.astype(np.float64)
    except (TypeError, ValueError, OverflowError, IndexError) as error:
        raise ContractError(f"errors: {name} is no column of numbers ({error})") from None
    if values.ndim != 1:
        raise ContractError(f"errors: {name} has shape {values.shape}, expected (N,)")
    if bad := int(np.count_nonzero(np.isnan(values) & known)):
        raise ContractError(
            f"errors: {bad} values of {name} are NaN; pass None where it is n/a, FAILED where the"
            " method gave no answer"
        )
    _check_errors(name, values[known])
    return values, known


def _check_errors(name: str, values: Array) -> None:
    """Raise :class:`ContractError` unless all are errors that there can be, or of FAILED."""
    most = 1 + _SLACK if name in ("iou", "fscore") else np.inf
    wrong = ((values < 0) | (values > most)) & (values != FAILED[name])
    if wrong.any():
        expected = f"0 or more, FAILED has {FAILED[name]}" + (", 1 at most" if most < 2 else "")
        raise ContractError(f"errors: {name} is {values[wrong][0]:g}, expected {expected}")


def count(
    errors: Errors, threshold: JointThreshold, among: NDArray[np.bool_] | None = None
) -> Count | None:
    """How many samples (of those ``among``, (N,) bool) are correct.

    None (n/a) if none of them can be judged.
    """
    judged = errors.judge(threshold)
    if judged is None:
        return None
    correct, known = judged
    if among is not None:
        among = np.asarray(among)
        if among.dtype != bool or among.shape != known.shape:
            raise ContractError(
                f"among: {among.shape} of {among.dtype}, expected {known.shape} of bool"
            )
        correct, known = correct & among, known & among
    total = int(np.count_nonzero(known))
    return Count(int(np.count_nonzero(correct)), total) if total else None


def count_by_category(
    errors: Errors, categories: Sequence[str], threshold: JointThreshold, names: Iterable[str]
) -> dict[str, Count | None]:
    """The count of each category in ``names``; ``categories`` gives each sample's.

    A category without samples is None (n/a).
    """
    of_sample = np.asarray(categories, dtype=str)
    return {name: count(errors, threshold, of_sample == name) for name in names}


def mean_over_categories(counts: Mapping[str, Count | None]) -> float | None:
    """Mean of the categories' precisions; absent categories take no part; None if all are."""
    if not all(entry is None or isinstance(entry, Count) for entry in counts.values()):
        raise ContractError("mean_over_categories: expected a Count, or None, per category")
    present = [entry.precision for entry in counts.values() if entry is not None]
    return float(np.mean(present)) if present else None


def curve(
    errors: Errors, metric: str, thresholds: Iterable[float], among: NDArray[np.bool_] | None = None
) -> list[Count] | None:
    """Counts against thresholds on one metric alone; None (n/a) if it is known of no sample."""
    if metric not in METRICS:
        raise ContractError(f"curve: metric {metric!r}, expected one of {', '.join(METRICS)}")
    limits = finite_array(
        list(thresholds) if isinstance(thresholds, Iterable) else thresholds,
        "curve: thresholds",
        MAX,
    )
    if limits.ndim != 1:
        raise ContractError(f"curve: thresholds of shape {limits.shape}, expected (N,)")
    counts = [count(errors, JointThreshold(**{metric: float(limit)}), among) for limit in limits]
    present = [entry for entry in counts if entry is not None]
    return present if present else None


def best_and_worst(
    hypotheses: Sequence[Sequence[Row]], threshold: JointThreshold
) -> tuple[Count, Count] | None:
    """P_best and P_worst: counts of samples whose best (worst) hypothesis is correct.

    ``hypotheses``: each sample's hypotheses' errors. The best is correct if any is, the worst if
    all are. A sample without hypotheses counts as not correct; one with a hypothesis that cannot
    be judged takes no part. None (n/a) if no sample is judged.
    """
    answers = [list(rows) or [FAILED] for rows in hypotheses]
    judged = Errors.from_rows([row for rows in answers for row in rows]).judge(threshold)
    if judged is None:
        return None
    correct, known = judged
    lengths = np.array([len(rows) for rows in answers])
    starts = np.cumsum(lengths) - lengths
    all_known = np.logical_and.reduceat(known, starts)
    total = int(np.count_nonzero(all_known))
    if total == 0:
        return None
    best = np.logical_or.reduceat(correct, starts) & all_known
    worst = np.logical_and.reduceat(correct, starts) & all_known
    return Count(int(np.count_nonzero(best)), total), Count(int(np.count_nonzero(worst)), total)


def _scores(value: ArrayLike, metric: str, name: str) -> Array:
    """Errors (N,) of a metric, none of them n/a."""
    with np.errstate(over="ignore"):
        values, known = _column(metric, value)
    if not known.all():
        raise ContractError(f"{name}: {metric} is None somewhere; leave samples out that are n/a")
    return values


def share_met(margins: Array, bins: int | None) -> Array:
    """For each sample the share of thresholds in (0, 1) below its ``margin``.

    Exact, or of the middles of ``bins`` equal intervals.
    """
    if bins is None:
        return np.clip(margins, 0, 1)
    bins = checked_integer(bins, "bins", 1, _MOST_BINS)
    middles = (np.arange(bins) + 0.5) / bins
    return np.searchsorted(middles, margins, side="left") / bins


def _quotient(errors: Array, largest: float) -> Array:
    with np.errstate(over="ignore"):  # far beyond the largest threshold is far enough
        return errors / largest


def iou_auc(iou: ArrayLike, lower: float, *, bins: int | None = None) -> float | None:
    """Area under the precision curve over IoU thresholds from ``lower`` to 1, over its width.

    ``iou`` (N,). Omni6DPose uses ``lower`` 0.25, 0.5 and 0.75. The integral is exact; with
    ``bins`` it is the midpoint sum that Omni6DPose's code prints (10, 100 and 100 bins). None
    (n/a) for no samples.
    """
    values = _scores(iou, "iou", "iou_auc")
    lower = checked_number(lower, "iou_auc: lower", 0, 1)
    if not 0 <= lower < 1:
        raise ContractError(f"iou_auc: lower is {lower}, expected 0 <= lower < 1")
    if len(values) == 0:
        return None
    return float(np.mean(share_met((values - lower) / (1 - lower), bins)))


def pose_vus(
    rotation_deg: ArrayLike,
    position_m: ArrayLike,
    max_rotation_deg: float,
    max_position_m: float,
    *,
    bins: int | None = None,
) -> float | None:
    """Volume under the precision surface over rotation and position thresholds, normalised.

    ``rotation_deg`` (N,) degrees and ``position_m`` (N,) metres; the thresholds run from 0 to the
    two maxima (Omni6DPose: 5 deg 2 cm, 5 deg 5 cm, 10 deg 2 cm, 10 deg 5 cm). The integral is
    exact; with ``bins`` it is the midpoint sum that Omni6DPose's code prints (100 per axis). None
    (n/a) for no samples.
    """
    rotation = _scores(rotation_deg, "rotation_deg", "pose_vus")
    position = _scores(position_m, "position_m", "pose_vus")
    if len(rotation) != len(position):
        raise ContractError(f"pose_vus: {len(rotation)} rotations but {len(position)} positions")
    for name, limit in (("rotation_deg", max_rotation_deg), ("position_m", max_position_m)):
        checked_number(limit, f"pose_vus: the largest {name}", sys.float_info.min, MAX)
    if len(rotation) == 0:
        return None
    # a sample's part of the volume is the product of the shares of thresholds that it meets
    return float(
        np.mean(
            share_met(1 - _quotient(rotation, max_rotation_deg), bins)
            * share_met(1 - _quotient(position, max_position_m), bins)
        )
    )
