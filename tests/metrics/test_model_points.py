"""ADD, ADD-S, MSSD and MSPD, against loops over points and poses, and against bop_toolkit."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_cpas.metrics.model_points import (
    SPINS,
    ModelPoints,
    add,
    add_s,
    mspd,
    mssd,
    symmetry_rotations,
)
from pytest_cpas.types import Camera, ContractError, Mesh, Pose, Symmetry

CAMERA = Camera(1280, 960, 1100.0, 1080.0, 640.0, 470.0)

SYMMETRIES = {
    "none": Symmetry.none(),
    "box": Symmetry.box(),
    "5-fold": Symmetry.n_fold((1, 2, 3), 5),
    "axis": Symmetry.about((0, 1, 0)),
    "oblique axis, flip": Symmetry.about((1, -2, 0.5), flip=True),
}


def near(rng, pose: Pose, degrees: float, metres: float) -> Pose:
    turn = Rotation.from_rotvec(np.radians(degrees) * rng.normal(size=3)).as_matrix()
    return Pose(turn @ pose.rotation, pose.translation + metres * rng.normal(size=3))


def a_pose(rng) -> Pose:
    return Pose(Rotation.random(random_state=rng).as_matrix(), (0.1, -0.2, 0.9 + rng.random()))


def elements(symmetry: Symmetry) -> list[np.ndarray]:
    """The group with 315 spins, made with scipy and not with our own formula."""
    if symmetry.axis is None:
        return list(symmetry.rotations)
    return [
        Rotation.from_rotvec(2 * np.pi * i / 315 * symmetry.axis).as_matrix() @ rotation
        for i in range(315)
        for rotation in symmetry.rotations
    ]


def by_hand(estimate: Pose, truth: Pose, points: np.ndarray, symmetry: Symmetry) -> dict:
    """One point after the other, as the definitions have it."""
    estimated = [estimate.rotation @ x + estimate.translation for x in points]
    true = [truth.rotation @ x + truth.translation for x in points]
    pairs = list(zip(estimated, true, strict=True))
    found = {
        "add": np.mean([np.linalg.norm(a - b) for a, b in pairs]),
        "add_s": np.mean([min(np.linalg.norm(a - b) for a in estimated) for b in true]),
        "mssd": np.inf,
        "mspd": np.inf,
    }
    for element in elements(symmetry):
        posed = points @ (truth.rotation @ element).T + truth.translation
        gaps = np.linalg.norm(np.array(estimated) - posed, axis=1)
        found["mssd"] = min(found["mssd"], gaps.max())
        images = []
        for cloud in (np.array(estimated), posed):
            image = cloud @ CAMERA.matrix.T
            images.append(image[:, :2] / image[:, 2:])
        pixels = np.linalg.norm(images[0] - images[1], axis=1).max()
        found["mspd"] = min(found["mspd"], pixels * 640 / 1280)
    return found


@pytest.mark.parametrize("symmetry", SYMMETRIES.values(), ids=SYMMETRIES)
@pytest.mark.parametrize("degrees", [0.5, 10, 120])
def test_against_loops(symmetry, degrees):
    rng = np.random.default_rng(int(degrees))
    for _ in range(3):
        points = rng.normal(0, 0.05, (60, 3)) * (1, 0.3, 2)
        truth = a_pose(rng)
        turned = Pose(truth.rotation @ elements(symmetry)[-1], truth.translation)
        estimate = near(rng, turned, degrees, 0.02)
        model, expected = ModelPoints(points), by_hand(estimate, truth, points, symmetry)
        found = {
            "add": add(estimate, truth, model),
            "add_s": add_s(estimate, truth, model),
            "mssd": mssd(estimate, truth, model, symmetry),
            "mspd": mspd(estimate, truth, model, symmetry, CAMERA),
        }
        assert found == {name: pytest.approx(value, rel=1e-9) for name, value in expected.items()}


def rotation(axis, degrees: float) -> np.ndarray:
    return Rotation.from_rotvec(
        np.radians(degrees) * np.array(axis) / np.linalg.norm(axis)
    ).as_matrix()


#: Six points, three pairs of poses (rotation and millimetres, true and estimated), and what
#: bop_toolkit (commit cea62d6) gives for them: add, adi, then mssd and mspd without symmetry, with
#: half a turn about y, with any turn about y, and with any turn about y and upside down.
BOP_POINTS = [[30, 0, 0], [-30, 0, 0], [0, 40, 0], [0, -40, 0], [0, 0, 20], [10, 20, -20]]
TILTED = rotation((1, 0, 0), -35)
BOP_FIGURES = {
    "small": (
        (rotation((1, 2, 3), 20), (100, -50, 900)),
        (rotation((1, 2, 3), 23), (104, -52, 910)),
        [11.01215343, 11.01215343],
        [
            12.03069621,
            5.366908883,
            12.03069621,
            5.366908883,
            11.43233259,
            5.297161838,
            11.43233259,
            5.297161838,
        ],
    ),
    "half turn": (
        (rotation((0, 0, 1), 90), (0, 0, 700)),
        (rotation((0, 0, 1), 90) @ rotation((0, 1, 0), 177), (1, 2, 703)),
        [35.20778809, 9.791305652],
        [
            62.13524908,
            95.28667262,
            5.071770276,
            5.079522548,
            3.799805434,
            3.634279275,
            3.799805434,
            3.634279275,
        ],
    ),
    "upside down": (
        (TILTED, (-80, 60, 1200)),
        (TILTED @ rotation((0, 1, 0), 41) @ rotation((1, 0, 0), 180), (-75, 66, 1180)),
        [50.7366315, 19.89011739],
        [
            97.37982624,
            68.14098255,
            97.37982624,
            68.14098255,
            97.37982624,
            68.14098255,
            21.49945157,
            7.873259019,
        ],
    ),
}


@pytest.mark.parametrize(
    ("true", "estimated", "adds", "symmetric"), BOP_FIGURES.values(), ids=BOP_FIGURES
)
def test_figures_of_bop_toolkit(true, estimated, adds, symmetric):
    truth, estimate = (Pose(turn, np.array(shift) / 1000) for turn, shift in (true, estimated))
    model = ModelPoints(np.array(BOP_POINTS) / 1000)
    assert model.diameter == pytest.approx(0.08)
    found = [add(estimate, truth, model), add_s(estimate, truth, model)]
    assert [1000 * value for value in found] == pytest.approx(adds, rel=1e-8)
    groups = [
        Symmetry.none(),
        Symmetry.n_fold((0, 1, 0), 2),
        Symmetry.about((0, 1, 0)),
        Symmetry(np.stack([np.eye(3), np.diag((1, -1, -1))]), np.array((0, 1, 0))),
    ]
    camera = Camera(640, 480, 1100.0, 1080.0, 640.0, 470.0)
    figures = []
    for group in groups:
        figures += [1000 * mssd(estimate, truth, model, group)]
        figures += [mspd(estimate, truth, model, group, camera)]
    assert figures == pytest.approx(symmetric, rel=1e-8)


POINTS = np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.0, 0.05, 0.0]])


def test_figures_that_follow_by_hand():
    """A half turn about y swaps the two points that are 10 cm from the axis."""
    truth = Pose(np.eye(3), (0, 0, 1))
    turned = Pose(np.diag((-1, 1, -1)), (0, 0, 1))
    moved = Pose(np.diag((-1, 1, -1)), (0, 0.03, 1))
    model, two_fold = ModelPoints(POINTS), Symmetry.n_fold((0, 1, 0), 2)
    assert model.diameter == pytest.approx(0.2)
    assert add(turned, truth, model) == pytest.approx(0.4 / 3)
    assert add_s(turned, truth, model) == pytest.approx(0, abs=1e-12)
    assert mssd(turned, truth, model, Symmetry.none()) == pytest.approx(0.2)
    assert mssd(turned, truth, model, two_fold) == pytest.approx(0, abs=1e-12)
    assert mssd(moved, truth, model, two_fold) == pytest.approx(0.03)
    camera = Camera(640, 480, 500.0, 600.0, 320.0, 240.0)
    assert mspd(moved, truth, model, two_fold, camera) == pytest.approx(18)
    assert mspd(turned, truth, model, Symmetry.none(), camera) == pytest.approx(100)
    twice = Camera(1280, 960, 1000.0, 1200.0, 640.0, 480.0)
    assert mspd(moved, truth, model, two_fold, twice) == pytest.approx(18)


def test_an_axis_has_the_steps_of_bop():
    """pi over a hundredth of the diameter, rounded up."""
    assert SPINS == 315
    assert len(symmetry_rotations(Symmetry.about((0, 0, 1)))) == 315
    assert len(symmetry_rotations(Symmetry.about((0, 0, 1), flip=True))) == 630
    assert len(symmetry_rotations(Symmetry.box())) == 4
    model = ModelPoints(np.array([[0.1, 0, 0], [-0.1, 0, 0]]))
    truth = Pose(np.eye(3), (0, 0, 1))
    half_a_step = Rotation.from_rotvec([0, np.pi / 315, 0]).as_matrix()
    found = mssd(Pose(half_a_step, (0, 0, 1)), truth, model, Symmetry.about((0, 1, 0)))
    assert found == pytest.approx(2 * 0.1 * np.sin(np.pi / 630))
    assert found / model.diameter < 0.005


def test_a_ball_is_judged_by_where_it_is():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3))
    model = ModelPoints(0.05 * points / np.linalg.norm(points, axis=1)[:, None])
    truth = a_pose(rng)
    estimate = Pose(a_pose(rng).rotation, truth.translation + np.array((0.01, 0, 0)))
    assert mssd(estimate, truth, model, Symmetry.full()) == pytest.approx(0.01)
    assert mspd(estimate, truth, model, Symmetry.full(), CAMERA) > 0
    with pytest.raises(ContractError, match="all rotations"):
        symmetry_rotations(Symmetry.full())


def test_the_model_is_what_its_triangles_span():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9.0]])
    model = ModelPoints.of(Mesh(vertices, np.array([[0, 1, 2], [2, 1, 0]])))
    assert model.points.tolist() == vertices[:3].tolist()
    assert model.diameter == pytest.approx(np.sqrt(2))
    for bad in (np.zeros((0, 3)), np.zeros((3, 2)), [[0, 0, np.nan]]):
        with pytest.raises(ContractError, match="model points"):
            ModelPoints.of(bad)
    with pytest.raises(ContractError, match="all 2 coincide"):
        _ = ModelPoints.of(np.ones((2, 3))).diameter


def test_what_cannot_be_projected_is_far_off():
    truth = Pose(np.eye(3), (0, 0, 1))
    model = ModelPoints(POINTS)
    found = mspd(Pose(np.eye(3), (0, 0, 0)), truth, model, Symmetry.none(), CAMERA)
    assert found == 1e30
    behind = Pose(np.eye(3), (0, 0, -1))
    assert np.isfinite(mspd(behind, truth, model, Symmetry.none(), CAMERA))


def test_few_points_bound_what_all_give():
    """The pruned search over elements is exact also where the outermost points do not decide."""
    rng = np.random.default_rng(3)
    for seed, symmetry in itertools.product(range(3), SYMMETRIES.values()):
        points = np.random.default_rng(seed).normal(size=(3000, 3)) * 0.03
        points[::2] /= np.linalg.norm(points[::2], axis=1)[:, None] * 10
        truth = Pose(a_pose(rng).rotation, (0, 0, 0.3))
        estimate = near(rng, truth, 4, 0.02)
        model, every = ModelPoints(points), symmetry_rotations(symmetry)
        true = np.einsum("sij,nj->sni", truth.rotation @ every, points) + truth.translation
        gaps = np.linalg.norm(estimate.apply(points) - true, axis=2).max(axis=1)
        assert mssd(estimate, truth, model, symmetry) == pytest.approx(gaps.min(), rel=1e-9)
        image = CAMERA.project(estimate.apply(points)) - CAMERA.project(true)
        pixels = np.linalg.norm(image, axis=2).max(axis=1).min() / 2
        assert mspd(estimate, truth, model, symmetry, CAMERA) == pytest.approx(pixels, rel=1e-9)
