import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from pytest_cpas.datasets import shapes
from pytest_cpas.datasets.nocs import REAL_CAMERA
from pytest_cpas.datasets.rendering import camera_rays, render
from pytest_cpas.reading.pickles import load_numpy_pickle
from pytest_cpas.types import Array, Camera, Mesh, Pose

SMALL = Camera(64, 48, 60.0, 55.0, 30.5, 25.25)


def posed(seed: int, distance: float) -> Pose:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    return Pose(rotation, [*rng.uniform(-0.05, 0.05, 2), distance])


def brute_force(
    objects: list[tuple[Mesh, Pose]], camera: Camera
) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Depth, instance and triangle of the nearest intersection, by barycentric coordinates."""
    corners = np.concatenate([pose.apply(mesh.vertices)[mesh.triangles] for mesh, pose in objects])
    owner = np.repeat(np.arange(len(objects)), [len(m.triangles) for m, _ in objects])
    local = np.concatenate([np.arange(len(m.triangles)) for m, _ in objects])
    depth = np.zeros((camera.height, camera.width))
    instance = np.full(depth.shape, -1)
    triangle = np.full(depth.shape, -1)
    for v in range(camera.height):
        for u in range(camera.width):
            ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
            # solve a + s (b - a) + t (c - a) = z ray
            system = np.stack(
                [
                    corners[:, 1] - corners[:, 0],
                    corners[:, 2] - corners[:, 0],
                    np.broadcast_to(-ray, (len(corners), 3)),
                ],
                axis=-1,
            )
            usable = np.abs(np.linalg.det(system)) > 1e-14
            s, t, z = np.linalg.solve(system[usable], -corners[usable, 0, :, None])[..., 0].T
            inside = (s >= 0) & (t >= 0) & (s + t <= 1) & (z > 0)
            if inside.any():
                best = np.argmin(np.where(inside, z, np.inf))
                depth[v, u] = z[best]
                index = np.flatnonzero(usable)[best]
                instance[v, u], triangle[v, u] = owner[index], local[index]
    return depth, instance, triangle


def test_agrees_with_solving_for_every_triangle() -> None:
    camera = Camera(40, 30, 45.0, 42.0, 18.5, 16.25)
    coarse = trimesh.creation.icosphere(subdivisions=1, radius=0.06)
    ball = Mesh(np.asarray(coarse.vertices), np.asarray(coarse.faces))
    objects = [(shapes.mean_shape("laptop"), posed(3, 0.5)), (ball, posed(5, 0.4))]
    depth, instance, triangle = brute_force(objects, camera)
    assert set(np.unique(instance)) == {-1, 0, 1}
    seen = render(objects, camera)
    # a ray through an edge may go either way
    same = (seen.instance == instance) & (seen.triangle == triangle)
    assert same.mean() > 0.995
    np.testing.assert_allclose(seen.depth[same], depth[same], rtol=0, atol=1e-9)


def test_depth_of_a_tilted_plane_is_exact() -> None:
    square = Mesh(
        np.array([[-5.0, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    pose = Pose(Rotation.from_euler("xy", [20, 35], degrees=True).as_matrix(), [0, 0, 2.0])
    seen = render([(square, pose)], SMALL)
    normal = pose.rotation[:, 2]
    v, u = np.mgrid[: SMALL.height, : SMALL.width]
    rays = np.stack([(u - SMALL.cx) / SMALL.fx, (v - SMALL.cy) / SMALL.fy, np.ones(u.shape)], -1)
    np.testing.assert_allclose(camera_rays(SMALL), rays, atol=1e-12)
    np.testing.assert_allclose(seen.depth, normal[2] * 2 / (rays @ normal), rtol=1e-12)
    # the camera looks at the back of the square: the normal is turned
    np.testing.assert_allclose(seen.normal, np.broadcast_to(-normal, seen.normal.shape), atol=1e-12)


def test_silhouette_meets_the_pixel_centres() -> None:
    # a square that covers pixel centres 10..20 x 5..30 with 0.4 pixel to spare
    z = 1.5
    u, v = np.array([9.6, 20.4]), np.array([4.6, 30.4])
    x, y = (u - SMALL.cx) * z / SMALL.fx, (v - SMALL.cy) * z / SMALL.fy
    square = Mesh(
        np.array([[x[0], y[0], 0], [x[1], y[0], 0], [x[1], y[1], 0], [x[0], y[1], 0]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    seen = render([(square, Pose(np.eye(3), [0, 0, z]))], SMALL)
    expected = np.full((SMALL.height, SMALL.width), -1)
    expected[5:31, 10:21] = 0
    np.testing.assert_array_equal(seen.instance, expected)
    np.testing.assert_array_equal(seen.depth > 0, expected == 0)


def test_the_nearest_of_two_is_seen_whatever_their_order() -> None:
    mug, can = shapes.mean_shape("mug"), shapes.mean_shape("can")
    near, far = Pose(np.eye(3), [0, 0, 0.4]), Pose(np.eye(3), [0.02, 0, 0.8])
    one = render([(mug, near), (can, far)], SMALL)
    two = render([(can, far), (mug, near)], SMALL)
    np.testing.assert_array_equal(one.depth, two.depth)
    np.testing.assert_array_equal(one.instance == 0, two.instance == 1)
    np.testing.assert_array_equal(one.triangle, two.triangle)
    alone = render([(mug, near)], SMALL)
    assert np.all((one.instance == 0) == (alone.instance == 0))


def test_normals_face_the_camera_and_are_those_of_the_triangles() -> None:
    mesh, pose = shapes.mean_shape("camera"), posed(7, 0.3)
    seen = render([(mesh, pose)], SMALL)
    hit = seen.instance == 0
    assert np.all((seen.normal * camera_rays(SMALL)).sum(-1)[hit] < 0)
    body = trimesh.Trimesh(pose.apply(mesh.vertices), mesh.triangles, process=False)
    expected = body.face_normals[seen.triangle[hit]]  # outwards, and of a closed body towards us
    np.testing.assert_allclose(seen.normal[hit], expected, atol=1e-6)
    assert not seen.normal[~hit].any()


def test_nothing_in_sight() -> None:
    behind = Pose(np.eye(3), [0, 0, -1.0])
    for objects in ([], [(shapes.mean_shape("can"), behind)]):
        seen = render(objects, SMALL)
        assert not seen.depth.any()
        assert np.all(seen.instance == -1)
        assert np.all(seen.triangle == -1)


def test_published_real275_meshes_fit_their_frame_in_nocs_axes(test_data: Path) -> None:
    """The claim about the published files in synthetic.py's docstring."""
    root = test_data / "real275"
    truth = load_numpy_pickle(root / "gts/real_test/results_real_test_scene_1_0000.pkl")
    mask = np.asarray(Image.open(root / "real_test/scene_1/0000_mask.png"))
    measured = np.asarray(Image.open(root / "real_test/scene_1/0000_depth.png")) / 1000
    for mask_id, model in ((3, "camera_canon_len_norm"), (4, "mug_daniel_norm")):
        loaded = trimesh.load_mesh(root / f"obj_models/real_test/{model}.obj", process=False)
        scaled = truth["gt_RTs"][mask_id - 1]
        rotation = scaled[:3, :3] / np.cbrt(np.linalg.det(scaled[:3, :3]))
        overlaps = []
        for turn in (0, 90, 180, 270):
            axes = Rotation.from_euler("y", turn, degrees=True).as_matrix()
            mesh = Mesh(np.asarray(loaded.vertices) @ axes.T, np.asarray(loaded.faces))
            seen = render([(mesh, Pose(rotation, scaled[:3, 3]))], REAL_CAMERA)
            hit, visible = seen.instance == 0, mask == mask_id
            overlaps.append((hit & visible).sum() / (hit | visible).sum())
            if turn == 0:
                both = hit & visible & (measured > 0)
                assert np.median(np.abs(seen.depth - measured)[both]) < 0.005
        assert overlaps[0] > 0.94
        assert max(overlaps[1:]) < 0.7


def test_missing_open3d_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ImportError, match=r"pip install 'pytest-cpas\[open3d\]'"):
        render([(shapes.mean_shape("can"), posed(0, 1.0))], SMALL)
