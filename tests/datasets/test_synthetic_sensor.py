"""The sensor that the embedded data sets are measured with: its noise, and what it misses."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from pytest_cpas.datasets.rendering import render
from pytest_cpas.datasets.synthetic import measure
from pytest_cpas.types import Camera, Mesh, Pose


def wall(distance: float, tilt: float, camera: Camera, seed: int) -> NDArray[np.uint16]:
    """Measurements of a plane that is ``tilt`` degrees off facing the central pixel."""
    c, s = np.cos(np.deg2rad(tilt)), np.sin(np.deg2rad(tilt))
    square = Mesh(
        np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 100,
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    pose = Pose(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), [0, 0, distance])
    return measure(render([(square, pose)], camera), camera, np.random.default_rng(seed))


# so long a lens that all rays are nearly parallel
TELE = Camera(120, 100, 20000.0, 20000.0, 59.5, 49.5)


@pytest.mark.parametrize(("distance", "millimetres"), [(0.5, 1.219), (1.0, 1.884), (2.0, 6.064)])
def test_axial_noise_is_that_of_nguyen_et_al(distance: float, millimetres: float) -> None:
    measured = wall(distance, 0, TELE, seed=1).astype(float)
    assert np.all(measured > 0)
    assert measured.mean() == pytest.approx(1000 * distance, abs=0.2)
    # rounding to millimetres adds a variance of 1/12
    assert measured.std() == pytest.approx(np.hypot(millimetres, 12**-0.5), rel=0.03)


def test_noise_grows_towards_grazing_angles() -> None:
    # 69 degrees at 1 m: 1.884 + 0.1 * 1.2043^2 / 0.3665^2 = 2.964 mm, along the wall's profile
    camera = Camera(5, 4000, 2e6, 2e6, 2.0, 1999.5)
    measured = wall(1.0, 69, camera, seed=2).astype(float)
    assert np.all(measured > 0)
    assert measured.std() == pytest.approx(np.hypot(2.964, 12**-0.5), rel=0.03)


@pytest.mark.parametrize(
    ("tilt", "share"), [(0, 0.0), (60, 0.0), (69, 0.0), (77.5, 0.5), (86, 1.0)]
)
def test_grazing_angles_are_missing(tilt: float, share: float) -> None:
    camera = Camera(100, 80, 1e6, 1e6, 49.5, 39.5)
    assert np.mean(wall(0.8, tilt, camera, seed=3) == 0) == pytest.approx(share, abs=0.02)


def test_depth_edges_and_nothing_are_missing() -> None:
    square = Mesh(
        np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.1,
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    camera = Camera(640, 480, 525, 525, 319.5, 239.5)
    scene = render(
        [
            (square, Pose(np.eye(3), [0, 0, 0.8])),
            (Mesh(square.vertices * 4, square.triangles), Pose(np.eye(3), [0, 0, 1.0])),
        ],
        camera,
    )
    measured = measure(scene, camera, np.random.default_rng(0))
    assert not measured[scene.instance < 0].any()
    inner = scene.instance == 0
    edge = ndimage.binary_dilation(inner) & ~ndimage.binary_erosion(inner)
    assert np.mean(measured[edge] == 0) == pytest.approx(0.8, abs=0.08)
    flat = ndimage.binary_erosion(scene.instance >= 0, iterations=2)
    flat &= ~ndimage.binary_dilation(inner, iterations=3)
    assert np.all(measured[flat] > 0)
    # a step of 1 cm at 1 m is no edge
    shallow = render(
        [
            (square, Pose(np.eye(3), [0, 0, 0.99])),
            (Mesh(square.vertices * 4, square.triangles), Pose(np.eye(3), [0, 0, 1.0])),
        ],
        camera,
    )
    measured = measure(shallow, camera, np.random.default_rng(0))
    assert np.all(measured[ndimage.binary_erosion(shallow.instance >= 0, iterations=2)] > 0)
