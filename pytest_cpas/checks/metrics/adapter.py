"""What an implementation of metrics offers, and under which definition.

An adapter is a mapping ``METRICS`` from the names of :data:`KNOWN` to ``offer(function, ...)``.
The function takes the arguments that :data:`KNOWN` lists; the keyword arguments of :func:`offer`
say in which convention, and are the only thing that a foreign code needs to declare::

    METRICS = {
        "rotation_error": offer(angle_between, rotation="quaternion-wxyz", angle="deg"),
        "chamfer": offer(chamfer_distance, squared=True, combine="sum"),
    }

A metric that is left out is n/a.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pytest_cpas.types import DeclarationError

__all__ = ["KNOWN", "Box", "Known", "Offer", "Sample", "offer"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Box:
    """A box centred on ``translation`` (3,), metres, with ``extents`` (3,), its side lengths.

    ``rotation`` (3, 3) takes the box's axes to the camera's.
    """

    rotation: Array
    translation: Array
    extents: Array


@dataclass(frozen=True, eq=False)
class Sample:
    """A posed object: as :class:`Box`, and its surface as ``points`` (N, 3) in the camera frame."""

    rotation: Array
    translation: Array
    extents: Array
    points: Array


@dataclass(frozen=True)
class Known:
    """A metric that can be offered.

    ``arguments``: what its function takes, in words. ``gives``: ``number``, ``numbers``, either
    ``or None``, ``points`` or ``truth value``. ``choices``: the conventions that can be declared,
    the first being the default.
    """

    arguments: str
    gives: str = "number"
    choices: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)


_ROTATION: dict[str, tuple[Any, ...]] = {
    "rotation": ("matrix", "quaternion-xyzw", "quaternion-wxyz", "scipy")
}
_ANGLE: dict[str, tuple[Any, ...]] = {"angle": ("rad", "deg")}
_BOX: dict[str, tuple[Any, ...]] = {
    "box": (
        ("rotation", "translation", "extents"),
        ("translation", "rotation", "extents"),
        ("rotation", "translation", "half extents"),
        ("translation", "rotation", "half extents"),
        ("corners",),
    ),
    "percent": (False, True),
} | _ROTATION
_SHARE: dict[str, tuple[Any, ...]] = {
    "boundary": ("strict", "inclusive"),
    "percent": (False, True),
}
_SYMMETRIES = ("axis", "axis with flip", "discrete", "sphere")
#: Of an implementation that knows continuous symmetries about x, y and z only.
_PRINCIPAL = ("principal axis", "principal axis with flip")
_SYMMETRY: dict[str, tuple[Any, ...]] = {"symmetries": (_SYMMETRIES,)}
_LENGTH: dict[str, tuple[Any, ...]] = {"length": ("m", "cm", "mm")}
_PERCENT: dict[str, tuple[Any, ...]] = {"percent": (False, True)}

_POSES = "estimated rotation and translation, true rotation and translation, points of the model"

#: The metrics that the properties know. Points are (N, 3) arrays, everything in metres.
KNOWN: Mapping[str, Known] = MappingProxyType(
    {
        "rotation_error": Known("estimate, truth (rotations)", choices=_ROTATION | _ANGLE),
        "symmetric_rotation_error": Known(
            "estimate, truth (rotations), symmetry (pytest_cpas.types.Symmetry of the true object)",
            choices=_ROTATION | _ANGLE | _SYMMETRY,
        ),
        "translation_error": Known("estimate, truth (3,)", choices=_LENGTH),
        "box_iou": Known("box a, box b (each as the definition's box says)", choices=_BOX),
        "symmetric_box_iou": Known(
            "estimated box, true box, symmetry (pytest_cpas.types.Symmetry of the true object)",
            choices=_BOX | _SYMMETRY,
        ),
        "equal_diagonals_iou": Known(
            "estimated box, true box; each scaled about the camera to a diagonal of 1, then their"
            " IoU",
            choices=_BOX,
        ),
        "relative_translation_error": Known(
            "estimated box, true box; each scaled as in equal_diagonals_iou, then the distance of"
            " their centres",
            choices={"box": _BOX["box"]} | _ROTATION,
        ),
        "axis_aligned_iou": Known(
            "estimated box, true box, spins: IoU of the boxes along the camera's axes around the"
            " corners; the largest over so many turns of the estimate about its y axis",
            choices=_BOX,
        ),
        "legacy_iou": Known(
            "the same, with the extremes of each corner's coordinates, as NOCS' published code",
            choices=_BOX,
        ),
        "iou_plus": Known(
            "estimated points, true points (camera frame): IoU of the boxes along its axes around"
            " them",
            choices=_PERCENT,
        ),
        "average_distance": Known("points from, points to"),
        "chamfer": Known(
            "true points, estimated points",
            choices={"combine": ("mean", "sum"), "squared": (False, True)},
        ),
        "surface_precision": Known("true points, estimated points, threshold", choices=_SHARE),
        "surface_recall": Known("true points, estimated points, threshold", choices=_SHARE),
        "fscore": Known("true points, estimated points, threshold", choices=_SHARE),
        "nad": Known("true points, estimated points", choices={"normaliser": ("own", "truth")}),
        "diameter": Known("points"),
        "precision": Known(
            "errors (mapping of names to (N,) arrays: rotation_deg, position_m, iou, fscore, nad;"
            " infinite without an answer, minus infinite of iou and fscore; None where n/a), limits"
            " (mapping of such names to numbers)",
            gives="number or None",
            choices={"boundary": ("inclusive", "strict")} | _PERCENT,
        ),
        "mean_precision": Known(
            "errors and limits as in precision, categories (N names), names (that are judged)",
            gives="number or None",
            choices=_PERCENT,
        ),
        "best_precision": Known(
            "hypotheses (per sample a list of mappings of names to numbers, as in precision),"
            " limits: a sample is correct if any of its hypotheses is",
            gives="number or None",
            choices=_PERCENT,
        ),
        "worst_precision": Known(
            "the same: a sample is correct if all of its hypotheses are",
            gives="number or None",
            choices=_PERCENT,
        ),
        "precision_curve": Known(
            "errors (N,), name of the error, thresholds (K,): the precision at each",
            gives="numbers",
            choices=_PERCENT,
        ),
        "count_interval": Known(
            "correct, total, confidence: ends of the exact (Clopper-Pearson) interval",
            gives="numbers",
            choices=_PERCENT,
        ),
        "mean_interval": Known(
            "values (N,), NaN where n/a, confidence: ends of Student's interval of the mean",
            gives="numbers or None",
        ),
        "median_interval": Known(
            "values (N,), NaN where n/a, confidence: ends of the interval of order statistics of"
            " the median",
            gives="numbers or None",
        ),
        "iou_auc": Known(
            "IoUs (N,), lower threshold",
            gives="number or None",
            choices={"bins": (None, 10, 100)} | _PERCENT,
        ),
        "pose_vus": Known(
            "degrees (N,), metres (N,), largest degrees, largest metres",
            gives="number or None",
            choices={"bins": (None, 10, 100)} | _PERCENT,
        ),
        "pose_correct": Known(
            "estimate, truth (Sample), limits (as in precision; F at 1 cm), axis of continuous"
            " symmetry of the object (0, 1, 2 or None)",
            gives="truth value",
        ),
        "average_precision": Known(
            "scores (N,), correct (N,) bool, number of ground truths",
            choices={"interpolated": (True, False)} | _PERCENT,
        ),
        "detection_ap": Known(
            "images, categories and scores of predictions (P,), images and categories of ground"
            " truths (G,), IoU (P, G), threshold, category",
            gives="number or None",
            choices={"boundary": ("strict", "inclusive")} | _PERCENT,
        ),
        "mean_detection_ap": Known(
            "as detection_ap, with a list of categories: mean over those with ground truth",
            gives="number or None",
            choices={"boundary": ("strict", "inclusive")} | _PERCENT,
        ),
        "pose_ap": Known(
            "images, categories and scores of predictions (P,), images and categories of ground"
            " truths (G,), degrees (P, G), metres (P, G), largest degrees, largest metres (both"
            " inclusive), category; matched by degrees plus centimetres",
            gives="number or None",
            choices=_PERCENT,
        ),
        "matched_pose_ap": Known(
            "the same, and IoU (P, G): only what is matched above IoU 0.1 takes part",
            gives="number or None",
            choices=_PERCENT,
        ),
        "sample_surface": Known(
            "vertices (V, 3), triangles (T, 3), count, seed: points, uniform by area",
            gives="points",
        ),
        "add": Known(_POSES, choices=_LENGTH),
        "add_s": Known(_POSES, choices=_LENGTH),
        "mssd": Known(f"{_POSES}, symmetry (pytest_cpas.types.Symmetry)", choices=_LENGTH),
        "mspd": Known(
            f"{_POSES}, symmetry, focal lengths and principal point (fx, fy, cx, cy), image width:"
            " pixels of an image that is 640 wide"
        ),
    }
)


@dataclass(frozen=True)
class Offer:
    """A function and the definition under which it computes; made by :func:`offer`."""

    function: Callable[..., Any]
    definition: Mapping[str, Any]

    def completed(self, metric: str) -> Offer:
        """With the defaults of ``metric``.

        Raises :class:`DeclarationError` for an impossible definition.
        """
        if metric not in KNOWN:
            raise DeclarationError(f"adapter: unknown metric {metric!r}; known: {', '.join(KNOWN)}")
        choices = KNOWN[metric].choices
        for key, value in self.definition.items():
            if key not in choices:
                raise DeclarationError(
                    f"adapter: {metric} has no {key!r} to declare; it has {sorted(choices)}"
                )
            possible: Any = choices[key]
            if key == "symmetries":
                if not set(value) <= {*_SYMMETRIES, *_PRINCIPAL}:
                    raise DeclarationError(
                        f"adapter: {metric}: {key} is {value!r}, expected some of"
                        f" {(*_SYMMETRIES, *_PRINCIPAL)}"
                    )
            elif value not in possible:
                raise DeclarationError(
                    f"adapter: {metric}: {key} is {value!r}, expected one of {possible}"
                )
        defaults = {key: values[0] for key, values in choices.items()}
        return Offer(self.function, {**defaults, **self.definition})

    def arguments(self, args: tuple[Any, ...]) -> list[Any]:
        """The arguments in the function's conventions; all arrays are copies."""
        converted: list[Any] = []
        for arg in args:
            if isinstance(arg, Box):
                converted += [self._part(arg, part) for part in self.definition["box"]]
            elif isinstance(arg, _Turn):
                converted.append(self._rotation(arg.matrix))
            else:
                converted.append(_copied(arg))
        return converted

    def result(self, value: float) -> float:
        """The function's number in radians, metres, and shares of 1."""
        if self.definition.get("percent"):
            value = value / 100
        if self.definition.get("angle") == "deg":
            value = value * np.pi / 180
        return value / {"m": 1, "cm": 100, "mm": 1000}[self.definition.get("length", "m")]

    def _rotation(self, matrix: Array) -> Any:
        convention = self.definition["rotation"]
        if convention == "matrix":
            return matrix.copy()
        if not np.isfinite(matrix).all():
            return Rotation.identity() if convention == "scipy" else np.full(4, np.nan)
        rotation = Rotation.from_matrix(matrix)
        if convention == "scipy":
            return rotation
        return rotation.as_quat(scalar_first=convention == "quaternion-wxyz")

    def _part(self, box: Box, part: str) -> Any:
        if part == "rotation":
            return self._rotation(box.rotation)
        if part == "translation":
            return box.translation.copy()
        if part == "extents":
            return box.extents.copy()
        if part == "half extents":
            return box.extents / 2
        signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return signs * (box.extents / 2) @ box.rotation.T + box.translation


def offer(function: Callable[..., Any], **definition: Any) -> Offer:
    """Offer a metric: its function, and where its definition differs from the default."""
    return Offer(function, definition)


@dataclass(frozen=True, eq=False)
class _Turn:
    """A rotation among the arguments, to be passed as the definition says."""

    matrix: Array


def as_turns(metric: str, args: tuple[Any, ...]) -> tuple[Any, ...]:
    """Mark the arguments of ``metric`` that are rotations."""
    if metric in ("rotation_error", "symmetric_rotation_error"):
        return (_Turn(args[0]), _Turn(args[1]), *args[2:])
    return args


def _copied(arg: Any) -> Any:
    if isinstance(arg, np.ndarray):
        return arg.copy()
    if isinstance(arg, dict):
        return {key: _copied(value) for key, value in arg.items()}
    if isinstance(arg, list):
        return list(arg)
    if isinstance(arg, Sample):
        return Sample(
            *(part.copy() for part in (arg.rotation, arg.translation, arg.extents, arg.points))
        )
    return arg
