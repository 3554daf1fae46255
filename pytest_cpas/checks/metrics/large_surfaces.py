"""Properties of metrics on surfaces of many points, and of odd ones.

What is compared with all pairs of points has few of them; here the values are known otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.distance import cdist

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.properties import close, prop
from pytest_cpas.checks.metrics.subject import Subject
from pytest_cpas.checks.metrics.surfaces import (
    CHAMFER,
    DIAMETER,
    DISTANCES,
    FINE,
    FSCORE,
    NAD,
    ONE_WAY,
    PRECISION,
    RECALL,
    SHARES,
)  # fmt: skip

Array = NDArray[np.float64]

#: Distance of the points of a lattice, metres.
_SPACING = 0.02


def _displaced(seed: int, side: int, extra: int) -> tuple[Array, Array, Array, Array]:
    """A lattice, the same with each point displaced, in another order and with some more points;
    and the distances from either to the other.

    No point is displaced by a quarter of the lattice's spacing, so that its nearest is its own.
    """
    rng = np.random.default_rng(seed)
    truth = np.stack(np.meshgrid(*[np.arange(side) * _SPACING] * 3), axis=-1).reshape(-1, 3)
    moves = rng.normal(size=truth.shape)
    moves *= (_SPACING * rng.uniform(0.01, 0.24, len(truth)) / np.linalg.norm(moves, axis=1))[
        :, None
    ]
    outliers = np.zeros((extra, 3))
    outliers[:, 0] = truth[-1, 0] + 1 + np.arange(extra)
    forth = np.linalg.norm(moves, axis=1)
    estimate = np.concatenate([truth + moves, outliers])
    back = np.concatenate([forth, outliers[:, 0] - truth[-1, 0]])
    order = rng.permutation(len(estimate))
    return truth[rng.permutation(len(truth))], estimate[order], forth, back


def _distance(
    subject: Subject, metric: str, a: Array, b: Array, forth: Array, back: Array
) -> float:
    """The value under the subject's definition, of known distances."""
    if metric == ONE_WAY:
        return float(forth.mean())
    if metric == NAD:
        diameters = [_diameter(a), _diameter(b)]
        if subject.defines(NAD, "normaliser") == "truth":
            diameters[1] = diameters[0]
        return max(float(forth.mean()) / diameters[0], float(back.mean()) / diameters[1])
    power = 2 if subject.defines(CHAMFER, "squared") else 1
    total = float((forth**power).mean() + (back**power).mean())
    return total / 2 if subject.defines(CHAMFER, "combine") == "mean" else total


def _diameter(points: Array) -> float:
    outer = points[ConvexHull(points).vertices] if len(points) > 1000 else points
    return float(cdist(outer, outer).max())


def _of_each_distance(metric: str) -> None:
    def many_points(subject: Subject, seed: int, side: int, extra: int) -> None:
        """Of thousands of points, in any order, each takes part, with its own nearest one."""
        case = _displaced(seed, side, extra)
        for a, b, forth, back in (case, (case[1], case[0], case[3], case[2])):
            close(subject(metric, a, b), _distance(subject, metric, a, b, forth, back), FINE)

    def many_at_random(subject: Subject, seed: int, counts: list[int], flat: bool) -> None:
        """The value agrees with the definition for clouds of hundreds of points."""
        rng = np.random.default_rng(seed)
        a, b = (rng.random((n, 3)) * [1, 1, not flat] for n in counts)
        pairs = cdist(a, b)
        expected = _distance(subject, metric, a, b, pairs.min(axis=1), pairs.min(axis=0))
        close(subject(metric, a, b), expected, FINE)

    prop(
        metric,
        reason="a part of the points, neighbours that are about the nearest, and pairs by index all"
        " give nearly the right value",
        given={
            "seed": some.seeds, "side": st.sampled_from([9, 14]), "extra": st.integers(0, 3),
        },
        weight=0.05,
        corners=lambda: (
            {"seed": i, "side": side, "extra": extra}
            for i, (side, extra) in enumerate(((6, 0), (11, 2), (20, 1)))
        ),
    )(many_points)  # fmt: skip
    prop(
        metric,
        reason="approximate search finds neighbours that are not the nearest",
        given={
            "seed": some.seeds,
            "counts": st.lists(st.integers(100, 700), min_size=2, max_size=2),
            "flat": st.booleans(),
        },
        weight=0.05,
        corners=lambda: (
            {"seed": 1, "counts": counts, "flat": flat}
            for counts, flat in (([600, 600], False), ([33, 900], False), ([900, 257], True))
        ),
    )(many_at_random)


for _metric in DISTANCES:
    _of_each_distance(_metric)


# -- shares of points --------------------------------------------------------------------------


def _scattered(numbers: list[int], threshold: float, seed: int) -> tuple[Array, Array, Array]:
    """Places with true and estimated points; and the share of either that is near the other.

    ``numbers``: of places with a point of each; with three true points about an estimated one; with
    an estimated point beside two true ones of which it reaches one; with a true point alone; with
    an estimated one alone; with one of each that are just too far apart.
    """
    rng = np.random.default_rng(seed)
    kinds = np.repeat(np.arange(len(numbers)), numbers)
    truth, estimate, near_truth, near_estimate = [], [], [], []
    for index, kind in enumerate(kinds):
        place = np.array([index % 50, index // 50, 0.0]) * 20 * threshold
        step = threshold * rng.permutation(np.eye(3))
        near, far = rng.uniform(0.9, 0.999), rng.uniform(1.001, 1.1)
        true: list[Array] = []
        estimated: list[Array] = []
        if kind == 0:
            true, estimated = [place], [place + near * step[0]]
        elif kind == 1:
            true, estimated = [place + s * step[0] for s in (near, -near, 0.1)], [place]
        elif kind == 2:
            true, estimated = [place + near * step[0], place - far * step[0]], [place]
        elif kind == 3:
            true = [place]
        elif kind == 4:
            estimated = [place]
        else:
            true, estimated = [place], [place + far * step[0]]
        truth += true
        estimate += estimated
        near_truth += {0: [1], 1: [1, 1, 1], 2: [1, 0], 3: [0], 4: [], 5: [0]}[int(kind)]
        near_estimate += {0: [1], 1: [1], 2: [1], 3: [], 4: [0], 5: [0]}[int(kind)]
    shares = np.array([np.mean(near_truth), np.mean(near_estimate)])
    clouds = [np.array(points)[rng.permutation(len(points))] for points in (truth, estimate)]
    return clouds[0], clouds[1], shares


def _scenes() -> Iterator[dict[str, Any]]:
    for i, numbers in enumerate((
        [3, 0, 0, 0, 0, 2], [5, 0, 0, 2, 2, 1], [2, 1, 0, 0, 2, 0], [1, 0, 2, 0, 2, 0],
        [1, 0, 0, 7, 7, 0], [9, 0, 0, 1, 1, 0], [2, 3, 1, 4, 0, 2], [0, 0, 0, 3, 3, 2],
        [0, 4, 0, 0, 9, 0], [300, 40, 30, 80, 200, 60], [1500, 0, 0, 400, 400, 100],
    )):  # fmt: skip
        for threshold in (0.01, 0.05, 1.5):
            yield {"numbers": numbers, "threshold": threshold, "seed": i}


def _of_each_share(metric: str) -> None:
    def partly_near(subject: Subject, numbers: list[int], threshold: float, seed: int) -> None:
        """Where a part of the points is near, of as many or of other numbers, it is their share."""
        truth, estimate, (recall, precision) = _scattered(numbers, threshold, seed)
        both = recall * precision
        expected = {
            RECALL: recall, PRECISION: precision,
            FSCORE: 2 * both / (recall + precision) if both else 0.0,
        }[metric]  # fmt: skip
        close(subject(metric, truth, estimate, threshold), float(expected), FINE)

    def odd_thresholds(subject: Subject, factor: float) -> None:
        """Points far below the threshold all count, points far above it do not."""
        a = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        b = a[::-1] + 1e-3
        close(subject(metric, a, b, 2e-3 * factor), 1.0, FINE)
        close(subject(metric, a, b, 1e-3 / factor), 0.0, FINE)

    prop(
        metric,
        reason="between 0 and 1 the means of precision and recall differ, and so do the two",
        given={
            "numbers": st.lists(st.integers(0, 4), min_size=6, max_size=6).filter(
                lambda n: n[0] + n[1] + n[2] > 0 or (n[3] + n[5] > 0 and n[4] + n[5] > 0)
            ),
            "threshold": some.real(0.005, 0.3),
            "seed": some.seeds,
        },
        weight=0.25,
        corners=_scenes,
    )(partly_near)
    prop(
        metric,
        reason="thresholds of other data sets are millimetres, or metres",
        given={"factor": some.log_real(1, 400)},
        weight=0.1,
        corners=lambda: ({"factor": factor} for factor in (1.0, 10.0, 450.0)),
    )(odd_thresholds)


for _metric in SHARES:
    _of_each_share(_metric)


# -- diameter, and clouds without volume -------------------------------------------------------


def _of_cloud(kind: str, count: int, seed: int) -> Array:
    """A cloud whose farthest points are 2 apart."""
    rng = np.random.default_rng(seed)
    inner = rng.uniform(-0.5, 0.5, (count, 3))
    if kind == "line":
        inner = inner[:, :1] * [[0.6, 0.0, 0.8]]
    elif kind == "plane":
        inner[:, 2] = 0
    elif kind == "copies":
        inner = np.tile(inner[:1], (count, 1))
    elif kind == "sphere":
        inner *= 0.999 / np.linalg.norm(inner, axis=1, keepdims=True)
    direction = {"line": [0.6, 0, 0.8], "plane": [0.6, 0.8, 0]}.get(kind, [2 / 3, 1 / 3, -2 / 3])
    ends = np.array([direction, np.negative(direction)])
    cloud = np.concatenate([inner, ends])
    return np.asarray(cloud[rng.permutation(len(cloud))])


_KINDS = ("ball", "copies", "line", "plane", "sphere")


@prop(
    DIAMETER,
    reason="two points decide it: a part of the points, or a pair that seems farthest, misses them;"
    " hulls of flat clouds fail",
    given={
        "kind": st.sampled_from(_KINDS), "count": st.sampled_from([0, 1, 30, 900]),
        "seed": some.seeds,
    },
    weight=0.25,
    corners=lambda: (
        {"kind": kind, "count": count, "seed": count}
        for kind in _KINDS for count in (0, 1, 2, 40, 700, 7000)
    ),
)  # fmt: skip
def of_two_points(subject: Subject, kind: str, count: int, seed: int) -> None:
    """The diameter is the distance of the two points that are farthest apart, among any others."""
    close(subject(DIAMETER, _of_cloud(kind, count, seed)), 2.0, FINE)


def _body(kind: str, count: int, seed: int) -> Array:
    """Points on a body whose width is nearly the same in all directions."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    if kind == "ellipsoid":
        points *= 1 + 0.01 * rng.random(3)
    elif kind == "rough ball":
        points *= 1 + 0.02 * rng.random((count, 1))
    else:  # arcs about the corners of a triangle, or balls about those of a tetrahedron
        corners = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(8)
        own = corners[rng.integers(4, size=count)]
        points = own + points
        inside = np.linalg.norm(points[:, None] - corners[None], axis=2).max(axis=1) <= 1 + 1e-12
        points = np.concatenate([points[inside], corners])
    return np.asarray(points * 0.1 + rng.normal(size=3))


_BODIES = ("ellipsoid", "rough ball", "constant width")


@prop(
    DIAMETER,
    reason="bodies of nearly constant width have nearly as large distances everywhere: a walk to"
    " the farthest point stops at one of them, and a wrong bound prunes the right one",
    given={
        "kind": st.sampled_from(_BODIES), "count": st.integers(70, 400), "seed": some.seeds,
    },
    weight=0.1,
    corners=lambda: (
        {"kind": kind, "count": count, "seed": seed}
        for kind in _BODIES for count in (150, 1000, 3000) for seed in range(2)
    ),
)  # fmt: skip
def of_nearly_constant_width(subject: Subject, kind: str, count: int, seed: int) -> None:
    """The diameter of bodies of nearly constant width is their largest distance."""
    points = _body(kind, count, seed)
    hull = points[ConvexHull(points).vertices]
    close(subject(DIAMETER, points), float(cdist(hull, hull).max()), FINE)


@prop(
    DIAMETER,
    reason="a single point has no two points, and no extent",
    given={"point": some.positions, "times": st.integers(1, 3)},
    weight=0.1,
)
def of_one_point(subject: Subject, point: list[float], times: int) -> None:
    """One point, also if it is listed several times, has diameter 0."""
    close(subject(DIAMETER, np.tile(np.array(point), (times, 1))), 0, FINE)


@prop(
    NAD,
    reason="surfaces without volume, and of few points, have a diameter as well",
    given={
        "kinds": st.lists(st.sampled_from(_KINDS), min_size=2, max_size=2),
        "count": st.integers(0, 40), "seed": some.seeds,
    },
    weight=0.1,
    corners=lambda: (
        {"kinds": [one, other], "count": count, "seed": 3}
        for one in _KINDS for other in ("line", "plane") for count in (0, 12)
    ),
)  # fmt: skip
def of_flat_clouds(subject: Subject, kinds: list[str], count: int, seed: int) -> None:
    """NAD of clouds in a line or a plane agrees with the definition."""
    a, b = (_of_cloud(kind, count + i, seed + i) for i, kind in enumerate(kinds))
    pairs = cdist(a, b)
    expected = max(pairs.min(axis=1).mean(), pairs.min(axis=0).mean()) / 2
    close(subject(NAD, a, b), float(expected), FINE)
