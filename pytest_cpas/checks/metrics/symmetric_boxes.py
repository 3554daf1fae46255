"""Properties of the IoU of oriented boxes under the symmetry group of the true object."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.adapter import Box
from pytest_cpas.checks.metrics.boxes import COARSE, FINE, IOU
from pytest_cpas.checks.metrics.properties import close, expect, prop
from pytest_cpas.checks.metrics.strategies import as_box, as_symmetry, element, turned
from pytest_cpas.checks.metrics.subject import Subject

SYMMETRIC = "symmetric_box_iou"

GROUP = {"group": some.symmetries, "which": st.integers(0, 6), "spin": some.real(0, 6.28)}
OBJECT_BOXES = st.tuples(some.rotations, some.positions, some.extents).map(list)


@prop(
    SYMMETRIC,
    reason="all poses of the group look alike; a sampled symmetry misses those in between",
    given={"box": OBJECT_BOXES} | GROUP,
    weight=1.5,
)
def reached_on_the_group(
    subject: Subject, box: list[Any], group: list[Any], which: int, spin: float
) -> None:
    """An estimate that a symmetry takes to the truth has IoU 1."""
    if some.supports(subject, SYMMETRIC, group):
        b = as_box(box)
        a = Box(b.rotation @ element(group, which, spin), b.translation, b.extents)
        close(subject(SYMMETRIC, a, b, as_symmetry(group)), 1, COARSE)


@prop(
    SYMMETRIC,
    reason="a loop that ends one element early, or starts one late, misses one of the equal poses",
    given={"box": OBJECT_BOXES, "axis": some.axes, "n": st.sampled_from([3, 5, 7])},
    applies=some.supports_any(SYMMETRIC, "discrete"),
    weight=0.25,
)
def reached_by_every_rotation(subject: Subject, box: list[Any], axis: list[int], n: int) -> None:
    """Turned by any rotation of an n-fold symmetry, the estimate still has IoU 1."""
    b = as_box(box)
    symmetry = as_symmetry(["n-fold", axis, n])
    for rotation in symmetry.rotations:
        a = Box(b.rotation @ rotation, b.translation, b.extents)
        close(subject(SYMMETRIC, a, b, symmetry), 1, COARSE)


@prop(
    SYMMETRIC,
    IOU,
    reason="the identity is in every group",
    given={"pair": some.near_boxes(), "group": some.symmetries},
    weight=0.5,
)
def at_least_plain(subject: Subject, pair: list[Any], group: list[Any]) -> None:
    """The symmetric IoU is at least the plain one, and at most 1."""
    if some.supports(subject, SYMMETRIC, group):
        a, b = map(as_box, pair)
        plain, value = subject(IOU, a, b), subject(SYMMETRIC, a, b, as_symmetry(group))
        expect(plain - COARSE <= value <= 1 + FINE, f"{value!r}, but the plain IoU is {plain!r}")


@prop(
    SYMMETRIC,
    IOU,
    reason="the definition: a maximum over the true object's group, to 1e-6",
    given={"pair": some.near_boxes()} | GROUP,
    weight=0.5,
)
def at_least_any_element(
    subject: Subject, pair: list[Any], group: list[Any], which: int, spin: float
) -> None:
    """The symmetric IoU is at least the IoU with the truth turned by any of its symmetries."""
    if some.supports(subject, SYMMETRIC, group):
        a, b = map(as_box, pair)
        same = Box(b.rotation @ element(group, which, spin), b.translation, b.extents)
        one, value = subject(IOU, a, same), subject(SYMMETRIC, a, b, as_symmetry(group))
        expect(value >= one - COARSE, f"{value!r}, but one of the symmetries gives {one!r}")


@prop(
    SYMMETRIC,
    IOU,
    reason="the definition: a maximum over the true object's group is reached",
    given={"pair": some.near_boxes(), "group": some.discrete},
    applies=some.supports_any(SYMMETRIC, "discrete"),
)
def largest_of_a_discrete_group(subject: Subject, pair: list[Any], group: list[Any]) -> None:
    """The symmetric IoU is the largest over the rotations of a discrete group."""
    a, b = map(as_box, pair)
    symmetry = as_symmetry(group)
    expected = max(
        subject(IOU, a, Box(b.rotation @ r, b.translation, b.extents)) for r in symmetry.rotations
    )
    close(subject(SYMMETRIC, a, b, symmetry), expected, COARSE)


@prop(
    SYMMETRIC,
    reason="which of the equal poses was annotated is chance",
    given={"pair": some.near_boxes()} | GROUP,
    weight=0.5,
)
def invariant_under_the_group(
    subject: Subject, pair: list[Any], group: list[Any], which: int, spin: float
) -> None:
    """Turning the truth by one of its symmetries changes nothing."""
    if some.supports(subject, SYMMETRIC, group):
        a, b = map(as_box, pair)
        symmetry = as_symmetry(group)
        same = Box(b.rotation @ element(group, which, spin), b.translation, b.extents)
        close(subject(SYMMETRIC, a, same, symmetry), subject(SYMMETRIC, a, b, symmetry), 2e-6)


@prop(
    SYMMETRIC,
    reason="closed form for a continuous axis, where no sample of angles hits the best one",
    given={
        "box": OBJECT_BOXES,
        "axis": st.integers(0, 2),
        "spin": some.real(0, 6.28),
        "share": some.real(0.5, 0.95),
    },
    applies=some.supports_any(SYMMETRIC, "axis", "principal axis"),
)
def smaller_and_spun(
    subject: Subject, box: list[Any], axis: int, spin: float, share: float
) -> None:
    """A smaller copy of the box, spun about the axis, has IoU share cubed."""
    b = as_box(box)
    unit_axis = np.eye(3)[axis]
    a = Box(b.rotation @ turned(unit_axis, spin), b.translation, share * b.extents)
    symmetry = as_symmetry(["axis", unit_axis.tolist(), 1])
    close(subject(SYMMETRIC, a, b, symmetry), share**3, COARSE)
