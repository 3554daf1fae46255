"""Properties of metrics on surfaces: distances, F-score, diameter."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.exact import largest_distance, nearest
from pytest_cpas.checks.metrics.properties import close, expect, prop
from pytest_cpas.checks.metrics.strategies import Rows
from pytest_cpas.checks.metrics.subject import Subject

Array = NDArray[np.float64]

FINE = 1e-12
ONE_WAY = "average_distance"
CHAMFER = "chamfer"
PRECISION = "surface_precision"
RECALL = "surface_recall"
FSCORE = "fscore"
NAD = "nad"
DIAMETER = "diameter"

DISTANCES = (ONE_WAY, CHAMFER, NAD)
SHARES = (PRECISION, RECALL, FSCORE)

CLOUDS = {"clouds": some.cloud_pairs}
MOTION = {"camera": some.rotations, "shift": some.positions}
THRESHOLD = {"threshold": some.thresholds}


def _arrays(clouds: list[Rows]) -> tuple[Array, Array]:
    return np.array(clouds[0]), np.array(clouds[1])


def _has_extent(clouds: list[Rows]) -> bool:
    return all(len({tuple(p) for p in cloud}) > 1 for cloud in clouds)


def _expected(subject: Subject, metric: str, a: Array, b: Array) -> float:
    """The distance under the subject's definition, by brute force."""
    forth, back = nearest(a, b), nearest(b, a)
    if metric == ONE_WAY:
        return float(forth.mean())
    if metric == NAD:
        diameters = largest_distance(a), largest_distance(b)
        if subject.defines(NAD, "normaliser") == "truth":
            diameters = diameters[0], diameters[0]
        return max(float(forth.mean()) / diameters[0], float(back.mean()) / diameters[1])
    power = 2 if subject.defines(CHAMFER, "squared") else 1
    total = float((forth**power).mean() + (back**power).mean())
    return total / 2 if subject.defines(CHAMFER, "combine") == "mean" else total


def _apart(clouds: list[Rows], metric: str) -> bool:
    """NAD is not defined for a cloud without extent."""
    return metric != NAD or _has_extent(clouds)


def _of_each_distance(metric: str) -> None:
    def identity(subject: Subject, cloud: Rows, shift: Any) -> None:
        """A surface has distance 0 to itself, wherever it is."""
        if _apart([cloud], metric):
            moved = np.array(cloud) + np.array(shift)
            close(subject(metric, moved, moved), 0, FINE)

    def by_brute_force(subject: Subject, clouds: list[Rows]) -> None:
        """The value agrees with the definition, computed from all pairs of points."""
        if _apart(clouds, metric):
            a, b = _arrays(clouds)
            close(subject(metric, a, b), _expected(subject, metric, a, b), FINE)

    def moved_camera(subject: Subject, clouds: list[Rows], camera: Rows, shift: Any) -> None:
        """Moving both surfaces together changes nothing, to 1e-9 m even at 10 m."""
        if _apart(clouds, metric):
            a, b = _arrays(clouds)
            moved = [cloud @ np.array(camera).T + np.array(shift) for cloud in (a, b)]
            close(subject(metric, *moved), subject(metric, a, b), 1e-9)

    def unit(subject: Subject, clouds: list[Rows], scale: float) -> None:
        """In another unit the value is that in the other unit."""
        if _apart(clouds, metric):
            a, b = _arrays(clouds)
            squared = metric == CHAMFER and subject.defines(CHAMFER, "squared")
            factor = 1.0 if metric == NAD else scale**2 if squared else scale
            value = subject(metric, scale * a, scale * b) / factor
            close(value, subject(metric, a, b), 1e-9)

    def repeated_and_permuted(subject: Subject, clouds: list[Rows], times: list[int]) -> None:
        """The order of points, and listing all of them again, changes nothing."""
        if _apart(clouds, metric):
            a, b = _arrays(clouds)
            again = [np.tile(cloud[::-1], (n, 1)) for cloud, n in zip((a, b), times, strict=True)]
            close(subject(metric, *again), subject(metric, a, b), FINE)

    once = {"clouds": some.cloud_pairs}
    prop(
        metric,
        reason="a perfect reconstruction must be perfect; |a|^2 + |b|^2 - 2 a.b cancels far away",
        given={"cloud": some.clouds(2), "shift": some.positions},
        weight=0.5,
    )(identity)
    prop(
        metric,
        reason="an independent truth, with surfaces of very different numbers of points",
        given=once,
    )(by_brute_force)
    prop(
        metric,
        reason="distances have no frame; float32 and expanded squares cancel away from the origin",
        given=once | MOTION,
    )(moved_camera)
    prop(
        metric,
        reason="a distance scales with its unit, a normalised one does not depend on it",
        given=once | {"scale": st.sampled_from([0.001, 100.0, 1000.0])},
        weight=0.5,
    )(unit)
    prop(
        metric,
        reason="a surface is a set; a mean over points does not grow with their number",
        given=once | {"times": st.lists(st.integers(1, 4), min_size=2, max_size=2)},
    )(repeated_and_permuted)


for _metric in DISTANCES:
    _of_each_distance(_metric)


@prop(ONE_WAY, reason="the two directions are two numbers; swapped, missing parts go unseen",
      given={"cloud": some.clouds(1, 6), "far": some.real(0.6, 2)})  # fmt: skip
def from_part_to_whole(subject: Subject, cloud: Rows, far: float) -> None:
    """From a part to the whole the distance is 0, from the whole to the part it is not."""
    part = np.array(cloud)
    whole = np.vstack([part, part[0] + [far, 0, 0]])
    close(subject(ONE_WAY, part, whole), 0, FINE, "from the part to the whole")
    expect(subject(ONE_WAY, whole, part) > 0, "from the whole to the part it is 0")


@prop(CHAMFER, reason="both directions enter alike", given=CLOUDS)
def symmetry_of_arguments(subject: Subject, clouds: list[Rows]) -> None:
    """Truth and estimate can be swapped."""
    a, b = _arrays(clouds)
    close(subject(CHAMFER, b, a), subject(CHAMFER, a, b), FINE)


def _sphere(seed: int, count: int) -> Array:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(0.1 * points / np.linalg.norm(points, axis=1)[:, None])


@prop(
    CHAMFER,
    reason="points of a surface lie about n^-1/2 apart; sums and maxima do not fall like that",
    given={"seed": some.seeds},
    weight=0.1,
)
def falls_with_the_sample_count(subject: Subject, seed: int) -> None:
    """Of two samples of one surface CD falls like n^-1/2 (its square like n^-1)."""
    few, many = (subject(CHAMFER, _sphere(seed, n), _sphere(seed + 1, n)) for n in (500, 8000))
    power = 1.0 if subject.defines(CHAMFER, "squared") else 0.5
    # 500 points: the mean of nearest distances varies by about 3 %, five times that is allowed
    close(few / many / 16**power, 1, 0.16 * 2 * power, "CD(500) / CD(8000), over its limit")


@prop(
    NAD,
    CHAMFER,
    reason="max(x / d1, y / d2) <= (x + y) / min(d1, d2): NAD cannot exceed what CD allows",
    given=CLOUDS,
    applies=lambda subject: (
        subject.defines(CHAMFER, "combine") == "mean" and not subject.defines(CHAMFER, "squared")
    ),
)
def at_most_chamfer(subject: Subject, clouds: list[Rows]) -> None:
    """NAD is at most 2 CD over the smaller diameter."""
    if _has_extent(clouds):
        a, b = _arrays(clouds)
        limit = 2 * subject(CHAMFER, a, b) / min(largest_distance(a), largest_distance(b))
        value = subject(NAD, a, b)
        expect(value <= limit + FINE, f"NAD is {value!r}, but CD allows {limit!r} only")


# -- shares of points --------------------------------------------------------------------------


def _share(subject: Subject, metric: str, a: Array, b: Array, threshold: float) -> float:
    """The share under the definition, by brute force (no distance is at the threshold)."""
    recall, precision = (float((nearest(x, y) < threshold).mean()) for x, y in ((a, b), (b, a)))
    if metric == RECALL:
        return recall
    if metric == PRECISION:
        return precision
    return 2 * recall * precision / (recall + precision) if recall * precision else 0.0


def _of_each_share(metric: str) -> None:
    def identity(subject: Subject, cloud: Rows, threshold: float) -> None:
        """A surface against itself gives 1 at any threshold."""
        close(subject(metric, np.array(cloud), np.array(cloud), threshold), 1, FINE)

    def by_brute_force(subject: Subject, clouds: list[Rows], threshold: float) -> None:
        """The value agrees with the definition, computed from all pairs of points."""
        a, b = _arrays(clouds)
        expected = _share(subject, metric, a, b, threshold)
        close(subject(metric, a, b, threshold), expected, FINE)

    def monotone(subject: Subject, clouds: list[Rows], limits: list[float]) -> None:
        """A larger threshold never gives less; all values are in [0, 1]."""
        a, b = _arrays(clouds)
        tight, loose = (subject(metric, a, b, limit) for limit in sorted(limits))
        expect(
            -FINE <= tight <= loose + FINE <= 1 + 2 * FINE,
            f"{tight!r} at {min(limits)!r}, {loose!r} at {max(limits)!r}",
        )

    def boundary(subject: Subject, steps: int) -> None:
        """A point at the threshold counts as the definition says."""
        a, b = np.zeros((1, 3)), np.array([[steps / 64, 0.0, 0.0]])
        inclusive = subject.defines(metric, "boundary") == "inclusive"
        close(subject(metric, a, b, steps / 64), float(inclusive), FINE)

    def moved_camera(
        subject: Subject, clouds: list[Rows], threshold: float, camera: Rows, shift: Any
    ) -> None:
        """Moving both surfaces together changes nothing."""
        a, b = _arrays(clouds)
        distances = np.concatenate([nearest(a, b), nearest(b, a)])
        if np.abs(distances - threshold).min() > 1e-9:
            moved = [cloud @ np.array(camera).T + np.array(shift) for cloud in (a, b)]
            value = subject(metric, *moved, threshold)
            close(value, subject(metric, a, b, threshold), FINE)

    def unit(subject: Subject, clouds: list[Rows], threshold: float, power: int) -> None:
        """A change of unit of points and threshold changes nothing."""
        a, b = _arrays(clouds)
        scale = 2.0**power
        value = subject(metric, scale * a, scale * b, scale * threshold)
        close(value, subject(metric, a, b, threshold), FINE)

    def repeated_and_permuted(
        subject: Subject, clouds: list[Rows], threshold: float, times: list[int]
    ) -> None:
        """The order of points, and listing all of them again, changes nothing."""
        a, b = _arrays(clouds)
        again = [np.tile(cloud[::-1], (n, 1)) for cloud, n in zip((a, b), times, strict=True)]
        close(subject(metric, *again, threshold), subject(metric, a, b, threshold), FINE)

    def converges(subject: Subject, seed: int, share: float) -> None:
        """At n and 4n samples it agrees within 5 standard deviations."""
        # two unit squares, one moved sideways in its plane: of each, `share` overlaps. A point
        # counts if it is within 0.05 of the other square, but for the chance of a hole there.
        # n points: the share of points in a region of area p varies by sqrt(p (1 - p) / n);
        # holes of radius 0.05 have a chance below exp(-n pi 0.05^2 / 2) < 1e-3 for n = 2000
        few, many = (
            subject(
                metric,
                np.random.default_rng(seed).random((n, 3)) * [1, 1, 0],
                np.random.default_rng(seed + 1).random((n, 3)) * [1, 1, 0] + [1 - share, 0, 0],
                0.05,
            )
            for n in (2000, 8000)
        )
        close(few, many, 5 * math.sqrt(0.25 / 2000 + 0.25 / 8000), "at 2000 points it")

    prop(
        metric,
        reason="a perfect reconstruction must be perfect",
        given={"cloud": some.clouds()} | THRESHOLD,
        weight=0.5,
    )(identity)
    prop(
        metric,
        reason="an independent truth; numbers of points differ, so that shares differ from counts",
        given=CLOUDS | THRESHOLD,
    )(by_brute_force)
    prop(
        metric,
        reason="what is near at one threshold is near at a larger one",
        given=CLOUDS | {"limits": st.lists(some.thresholds, min_size=2, max_size=2)},
        weight=0.5,
    )(monotone)
    prop(
        metric,
        reason="strict and inclusive differ for every surface on a grid, voxels say",
        given={"steps": st.integers(1, 32)},
        weight=0.25,
    )(boundary)
    prop(
        metric,
        reason="distances have no frame",
        given=CLOUDS | THRESHOLD | MOTION,
        weight=0.5,
    )(moved_camera)
    prop(
        metric,
        reason="points in millimetres with a threshold in metres score 0",
        given=CLOUDS | THRESHOLD | {"power": st.sampled_from([-10, 7, 10])},
        weight=0.5,
    )(unit)
    prop(
        metric,
        reason="a surface is a set; a share does not depend on how often points are listed",
        given=CLOUDS | THRESHOLD | {"times": st.lists(st.integers(1, 4), min_size=2, max_size=2)},
    )(repeated_and_permuted)
    prop(
        metric,
        reason="unlike CD, a share must not depend on how densely a surface is sampled",
        given={"seed": some.seeds, "share": some.real(0.2, 0.8)},
        weight=0.1,
    )(converges)


for _metric in SHARES:
    _of_each_share(_metric)


@prop(
    PRECISION,
    RECALL,
    reason="precision is about the estimate's points, recall about the truth's",
    given=CLOUDS | THRESHOLD,
)
def swaps_with_recall(subject: Subject, clouds: list[Rows], threshold: float) -> None:
    """Swapping truth and estimate swaps precision and recall."""
    a, b = _arrays(clouds)
    close(subject(PRECISION, a, b, threshold), subject(RECALL, b, a, threshold), FINE)


@prop(
    FSCORE,
    PRECISION,
    RECALL,
    reason="the harmonic mean: an arithmetic one rewards a single point that hits",
    given=CLOUDS | THRESHOLD,
    applies=lambda subject: (
        subject.defines(FSCORE, "boundary")
        == subject.defines(PRECISION, "boundary")
        == subject.defines(RECALL, "boundary")
    ),
)
def harmonic_mean(subject: Subject, clouds: list[Rows], threshold: float) -> None:
    """F is the harmonic mean of precision and recall, 0 if one of them is."""
    a, b = _arrays(clouds)
    p, r = subject(PRECISION, a, b, threshold), subject(RECALL, a, b, threshold)
    expected = 2 * p * r / (p + r) if p > 0 and r > 0 else 0.0
    close(subject(FSCORE, a, b, threshold), expected, FINE)


# -- diameter ----------------------------------------------------------------------------------

CLOUD = {"cloud": some.clouds(1, 20)}


@prop(DIAMETER, reason="the definition; a box's diagonal or a hull's radius is another number",
      given=CLOUD)  # fmt: skip
def largest_of_all_pairs(subject: Subject, cloud: Rows) -> None:
    """The diameter is the largest distance of two points."""
    close(subject(DIAMETER, np.array(cloud)), largest_distance(np.array(cloud)), FINE)


@prop(DIAMETER, reason="a diameter has no frame", given=CLOUD | MOTION)
def of_a_moved_cloud(subject: Subject, cloud: Rows, camera: Rows, shift: list[float]) -> None:
    """Moving the points together changes nothing."""
    moved = np.array(cloud) @ np.array(camera).T + np.array(shift)
    close(subject(DIAMETER, moved), subject(DIAMETER, np.array(cloud)), 1e-9)


@prop(
    DIAMETER,
    reason="round bodies have many nearly farthest pairs, where pruning goes wrong",
    given={"seed": some.seeds, "count": st.integers(2, 300), "flat": st.booleans()},
    weight=0.5,
)
def of_round_bodies(subject: Subject, seed: int, count: int, flat: bool) -> None:
    """The diameter of points on a sphere or circle is their largest distance."""
    points = _sphere(seed, count) * ([1, 1, 0] if flat else [1, 1, 1])
    expected = max(float(np.linalg.norm(points - p, axis=1).max()) for p in points)
    close(subject(DIAMETER, points), expected, FINE)
