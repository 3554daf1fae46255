"""The largest overlap of box A with box B that may spin freely about an axis of its own.

The overlap f(theta) is continuous, has several local maxima and may have kinks. Turning B sweeps
volume at no more than a rate L that its extents give, so between two angles f lies below the tent
of slope L over their values. That bound is rigorous, but alone it would need thousands of angles
where the top is flat.

f' is known too: it is the torque on B. It changes fast in two cases only. The line in which a
face of B meets a face of A moves at a speed of 1 / sin(the faces' angle), so f' may even jump
where they are parallel: at an *alignment*, an angle where both have the same azimuth about the
axis. And a face may pass through a thin box within an angle of thickness / radius. Hence the
alignments are nodes of the search, and an interval that is shorter than half its distance from
them, than the thickness over the radius, and than ``_TRUSTED_WIDTH``, is judged by f and f' at its
ends: a concave arc lies below both tangents, a convex one below its ends. All other intervals are
judged by the tent. Intervals whose bound exceeds the best value by more than the tolerance are
split until there is none; so where f' is wild the search is rigorous, and elsewhere it needs
about a hundred angles. Of boxes thinner than ``_LEAST_TRUSTED_WIDTH`` of their radius a maximum may
be missed, else the search would not end.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.metrics._box_clipping import overlap_and_torque

__all__ = ["largest_overlap"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

#: Angles per half turn that every search starts with, beside the alignments.
_START = 24
#: The ends of an interval are believed below this width, and below this multiple of its distance
#: from the nearest alignment.
_TRUSTED_WIDTH = 0.06
#: The same for boxes so thin that intervals as narrow as they are thin would be without number.
_LEAST_TRUSTED_WIDTH = 1e-4
_TRUSTED_RATIO = 0.5
#: Pairs that are searched together; bounds the memory.
_CHUNK = 1024


def largest_overlap(
    rotation: Array, offset: Array, half_a: Array, half_b: Array, axis: Array, tolerance: Array
) -> Array:
    """The largest volumes (N,) that box A shares with box B, turned by any angle about ``axis``.

    ``rotation`` (N, 3, 3) and ``offset`` (N, 3) take A's frame to B's; ``half_a``, ``half_b``
    (N, 3) are half the extents; ``axis`` (3,) is a unit vector in B's frame; ``tolerance`` (N,) is
    the volume by which a result may fall short.
    """
    best = np.zeros(len(offset))
    reach = np.linalg.norm(half_a, axis=1) + np.linalg.norm(half_b, axis=1)
    near = np.flatnonzero(np.linalg.norm(offset, axis=1) < reach)  # others never meet
    for start in range(0, len(near), _CHUNK):
        chunk = near[start : start + _CHUNK]
        spin = _Spin(rotation[chunk], offset[chunk], half_a[chunk], half_b[chunk], axis)
        best[chunk] = _search(spin, tolerance[chunk])
    return best


def _search(spin: _Spin, tolerance: Array) -> Array:
    nodes = spin.nodes()
    pairs = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    low = nodes.ravel()
    width = np.diff(nodes, axis=1, append=nodes[:, :1] + spin.period).ravel()
    left = spin(pairs, low)
    right = np.roll(left.reshape(3, *nodes.shape), -1, axis=2).reshape(3, -1)
    best = left[0].reshape(nodes.shape).max(axis=1)
    while True:
        bound, split = spin.bound(pairs, width, left, right)
        promising = bound > best[pairs] + tolerance[pairs]
        if not promising.any():
            return np.asarray(best)
        pairs, low, width = pairs[promising], low[promising], width[promising]
        left, right, split = left[:, promising], right[:, promising], split[promising]
        middle = spin(pairs, low + split)
        np.maximum.at(best, pairs, middle[0])
        pairs = np.concatenate([pairs, pairs])
        low = np.concatenate([low, low + split])
        width = np.concatenate([split, width - split])
        left, right = np.concatenate([left, middle], 1), np.concatenate([middle, right], 1)


class _Spin:
    """f and f' of a batch of pairs, and what bounds them."""

    def __init__(
        self, rotation: Array, offset: Array, half_a: Array, half_b: Array, axis: Array
    ) -> None:
        self.half_a, self.half_b, self.axis = half_a, half_b, axis
        # A turned back by theta is still + cos(theta) * level + sin(theta) * ahead
        pose = np.concatenate([rotation, offset[:, :, None]], axis=2)
        self.still = np.outer(axis, axis) @ pose
        self.level = pose - self.still
        x, y, z = axis
        self.ahead = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]]) @ pose
        # half of each face of B moves outwards: that is the largest gain of volume per radian
        square = half_b**2
        self.rate = 2 * half_b * (square.sum(axis=1, keepdims=True) - square) @ np.abs(axis)
        self.cap = 8 * np.minimum(half_a.prod(axis=1), half_b.prod(axis=1))
        thinnest = np.minimum(half_a.min(axis=1), half_b.min(axis=1))
        radius = np.linalg.norm(half_b, axis=1)
        self.trusted_width = np.clip(thinnest / radius, _LEAST_TRUSTED_WIDTH, _TRUSTED_WIDTH)
        # half a turn about one of its own axes leaves a box as it was
        self.period = np.pi if np.sort(np.abs(axis))[1] < 1e-9 else 2 * np.pi
        # azimuths about the axis of the faces of A, (N, 3), and of B that are not across it
        u = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        v = np.cross(axis, u)
        of_a = np.arctan2(v @ rotation, u @ rotation)
        of_b = np.arctan2(v, u)[np.hypot(u, v) > 1e-9]
        self.alignments = (of_a[:, :, None] - of_b).reshape(len(rotation), -1) % np.pi

    def nodes(self) -> Array:
        """The angles (N, K) that a search starts with, ascending."""
        turns = np.arange(0, self.period, np.pi)
        regular = np.tile(np.arange(0, self.period, np.pi / _START), (len(self.rate), 1))
        aligned = self.alignments[:, None, :] + turns[:, None]
        return np.sort(np.concatenate([regular, aligned.reshape(len(regular), -1)], axis=1))

    def __call__(self, pairs: Index, angles: Array) -> Array:
        """f and f' of ``pairs`` with B turned by ``angles``, and how far the nearest alignment is:
        (3, M)."""
        cosine, sine = np.cos(angles)[:, None, None], np.sin(angles)[:, None, None]
        pose = self.still[pairs] + cosine * self.level[pairs] + sine * self.ahead[pairs]
        rotation, offset = pose[:, :, :3].copy(), pose[:, :, 3].copy()
        volume, torque = overlap_and_torque(
            rotation, offset, self.half_a[pairs], self.half_b[pairs]
        )
        distance = np.full(len(pairs), np.pi)
        for alignments in self.alignments.T:
            gaps = angles - alignments[pairs]
            np.minimum(distance, np.abs(gaps - np.pi * np.rint(gaps / np.pi)), out=distance)
        return np.stack([volume, -torque @ self.axis, distance])

    def bound(self, pairs: Index, width: Array, left: Array, right: Array) -> tuple[Array, Array]:
        """Upper bounds (M,) of f on intervals, and how far from their low ends to split them."""
        (f_left, slope_left, gap_left), (f_right, slope_right, gap_right) = left, right
        rate = self.rate[pairs]
        tent = np.minimum((f_left + f_right + rate * width) / 2, self.cap[pairs])
        # no interval contains an alignment, so the distance is that of the nearer end
        distance = np.minimum(gap_left, gap_right)
        trusted = width <= np.minimum(_TRUSTED_RATIO * distance, self.trusted_width[pairs])
        rise, noise = f_right - f_left, 1e-13 * rate
        concave = (rise <= slope_left * width + noise) & (rise >= slope_right * width - noise)
        convex = (rise >= slope_left * width - noise) & (rise <= slope_right * width + noise)
        peak = concave & (slope_left > 0) & (slope_right < 0)
        drop = np.where(peak, slope_left - slope_right, 1.0)
        crossing = f_left + slope_left * np.where(peak, (rise - slope_right * width) / drop, 0)
        arc = np.where(peak, np.minimum(crossing, tent), np.maximum(f_left, f_right))
        # a smooth peak is found where the derivative, taken as linear, is 0
        split = np.where(trusted & peak, slope_left / drop, 0.5)
        return (
            np.where(trusted & (concave | convex), arc, tent),
            np.clip(split, 0.02, 0.98) * width,
        )
