"""Properties of the areas under precision: AUC of the IoU, VUS of the pose."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.precision import FINE
from pytest_cpas.checks.metrics.properties import REFUSED, close, expect, prop, unless_refused
from pytest_cpas.checks.metrics.strategies import Rows
from pytest_cpas.checks.metrics.subject import Subject

AUC = "iou_auc"
VUS = "pose_vus"

_IOUS = st.lists(
    st.one_of(some.real(0, 1), st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0])),
    min_size=1, max_size=6,
)  # fmt: skip
_POSES = st.lists(
    st.tuples(
        st.one_of(some.real(0, 12), st.sampled_from([0.0, 5.0, 10.0, 180.0])),
        st.one_of(some.real(0, 0.06), st.sampled_from([0.0, 0.02, 0.05, 1.0])),
    ).map(list),
    min_size=1, max_size=6,
)  # fmt: skip
_RANGES = st.sampled_from([[5.0, 0.02], [5.0, 0.05], [10.0, 0.02], [10.0, 0.05]])
_LOWER = st.sampled_from([0.25, 0.5, 0.75])


def _clip(value: float) -> float:
    return min(max(value, 0.0), 1.0)


def _bin_error(subject: Subject, metric: str, dimensions: int) -> float:
    """How far a midpoint sum may be from the integral, for each sample and so for the mean."""
    bins = subject.defines(metric, "bins")
    return FINE if bins is None else dimensions * 0.5 / bins + FINE


@prop(AUC, reason="closed form of the area: a sample adds its clipped, normalised IoU",
      given={"ious": _IOUS, "lower": _LOWER})  # fmt: skip
def closed_form(subject: Subject, ious: list[float], lower: float) -> None:
    """The area is the mean of (IoU - lower) / (1 - lower), clipped to [0, 1]."""
    expected = sum(_clip((iou - lower) / (1 - lower)) for iou in ious) / len(ious)
    close(subject(AUC, np.array(ious), lower), expected, _bin_error(subject, AUC, 1))


@prop(AUC, reason="the ends of the scale", given={"lower": _LOWER}, weight=0.25,
      name="perfect_and_hopeless")  # fmt: skip
def auc_ends(subject: Subject, lower: float) -> None:
    """IoU 1 has area 1, IoU at the lower threshold area 0."""
    close(subject(AUC, np.ones(3), lower), 1, FINE)
    close(subject(AUC, np.full(3, lower), lower), 0, FINE)


@prop(VUS, reason="closed form of the volume: a sample adds the product of its two margins",
      given={"poses": _POSES, "ranges": _RANGES}, name="closed_form")  # fmt: skip
def vus_closed_form(subject: Subject, poses: Rows, ranges: list[float]) -> None:
    """The volume is the mean of (1 - angle / largest) (1 - distance / largest), each clipped."""
    expected = sum(_clip(1 - r / ranges[0]) * _clip(1 - t / ranges[1]) for r, t in poses)
    angles, shifts = np.array(poses).T.copy()
    value = subject(VUS, angles, shifts, *ranges)
    close(value, expected / len(poses), _bin_error(subject, VUS, 2))


@prop(VUS, reason="the ends of the scale", given={"ranges": _RANGES}, weight=0.25,
      name="perfect_and_hopeless")  # fmt: skip
def vus_ends(subject: Subject, ranges: list[float]) -> None:
    """No error has volume 1; an error of the largest angle or distance alone has volume 0."""
    close(subject(VUS, np.zeros(3), np.zeros(3), *ranges), 1, FINE)
    close(subject(VUS, np.full(3, ranges[0]), np.zeros(3), *ranges), 0, FINE)
    close(subject(VUS, np.zeros(3), np.full(3, ranges[1]), *ranges), 0, FINE)


# -- ranges, sums over bins, and samples without an answer --------------------------------------


def _ranges() -> Iterator[dict[str, object]]:
    poses = [[0.0, 0.0], [3.1, 0.004], [4.9, 0.0199], [7.7, 0.031], [9.9, 0.049], [14.0, 0.09]]
    for degrees, metres in itertools.product((1.5, 5.0, 10.0, 20.0, 180.0), (0.005, 0.02, 0.1, 1)):
        yield {"poses": poses, "ranges": [degrees, float(metres)]}


@prop(VUS, reason="ranges that are written into the code, or taken for each other",
      given={
          "poses": _POSES,
          "ranges": st.tuples(some.real(1, 60), some.real(0.005, 0.5)).map(list),
      }, weight=0.5, corners=_ranges)  # fmt: skip
def any_range(subject: Subject, poses: Rows, ranges: list[float]) -> None:
    """The volume is right for other ranges than those of published tables."""
    vus_closed_form(subject, poses, ranges)


@prop(AUC, reason="a lower threshold that is written into the code",
      given={"ious": _IOUS, "lower": some.real(0, 0.95)}, weight=0.5,
      corners=lambda: (
          {"ious": [0.0, 0.05, 0.3, 0.62, 0.81, 0.97, 1.0], "lower": lower}
          for lower in (0.0, 0.1, 1 / 3, 0.9, 0.99)
      ))  # fmt: skip
def any_lower_threshold(subject: Subject, ious: list[float], lower: float) -> None:
    """The area is right for other lower thresholds than those of published tables."""
    closed_form(subject, ious, lower)


def _met(margin: float, bins: int) -> tuple[float, float] | None:
    """The share of thresholds below a margin: of the middles of bins, and by trapezoids.

    None where the margin is at one of them.
    """
    if any(abs(2 * bins * margin - edge) < 1e-6 for edge in range(2 * bins + 1)):
        return None
    middles = sum((i + 0.5) / bins < margin for i in range(bins)) / bins
    edges = [float(i / bins < margin) for i in range(bins + 1)]
    return middles, (sum(edges) - (edges[0] + edges[-1]) / 2) / bins


def _sums(subject: Subject, metric: str, margins: list[list[float]]) -> list[float] | None:
    """What the declared number of bins may give: the mean of products of shares, by either rule."""
    bins = subject.defines(metric, "bins")
    shares = [[_met(_clip(margin), bins) for margin in row] for row in margins]
    if any(share is None for row in shares for share in row):
        return None
    return [
        sum(math.prod(share[rule] for share in row if share) for row in shares) / len(shares)
        for rule in (0, 1)
    ]


def _agrees(value: float, sums: list[float] | None) -> None:
    expect(
        sums is None or any(abs(value - expected) <= 1e-9 for expected in sums),
        f"the value is {value!r}, expected {sums!r} (middles of the bins, or trapezoids)",
    )


def _in_bins() -> Iterator[list[float]]:
    """Margins in each part of a scale of 10 and of 100 bins."""
    yield [(i + 0.3) / 10 for i in range(10)]
    yield [(i + 0.8) / 10 for i in range(10)]
    for i in range(0, 100, 7):
        yield [(i + 0.3) / 100]
        yield [(i + 0.8) / 100]


@prop(AUC, reason="bins that are one too few, or shifted by half a bin, move every area alike",
      given={"margins": st.lists(some.real(0, 1), min_size=1, max_size=6), "lower": _LOWER},
      weight=0.5, applies=lambda subject: subject.defines(AUC, "bins") is not None,
      corners=lambda: ({"margins": m, "lower": 0.25} for m in _in_bins()))  # fmt: skip
def sum_over_bins(subject: Subject, margins: list[float], lower: float) -> None:
    """With bins the area is the sum over their middles, or that of trapezoids."""
    value = subject(AUC, lower + (1 - lower) * np.array(margins), lower)
    _agrees(value, _sums(subject, AUC, [[margin] for margin in margins]))


@prop(VUS, reason="bins that are one too few, or shifted by half a bin, move every volume alike",
      given={
          "margins": st.lists(
              st.tuples(some.real(0, 1), some.real(0, 1)).map(list), min_size=1, max_size=6
          ),
          "ranges": _RANGES,
      }, weight=0.5, applies=lambda subject: subject.defines(VUS, "bins") is not None,
      corners=lambda: (
          {"margins": [[m, n] for m, n in zip(one, reversed(one), strict=True)],
           "ranges": [10.0, 0.05]}
          for one in _in_bins()
      ), name="sum_over_bins")  # fmt: skip
def vus_sum_over_bins(subject: Subject, margins: Rows, ranges: list[float]) -> None:
    """With bins the volume is the sum over their middles, or that of trapezoids."""
    errors = (1 - np.array(margins)) * ranges
    value = subject(VUS, errors[:, 0].copy(), errors[:, 1].copy(), *ranges)
    _agrees(value, _sums(subject, VUS, margins))


@prop(AUC, reason="a sample without an answer adds nothing, but it is one of the samples",
      given={"answered": st.lists(st.booleans(), min_size=1, max_size=6), "lower": _LOWER},
      weight=0.25, corners=lambda: (
          {"answered": a, "lower": lower}
          for a in ([False], [True, False, False]) for lower in (0.0, 0.5)
      ), name="failed_samples")  # fmt: skip
def auc_of_failed(subject: Subject, answered: list[bool], lower: float) -> None:
    """A sample with an IoU of minus infinity has area 0, and counts."""
    ious = np.where(answered, 1.0, -np.inf)
    value = unless_refused(subject, AUC, ious, lower)
    if value is not REFUSED:
        close(value, sum(answered) / len(answered), FINE)


@prop(VUS, reason="a sample without an answer adds nothing, but it is one of the samples",
      given={
          "answered": st.lists(st.booleans(), min_size=1, max_size=6),
          "which": st.integers(0, 2), "ranges": _RANGES,
      }, weight=0.25, corners=lambda: (
          {"answered": a, "which": which, "ranges": [5.0, 0.02]}
          for a in ([False], [True, False, False]) for which in range(3)
      ), name="failed_samples")  # fmt: skip
def vus_of_failed(subject: Subject, answered: list[bool], which: int, ranges: list[float]) -> None:
    """A sample with an infinite error has volume 0, and counts."""
    errors = [np.where(answered, 0.0, np.inf if which in (i, 2) else 0.0) for i in range(2)]
    value = unless_refused(subject, VUS, *errors, *ranges)
    if value is not REFUSED:
        close(value, sum(answered) / len(answered), FINE)


def _is_none(value: Any) -> bool:
    return value is REFUSED or value is None or math.isnan(value)


@prop(AUC, reason="no samples are none, and 0 is the worst of all areas",
      given={"lower": _LOWER}, weight=0.1, name="no_samples")  # fmt: skip
def auc_of_nothing(subject: Subject, lower: float) -> None:
    """Without samples there is no area: None, NaN, or an error."""
    value = unless_refused(subject, AUC, np.zeros(0), lower)
    expect(_is_none(value), f"the area of no samples is {value!r}")


@prop(VUS, reason="no samples are none, and 0 is the worst of all volumes",
      given={"ranges": _RANGES}, weight=0.1, name="no_samples")  # fmt: skip
def vus_of_nothing(subject: Subject, ranges: list[float]) -> None:
    """Without samples there is no volume: None, NaN, or an error."""
    value = unless_refused(subject, VUS, np.zeros(0), np.zeros(0), *ranges)
    expect(_is_none(value), f"the volume of no samples is {value!r}")
