"""Properties of the IoU of boxes that stand upright on the axis of a continuous symmetry.

Their overlap is that of two rectangles, times a height: as a function of the spin it has several
maxima, and all of them can be found.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.adapter import Box
from pytest_cpas.checks.metrics.exact import rectangles_overlap
from pytest_cpas.checks.metrics.properties import close, prop
from pytest_cpas.checks.metrics.strategies import as_symmetry, turned
from pytest_cpas.checks.metrics.subject import Subject
from pytest_cpas.checks.metrics.symmetric_boxes import SYMMETRIC

#: Angles from which the largest overlap is climbed for, per turn.
_STARTS = 360

#: Sides of the estimate and of the truth across the axis, where the estimate is (distance, angle),
#: and by how much it is turned. Of many random ones those on which a search falls shortest that
#: climbs from the pose as it is, or from the best of 4, 8, 12, 20, 36 and 72 spins.
_SIDE_MAXIMA = (
    ([0.11, 0.25], [0.35, 0.07], [0.08, 1.28], 2.5),
    ([0.1, 0.15], [0.04, 0.3], [0.11, 0.25], 2.81),
    ([0.11, 0.27], [0.26, 0.2], [0.06, 2.73], 2.38),
    ([0.31, 0.1], [0.39, 0.11], [0.08, 1.99], 0.14),
    ([0.14, 0.01], [0.11, 0.02], [0.04, 1.24], 1.69),
    ([0.26, 0.06], [0.21, 0.15], [0.07, 0.42], 2.86),
    ([0.04, 0.23], [0.29, 0.02], [0.03, 2.65], 2.94),
    ([0.07, 0.03], [0.39, 0.02], [0.22, 1.35], 1.45),
    ([0.04, 0.37], [0.06, 0.4], [0.05, 1.2], 1.36),
    ([0.17, 0.28], [0.25, 0.32], [0.07, 2.52], 1.37),
    ([0.13, 0.32], [0.4, 0.08], [0.01, 1.09], 2.37),
    ([0.15, 0.27], [0.26, 0.4], [0.1, 1.82], 0.6),
    ([0.09, 0.35], [0.09, 0.38], [0.01, 2.79], 2.85),
)


def _largest(first: list[float], second: list[float], where: list[float], turn: float) -> float:
    """The largest area that the rectangles share, the second one spun in any way."""
    distance, direction = where

    def area(spin: float) -> float:
        at = direction - spin
        shift = distance * math.cos(at), distance * math.sin(at)
        return rectangles_overlap(first, second, shift, turn - spin)

    grid = 2 * math.pi / _STARTS
    areas = [area(i * grid) for i in range(_STARTS)]
    best = 0.0
    for i in sorted(range(_STARTS), key=areas.__getitem__)[-12:]:
        spin, value, step = i * grid, areas[i], grid
        while step > 1e-7:
            found, at = max((area(spin + move), spin + move) for move in (-step, step))
            if found > value:
                spin, value = at, found
            else:
                step /= 2
        best = max(best, value)
    return best


@prop(
    SYMMETRIC,
    reason="the overlap has several maxima over a turn: a search that climbs to the nearest one, or"
    " from the best of a few spins, stops at a smaller one",
    given={
        "first": st.lists(some.real(0.02, 0.4), min_size=2, max_size=2),
        "second": st.lists(some.real(0.02, 0.4), min_size=2, max_size=2),
        "where": st.tuples(some.real(0, 0.2), some.real(0, 6.28)).map(list),
        "turn": some.real(0, 3.14),
        "axis": st.integers(0, 2),
    },
    weight=0.25,
    applies=some.supports_any(SYMMETRIC, "axis", "principal axis"),
    corners=lambda: (
        {"first": first, "second": second, "where": where, "turn": turn, "axis": i % 3}
        for i, (first, second, where, turn) in enumerate(_SIDE_MAXIMA)
    ),
)
def upright_boxes(
    subject: Subject, first: list[float], second: list[float], where: list[float], turn: float,
    axis: int,
) -> None:  # fmt: skip
    """Of boxes that stand on the axis of symmetry it is the largest IoU over a whole turn."""
    heights, raised = (0.2, 0.3), 0.05
    shared = _largest(first, second, where, turn) * min(heights)
    volumes = first[0] * first[1] * heights[0] + second[0] * second[1] * heights[1]
    normal, one, other = (np.eye(3)[(axis + i) % 3] for i in range(3))
    sizes = [
        height * normal + sides[0] * one + sides[1] * other
        for height, sides in zip(heights, (first, second), strict=True)
    ]
    distance, direction = where
    offset = distance * (math.cos(direction) * one + math.sin(direction) * other)
    camera, place = turned([1, 2, -4], 1.1), np.array([0.2, -0.1, 1.2])
    estimate = Box(
        camera @ turned(normal, turn), place + camera @ (offset + raised * normal), sizes[0]
    )
    group: list[Any] = ["axis", normal.tolist(), 1]
    value = subject(SYMMETRIC, estimate, Box(camera, place, sizes[1]), as_symmetry(group))
    close(value, shared / (volumes - shared), 1e-5)
