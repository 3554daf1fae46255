"""The z-buffer against closed forms, and against Open3D's ray caster."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pytest_cpas.datasets import rasterising, shapes
from pytest_cpas.datasets._scenes import box
from pytest_cpas.datasets.rasterising import rasterise
from pytest_cpas.datasets.rendering import camera_rays, cast_rays, render
from pytest_cpas.types import Array, Camera, Mesh, Pose

#: Columns and rows of different size, and no symmetry.
CAMERA = Camera(64, 48, 60.0, 71.0, 30.5, 25.25)


def seen(corners: Array, camera: Camera = CAMERA) -> NDArray[np.int64]:
    """The triangle that each pixel sees (H, W), -1 = none."""
    hit, triangle = rasterise(np.asarray(corners, dtype=float), camera)
    assert np.all(np.diff(hit) > 0)
    image = np.full(camera.height * camera.width, -1)
    image[hit] = triangle
    return image.reshape(camera.height, camera.width)


def at(u: float, v: float, z: float) -> list[float]:
    """The point at depth ``z`` that a pixel of :data:`CAMERA` sees."""
    return [(u - CAMERA.cx) * z / CAMERA.fx, (v - CAMERA.cy) * z / CAMERA.fy, z]


def metres(low: int, high: int) -> st.SearchStrategy[float]:
    return st.integers(low, high).map(lambda millimetres: millimetres / 1000)


points = st.tuples(metres(-250, 250), metres(-250, 250), metres(-250, 1000))


@given(st.lists(st.tuples(points, points, points), min_size=1, max_size=6))
@settings(max_examples=60, deadline=None)
def test_each_triangle_is_seen_where_its_corners_solve_for_it(
    triangles: list[tuple[tuple[float, float, float], ...]],
) -> None:
    """Also in part behind the camera. A ray is a sum of the corners: where no weight is negative,
    it meets the triangle, at the depth of one over the weights' sum."""
    corners = np.array(triangles)
    assume(np.abs(np.linalg.det(corners)).min() > 1e-5)  # none is seen from its side
    rays = camera_rays(CAMERA).reshape(-1, 3)
    weights = np.stack([np.linalg.solve(triangle.T, rays.T).T for triangle in corners])
    total = weights.sum(axis=-1)
    inside = (weights > 0).all(axis=-1)
    with np.errstate(divide="ignore"):
        depth = np.where(inside, 1 / np.where(inside, total, 1), np.inf).min(axis=0)
    # within rounding of an edge it may go either way
    clear = (np.abs(weights) > 1e-7 * np.abs(weights).max(axis=-1, keepdims=True)).all(axis=(0, 2))
    image = seen(corners).ravel()
    np.testing.assert_array_equal((image >= 0)[clear], np.isfinite(depth)[clear])
    hit = clear & (image >= 0)
    found = 1 / total[image[hit], np.flatnonzero(hit)]
    np.testing.assert_allclose(found, depth[hit], rtol=1e-6)


@pytest.mark.parametrize("name", ["mug", "laptop", "camera"])
def test_it_sees_what_open3d_sees(name: str) -> None:
    rng = np.random.default_rng(len(name))
    objects = [
        (shapes.make(name, rng), Pose(Rotation.random(random_state=k).as_matrix(), at(*place)))
        for k, place in enumerate([(20, 20, 0.5), (35, 25, 0.7), (60, 40, 0.6)])
    ]
    objects.append((box(np.array([4.0, 3.0, 3.6])), Pose(np.eye(3), [0.3, 0.1, 1.0])))
    one, other = render(objects, CAMERA, rasterise), render(objects, CAMERA, cast_rays)
    assert set(np.unique(one.instance)) == {0, 1, 2, 3}
    same = (one.instance == other.instance) & (one.triangle == other.triangle)
    assert same.mean() > 0.998  # a ray through an edge may go either way
    np.testing.assert_array_equal(one.depth[same], other.depth[same])


def test_a_room_around_the_camera_has_no_holes() -> None:
    """All its triangles reach behind the camera, and its depth is known in closed form."""
    half = np.array([2.0, 1.5, 1.8])
    turn = Rotation.from_euler("yxz", [20, 30, 10], degrees=True).as_matrix()
    room = render([(box(2 * half), Pose(turn, [0.1, -0.2, 0.3]))], CAMERA, rasterise)
    inner = camera_rays(CAMERA) @ turn
    start = -np.array([0.1, -0.2, 0.3]) @ turn
    with np.errstate(divide="ignore"):
        leaves = np.maximum((half - start) / inner, (-half - start) / inner).min(axis=-1)
    assert np.all(room.instance == 0)
    np.testing.assert_allclose(room.depth, leaves, rtol=1e-9)


def test_a_sphere_is_where_it_is() -> None:
    rings = np.deg2rad(np.arange(1.5, 180, 3))
    ball = shapes.solid_of_revolution(0.2 * np.stack([np.sin(rings), -np.cos(rings)], axis=1))
    image = render([(ball, Pose(np.eye(3), [0.05, 0.02, 0.9]))], CAMERA, rasterise)
    rays = camera_rays(CAMERA)
    centre = np.array([0.05, 0.02, 0.9])
    a, b = (rays**2).sum(axis=-1), rays @ centre
    root = b**2 - a * (centre @ centre - 0.2**2)
    with np.errstate(invalid="ignore"):
        depth = np.where(root > 0, (b - np.sqrt(root)) / a, 0)
    well_inside = root > 0.1 * root.max()
    np.testing.assert_allclose(image.depth[well_inside], depth[well_inside], atol=0.002)
    assert not image.depth[root < -0.02].any()


@pytest.mark.parametrize("shift", [0.0, 0.5, 0.25])
def test_no_ray_slips_between_triangles(shift: float) -> None:
    """A net whose edges and corners go through the centres of pixels, or between them."""
    u, v = np.meshgrid(np.arange(5.0, 41, 4) + shift, np.arange(4.0, 41, 4) + shift)
    net = np.array([at(a, b, 0.8) for a, b in zip(u.ravel(), v.ravel(), strict=True)])
    net = net.reshape(*u.shape, 3)
    a, b, c, d = net[:-1, :-1], net[:-1, 1:], net[1:, 1:], net[1:, :-1]
    triangles = np.concatenate(
        [np.stack(t, axis=-2).reshape(-1, 3, 3) for t in ((a, b, c), (a, c, d))]
    )
    image = seen(triangles)
    inside = np.zeros(image.shape, dtype=bool)
    inside[5:40, 6:37] = True  # the rim itself may go either way
    assert np.all(image[inside] >= 0)
    around = np.zeros(image.shape, dtype=bool)
    around[4:42, 5:39] = True
    assert np.all(image[~around] == -1)


def test_of_equally_near_triangles_the_first_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    one = [at(5, 5, 1), at(60, 5, 1), at(5, 40, 1)]
    for at_once in (10_000, 7):  # across parts as within one
        monkeypatch.setattr(rasterising, "_AT_ONCE", at_once)
        image = seen(np.array([one, one]))
        assert np.unique(image).tolist() == [-1, 0]


def test_parts_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    mug = shapes.mean_shape("mug")
    corners = (mug.vertices + np.array([0, 0, 0.3]))[mug.triangles]
    whole = seen(corners)
    monkeypatch.setattr(rasterising, "_AT_ONCE", 50)
    np.testing.assert_array_equal(seen(corners), whole)


@pytest.mark.parametrize(
    "triangle",
    [
        [[0, 0, -1], [0.1, 0, -1], [0, 0.1, -1]],  # behind
        [[0, 0, 1], [0.1, 0, 1], [0.2, 0, 1]],  # a line
        [[0, 0, 0.5], [0, 0, 1], [0.1, 0.1, 2]],  # its plane goes through the camera
        [[9, 9, 1], [9.1, 9, 1], [9, 9.1, 1]],  # beside the image
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
    ],
)
def test_what_cannot_be_seen(triangle: list[list[float]]) -> None:
    assert np.all(seen(np.array([triangle])) == -1)


def test_nothing_at_all() -> None:
    far = Mesh(np.array([[0.0, 0, -5], [1, 0, -5], [0, 1, -5]]), np.array([[0, 1, 2]]))
    for objects in ([], [(far, Pose(np.eye(3), [0, 0, 0]))]):
        assert np.all(render(objects, CAMERA, rasterise).instance == -1)
