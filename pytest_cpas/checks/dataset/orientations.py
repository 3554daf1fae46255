"""How constrained the orientations of a data set are: where the objects' up axes point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pytest_cpas.types import Array

__all__ = ["REACH", "Spread", "lambert", "up_axis_spread"]

#: The angle within which a direction counts as covered, degrees.
REACH = 15.0

#: Directions that stand for the sphere: 0.4 % of its area is the difference of 16 of them.
_PROBES = 4000


@dataclass(frozen=True)
class Spread:
    """How directions are spread over the sphere.

    ``count``: how many there are. ``resultant``: their mean resultant length, the length of their
    mean vector: 1 where all agree, 0 where they cancel (Mardia & Jupp, "Directional Statistics",
    9.2). ``coverage``: share of the sphere's area within :data:`REACH` of at least one of them,
    divided by what as many independent uniform directions cover on average: about 1 where every
    direction is as likely, near 0 where few occur.
    """

    count: int
    resultant: float
    coverage: float


def up_axis_spread(up: Array) -> Spread:
    """The spread of unit vectors (n, 3), n at least 1."""
    z = 1 - (2 * np.arange(_PROBES) + 1) / _PROBES
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(_PROBES)  # a Fibonacci lattice: equal areas
    radius = np.sqrt(1 - z**2)
    probes = np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=-1)
    reach = 2 * np.sin(np.radians(REACH) / 2)
    distances, _ = cKDTree(up).query(probes, distance_upper_bound=reach)
    cap = (1 - np.cos(np.radians(REACH))) / 2
    expected = 1 - (1 - cap) ** len(up)
    return Spread(
        len(up),
        float(np.linalg.norm(up.mean(axis=0))),
        float(np.mean(np.isfinite(distances)) / expected),
    )


def lambert(up: Array) -> Array:
    """Lambert's equal-area projection (n, 2), to the unit disc, of unit vectors (n, 3).

    Camera frame; to the right and down on paper: the middle is the image's up (-y), the rim its
    down; to the right is the camera's right (+x), below the middle is what points towards the
    camera (-z).
    """
    x, y, z = up.T
    # |(x, z)| is sin(theta), theta measured from -y; the projection has the radius 2 sin(theta / 2)
    factor = np.sqrt(np.maximum(2 / np.maximum(1 - y, 1e-12), 0)) / 2
    return np.stack([factor * x, -factor * z], axis=-1)
