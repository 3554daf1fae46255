"""Properties of what else is called IoU: of boxes along the camera's axes, and without a scale."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.adapter import Box
from pytest_cpas.checks.metrics.boxes import COARSE, FINE, IOU
from pytest_cpas.checks.metrics.properties import close, prop
from pytest_cpas.checks.metrics.strategies import Rows, as_box, turned
from pytest_cpas.checks.metrics.subject import Subject

Array = NDArray[np.float64]

ALIGNED = "axis_aligned_iou"
LEGACY = "legacy_iou"
PLUS = "iou_plus"
SCALED = "equal_diagonals_iou"
RELATIVE = "relative_translation_error"


def _corners(box: Box, spin: float = 0.0) -> Array:
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    return signs * box.extents @ (box.rotation @ turned([0, 1, 0], spin)).T + box.translation


def _of_intervals(a: Array, b: Array, axis: int) -> float:
    """IoU of the products of intervals between the extremes over an axis."""
    low_a, high_a, low_b, high_b = (f(x, axis=axis) for x in (a, b) for f in (np.min, np.max))
    sides = np.minimum(high_a, high_b) - np.maximum(low_a, low_b)
    shared = float(sides.prod()) if sides.min() > 0 else 0.0
    union = float((high_a - low_a).prod() + (high_b - low_b).prod()) - shared
    return shared / union if union > 0 else 0.0


_GENERAL = turned([1, 2, -4], 1.1).tolist()
_PAIRS = (
    [[_GENERAL, [0.1, 0.0, 1.0], [0.1, 0.2, 0.3]], [_GENERAL, [0.12, 0.03, 1.05], [0.1, 0.2, 0.3]]],
    [[_GENERAL, [0.1, 0.0, 1.0], [0.1, 0.2, 0.3]], [turned([2, 0, 1], 0.7).tolist(),
                                                    [0.05, 0.0, 0.9], [0.2, 0.1, 0.25]]],
    [[np.eye(3).tolist(), [0.4, -0.2, 0.8], [0.2, 0.2, 0.2]],
     [turned([0, 0, 1], 0.8).tolist(), [0.5, -0.1, 0.7], [0.2, 0.3, 0.1]]],
    [[np.eye(3).tolist(), [0.3, 0.7, 1.9], [0.1, 0.1, 0.1]],
     [np.eye(3).tolist(), [0.5, 0.7, 1.9], [0.1, 0.1, 0.1]]],
)  # fmt: skip


def _of_each(metric: str, axis: int) -> None:
    def by_definition(subject: Subject, pair: list[Any], spins: int) -> None:
        """It is the largest IoU of the intervals between the corners' extremes, over all spins."""
        a, b = map(as_box, pair)
        expected = max(
            _of_intervals(_corners(a, 2 * math.pi * i / spins), _corners(b), axis)
            for i in range(spins)
        )
        close(subject(metric, a, b, spins), expected, FINE)

    prop(
        metric,
        reason="the definition, written down once more",
        given={"pair": some.near_boxes(), "spins": st.sampled_from([1, 2, 5, 20])},
        weight=0.5,
        corners=lambda: (
            {"pair": pair, "spins": spins} for pair in _PAIRS for spins in (1, 2, 3, 20)
        ),
    )(by_definition)


_of_each(ALIGNED, 0)
_of_each(LEGACY, 1)


@prop(ALIGNED, reason="boxes with sides along the camera's axes are those around their corners",
      given={"sizes": st.lists(some.sides, min_size=6, max_size=6), "place": some.positions},
      weight=0.25)  # fmt: skip
def of_aligned_boxes(subject: Subject, sizes: list[float], place: list[float]) -> None:
    """Of boxes of one centre, along the camera's axes, it is that of nested intervals."""
    first, second = np.array(sizes[:3]), np.array(sizes[3:])
    shared = float(np.minimum(first, second).prod())
    boxes = [Box(np.eye(3), np.array(place), size) for size in (first, second)]
    expected = shared / (float(first.prod() + second.prod()) - shared)
    close(subject(ALIGNED, *boxes, 1), expected, COARSE)


# -- IoU+ --------------------------------------------------------------------------------------


def _solid(cloud: Rows) -> bool:
    return bool(np.ptp(np.array(cloud), axis=0).min() > 0)


_SOLID = some.clouds(3, 12).filter(_solid)


def _surfaces() -> Iterator[dict[str, Any]]:
    base = [[0.0, 0, 0], [0.5, 0.25, 0], [0.25, 0.5, 0.125], [0.0, 0.0, 0.375]]
    for shift in ([0.0, 0, 0], [0.25, 0, 0], [0.5, 0, 0], [0.1, -0.1, 0.2], [0, 0, 0.375],
                  [3.0, 0, 0], [0.1, 0.2, -0.1]):  # fmt: skip
        for order in (1, -1):
            yield {"clouds": [base, [[2 * x for x in p] for p in base]][::order], "shift": shift}


@prop(PLUS, reason="the boxes are around the points, which need not be many, nor in any order",
      given={"clouds": st.tuples(_SOLID, _SOLID).map(list), "shift": some.positions},
      corners=_surfaces, name="by_definition")  # fmt: skip
def plus_by_definition(subject: Subject, clouds: list[Rows], shift: list[float]) -> None:
    """It is the IoU of the boxes between the points' extremes along the camera's axes."""
    a, b = (np.array(cloud, dtype=float) for cloud in clouds)
    close(subject(PLUS, a, b + shift), _of_intervals(a, b + shift, 0), FINE)
    close(subject(PLUS, a + shift, b + shift), _of_intervals(a, b, 0), FINE)


# -- without a scale ---------------------------------------------------------------------------

_AHEAD = st.tuples(
    some.rotations, st.lists(some.real(0.4, 2), min_size=3, max_size=3), some.extents
).map(list)


def _zoomed(box: Box, factor: float) -> Box:
    return Box(box.rotation, factor * box.translation, factor * box.extents)


@prop(SCALED, reason="a single picture does not tell a small object from a large one far away",
      given={"a": _AHEAD, "b": _AHEAD, "factors": st.lists(
          some.log_real(0.2, 5), min_size=2, max_size=2)},
      weight=0.5, corners=lambda: (
          {"a": pair[0], "b": pair[1], "factors": f} for pair in _PAIRS for f in ([1, 3], [0.5, 1])
      ))  # fmt: skip
def scaled_about_the_camera(subject: Subject, a: Any, b: Any, factors: list[float]) -> None:
    """Scaling either box about the camera, with its distance, changes nothing."""
    one = subject(SCALED, as_box(a), as_box(b))
    boxes = [_zoomed(as_box(x), f) for x, f in zip((a, b), factors, strict=True)]
    close(subject(SCALED, *boxes), one, COARSE)


@prop(SCALED, IOU, reason="of boxes with one diagonal nothing is scaled",
      given={"pair": some.near_boxes()}, weight=0.5,
      corners=lambda: ({"pair": pair} for pair in _PAIRS))  # fmt: skip
def of_equal_diagonals(subject: Subject, pair: list[Any]) -> None:
    """Of boxes that have the same diagonal it is the IoU."""
    a, b = map(as_box, pair)
    same = Box(b.rotation, b.translation,
               b.extents * np.linalg.norm(a.extents) / np.linalg.norm(b.extents))  # fmt: skip
    close(subject(SCALED, a, same), subject(IOU, a, same), COARSE)


@prop(RELATIVE, reason="the definition: each centre in units of its own box's diagonal",
      given={"a": _AHEAD, "b": _AHEAD},
      corners=lambda: ({"a": pair[i], "b": pair[1 - i]} for pair in _PAIRS for i in range(2)),
      name="by_definition")  # fmt: skip
def relative_by_definition(subject: Subject, a: Any, b: Any) -> None:
    """It is the distance of the centres, each over the diagonal of its own box."""
    centres = [x.translation / math.hypot(*x.extents) for x in map(as_box, (a, b))]
    close(subject(RELATIVE, as_box(a), as_box(b)), math.dist(*centres), FINE)
