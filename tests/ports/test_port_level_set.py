import numpy as np
import pytest
import trimesh

from method_adapters._crop import NoAnswerError
from method_adapters._level_set import level_set

pytest.importorskip("skimage", reason="pip install 'pytest-cpas[sdf]'")


def grid(n):
    axis = np.linspace(-1, 1, n)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)


def solid(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.triangles, process=True)


def test_ellipsoid_off_the_centre():
    """Axes in order, metric, outside out: volume and every vertex in closed form."""
    centre, radii = np.array([0.1, -0.2, 0.15]), np.array([0.3, 0.5, 0.7])
    values = np.linalg.norm((grid(64) - centre) / radii, axis=-1) - 1
    mesh = level_set(values, 0.0, half_width=0.2, closed=False)
    reached = np.linalg.norm((mesh.vertices / 0.2 - centre) / radii, axis=1)
    np.testing.assert_allclose(reached, 1, atol=2e-3)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0.2 * centre, atol=1e-4)
    assert solid(mesh).is_watertight
    expected = 4 / 3 * np.pi * radii.prod() * 0.2**3
    assert solid(mesh).volume == pytest.approx(expected, rel=5e-3)


def test_level_moves_the_surface():
    values = np.linalg.norm(grid(33), axis=-1) - 0.5
    for level in (-0.1, 0.02, 0.2):
        vertices = level_set(values, level, half_width=1.0, closed=False).vertices
        np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.5 + level, atol=2e-3)


@pytest.mark.parametrize("closed", [False, True])
def test_surface_that_leaves_the_grid(closed):
    values = np.linalg.norm(grid(32)[..., ::2], axis=-1) - 0.6  # a pipe along y
    mesh = level_set(values, 0.0, half_width=1.0, closed=closed)
    assert solid(mesh).is_watertight == closed
    beyond = np.abs(mesh.vertices[:, 1]).max() - 1
    assert 0 < beyond < 2 / 31 if closed else beyond == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("value", [0.5, -0.5, np.nan])
def test_no_surface(value):
    with pytest.raises(NoAnswerError, match="no surface at 0 in signed distances from"):
        level_set(np.full((8, 8, 8), value), 0.0, half_width=1.0, closed=False)
