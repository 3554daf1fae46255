"""Properties of rotation and translation errors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pytest_cpas.checks.metrics import strategies as some
from pytest_cpas.checks.metrics.properties import close, expect, prop
from pytest_cpas.checks.metrics.strategies import Rows, as_symmetry, element, turned
from pytest_cpas.checks.metrics.subject import Subject
from pytest_cpas.types import Symmetry

#: For all but the properties on accuracy: an arccos of a rounded trace is off by a few 1e-8.
COARSE = 1e-6
#: What the digits of a rotation matrix allow everywhere.
FINE = 1e-12

PLAIN = "rotation_error"
SYMMETRIC = "symmetric_rotation_error"


def _matrix_only(metric: str) -> Any:
    return lambda subject: subject.defines(metric, "rotation") == "matrix"


@prop(
    PLAIN,
    reason="a perfect prediction must be perfect; a trace above 3 must not give NaN",
    given={"a": some.rotations},
)
def identity(subject: Subject, a: Rows) -> None:
    """A rotation has error 0 to itself."""
    close(subject(PLAIN, np.array(a), np.array(a)), 0, COARSE)


@prop(
    PLAIN,
    reason="an angle between two orientations has no direction",
    given={"a": some.rotations, "b": some.rotations},
)
def symmetry_of_arguments(subject: Subject, a: Rows, b: Rows) -> None:
    """Estimate and truth can be swapped."""
    one = subject(PLAIN, np.array(a), np.array(b))
    close(subject(PLAIN, np.array(b), np.array(a)), one, COARSE)


@prop(
    PLAIN,
    reason="there is no rotation by more than half a turn",
    given={"a": some.rotations, "b": some.rotations},
)
def in_range(subject: Subject, a: Rows, b: Rows) -> None:
    """The error is in [0, pi]."""
    value = subject(PLAIN, np.array(a), np.array(b))
    expect(0 <= value <= math.pi + COARSE, f"the error is {value!r}, expected 0 to pi")


@prop(
    PLAIN,
    reason="the error is between two orientations, not between them and the camera's axes",
    given={"a": some.rotations, "b": some.rotations, "camera": some.rotations},
)
def turned_camera(subject: Subject, a: Rows, b: Rows, camera: Rows) -> None:
    """Turning the camera changes nothing."""
    c = np.array(camera)
    one = subject(PLAIN, np.array(a), np.array(b))
    close(subject(PLAIN, c @ np.array(a), c @ np.array(b)), one, COARSE)


@prop(
    PLAIN,
    reason="data sets disagree about which axis of an object is up",
    given={"a": some.rotations, "b": some.rotations, "frame": some.rotations},
)
def turned_object_frame(subject: Subject, a: Rows, b: Rows, frame: Rows) -> None:
    """Another object frame changes nothing."""
    f = np.array(frame)
    one = subject(PLAIN, np.array(a), np.array(b))
    close(subject(PLAIN, np.array(a) @ f, np.array(b) @ f), one, COARSE)


@prop(
    PLAIN,
    reason="the angle is a metric of the rotations; squares and cosines are not",
    given={"a": some.rotations, "b": some.rotations, "c": some.rotations},
)
def triangle_inequality(subject: Subject, a: Rows, b: Rows, c: Rows) -> None:
    """Angle(a, c) <= angle(a, b) + angle(b, c)."""
    x, y, z = np.array(a), np.array(b), np.array(c)
    long, short = subject(PLAIN, x, z), (subject(PLAIN, x, y), subject(PLAIN, y, z))
    expect(long <= sum(short) + COARSE, f"{long!r} > {short[0]!r} + {short[1]!r}")


@prop(
    PLAIN,
    reason="the definition, where it is known in closed form",
    given={"a": some.rotations, "axis": some.axes, "angle": some.angles},
    corners=lambda: (
        {"a": turned([1, 2, -4], 1.1).tolist(), "axis": axis, "angle": angle}
        for axis in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [-1, 2, 3])
        for angle in (0.0, 1e-3, 0.4, math.pi / 2, 2.0, 2 * math.pi / 3, 3.0, math.pi)
    ),
)
def one_axis(subject: Subject, a: Rows, axis: list[int], angle: float) -> None:
    """A turn by x about any one axis has error x."""
    close(subject(PLAIN, np.array(a) @ turned(axis, angle), np.array(a)), angle, COARSE)


@prop(
    PLAIN,
    reason="the arccos of a trace loses half of the digits there, float32 nearly all",
    given={"axis": some.axes, "angle": some.log_real(1e-11, 1e-3)},
)
def accurate_near_zero(subject: Subject, axis: list[int], angle: float) -> None:
    """Angles near 0 are right to 1e-12 rad."""
    close(subject(PLAIN, turned(axis, angle), np.eye(3)), angle, FINE)


@prop(
    PLAIN,
    reason="the arccos of a trace loses half of the digits there, too",
    given={"axis": some.axes, "less": some.log_real(1e-11, 1e-3)},
)
def accurate_near_half_turn(subject: Subject, axis: list[int], less: float) -> None:
    """Angles near 180 degrees are right to 1e-12 rad."""
    # a half turn about a unit vector u is 2 u u^T - I, without any rounded sine of pi
    unit = np.array(axis) / np.linalg.norm(axis)
    half = 2 * np.outer(unit, unit) - np.eye(3)
    value = subject(PLAIN, half @ turned(axis, -less), np.eye(3))
    close(math.pi - value, less, FINE, "pi less the error")


@prop(
    PLAIN,
    reason="a mirrored object is not the object; scored, it hides a bug in a method's frames",
    given={"a": some.rotations, "axis": st.integers(0, 2)},
    applies=_matrix_only(PLAIN),
)
def reflection_rejected(subject: Subject, a: Rows, axis: int) -> None:
    """A reflection raises."""
    mirrored = np.array(a)
    mirrored[:, axis] *= -1
    subject.refuses(PLAIN, mirrored, np.array(a))


@prop(
    PLAIN,
    reason="a scale left in the rotation changes the trace and with it the angle",
    given={"a": some.rotations, "scale": st.sampled_from([0.0, 0.5, 0.9, 1.1, 2.0])},
    applies=_matrix_only(PLAIN),
)
def scale_rejected(subject: Subject, a: Rows, scale: float) -> None:
    """A matrix that is not orthonormal raises."""
    subject.refuses(PLAIN, scale * np.array(a), np.array(a))


@prop(
    PLAIN,
    reason="who checks the estimate alone scores against a mirrored or scaled truth",
    given={"a": some.rotations, "axis": st.integers(0, 2), "factor": st.sampled_from([-1.0, 1.1])},
    weight=0.25,
    applies=_matrix_only(PLAIN),
    corners=lambda: (
        {"a": np.eye(3).tolist(), "axis": axis, "factor": factor}
        for axis in range(3)
        for factor in (-1.0, 0.0, 0.9, 1.1)
    ),
)
def bad_truth_rejected(subject: Subject, a: Rows, axis: int, factor: float) -> None:
    """A true rotation of which one axis is mirrored or stretched raises."""
    truth = np.array(a)
    truth[:, axis] *= factor
    subject.refuses(PLAIN, np.array(a), truth)


# -- under a symmetry group --------------------------------------------------------------------

GROUP = {"group": some.symmetries, "which": st.integers(0, 6), "spin": some.real(0, 6.28)}


@prop(
    SYMMETRIC,
    reason="all poses of the group look alike; a sampled symmetry misses those in between",
    given={"a": some.rotations} | GROUP,
)
def zero_on_the_group(subject: Subject, a: Rows, group: list[Any], which: int, spin: float) -> None:
    """An estimate that a symmetry takes to the truth has error 0."""
    if some.supports(subject, SYMMETRIC, group):
        same = np.array(a) @ element(group, which, spin)
        close(subject(SYMMETRIC, same, np.array(a), as_symmetry(group)), 0, COARSE)


@prop(
    SYMMETRIC,
    reason="which of the equal poses was annotated is chance",
    given={"a": some.rotations, "b": some.rotations} | GROUP,
)
def invariant_under_the_group(
    subject: Subject, a: Rows, b: Rows, group: list[Any], which: int, spin: float
) -> None:
    """Turning the truth by a symmetry changes nothing."""
    if some.supports(subject, SYMMETRIC, group):
        symmetry = as_symmetry(group)
        one = subject(SYMMETRIC, np.array(a), np.array(b), symmetry)
        same = np.array(b) @ element(group, which, spin)
        close(subject(SYMMETRIC, np.array(a), same, symmetry), one, COARSE)


@prop(
    SYMMETRIC,
    reason="the definition; checked against scipy's angle of each element",
    given={"a": some.rotations, "b": some.rotations, "group": some.discrete},
    applies=some.supports_any(SYMMETRIC, "discrete"),
)
def least_of_a_discrete_group(subject: Subject, a: Rows, b: Rows, group: list[Any]) -> None:
    """The error is the least over the rotations of a discrete group."""
    symmetry = as_symmetry(group)
    relative = np.swapaxes(np.array(b) @ symmetry.rotations, -1, -2) @ np.array(a)
    expected = float(Rotation.from_matrix(relative).magnitude().min())
    close(subject(SYMMETRIC, np.array(a), np.array(b), symmetry), expected, COARSE)


@prop(
    SYMMETRIC,
    reason="closed form, with 0 and 180 degrees, where rounding makes an arccos NaN",
    given={
        "a": some.rotations,
        "axis": some.axes_of_objects,
        "across": some.axes,
        "tilt": some.angles,
        "spin": some.real(0, 6.28),
    },
    applies=some.supports_any(SYMMETRIC, "axis", "principal axis"),
)
def tilted_axis(
    subject: Subject, a: Rows, axis: list[int], across: list[int], tilt: float, spin: float
) -> None:
    """A tilt of the axis of rotation by x, with any spin, has error x."""
    normal = np.cross(axis, across)
    if not normal.any():
        normal = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    estimate = np.array(a) @ turned(normal, tilt) @ turned(axis, spin)
    if some.supports(subject, SYMMETRIC, ["axis", axis, 1]):
        value = subject(SYMMETRIC, estimate, np.array(a), as_symmetry(["axis", axis, 1]))
        close(value, tilt, COARSE)


@prop(
    SYMMETRIC,
    PLAIN,
    reason="the identity is in every group",
    given={"a": some.rotations, "b": some.rotations, "group": some.symmetries},
)
def at_most_plain(subject: Subject, a: Rows, b: Rows, group: list[Any]) -> None:
    """The error is at most the plain one."""
    if some.supports(subject, SYMMETRIC, group):
        plain = subject(PLAIN, np.array(a), np.array(b))
        value = subject(SYMMETRIC, np.array(a), np.array(b), as_symmetry(group))
        expect(value <= plain + COARSE, f"{value!r} > {plain!r}, the plain error")


@prop(
    SYMMETRIC,
    reason="of two opposite directions one is within 90 degrees",
    given={"a": some.rotations, "b": some.rotations, "axis": some.axes_of_objects},
    applies=some.supports_any(SYMMETRIC, "axis with flip", "principal axis with flip"),
)
def flip_halves_the_range(subject: Subject, a: Rows, b: Rows, axis: list[int]) -> None:
    """An axis that may be flipped has at most 90 degrees error."""
    group = ["axis with flip", axis, 1]
    if some.supports(subject, SYMMETRIC, group):
        value = subject(SYMMETRIC, np.array(a), np.array(b), as_symmetry(group))
        expect(0 <= value <= math.pi / 2 + COARSE, f"the error is {value!r}, expected 0 to pi / 2")


@prop(
    SYMMETRIC,
    reason="every rotation is in its group",
    given={"a": some.rotations, "b": some.rotations},
    applies=some.supports_any(SYMMETRIC, "sphere"),
)
def sphere(subject: Subject, a: Rows, b: Rows) -> None:
    """A sphere has no rotation error."""
    value = subject(SYMMETRIC, np.array(a), np.array(b), Symmetry.full())
    close(value, 0, COARSE)


# -- translation -------------------------------------------------------------------------------

SHIFT = "translation_error"


@prop(
    SHIFT,
    reason="the definition; a float32 loses millimetres far from the camera",
    given={"a": some.positions, "b": some.positions},
)
def euclidean(subject: Subject, a: list[float], b: list[float]) -> None:
    """The error is the Euclidean distance, to 1e-12 m."""
    close(subject(SHIFT, np.array(a), np.array(b)), math.dist(a, b), FINE)


@prop(
    SHIFT,
    reason="differences of large numbers must not lose what matters",
    given={"far": some.positions, "small": some.log_real(1e-6, 1e-3), "axis": st.integers(0, 2)},
)
def small_shift_far_away(subject: Subject, far: list[float], small: float, axis: int) -> None:
    """Small shifts far away are right to 1e-12 m."""
    moved = list(far)
    moved[axis] += small
    close(subject(SHIFT, np.array(moved), np.array(far)), abs(moved[axis] - far[axis]), FINE)


@prop(
    SHIFT,
    reason="a distance has no frame",
    given={
        "a": some.positions, "b": some.positions,
        "camera": some.rotations, "shift": some.positions,
    },
)  # fmt: skip
def moved_camera(
    subject: Subject, a: list[float], b: list[float], camera: Rows, shift: list[float]
) -> None:
    """Moving and turning the camera changes nothing."""
    one = subject(SHIFT, np.array(a), np.array(b))
    x, y = (np.array(camera) @ np.array(p) + np.array(shift) for p in (a, b))
    close(subject(SHIFT, x, y), one, FINE)
