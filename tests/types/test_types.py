import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_cpas.types import (
    Camera,
    ContractError,
    Hypothesis,
    Mesh,
    MethodInfo,
    Observation,
    Pose,
    Prediction,
    Symmetry,
)

CAMERA = Camera(4, 3, 10.0, 11.0, 1.5, 1.0)
ROTATION = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()


def test_project_inverts_back_project():
    depth = np.random.default_rng(0).uniform(0.5, 2, (3, 4)).astype(np.float32)
    depth[1, 2] = 0
    mask = np.ones((3, 4), bool)
    mask[0, 0] = False
    points = CAMERA.back_project(depth, mask)
    rows, columns = np.nonzero(mask & (depth > 0))
    np.testing.assert_allclose(CAMERA.project(points), np.stack([columns, rows], -1), atol=1e-12)
    np.testing.assert_array_equal(points[:, 2], depth[rows, columns])
    homogeneous = points @ CAMERA.matrix.T
    np.testing.assert_allclose(
        homogeneous[:, :2] / homogeneous[:, 2:], CAMERA.project(points), atol=1e-12
    )


def test_pose_maps_and_inverts():
    pose = Pose(ROTATION, [1, 2, 3])
    points = np.random.default_rng(0).normal(size=(5, 3))
    posed = np.concatenate([points, np.ones((5, 1))], 1) @ pose.matrix.T
    np.testing.assert_allclose(pose.apply(points), posed[:, :3])
    np.testing.assert_allclose(pose.inverse().apply(pose.apply(points)), points)
    np.testing.assert_array_equal(Pose.from_matrix(pose.matrix).matrix, pose.matrix)


def test_pose_repairs_float32_noise_and_nothing_more():
    noisy = (ROTATION + np.random.default_rng(0).normal(scale=1e-6, size=(3, 3))).astype(np.float32)
    repaired = Pose(noisy, np.zeros(3)).rotation
    assert np.abs(repaired @ repaired.T - np.eye(3)).max() < 1e-15
    assert np.abs(repaired - ROTATION).max() < 1e-5
    with pytest.raises(ContractError, match="not orthonormal"):
        Pose(ROTATION * 1.001, np.zeros(3))


def test_values_are_copied_and_read_only():
    rotation, translation = ROTATION.copy(), np.zeros(3)
    pose = Pose(rotation, translation)
    rotation[:] = translation[:] = 9
    assert pose.rotation[0, 0] != 9
    assert pose.translation[0] == 0
    for array in (pose.rotation, pose.translation):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Pose(np.diag([1, 1, -1]), np.zeros(3)), "reflection"),
        (
            lambda: Pose(0.3 * ROTATION, np.zeros(3)),
            r"a rotation times 0.3, a scale left in the rotation: give rotation / 0.3",
        ),
        (lambda: Pose(ROTATION * [0.1, 0.2, 0.1], np.zeros(3)), "the extents left in the rotation"),
        (lambda: Pose(np.zeros((3, 3)), np.zeros(3)), "not orthonormal"),
        (lambda: Pose(ROTATION, np.zeros(4)), r"shape is \(4,\), expected \(3\)"),
        (lambda: Pose(np.full((3, 3), np.nan), np.zeros(3)), "9 of 9 values are NaN"),
        (lambda: Pose("abc", np.zeros(3)), "not an array of numbers"),
        (lambda: Pose.from_matrix(Pose(ROTATION, [1, 2, 3]).matrix.T), "is it transposed"),
        (
            lambda: Hypothesis(rotation=ROTATION, translation=np.zeros(3), extents=[1, 0, 1]),
            "three positive",
        ),
        (
            lambda: Hypothesis(rotation=ROTATION, translation=np.zeros(3), points=np.zeros((0, 3))),
            "no points",
        ),
        (
            lambda: Hypothesis(rotation=ROTATION, translation=np.zeros(3), points=np.zeros((5, 2))),
            r"expected \(N, 3\)",
        ),
        (
            lambda: Hypothesis(rotation=ROTATION, translation=np.zeros(3), score=np.nan),
            "expected a finite number",
        ),
        (
            lambda: Hypothesis(rotation=ROTATION, translation=np.zeros(3), mesh=np.zeros((3, 3))),
            "expected pytest_cpas",
        ),
        (lambda: Prediction(()), "no hypothesis and no reason"),
        (lambda: Prediction((Pose(ROTATION, np.zeros(3)),)), "holds a Pose, expected Hypothesis"),
        (lambda: Camera(0, 3, 1, 1, 0, 0), "0 x 3"),
        (lambda: Camera(4, 3, 1, -1, 0, 0), "OpenGL"),
        (lambda: Mesh(np.zeros((3, 3)), np.zeros((0, 3), int)), "no triangles"),
        (lambda: Mesh(np.zeros((3, 3)), np.array([[0, 1, 3]])), "run from 0 to 3"),
        (lambda: Mesh(np.zeros((3, 3)), np.array([[0.0, 1, 2]])), "vertex indices"),
        (lambda: Symmetry(np.diag([1, 1, -1])[None]), "proper rotation"),
        (lambda: Symmetry(Rotation.from_rotvec([1, 0, 0]).as_matrix()[None], [0, 1, 0]), "full()"),
        (lambda: Symmetry.about([0, 0, 0]), "length 0"),
        (
            lambda: MethodInfo(
                name="x",
                categories=("mug",),
                needs=frozenset({"lidar"}),
                gives=frozenset(),
                licence="MIT",
            ),
            "lidar",
        ),
        (
            lambda: MethodInfo(
                name="x", categories=(), needs=frozenset(), gives=frozenset(), licence="MIT"
            ),
            "no categories",
        ),
        (
            lambda: MethodInfo(
                name="../x",
                categories=("mug",),
                needs=frozenset(),
                gives=frozenset(),
                licence="MIT",
            ),
            "folder",
        ),
        (
            lambda: MethodInfo(
                name="x",
                categories=("mug",),
                needs=frozenset(),
                gives=frozenset(),
                licence="MIT",
                object_frame="up",
            ),
            "object_frame is 'up'",
        ),
    ],
)
def test_bad_values_are_refused_in_words(make, words):
    with pytest.raises(ContractError, match=words):
        make()


def observation(**changed):
    values = {
        "rgb": np.zeros((3, 4, 3), np.float32),
        "depth": np.ones((3, 4), np.float32),
        "mask": np.ones((3, 4), bool),
    }
    return Observation(category="mug", **(values | changed), camera=CAMERA)


def test_good_observation_is_accepted():
    assert observation().category == "mug"


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"rgb": np.zeros((3, 4, 3), np.uint8)}, "rgb: shape"),
        ({"rgb": np.full((3, 4, 3), 255, np.float32)}, "from 255 to 255, expected 0 to 1"),
        ({"depth": np.ones((3, 5), np.float32)}, "depth: shape"),
        ({"depth": np.full((3, 4), -1, np.float32)}, "from -1 to -1"),
        ({"depth": np.full((3, 4), np.nan, np.float32)}, "nan"),
        ({"depth": np.full((3, 4), np.inf, np.float32)}, "inf"),
        ({"mask": np.ones((4, 3), bool)}, "mask: shape"),
        ({"mask": np.ones((3, 4), np.uint8)}, "uint8"),
        ({"mask": np.zeros((3, 4), bool)}, "mask: empty"),
    ],
)
def test_bad_observations_are_refused(changed, words):
    with pytest.raises(ContractError, match=words):
        observation(**changed)


def test_symmetry_groups():
    flip = Symmetry.about([0, 1, 0], flip=True).rotations
    assert len(flip) == 2
    np.testing.assert_allclose(flip[1] @ [0, 1, 0], [0, -1, 0], atol=1e-15)
    quarter = Symmetry.n_fold([0, 0, 2], 4).rotations
    expected = Rotation.from_rotvec(
        np.outer([0, 90, 180, 270], [0, 0, 1]), degrees=True
    ).as_matrix()
    np.testing.assert_allclose(quarter, expected, atol=1e-15)
    assert len(Symmetry.box().rotations) == 4
    # the identity belongs to every group, listed or not
    assert len(Symmetry(expected[1:2]).rotations) == 2
