from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_cpas.metrics.pose import rotation_error, translation_error
from pytest_cpas.types import ContractError, Symmetry

PI = np.pi


def exact_rotation(axis: tuple[int, int, int], w: Fraction) -> tuple[np.ndarray, float]:
    """A rotation by 2 atan(|axis| / w), rounded once, and its angle."""
    x, y, z = (Fraction(v) for v in axis)
    n = x * x + y * y + z * z + w * w
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), w * w - x * x + y * y - z * z, 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), w * w - x * x - y * y + z * z],
    ]
    angle = 2 * math.atan2(math.sqrt(x * x + y * y + z * z), w)
    return np.array([[float(v / n) for v in row] for row in rows]), angle


@pytest.mark.parametrize("exponent", [-16, -15, -12, -9, -6, -3, -1, 0, 1, 3, 6, 9, 12, 15])
def test_angle_is_accurate_near_0_and_near_180_degrees(exponent: int) -> None:
    w = Fraction(10) ** exponent
    for axis in ((1, 0, 0), (3, -2, 5), (-1, 7, 2), (1, 1, 1)):
        rotation, angle = exact_rotation(axis, w)
        assert rotation_error(rotation, np.eye(3)) == pytest.approx(angle, abs=1e-15, rel=1e-15)
        other, _ = exact_rotation((2, 9, -4), Fraction(3))
        # a product of two matrices rounds, but no more than that
        assert rotation_error(other @ rotation, other) == pytest.approx(angle, abs=2e-15)


def test_half_turn_does_not_lose_half_the_digits() -> None:
    # the arccos of the trace is off by about 1e-8 here
    for angle in (PI, PI - 1e-10, PI - 3e-8, 1e-10, 3e-8):
        rotation = Rotation.from_rotvec(angle * np.array([0.48, 0.6, 0.64])).as_matrix()
        assert abs(rotation_error(rotation, np.eye(3)) - angle) < 1e-12


def test_agrees_with_scipy_and_broadcasts() -> None:
    a, b = Rotation.random(200, rng=1), Rotation.random(200, rng=2)
    errors = rotation_error(a.as_matrix(), b.as_matrix())
    np.testing.assert_allclose(errors, (a * b.inv()).magnitude(), atol=1e-14)
    grid = rotation_error(a.as_matrix()[:, None], b.as_matrix()[None, :7])
    assert grid.shape == (200, 7)
    np.testing.assert_array_equal(np.diagonal(grid[:7]), errors[:7])
    assert rotation_error(np.empty((0, 3, 3)), np.eye(3)).shape == (0,)


SYMMETRIES = {
    "none": Symmetry.none(),
    "y": Symmetry.about((0, 1, 0)),
    "y flip": Symmetry.about((0, 1, 0), flip=True),
    "diagonal": Symmetry.about((1, 2, -3)),
    "diagonal flip": Symmetry.about((1, 2, -3), flip=True),
    "5-fold": Symmetry.n_fold((0, 0, 1), 5),
    "box": Symmetry.box(),
    "list": Symmetry(rotations=Rotation.create_group("O").as_matrix()),
}


def elements(symmetry: Symmetry, samples: int) -> np.ndarray:
    if symmetry.axis is None:
        return symmetry.rotations
    angles = 2 * PI * np.arange(samples) / samples
    spins = Rotation.from_rotvec(angles[:, None] * symmetry.axis).as_matrix()
    return (spins[:, None] @ symmetry.rotations).reshape(-1, 3, 3)


@pytest.mark.parametrize("name", SYMMETRIES)
def test_is_the_minimum_over_the_group(name: str) -> None:
    symmetry = SYMMETRIES[name]
    group = elements(symmetry, 3600)
    truths = Rotation.random(20, rng=3).as_matrix()
    estimates = Rotation.random(20, rng=4).as_matrix()
    for estimate, truth in zip(estimates, truths, strict=True):
        relative = Rotation.from_matrix(estimate.T @ truth @ group)
        sampled = relative.magnitude().min()
        exact = rotation_error(estimate, truth, symmetry)
        # half a step of the samples is 0.05 degrees
        assert exact - 1e-14 <= sampled
        assert sampled <= exact + (1e-12 if symmetry.axis is None else 9e-4)


@pytest.mark.parametrize("name", SYMMETRIES)
def test_group_elements_are_free_and_small_tilts_are_not(name: str) -> None:
    symmetry = SYMMETRIES[name]
    group = elements(symmetry, 7)
    truth = Rotation.random(rng=5).as_matrix()
    assert rotation_error(truth @ group, truth, symmetry).max() < 3e-15
    assert rotation_error(truth, truth @ group, symmetry).max() < 3e-15
    axis = np.eye(3)[0] if symmetry.axis is None else np.cross(symmetry.axis, (0.3, 0.5, 0.7))
    axis /= np.linalg.norm(axis)
    for tilt in (1e-13, 1e-8, 1e-3):
        turned = truth @ Rotation.from_rotvec(tilt * axis).as_matrix() @ group
        np.testing.assert_allclose(rotation_error(turned, truth, symmetry), tilt, atol=3e-15)


def test_continuous_axis_upside_down_is_180_degrees_without_flip() -> None:
    upside_down = np.diag([1.0, -1.0, -1.0])
    assert rotation_error(upside_down, np.eye(3), SYMMETRIES["y"]) == pytest.approx(PI, abs=1e-15)
    assert rotation_error(upside_down, np.eye(3), SYMMETRIES["y flip"]) < 1e-15


def test_sphere_has_no_rotation_error() -> None:
    a = Rotation.random(4, rng=6).as_matrix()
    np.testing.assert_array_equal(rotation_error(a, np.eye(3), Symmetry.full()), np.zeros(4))


@pytest.mark.parametrize("symmetry", [Symmetry.none(), Symmetry.about((0, 1, 0)), Symmetry.full()])
@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.diag([1.0, 1.0, -1.0]), "reflection"),
        (-np.eye(3), "reflection"),
        (1.01 * np.eye(3), "not orthonormal"),
        (np.zeros((3, 3)), "not orthonormal"),
        (np.full((3, 3), np.nan), "NaN"),
        (np.diag([1.0, 1.0, np.inf]), "NaN or infinite"),
        (np.eye(4), "shape"),
        (np.eye(3)[0], "shape"),
        ("upright", "not an array"),
    ],
)
def test_what_is_no_rotation_is_refused(matrix: object, words: str, symmetry: Symmetry) -> None:
    for arguments in ((matrix, np.eye(3)), (np.eye(3), matrix)):
        with pytest.raises(ContractError, match=words):
            rotation_error(*arguments, symmetry)


def test_a_bad_entry_of_a_batch_is_named() -> None:
    batch = np.tile(np.eye(3), (5, 1, 1))
    batch[3] *= 2
    with pytest.raises(ContractError, match=r"1 of 5 entries \(the first at \(3,\)\)"):
        rotation_error(batch, np.eye(3))


def test_float32_matrices_are_replaced_by_the_nearest_rotation() -> None:
    exact = Rotation.random(50, rng=7).as_matrix()
    noisy = exact + np.random.default_rng(8).uniform(-2e-5, 2e-5, exact.shape)
    u, _, vt = np.linalg.svd(noisy)
    assert rotation_error(noisy, u @ vt).max() < 4e-15
    other = Rotation.random(50, rng=9).as_matrix()
    np.testing.assert_allclose(
        rotation_error(noisy, other), rotation_error(u @ vt, other), rtol=0, atol=4e-15
    )


def test_translation_error() -> None:
    assert translation_error((1, 2, 3), (1, 2, 3)) == 0
    assert translation_error((3, 0, 1), (0, 4, 1)) == 5
    assert translation_error(np.zeros((6, 1, 3)), np.ones((1, 2, 3))).shape == (6, 2)
    for bad in ((1, 2), (np.nan, 0, 0), "here"):
        with pytest.raises(ContractError, match="translation"):
            translation_error(bad, (0, 0, 0))


def test_values_do_not_depend_on_the_batch():
    """To the last bit: a shard, a single sample and a whole data set must print the same."""
    rng = np.random.default_rng(5)
    estimates = Rotation.random(500, rng=rng).as_matrix()
    estimates[::3] += rng.normal(scale=1e-6, size=estimates[::3].shape)
    truths = Rotation.random(500, rng=rng).as_matrix()
    for symmetry in (Symmetry.none(), Symmetry.about([0, 1, 0]), Symmetry.n_fold([1, 2, 3], 4)):
        together = rotation_error(estimates, truths, symmetry)
        alone = [rotation_error(e, t, symmetry) for e, t in zip(estimates, truths, strict=True)]
        np.testing.assert_array_equal(together, alone)
        np.testing.assert_array_equal(
            together[7:90], rotation_error(estimates[7:90], truths[7:90], symmetry)
        )
