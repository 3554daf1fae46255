"""The usual mistakes of an adapter, each with what undoes it and the line to change."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_cpas.diagnosis.evidence import Evidence
from pytest_cpas.evaluation.estimates import Estimates
from pytest_cpas.types import Array
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET, OPENCV_FROM_OPENGL, permute_extents

Undo = Callable[[Estimates], Estimates]


@dataclass(frozen=True, eq=False)
class Mistake:
    """``words`` say what is wrong, ``fix`` is the code to change, ``cure`` names the change.

    ``undo`` takes the answers in the frames that the method declared. ``turn`` (3, 3) is set for
    another object frame, whose ``undo`` it stands for: what leads there from ShapeNet's.
    ``fitted``: it has a number that was estimated, so it always explains a little more.
    ``numbers``: what to change where ``fix`` is a declaration, and there is a file alone.
    """

    name: str
    words: str
    cure: str
    fix: str
    undo: Undo
    turn: Array | None = None
    fitted: bool = False
    numbers: str = ""

    @property
    def fix_of_numbers(self) -> str:
        """The fix in terms of the numbers that are answered, without the call they are put in."""
        return self.numbers or _of_numbers(self.fix)


def _of_numbers(fix: str) -> str:
    match = re.fullmatch(r"(.*?)Hypothesis\((.*), \.\.\.\)(.*)", fix)
    if match is None:
        return fix
    before, arguments, after = match.groups()
    parts = (part.split("=", 1) for part in re.split(r", (?=\w+=)", arguments))
    changed = "; ".join(f"{name} = {value}" for name, value in parts if name != value)
    return f"{before}{changed}{after}"


# -- how the rotation was read ---------------------------------------------------------------


def _transposed(answers: Estimates) -> Estimates:
    return replace(answers, rotation=np.swapaxes(answers.rotation, 1, 2))


def _inverse(answers: Estimates) -> Estimates:
    rotation = np.swapaxes(answers.rotation, 1, 2)
    translation = -np.einsum("nij,nj->ni", rotation, answers.translation)
    return replace(answers, rotation=rotation, translation=translation)


def _reordered(order: tuple[int, ...]) -> Undo:
    def undo(answers: Estimates) -> Estimates:
        quaternions = Rotation.from_matrix(answers.rotation).as_quat()
        rotation = Rotation.from_quat(quaternions[:, order]).as_matrix()
        return replace(answers, rotation=rotation)

    return undo


READINGS = (
    Mistake(
        "pose-inverse",
        "your pose is the inverse: it maps camera coordinates to object coordinates",
        "the inverse",
        "Hypothesis(rotation=rotation.T, translation=-rotation.T @ translation, ...)",
        _inverse,
    ),
    Mistake(
        "rotation-transposed",
        "your rotation is transposed (columns taken for rows)",
        "the transpose",
        "Hypothesis(rotation=rotation.T, translation=translation, ...)",
        _transposed,
    ),
    Mistake(
        "quaternion-order-wxyz",
        "your quaternion is scalar-first (w, x, y, z) and is read as scalar-last (x, y, z, w)",
        "the other order",
        "Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix()",
        _reordered((1, 2, 3, 0)),
    ),
    Mistake(
        "quaternion-order-xyzw",
        "your quaternion is scalar-last (x, y, z, w) and is read as scalar-first (w, x, y, z)",
        "the other order",
        "Rotation.from_quat(quaternion).as_matrix(), which takes (x, y, z, w)",
        _reordered((3, 0, 1, 2)),
    ),
)


# -- camera frames ---------------------------------------------------------------------------

#: Camera axes in use, as what turns them into OpenCV's.
_CAMERAS = {
    "opencv": ("OpenCV's", np.eye(3)),
    "opengl": ("OpenGL's", OPENCV_FROM_OPENGL),
    "pytorch3d": ("PyTorch3D's (x left, y up, z forward)", np.diag([-1.0, -1.0, 1.0])),
    "robot": (
        "a robot's (x forward, y left, z up)",
        np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    ),
}


def cameras(evidence: Evidence) -> list[Mistake]:
    """Other camera frames than the declared one, wholly or in a part of the pose; lost signs."""
    declared = evidence.camera
    own = next(words for words, axes in _CAMERAS.values() if np.array_equal(axes, declared))
    found = []
    for part in ("", "rotation", "translation"):
        for name, (words, axes) in _CAMERAS.items():
            if np.array_equal(axes, declared):
                continue
            change = declared.T @ axes
            which = f"the camera frame of your {part}" if part else "your camera frame"
            turned = f"turn = {code(change)}; Hypothesis(rotation=turn @ rotation,"
            turned += " translation=turn @ translation, ...)"
            if part:
                fix = f"{part} = {code(change)} @ {part}"
            elif name in ("opencv", "opengl"):
                fix = f'camera_frame="{name}" in MethodInfo'
            else:
                fix = turned
            found.append(
                Mistake(
                    f"camera-frame-{name}" + (f"-{part}" if part else ""),
                    f"{which} is {words}, not {own}",
                    "that one rotation",
                    fix,
                    _in_camera(change, part),
                    numbers="" if part else _of_numbers(turned),
                )
            )
    known = [declared.T @ axes for _, axes in _CAMERAS.values()]
    for signs in itertools.product((1.0, -1.0), repeat=3):
        change = np.diag(signs)
        if not any(np.array_equal(change, other) for other in known):
            lost = ", ".join(axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0)
            found.append(
                Mistake(
                    f"translation-sign-{lost.replace(', ', '')}",
                    f"your translation has the wrong sign in {lost}",
                    "the other sign",
                    f"translation = translation * {[int(sign) for sign in signs]}",
                    _in_camera(change, "translation"),
                )
            )
    found.append(
        Mistake(
            "translation-x-y-swapped",
            "x and y of your translation are swapped (row and column of the image)",
            "the two exchanged",
            "translation = translation[[1, 0, 2]]",
            _in_camera(np.eye(3)[[1, 0, 2]], "translation"),
        )
    )
    return found


def _in_camera(change: Array, part: str) -> Undo:
    def undo(answers: Estimates) -> Estimates:
        rotation = answers.rotation if part == "translation" else change @ answers.rotation
        translation = answers.translation if part == "rotation" else answers.translation @ change.T
        return Estimates(rotation, translation, answers.extents)

    return undo


# -- object frames ---------------------------------------------------------------------------


def object_frames(evidence: Evidence) -> list[Mistake]:
    """The 23 other right-handed ways to lay axes along the object's, the named ones first."""
    permutations = [np.eye(3)[list(order)] for order in itertools.permutations(range(3))]
    signs = [np.diag(s) for s in itertools.product((1.0, -1.0), repeat=3)]
    proper = [s @ p for p in permutations for s in signs if np.linalg.det(s @ p) > 0]
    named = {"shapenet": np.eye(3), "nocs": NOCS_FROM_SHAPENET}
    owners = {"shapenet": "ShapeNet's", "nocs": "NOCS's"}
    own = next(name for name, axes in named.items() if np.array_equal(axes, evidence.axes))
    found = [
        Mistake(
            f"object-frame-{name}",
            f"your object frame is {owners[name]}, not {owners[own]}",
            "that one rotation",
            f'object_frame="{name}" in MethodInfo',
            _in_object(turn @ evidence.axes.T),
            turn,
            numbers=_of_numbers(_in_axes(turn @ evidence.axes.T)),
        )
        for name, turn in named.items()
        if name != own
    ]
    for turn in sorted(proper, key=lambda turn: _strangeness(turn @ evidence.axes.T)):
        if any(np.array_equal(turn, axes) for axes in named.values()):
            continue
        change = turn @ evidence.axes.T
        directions = ", ".join(_direction(row) for row in turn)
        found.append(
            Mistake(
                f"object-frame({directions.replace(' ', '')})",
                f"your object frame is not {owners[own]}: your x, y, z point along ShapeNet's"
                f" {directions}",
                "that one rotation",
                _in_axes(change),
                _in_object(change),
                turn,
            )
        )
    return found


def _in_axes(change: Array) -> str:
    order = (np.abs(change.T) @ np.arange(3)).astype(int).tolist()
    sized = "" if order == [0, 1, 2] else f", extents=extents[{order}]"
    return f"Hypothesis(rotation=rotation @ {code(change)}, translation=translation{sized}, ...)"


def _strangeness(change: Array) -> tuple[bool, float]:
    """Half turns about an axis come first, then quarter turns, then what exchanges three axes."""
    return not np.array_equal(change, np.diag(np.diag(change))), -float(np.trace(change))


def _direction(axis: Array) -> str:
    index = int(np.argmax(np.abs(axis)))
    return ("-" if axis[index] < 0 else "") + "xyz"[index]


def _in_object(change: Array) -> Undo:
    def undo(answers: Estimates) -> Estimates:
        return Estimates(
            answers.rotation @ change,
            answers.translation,
            permute_extents(answers.extents.T, change.T).T,
        )

    return undo


# -- lengths ---------------------------------------------------------------------------------


def units() -> list[Mistake]:
    """Translations that are not in metres."""
    return [
        Mistake(
            f"unit-{short}",
            f"your translation is in {long}, not in metres",
            "metres",
            f"Hypothesis(rotation=rotation, translation=translation / {divisor}, ...)",
            shifted(lambda t, divisor=divisor: t / divisor),  # type: ignore[misc]
        )
        for short, long, divisor in (
            ("mm", "millimetres", 1000),
            ("cm", "centimetres", 100),
            ("dm", "decimetres", 10),
        )
    ]


def shifted(change: Callable[[Array], Array]) -> Undo:
    """Undo a mistake of the translation alone; ``change`` maps (n, 3) to (n, 3)."""

    def undo(answers: Estimates) -> Estimates:
        return replace(answers, translation=change(answers.translation))

    return undo


def code(matrix: Array) -> str:
    """A signed permutation as Python writes it."""
    if np.array_equal(matrix, np.diag(np.diag(matrix))):
        return f"np.diag({np.diag(matrix).astype(int).tolist()})"
    return f"np.array({matrix.astype(int).tolist()})"
