"""A method's answers as short text, so that they can travel on rows.

Rows go through test reports and results files as plain values, for a data set of any size. An
answer is the base64 of 15 little-endian float32, 80 characters: the rotation row by row, the
translation and the extents (NaN without), in the standard frames and metres. A shape, which is kept
for pictures only, is a thinned cloud of points in steps of 1/255 of its box.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_cpas.metrics.surfaces import Surface
from pytest_cpas.types import Array, Hypothesis, Mesh
from pytest_cpas.types._arrays import LARGEST

_DTYPE = np.dtype("<f4")
_COUNT = 15

#: How far the product of a rotation and its inverse may be off: more than single precision needs.
_SLACK = 1e-2

#: Coordinates of an origin, metres, are no larger: those that are read, moved to another origin.
_FARTHEST_ORIGIN = 10 * LARGEST

#: Points of a shape: 1.6 kB of text.
SHAPE_POINTS = 400

#: Coordinates of a shape, metres, are no larger in a picture.
_FARTHEST = 1e6


@dataclass(frozen=True, eq=False)
class Estimates:
    """Answers of n samples: ``rotation`` (n, 3, 3), ``translation`` (n, 3) in metres, ``extents``
    (n, 3) in metres, NaN where a method gives none. In float32 precision."""

    rotation: Array
    translation: Array
    extents: Array


def encode_estimate(hypothesis: Hypothesis) -> str:
    """The text of a hypothesis that is in the standard frames."""
    extents = np.full(3, np.nan) if hypothesis.extents is None else hypothesis.extents
    values = np.concatenate([hypothesis.rotation.ravel(), hypothesis.translation, extents])
    return base64.b64encode(values.astype(_DTYPE).tobytes()).decode("ascii")


def decode_estimates(texts: Sequence[str]) -> Estimates:
    """The answers in texts of :func:`encode_estimate`; :class:`ValueError` for any other text."""
    parts = [base64.b64decode(text, validate=True) for text in texts]
    if any(len(part) != _COUNT * _DTYPE.itemsize for part in parts):
        raise ValueError(f"an estimate is {_COUNT} float32 in base64")
    values = np.frombuffer(b"".join(parts), _DTYPE).reshape(-1, _COUNT).astype(float)
    if not np.isfinite(values[:, :12]).all() or np.isinf(values[:, 12:]).any():
        raise ValueError("a rotation or a translation is not finite, or extents are infinite")
    rotation = values[:, :9].reshape(-1, 3, 3)
    with np.errstate(over="ignore", invalid="ignore"):  # what becomes no number is refused
        straight = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)) <= _SLACK
        if not straight.all() or not (np.linalg.det(rotation) > 0).all():
            raise ValueError("a rotation is none")
    if (np.abs(values[:, 9:12]) > _FARTHEST_ORIGIN).any() or (values[:, 12:] <= 0).any():
        raise ValueError("a translation is beyond what is read, or extents are not above 0")
    return Estimates(rotation, values[:, 9:12], values[:, 12:])


def decode_hypothesis(text: str) -> Hypothesis:
    """The answer in a text of :func:`encode_estimate`; :class:`ValueError` for any other text."""
    read = decode_estimates([text])
    [rotation], [translation], [extents] = read.rotation, read.translation, read.extents
    given = np.isfinite(extents).all()
    return Hypothesis(
        rotation=rotation, translation=translation, extents=extents if given else None
    )


def encode_shape(shape: Mesh | Array) -> str:
    """The text of at most :data:`SHAPE_POINTS` points of a shape; :func:`decode_shape` reads it.

    ``shape``: a mesh, which is sampled, or finite points (N, 3), metres. The base64 of the lower
    corner and the size of the points' box, 6 little-endian float32, and of 3 bytes per point.
    """
    points = Surface.of(shape, seed=0, count=SHAPE_POINTS).points
    points = points[:: -(-len(points) // SHAPE_POINTS)].clip(-_FARTHEST, _FARTHEST)
    low = points.min(axis=0)
    size = points.max(axis=0) - low
    steps = np.round(255 * (points - low) / np.where(size > 0, size, 1)).astype(np.uint8)
    box = np.concatenate([low, size]).astype(_DTYPE)
    return base64.b64encode(box.tobytes() + steps.tobytes()).decode("ascii")


def decode_shape(text: str) -> Array:
    """The points (N, 3), metres, of a text of :func:`encode_shape`; else :class:`ValueError`."""
    content = base64.b64decode(text, validate=True)
    corner = 6 * _DTYPE.itemsize
    if len(content) <= corner or (len(content) - corner) % 3:
        raise ValueError("a shape is 6 float32 and 3 bytes per point, in base64")
    if len(content) - corner > 3 * SHAPE_POINTS:
        count = (len(content) - corner) // 3
        raise ValueError(f"a shape of {count} points, at most {SHAPE_POINTS} are kept")
    low, size = np.frombuffer(content[:corner], _DTYPE).reshape(2, 3).astype(float)
    if not np.isfinite([low, size]).all() or (size < 0).any():
        raise ValueError("the box of a shape is not finite, or turned inside out")
    steps = np.frombuffer(content[corner:], np.uint8).reshape(-1, 3)
    points: Array = low + size * (steps / 255)
    return points
