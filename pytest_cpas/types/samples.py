"""Samples, each with what a method may see and the truth."""

from __future__ import annotations

import copy
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.types._arrays import Array, checked_extents, frozen_array
from pytest_cpas.types.errors import DataError, raised_as
from pytest_cpas.types.geometry import Camera, Mesh, Pose, Symmetry
from pytest_cpas.types.names import checked_text

__all__ = [
    "ALL",
    "CATEGORIES",
    "COMPLETENESS",
    "GroundTruth",
    "Observation",
    "Sample",
    "SampleRef",
    "evenly",
]


#: The categories of the paper, in the order that the field's class ids 1..6 give them.
CATEGORIES = ("bottle", "bowl", "camera", "can", "laptop", "mug")


#: What tables and verdicts call all categories together. No category is called so.
ALL = "all"

#: What a verdict on whether all samples are there is about, beside those on categories. No category
#: is called so.
COMPLETENESS = "completeness"


@dataclass(frozen=True, eq=False, kw_only=True)
class Observation:
    """What a method may see of one object.

    ``category``: its name. ``rgb`` (H, W, 3) float32 in 0..1. ``depth`` (H, W) float32 in metres
    along the optical axis, 0 = missing. ``mask`` (H, W) bool, the object's visible pixels.
    """

    category: str
    rgb: NDArray[np.float32]
    depth: NDArray[np.float32]
    mask: NDArray[np.bool_]
    camera: Camera

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        for name, array, shape, dtype in (
            ("rgb", self.rgb, (*size, 3), np.float32),
            ("depth", self.depth, size, np.float32),
            ("mask", self.mask, size, np.bool_),
        ):
            if array.shape != shape or array.dtype != dtype:
                raise DataError(
                    f"{name}: shape {array.shape} of {array.dtype}, expected {shape} of"
                    f" {np.dtype(dtype)} (the camera is {size[1]} x {size[0]})"
                )
        # min and max propagate NaN, and a comparison with NaN is false
        if not (self.rgb.min() >= 0 and self.rgb.max() <= 1):
            raise DataError(
                f"rgb: values from {self.rgb.min():g} to {self.rgb.max():g}, expected 0 to 1"
            )
        if not (self.depth.min() >= 0 and self.depth.max() < np.inf):
            raise DataError(
                f"depth: values from {self.depth.min():g} to {self.depth.max():g}, expected finite"
                " metres, 0 where missing"
            )
        if not self.mask.any():
            raise DataError("mask: empty, so there is no object to find")

    def copy(self) -> Observation:
        """The same with arrays of its own, which may be written to."""
        made = copy.copy(self)
        for name in ("rgb", "depth", "mask"):
            object.__setattr__(made, name, getattr(self, name).copy())
        return made


@dataclass(frozen=True, eq=False, kw_only=True)
class GroundTruth:
    """The truth about one object; a method never sees it.

    ``extents`` (3,) side lengths of the object-frame bounding box, metres. ``surface``: a
    :class:`Mesh` or points (N, 3) in the object frame, metres; None where a data set has no
    shapes (shape metrics are then n/a). ``symmetry``: of the object; ``symmetry_in_view``: of what
    can be seen of it, such as a mug whose handle is hidden; None where it is the same. The NOCS
    protocol judges by the latter.
    """

    pose: Pose
    extents: Array
    symmetry: Symmetry
    surface: Mesh | Array | None = None
    symmetry_in_view: Symmetry | None = None

    @raised_as(DataError)
    def __post_init__(self) -> None:
        object.__setattr__(self, "extents", checked_extents(self.extents))
        if self.surface is not None and not isinstance(self.surface, Mesh):
            object.__setattr__(
                self, "surface", frozen_array(self.surface, (None, 3), "surface points")
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleRef:
    """An entry of a data set's index; no image is opened to make one.

    ``id`` is unique in the data set and stable; ``scene`` groups samples that belong together;
    ``model`` is the data set's name of the object, the same for all its samples, if it has one.

    Raises :class:`DataError` for a category that is called as tables call something else.
    """

    id: str
    category: str
    scene: str
    model: str = ""

    def __post_init__(self) -> None:
        if self.category in (ALL, COMPLETENESS):
            raise DataError(
                f"sample {self.id}: category {self.category!r}, by which tables and verdicts mean"
                " something else; give the category another name"
            )
        # one object each: few differ, but for the id, which rows and golden tables have too
        with raised_as(DataError):
            for name in ("id", "category", "scene", "model"):
                text = checked_text(f"sample {name}", str(getattr(self, name)))
                object.__setattr__(self, name, sys.intern(text))
        if not self.id or not self.category:
            seen = f"sample {self.id!r} of category {self.category!r}"
            raise DataError(f"{seen}: both need a name")


@dataclass(frozen=True, eq=False)
class Sample:
    """One object in one image: what a method sees, and the truth about it."""

    ref: SampleRef
    observation: Observation
    truth: GroundTruth


_Value = TypeVar("_Value")


def evenly(values: Sequence[_Value], most: int) -> list[_Value]:
    """At most so many of the values, evenly spaced, in order."""
    count = min(most, len(values))
    return [values[i * len(values) // count] for i in range(count)]
