import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from method_adapters._so3_grid import cell_count, healpix_centres, rotation_grid

# as healpy 1.20.1 has them: cosines of the colatitude, in 24ths, and longitudes, in 16ths of pi
COSINES = 4 * [8, 16, 16, 22] + 4 * [-8, 0, 0, 8] + 4 * [-22, -16, -16, -8]
LONGITUDES = [
    *(4, 6, 2, 4, 12, 14, 10, 12, 20, 22, 18, 20, 28, 30, 26, 28),
    *(0, 2, 30, 0, 8, 10, 6, 8, 16, 18, 14, 16, 24, 26, 22, 24),
    *(4, 6, 2, 4, 12, 14, 10, 12, 20, 22, 18, 20, 28, 30, 26, 28),
]


def test_healpix_of_two_cells_a_side():
    theta, phi = healpix_centres(2)
    np.testing.assert_allclose(24 * np.cos(theta), COSINES, atol=1e-12)
    np.testing.assert_allclose(16 * phi / np.pi, LONGITUDES, atol=1e-12)


@pytest.mark.parametrize("side", [1, 2, 4, 8])
def test_nested_cells_lie_in_their_parent(side):
    """Four neighbours in the order make a cell of the coarser grid: their middle is its centre."""

    def directions(n):
        theta, phi = healpix_centres(n)
        parts = (np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta))
        return np.stack(parts, axis=-1)

    middles = directions(2 * side).reshape(-1, 4, 3).mean(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    apart = np.arccos(np.clip((middles * directions(side)).sum(axis=1), -1, 1))
    assert apart.max() < 0.2 / side  # a cell is 1 / side across


@pytest.mark.parametrize(
    ("cell", "quaternion"),
    [  # what SO3Grid of sdfest 0.1.1 says
        (0, [0.106574189669, 0.351468574910, 0.458042764580, 0.809511339490]),
        (1, [0.119153566374, 0.105662432703, 0.394337567297, 0.905061191828]),
        (47, [0.075359332215, 0.647770289815, -0.497051625386, 0.572410957601]),
        (48, [0.312459714104, 0.220942382690, 0.533402096794, 0.754344479485]),
        (301, [0.905061191828, 0.105662432703, 0.394337567297, -0.119153566374]),
        (575, [0.075359332215, -0.497051625386, 0.647770289815, -0.572410957601]),
    ],
)
def test_published_cells(cell, quaternion):
    np.testing.assert_allclose(rotation_grid(1)[cell], quaternion, atol=1e-12)


@pytest.mark.parametrize("resolution", [0, 1, 2])
def test_cells_cover_all_rotations_evenly(resolution):
    grid = rotation_grid(resolution)
    assert len(grid) == cell_count(resolution) == (72, 576, 4608)[resolution]
    np.testing.assert_allclose(np.linalg.norm(grid, axis=1), 1)
    assert (grid[:, 0] >= 0).all()
    closeness = np.abs(grid @ Rotation.random(2000, random_state=0).as_quat().T)
    farthest = 2 * np.degrees(np.arccos(closeness.max(axis=0).min()))
    assert farthest < (65, 33, 17)[resolution]
    share = np.bincount(closeness.argmax(axis=0), minlength=len(grid)) / 2000 * len(grid)
    assert share.max() < (2, 4, 14)[resolution]
