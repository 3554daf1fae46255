"""A method's answers as short text, so that they can travel on rows.

Rows go through test reports and results files as plain values, for a data set of any size. An
answer is the base64 of 15 little-endian float32, 80 characters: the rotation row by row, the
translation and the extents (NaN without), in the standard frames and metres.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_cpas.types import Array, Hypothesis

_DTYPE = np.dtype("<f4")
_COUNT = 15


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
    with np.errstate(over="ignore"):  # an absurd length becomes infinite
        return base64.b64encode(values.astype(_DTYPE).tobytes()).decode("ascii")


def decode_estimates(texts: Sequence[str]) -> Estimates:
    """The answers in texts of :func:`encode_estimate`; :class:`ValueError` for any other text."""
    parts = [base64.b64decode(text, validate=True) for text in texts]
    if any(len(part) != _COUNT * _DTYPE.itemsize for part in parts):
        raise ValueError(f"an estimate is {_COUNT} float32 in base64")
    values = np.frombuffer(b"".join(parts), _DTYPE).reshape(-1, _COUNT).astype(float)
    return Estimates(values[:, :9].reshape(-1, 3, 3), values[:, 9:12], values[:, 12:])
