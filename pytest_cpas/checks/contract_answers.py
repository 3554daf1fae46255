"""Contract checks that look at answers alone: values, frames, units, the shape and its box.

A method may be wrong about an object; an adapter is wrong about most. So what depends on how good
an answer is must fail for more than half of the samples.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pytest_cpas.checks.contract import MethodSubject, NotCheckedError, contract
from pytest_cpas.checks.subject import Finding, Outcome
from pytest_cpas.types import Array, Hypothesis, Mesh, MethodInfo, Observation

__all__ = [
    "check_answers",
    "check_extents_of_shape",
    "check_in_front_of_camera",
    "check_inputs_unmodified",
    "check_metric_units",
    "check_projects_onto_mask",
    "check_shape_in_box",
]

#: Distances and sizes outside of these are no object that a camera sees, metres.
NEAREST, FARTHEST, SMALLEST, LARGEST = 0.05, 30.0, 0.005, 10.0
#: An object's centre is as far away as its measured depth, up to this factor.
DEPTH_FACTOR = 2.0
#: By how much extents and the shape's own may differ, as a share of the diagonal.
EXTENTS_SHARE = 0.12


def _gives_shape_and_extents(info: MethodInfo) -> bool:
    return {"shape", "extents"} <= info.gives


def _mostly(subject: MethodSubject, judge: Callable[[Observation, Hypothesis], str]) -> None:
    """Violated if ``judge`` objects to more than half of the answers; it says the first."""
    answered = subject.hypotheses()
    if not answered:
        raise NotCheckedError("the method has no answer for any of the samples")
    words = [said for observation, found in answered if (said := judge(observation, found))]
    if 2 * len(words) > len(answered):
        raise Finding(
            Outcome.VIOLATED, f"{len(words)} of {len(answered)} samples, the first: {words[0]}"
        )


@contract(smoke=True)
def check_answers(subject: MethodSubject) -> None:
    """One valid prediction per observation: finite, typed, right-handed, with what is declared."""
    subject.first_answers()


@contract(smoke=True)
def check_inputs_unmodified(subject: MethodSubject) -> None:
    """The arrays of an observation are the same after the call."""
    subject.answers()
    if subject.changed_inputs:
        names = ", ".join(sorted(set(subject.changed_inputs)))
        raise Finding(
            Outcome.CHANGED_ARGUMENTS,
            f"{names} of the observation changed: the next method sees that; work on a copy",
        )


@contract(smoke=True)
def check_in_front_of_camera(subject: MethodSubject) -> None:
    """The object is in front of the camera."""

    def behind(observation: Observation, found: Hypothesis) -> str:
        z = found.translation[2]
        if z > 0:
            return ""
        return (
            f"z is {z:.3g} m, behind the camera. Usual causes: an OpenGL camera (declare"
            ' camera_frame="opengl"), the inverse pose (camera to object), a pose in the camera of'
            " another image"
        )

    _mostly(subject, behind)


@contract(smoke=True)
def check_metric_units(subject: MethodSubject) -> None:
    """Distance and size are metres: those of objects, the distance near the measured depth."""

    def not_metres(observation: Observation, found: Hypothesis) -> str:
        distance = float(np.linalg.norm(found.translation))
        seen = observation.depth[observation.mask & (observation.depth > 0)]
        if len(seen):
            ratio = distance / float(np.median(seen))
            if not 1 / DEPTH_FACTOR < ratio < DEPTH_FACTOR:
                return (
                    f"the object is {distance:.3g} away, the depth in the mask is"
                    f" {np.median(seen):.3g} m, {ratio:.3g} of it; is the translation in metres"
                    f"{_unit(ratio)}, and in the camera frame?"
                )
        elif not NEAREST < distance < FARTHEST:
            return f"the object is {distance:.3g} away; is the translation in metres?"
        size = _size(found)
        if size is not None and not SMALLEST < size < LARGEST:
            return (
                f"the object's size is {size:.3g}; expected metres"
                f"{_unit(size / 0.25)}: not pixels, not normalised"
            )
        if size is not None and size > distance:
            return (
                f"the object measures {size:.3g} m, {distance:.3g} m away: it would hold the"
                " camera; is its shape normalised (multiply by the scale)?"
            )
        return ""

    _mostly(subject, not_metres)


def _unit(ratio: float) -> str:
    for factor, unit in ((1000, "millimetres"), (100, "centimetres")):
        if factor / 3 < ratio < factor * 3:
            return f" (this looks like {unit})"
    return ""


def _size(found: Hypothesis) -> float | None:
    if found.extents is not None:
        return float(np.linalg.norm(found.extents))
    box = _box(found)
    return None if box is None else float(np.linalg.norm(box[1] - box[0]))


def _box(found: Hypothesis) -> Array | None:
    """Lowest and highest corner (2, 3) of the shape in the object frame, metres."""
    shape = found.shape
    if shape is None:
        return None
    if isinstance(shape, Mesh):
        return shape.bounds
    return np.stack([shape.min(axis=0), shape.max(axis=0)])


@contract(smoke=True)
def check_projects_onto_mask(subject: MethodSubject) -> None:
    """The estimate projects onto the mask."""

    def beside(observation: Observation, found: Hypothesis) -> str:
        corners = _corners(found)
        placed = found.pose.apply(corners)
        if np.any(placed[:, 2] <= 0):
            return "a part of the object is behind the camera"
        pixels = observation.camera.project(placed)
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        rows, columns = np.nonzero(observation.mask)
        mask_low = np.array([columns.min(), rows.min()], float)
        mask_high = np.array([columns.max(), rows.max()], float)
        # an estimate that is a point, or a mask of a few pixels, still has a place
        slack = 0.25 * (mask_high - mask_low).max() + 2
        common = np.minimum(high, mask_high + slack) - np.maximum(low, mask_low - slack)
        middle = observation.camera.project(found.translation)
        where = (
            f"it projects onto columns {low[0]:.0f} to {high[0]:.0f}, rows {low[1]:.0f} to"
            f" {high[1]:.0f}; the mask is columns {mask_low[0]:.0f} to {mask_high[0]:.0f}, rows"
            f" {mask_low[1]:.0f} to {mask_high[1]:.0f}"
        )
        causes = (
            ". Usual causes: x and y swapped or mirrored, another camera's intrinsics, a pose in"
            " the crop, a scale in the translation"
        )
        if np.any(common < 0) or np.any(
            np.abs(middle - (mask_low + mask_high) / 2) > (mask_high - mask_low) + slack
        ):
            return where + causes
        if found.extents is not None or found.shape is not None:
            covered = _covered(observation.mask, low, high)
            if covered < 0.3:
                return f"{where}: {100 * covered:.0f} % of the mask is covered; is the size halved?"
            grown = float(np.prod(high - low + 1) / np.prod(mask_high - mask_low + 1))
            if grown > 25:
                return f"{where}: {grown:.0f} times the mask's box; is the shape normalised?"
        return ""

    _mostly(subject, beside)


def _corners(found: Hypothesis) -> Array:
    """Points that span the estimate in the object frame: corners of its box, or its centre."""
    if found.extents is None:
        box = _box(found)
        if box is None:
            return np.zeros((1, 3))
        low, high = box
    else:
        low, high = -found.extents / 2, found.extents / 2
    return np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )


def _covered(mask: np.ndarray, low: Array, high: Array) -> float:
    rows, columns = np.nonzero(mask)
    inside = (columns >= low[0] - 1) & (columns <= high[0] + 1)
    inside &= (rows >= low[1] - 1) & (rows <= high[1] + 1)
    return float(inside.mean())


@contract(smoke=True, applies=_gives_shape_and_extents)
def check_extents_of_shape(subject: MethodSubject) -> None:
    """The extents are those of the method's own shape."""

    def disagree(observation: Observation, found: Hypothesis) -> str:
        box = _box(found)
        if box is None or found.extents is None:
            return ""
        own = box[1] - box[0]
        apart = np.abs(found.extents - own).max() / np.linalg.norm(own)
        if apart <= EXTENTS_SHARE:
            return ""
        return (
            f"extents {_numbers(found.extents)}, but the shape measures {_numbers(own)}"
            f" m{_explained(found.extents, own)}"
        )

    _mostly(subject, disagree)


def _explained(extents: Array, own: Array) -> str:
    """What turns the extents into the shape's own, if something usual does."""
    for order in ((0, 2, 1), (1, 0, 2), (2, 1, 0), (1, 2, 0), (2, 0, 1)):
        if np.allclose(extents[list(order)], own, rtol=0.05):
            axes = ", ".join("xyz"[i] for i in order)
            return f": the axes are permuted, extents in the order {axes} agree"
    ratio = extents / own
    if np.ptp(ratio) < 0.1 * ratio.mean():
        factor = float(ratio.mean())
        words = {0.5: " (half extents?)", 2.0: " (doubled?)"}
        near = next((w for f, w in words.items() if abs(factor / f - 1) < 0.1), "")
        return f": {factor:.3g} times as large{near}{_unit(factor)}; is one of them normalised?"
    return ": both must be in the same axes and metric"


def _numbers(values: Array) -> str:
    return "[" + ", ".join(f"{x:.3g}" for x in values) + "]"


@contract(smoke=True, applies=_gives_shape_and_extents)
def check_shape_in_box(subject: MethodSubject) -> None:
    """The shape lies in its own box, which is centred on the object frame's origin."""

    def outside(observation: Observation, found: Hypothesis) -> str:
        shape = found.shape
        if shape is None or found.extents is None:
            return ""
        points = shape.vertices if isinstance(shape, Mesh) else shape
        half = found.extents / 2 + EXTENTS_SHARE * np.linalg.norm(found.extents)
        share = float(np.mean(np.any(np.abs(points) > half, axis=1)))
        if share <= 0.05:
            return ""
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        return (
            f"{100 * share:.0f} % of the shape is outside of its box; the shape's middle is"
            f" {_numbers(middle)}, expected the origin. Usual causes: the shape in the camera"
            " frame, normalised, or not recentred"
        )

    _mostly(subject, outside)
