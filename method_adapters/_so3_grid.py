"""A grid of rotations: the circle times HEALPix, joined by the Hopf fibration.

Yershova, Jain, LaValle & Mitchell, "Generating uniform incremental grids on SO(3) using the Hopf
fibration" (2010), its base grid; the sphere's cells are those of Gorski et al., "HEALPix" (2005).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def cell_count(resolution: int) -> int:
    """How many cells :func:`rotation_grid` has."""
    return 72 << 3 * resolution


def rotation_grid(resolution: int) -> Array:
    """The cells' centres as unit quaternions (n, 4), scalar last, x not negative.

    ``resolution`` r: 6 * 2^r turns psi, slow, by 12 * 4^r directions (theta, phi), fast.
    """
    turns = 6 * 2**resolution
    psi = 2 * np.pi * (np.arange(turns) + 0.5) / turns
    theta, phi = healpix_centres(2**resolution)
    psi, theta, phi = psi[:, None] / 2, theta / 2, np.broadcast_to(phi, (turns, len(phi)))
    grid = np.stack(
        [
            np.cos(theta) * np.sin(psi),
            np.sin(theta) * np.cos(phi + psi),
            np.sin(theta) * np.sin(phi + psi),
            np.cos(theta) * np.cos(psi),
        ],
        axis=-1,
    ).reshape(-1, 4)
    signed: Array = np.where(grid[:, :1] < 0, -grid, grid)
    return signed


def healpix_centres(side: int) -> tuple[Array, Array]:
    """Colatitude and longitude (12 side^2,) of HEALPix's cells in nested order, radians.

    ``side``: cells along the side of a base cell, a power of two.
    """
    cell = np.arange(12 * side**2)
    face, within = np.divmod(cell, side**2)
    # the even bits of a nested index count along one side of the base cell, the odd ones along
    # the other
    x, y = np.zeros_like(cell), np.zeros_like(cell)
    for bit in range(side.bit_length() - 1):
        x |= (within >> 2 * bit & 1) << bit
        y |= (within >> 2 * bit + 1 & 1) << bit
    row, column = np.divmod(face, 4)
    ring = (row + 2) * side - x - y - 1
    # cells in a quarter of the ring: fewer towards the poles
    quarter = np.minimum(np.minimum(ring, side), 4 * side - ring)
    cap = 1 - quarter**2 / (3 * side**2)
    z = np.where(
        ring < side,
        cap,
        np.where(ring > 3 * side, -cap, 2 * (2 * side - ring) / (3 * side)),
    )
    # eighths of a turn from longitude 0 to the base cell's middle
    middle = np.where(row == 1, 2 * column, 2 * column + 1)
    phi = np.pi / 4 * (middle + (x - y) / quarter)
    return np.arccos(z), phi % (2 * np.pi)
