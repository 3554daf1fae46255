"""The largest overlap of box A with box B that may turn in any way about its centre.

A three-dimensional maximisation without a cheap bound, unlike ``_box_spin``: the overlap is
computed at rotations that cover all of them (half turns about B's axes leave it alone, so they
are about 16 degrees apart) and at those that line the boxes' axes up, where the kinks are. From the
best of them a pattern search climbs along 26 directions, other ones in each round: it needs no
derivative, so it also climbs ridges. Compared with a search from 20 times as many rotations it
falls short by less than 1e-7. It ends early where one box lies inside the other, since no overlap
can be larger.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pytest_cpas.metrics._box_clipping import overlap_and_torque

__all__ = ["largest_overlap_of_ball"]

Array = NDArray[np.float64]

_COVER = 1000
_CLIMBERS = 24
#: Rounds of the search; of boxes a hundredth as thin as long it may end before it has converged.
_MOST_ROUNDS = 1000
_DIRECTIONS = np.array([d for d in itertools.product((-1, 0, 1), repeat=3) if any(d)], dtype=float)


def largest_overlap_of_ball(rotation: Array, offset: Array, half_a: Array, half_b: Array) -> Array:
    """The largest volumes (N,) that box A shares with box B, turned by any rotation.

    ``rotation`` (N, 3, 3) and ``offset`` (N, 3) take A's frame to B's; ``half_a``, ``half_b``
    (N, 3) are half the extents.
    """
    pairs = zip(rotation, offset, half_a, half_b, strict=True)
    return np.array([_largest(*pair) for pair in pairs])


def _largest(rotation: Array, offset: Array, half_a: Array, half_b: Array) -> float:
    def value(turns: Array) -> Array:
        back = np.swapaxes(turns, -1, -2)
        count = len(turns)
        return overlap_and_torque(
            back @ rotation, back @ offset, np.tile(half_a, (count, 1)), np.tile(half_b, (count, 1))
        )[0]

    cap = 8 * min(half_a.prod(), half_b.prod()) * (1 - 1e-12)
    turns = np.concatenate([rotation @ _axis_permutations(), _cover(_COVER)])
    values = value(turns)
    order = np.argsort(-values, kind="stable")[:_CLIMBERS]
    turns, values = turns[order], values[order]
    step = 0.1
    frames = itertools.cycle(_cover(97))
    for _ in range(_MOST_ROUNDS):
        if step <= 1e-7 or values.max() >= cap:
            break
        moves = Rotation.from_rotvec(step * _DIRECTIONS @ next(frames)).as_matrix()
        tried = moves[None] @ turns[:, None]
        found = value(tried.reshape(-1, 3, 3)).reshape(tried.shape[:2])
        choice = found.argmax(axis=1)
        better = found.max(axis=1) > values
        values = np.where(better, found.max(axis=1), values)
        turns = np.where(better[:, None, None], tried[np.arange(len(turns)), choice], turns)
        if not better.any():
            step /= 2
    return float(values.max())


def _axis_permutations() -> Array:
    """The six rotations (6, 3, 3) that permute the axes, up to half turns about them."""
    found = []
    for order in itertools.permutations(range(3)):
        matrix = np.eye(3)[list(order)]
        found.append(matrix * np.linalg.det(matrix))
    return np.array(found)


def _cover(count: int) -> Array:
    """Evenly spread rotations (count, 3, 3).

    M. Alexa, "Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3)", CVPR 2022.
    """
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    quaternions = [
        inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)
    ]  # fmt: skip
    return Rotation.from_quat(np.stack(quaternions, axis=-1)).as_matrix()
