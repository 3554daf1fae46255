"""Contract checks on changed images whose answer geometry dictates.

They ask whether a method follows, not how exact it is: after the change, position, rotation and
surface must be where they were expected within :data:`POSITION`, :data:`ANGLE` and
:data:`SURFACE`, for one sample at least. An adapter that goes wrong does so for all of them; a
method that is sound may choose otherwise where an object is ambiguous.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pytest_cpas.checks.contract.checking import MethodSubject, NotCheckedError, contract
from pytest_cpas.checks.outcome import Finding, Outcome
from pytest_cpas.metrics.pose import rotation_error
from pytest_cpas.types import (
    Array,
    Camera,
    Hypothesis,
    Mesh,
    MethodInfo,
    Observation,
    Sample,
    Symmetry,
)
from pytest_cpas.types.frames import to_standard

__all__ = [
    "check_distance",
    "check_mirror",
    "check_resolution",
    "check_roll",
    "check_shift",
    "half_resolution",
    "mirrored",
    "moved_away",
    "rolled",
    "shifted",
]

#: How far position and surface may be from where they were expected, metres, and the rotation,
#: degrees.
POSITION, SURFACE, ANGLE = 0.02, 0.01, 20.0
#: Pixels that the image is shifted by, at most.
SHIFT = 48
#: By what the distance of an object grows.
FURTHER = 1.1


@dataclass(frozen=True)
class Changed:
    """An observation after a change, and the orthogonal map (3, 3) and shift (3,), metres, that
    take the camera coordinates of the object to those after it."""

    observation: Observation
    turn: Array
    shift: Array


def _unmoved(observation: Observation) -> Changed:
    return Changed(observation, np.eye(3), np.zeros(3))


def shifted(observation: Observation) -> Changed:
    """The image shifted within its frame, towards the middle, and the camera with it; what moves
    in is black and has no depth. The object stays where it is."""
    camera = observation.camera
    rows, columns = np.nonzero(observation.mask)
    du = SHIFT if columns.mean() < camera.width / 2 else -SHIFT
    dv = SHIFT if rows.mean() < camera.height / 2 else -SHIFT
    # an image so small has little to shift
    du = int(np.clip(du, -(camera.width // 8), camera.width // 8))
    dv = int(np.clip(dv, -(camera.height // 8), camera.height // 8))

    def move(image: NDArray[np.generic]) -> NDArray[np.generic]:
        moved = np.roll(image, (dv, du), axis=(0, 1))
        moved[slice(0, dv) if dv > 0 else slice(camera.height + dv, None)] = 0
        moved[:, slice(0, du) if du > 0 else slice(camera.width + du, None)] = 0
        return moved

    return _unmoved(
        _changed(observation, move, replace(camera, cx=camera.cx + du, cy=camera.cy + dv))
    )


def half_resolution(observation: Observation) -> Changed:
    """Every other pixel of the image. The object stays where it is."""
    c = observation.camera
    camera = Camera((c.width + 1) // 2, (c.height + 1) // 2, c.fx / 2, c.fy / 2, c.cx / 2, c.cy / 2)
    return _unmoved(_changed(observation, lambda image: image[::2, ::2], camera))


def mirrored(observation: Observation) -> Changed:
    """Left and right exchanged."""
    camera = replace(observation.camera, cx=observation.camera.width - 1 - observation.camera.cx)
    observation = _changed(observation, lambda image: image[:, ::-1], camera)
    return Changed(observation, np.diag([-1.0, 1.0, 1.0]), np.zeros(3))


def rolled(observation: Observation) -> Changed:
    """The image rotated by 90 degrees about the optical axis, x to y."""
    c = observation.camera
    camera = Camera(c.height, c.width, c.fy, c.fx, c.height - 1 - c.cy, c.cx)
    observation = _changed(observation, lambda image: np.rot90(image, -1), camera)
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    return Changed(observation, turn, np.zeros(3))


def moved_away(observation: Observation) -> Changed:
    """All that is seen moved along the optical axis by a tenth of the object's distance: every
    pixel goes where its point then is, the nearest wins. Away, so that no gaps open."""
    seen = observation.depth[observation.mask & (observation.depth > 0)]
    if len(seen) == 0:
        raise NotCheckedError("no depth in the mask")
    step = float(np.float32(np.median(seen) * (FURTHER - 1)))
    camera = observation.camera
    v, u = np.nonzero(observation.depth > 0)
    z = observation.depth[v, u].astype(float)
    columns = np.rint((u - camera.cx) * z / (z + step) + camera.cx).astype(int)
    rows = np.rint((v - camera.cy) * z / (z + step) + camera.cy).astype(int)
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    far_first = np.flatnonzero(inside)[np.argsort(-z[inside], kind="stable")]
    target, source = (rows[far_first], columns[far_first]), (v[far_first], u[far_first])
    depth, rgb = np.zeros_like(observation.depth), np.zeros_like(observation.rgb)
    mask = np.zeros_like(observation.mask)
    depth[target] = observation.depth[source] + np.float32(step)
    rgb[target], mask[target] = observation.rgb[source], observation.mask[source]
    moved = Observation(
        category=observation.category, rgb=rgb, depth=depth, mask=mask, camera=camera
    )
    return Changed(moved, np.eye(3), np.array([0, 0, step]))


def _changed(
    observation: Observation,
    change: Callable[[NDArray[np.generic]], NDArray[np.generic]],
    camera: Camera,
) -> Observation:
    rgb, depth, mask = (
        np.ascontiguousarray(change(image))
        for image in (observation.rgb, observation.depth, observation.mask)
    )
    if not mask.any():
        raise NotCheckedError("the mask is too small for this change")
    return Observation(
        category=observation.category,
        rgb=rgb.astype(np.float32),
        depth=depth.astype(np.float32),
        mask=mask.astype(bool),
        camera=camera,
    )


def _claims(name: str) -> Callable[[MethodInfo], bool]:
    return lambda info: info.deterministic and name in info.equivariances


def _follows(
    subject: MethodSubject,
    change: Callable[[Observation], Changed],
    advice: str,
    chosen: Callable[[Sample], bool] = lambda sample: True,
) -> None:
    objections = []
    for sample, answer in zip(subject.samples, subject.repeated_answers(), strict=True):
        if not answer.hypotheses or not chosen(sample):
            continue
        changed = change(sample.observation)
        again = subject.predict([changed.observation])[0]
        if again.hypotheses:
            expected, found = (
                to_standard(each.hypotheses[0], subject.info) for each in (answer, again)
            )
            objection = _apart(found, expected, changed, sample.truth.symmetry)
        else:
            objection = f"no answer after it: {again.reason}"
        if not objection:
            return
        objections.append(objection)
    if not objections:
        raise NotCheckedError("no sample among the few that are tried fits")
    if len(objections) == 1:
        raise NotCheckedError(f"a single sample, which may be ambiguous: {objections[0]}")
    raise Finding(
        Outcome.VIOLATED,
        f"none of {len(objections)} samples follows; the first: {objections[0]}; {advice}",
    )


def _apart(found: Hypothesis, expected: Hypothesis, changed: Changed, symmetry: Symmetry) -> str:
    position = changed.turn @ expected.translation + changed.shift
    off = found.translation - position
    distance = float(np.linalg.norm(off))
    if distance > POSITION:
        return (
            f"the position is {100 * distance:.1f} cm from where it must be (x, y, z:"
            f" {', '.join(f'{100 * x:+.1f}' for x in off)} cm)"
        )
    rotation = changed.turn @ expected.rotation
    if np.linalg.det(rotation) < 0:  # mirrored; only objects with an axis y are
        rotation = rotation * [-1, 1, 1]
    angle = float(np.degrees(rotation_error(found.rotation, rotation, symmetry)))
    if angle > ANGLE:
        return f"the rotation is {angle:.0f} deg from where it must be"
    surface = expected.pose.apply(_surface(expected)) @ changed.turn.T + changed.shift
    again = found.pose.apply(_surface(found))
    there, back = cKDTree(surface).query(again)[0], cKDTree(again).query(surface)[0]
    apart = float(np.mean(there) + np.mean(back)) / 2
    if apart > SURFACE:
        return f"the object's surface is {100 * apart:.1f} cm from where it must be, on average"
    return ""


def _surface(hypothesis: Hypothesis) -> Array:
    """Points that show how the estimate is turned, in the object frame.

    Those of the shape; without one, the corners of the box and the tip of its y axis; without that,
    tips of the axes, 10 cm long.
    """
    shape = hypothesis.shape
    if shape is not None:
        return shape.vertices if isinstance(shape, Mesh) else shape
    if hypothesis.extents is None:
        return np.vstack([np.zeros(3), 0.1 * np.eye(3)])
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return np.vstack([signs * hypothesis.extents / 2, [0, hypothesis.extents[1], 0]])


@contract(demanded=_claims("shift"))
def check_shift(subject: MethodSubject) -> None:
    """With image and principal point shifted, the answer is the same."""
    _follows(
        subject,
        shifted,
        "take the principal point from observation.camera, not from the image size or a constant",
    )


@contract(demanded=_claims("resolution"))
def check_resolution(subject: MethodSubject) -> None:
    """With every other pixel left out, the answer is the same."""
    _follows(
        subject,
        half_resolution,
        "take focal lengths and image size from observation.camera, not from constants",
    )


@contract(demanded=_claims("distance"))
def check_distance(subject: MethodSubject) -> None:
    """Seen from further away, the object is further away and otherwise the same."""
    _follows(
        subject,
        moved_away,
        "back-project with observation.camera; do not scale the size with the distance",
    )


@contract(demanded=_claims("mirror"))
def check_mirror(subject: MethodSubject) -> None:
    """With the image mirrored, an object with an axis of symmetry is mirrored."""
    _follows(
        subject,
        mirrored,
        "is x treated otherwise than -x: an axis with the wrong sign, a principal point that is"
        " a constant?",
        lambda sample: sample.truth.symmetry.axis is not None,
    )


@contract(demanded=_claims("roll"))
def check_roll(subject: MethodSubject) -> None:
    """With the image rotated by 90 degrees, so is the answer."""
    _follows(
        subject,
        rolled,
        "is x treated otherwise than y: rows taken for columns, fx for fy, an upright object"
        " assumed? If so, do not claim it",
    )
