"""Contract checks that look at answers alone: values, frames, units, the shape and its box."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.checks.contract.checking import MethodSubject, NotCheckedError, contract
from pytest_cpas.checks.outcome import Finding, Outcome
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
#: The share of the mask that the projected box covers at least, and how many times as large as the
#: mask's box it is at most; both lenient, for what is occluded.
LEAST_COVERED, MOST_LARGER = 0.3, 25.0
#: By how much extents and the shape's own may differ, as a share of the diagonal.
EXTENTS_SHARE = 0.12


def _gives_shape_and_extents(info: MethodInfo) -> bool:
    return {"shape", "extents"} <= info.gives


def _mostly(subject: MethodSubject, judge: Callable[[Observation, Hypothesis], str]) -> None:
    """Violated if ``judge``, which says what is wrong with an answer or nothing, objects to more
    than half of them: a method may be wrong about an object, an adapter is wrong about most."""
    answered = subject.hypotheses()
    if not answered:
        raise NotCheckedError("the method has no answer for any of the samples")
    words = [said for observation, found in answered if (said := judge(observation, found))]
    if words and len(answered) == 1:
        raise NotCheckedError(f"a single sample, which may be the method's mistake: {words[0]}")
    if 2 * len(words) > len(answered):
        raise Finding(
            Outcome.VIOLATED, f"{len(words)} of {len(answered)} samples, the first: {words[0]}"
        )


@contract(smoke=True)
def check_answers(subject: MethodSubject) -> None:
    """One valid prediction per observation: finite, typed, right-handed, with what is declared."""
    if subject.first.finding:
        raise subject.first.finding


@contract(smoke=True)
def check_inputs_unmodified(subject: MethodSubject) -> None:
    """The arrays of an observation are the same after the call."""
    subject.answers()
    if subject.first.changed_inputs:
        names = ", ".join(sorted(subject.first.changed_inputs))
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
    if found.shape is None:
        return None
    return found.shape.bounds if isinstance(found.shape, Mesh) else _bounds(found.shape)


@contract(smoke=True)
def check_projects_onto_mask(subject: MethodSubject) -> None:
    """The estimate projects onto the mask."""

    def beside(observation: Observation, found: Hypothesis) -> str:
        placed = found.pose.apply(_corners(found))
        if np.any(placed[:, 2] <= 0):
            return "a part of the object is behind the camera"
        pixels = np.argwhere(observation.mask)[:, ::-1]
        low, high = _bounds(observation.camera.project(placed))
        mask_low, mask_high = _bounds(pixels)
        where = (
            f"it projects onto columns {low[0]:.0f} to {high[0]:.0f}, rows {low[1]:.0f} to"
            f" {high[1]:.0f}; the mask is columns {mask_low[0]:.0f} to {mask_high[0]:.0f}, rows"
            f" {mask_low[1]:.0f} to {mask_high[1]:.0f}"
        )
        slack = 0.25 * (mask_high - mask_low).max() + 2  # pixels
        if np.any(low > mask_high + slack) or np.any(high < mask_low - slack):
            return (
                f"{where}. Usual causes: the inverse pose, x and y swapped or mirrored, another"
                " camera's intrinsics, a pose in the crop, a scale in the translation"
            )
        if found.extents is None and found.shape is None:
            return ""
        covered = np.mean(np.all((pixels >= low - 1) & (pixels <= high + 1), axis=1))
        if covered < LEAST_COVERED:
            return f"{where}: {100 * covered:.0f} % of the mask is covered; is the size halved?"
        larger = float(np.prod(high - low + 1) / np.prod(mask_high - mask_low + 1))
        if larger > MOST_LARGER:
            return f"{where}: {larger:.0f} times the mask's box; is the shape normalised?"
        return ""

    _mostly(subject, beside)


def _bounds(points: Array | NDArray[np.int64]) -> Array:
    """Lowest and highest corner (2, d) of points (N, d)."""
    return np.stack([points.min(axis=0), points.max(axis=0)]).astype(float)


def _corners(found: Hypothesis) -> Array:
    """Points that span the estimate in the object frame: corners of its box, or its centre."""
    box = _box(found)
    if found.extents is not None:
        box = np.stack([-found.extents / 2, found.extents / 2])
    if box is None:
        return np.zeros((1, 3))
    return np.array(list(itertools.product(*box.T)))


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
