"""Strategies that aim at the hard places. All of them give plain values that JSON can hold."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from pytest_cpas.checks.metrics.adapter import Box, Sample
from pytest_cpas.checks.metrics.subject import Subject
from pytest_cpas.types import Symmetry

Array = NDArray[np.float64]
Rows = list[list[float]]


#: Small ranges of integers are drawn evenly, large ones mostly near 0: hence two digits.
_DIGIT = st.integers(0, 99)
_SHARE = st.one_of(st.tuples(_DIGIT, st.just(0)), st.tuples(_DIGIT, _DIGIT), st.just((100, 0))).map(
    lambda digits: digits[0] / 100 + digits[1] / 10000
)


def real(low: float, high: float) -> st.SearchStrategy[float]:
    """Evenly distributed in [low, high]; simplest at ``low``."""
    return _SHARE.map(lambda share: low + (high - low) * share)


def log_real(low: float, high: float) -> st.SearchStrategy[float]:
    """Evenly distributed orders of magnitude."""
    return real(math.log(low), math.log(high)).map(math.exp)


def _turn(axis: ArrayLike, angle: float) -> Rows:
    rows: Rows = turned(axis, angle).tolist()
    return rows


def turned(axis: ArrayLike, angle: float) -> Array:
    """The rotation by ``angle`` about ``axis``, which need not be of unit length.

    By Rodrigues' formula with 1 - cos written as 2 sin^2, so that tiny angles keep all digits.
    """
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(
        np.eye(3) + math.sin(angle) * cross + 2 * math.sin(angle / 2) ** 2 * (cross @ cross)
    )


#: Directions with small whole components: they shrink well, and (1, 2, -4) is as general as any.
axes = st.lists(st.integers(-5, 5), min_size=3, max_size=3).filter(any)

#: Angles in [0, pi], with 0, 90 and 180 degrees and their neighbourhoods.
angles = st.one_of(
    real(0, math.pi),
    st.sampled_from([0.0, math.pi / 2, math.pi]),
    log_real(1e-9, 1e-2),
    log_real(1e-9, 1e-2).map(lambda angle: math.pi - angle),
)

quarter_turns = st.sampled_from(
    [
        np.round(rotation.as_matrix()).tolist()
        for rotation in (Rotation.identity(), *Rotation.create_group("O"))
    ]
)

#: Rotation matrices as lists: any, of angles near 0, 90 and 180 degrees, or of a cube.
rotations = st.one_of(st.builds(_turn, axes, angles), quarter_turns)
general_rotations = st.builds(_turn, axes, real(0.3, 2.8))

#: 0 to 10 m.
positions = st.one_of(
    st.lists(real(-0.5, 0.5), min_size=3, max_size=3),
    st.lists(real(-10, 10), min_size=3, max_size=3),
    st.just([0.0, 0.0, 0.0]),
)

#: Side lengths of objects, metres, and of anything from 1 mm to 2 m.
sides = real(0.05, 0.4)
extents = st.lists(sides, min_size=3, max_size=3)
any_extents = st.one_of(extents, st.lists(log_real(0.001, 2.0), min_size=3, max_size=3))

#: Rotation, translation, extents.
boxes = st.tuples(rotations, positions, any_extents).map(list)


@st.composite
def near_boxes(draw: st.DrawFn) -> list[Any]:
    """Two boxes that overlap more often than not, as [box, box]."""
    rotation, position, size = draw(rotations), draw(positions), draw(any_extents)
    reach = max(size)
    other = [side * draw(real(0.5, 1.5)) for side in size]
    offset = [reach * draw(real(-0.4, 0.4)) for _ in range(3)]
    turn = draw(rotations)
    moved = [p + o for p, o in zip(position, offset, strict=True)]
    return [[rotation, position, size], [turn, moved, other]]


def as_box(plain: list[Any]) -> Box:
    """The box of [rotation, translation, extents]."""
    return Box(*(np.array(part, dtype=float) for part in plain))


#: Small clouds on a lattice of 1/64 m: whole numbers shrink well and distances repeat exactly.
_COORDINATE = st.integers(-16, 16).map(lambda i: i / 64)


def clouds(minimum: int = 1, maximum: int = 12) -> st.SearchStrategy[Rows]:
    """Points within half a metre."""
    return st.lists(
        st.lists(_COORDINATE, min_size=3, max_size=3), min_size=minimum, max_size=maximum
    )


#: Two clouds whose sizes differ as often as not.
cloud_pairs = st.one_of(
    st.tuples(clouds(), clouds()), st.tuples(clouds(1, 3), clouds(8, 20)),
    st.tuples(clouds(8, 20), clouds(1, 3)),
).map(list)  # fmt: skip

#: Thresholds on distances; none of them is a distance of lattice points.
thresholds = st.one_of(real(0.01, 0.3), st.just(0.01)).map(
    lambda t: math.nextafter(t, 1) if (t * 64) ** 2 == round((t * 64) ** 2) else t
)

seeds = st.integers(0, 2**16)

#: Symmetry groups in plain words: [kind, axis, n].
axes_of_objects = st.one_of(
    st.just([0, 1, 0]), st.sampled_from([[1, 0, 0], [0, 0, 1]]), axes
)  # fmt: skip
continuous = st.tuples(
    st.sampled_from(["axis", "axis with flip"]), axes_of_objects, st.just(1)
).map(list)
discrete = st.one_of(
    st.tuples(st.just("n-fold"), axes_of_objects, st.integers(2, 7)).map(list),
    st.just(["box", [0, 1, 0], 1]),
)
symmetries = st.one_of(continuous, discrete)


def as_symmetry(plain: list[Any]) -> Symmetry:
    """The group of [kind, axis, n]."""
    kind, axis, n = plain
    if kind == "box":
        return Symmetry.box()
    if kind == "n-fold":
        return Symmetry.n_fold(axis, n)
    return Symmetry.about(axis, flip=kind == "axis with flip")


def supports(subject: Subject, metric: str, plain: list[Any]) -> bool:
    """Whether the subject declares the symmetry [kind, axis, n] for a metric."""
    kind, axis, _ = plain
    declared = subject.defines(metric, "symmetries")
    if not kind.startswith("axis"):
        return "discrete" in declared
    return kind in declared or (f"principal {kind}" in declared and sorted(axis) == [0, 0, 1])


def supports_any(metric: str, *kinds: str) -> Callable[[Subject], bool]:
    """Whether a subject declares one of the kinds, as a property's ``applies``."""
    return lambda subject: not set(kinds).isdisjoint(subject.defines(metric, "symmetries"))


def element(plain: list[Any], which: int, spin: float) -> Array:
    """A rotation of the group."""
    symmetry = as_symmetry(plain)
    rotation = symmetry.rotations[which % len(symmetry.rotations)]
    if symmetry.axis is None:
        return np.asarray(rotation)
    return np.asarray(turned(symmetry.axis, spin) @ rotation)


#: Shapes for :class:`Sample`: a fixed cloud that fills a box of these extents.
_UNIT = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]) / 2


def posed(rotation: ArrayLike, translation: ArrayLike, size: ArrayLike) -> Sample:
    """A sample whose surface is a lattice of 27 points in its box."""
    rotation, translation, size = (
        np.array(part, dtype=float) for part in (rotation, translation, size)
    )
    return Sample(rotation, translation, size, _UNIT * size @ rotation.T + translation)
