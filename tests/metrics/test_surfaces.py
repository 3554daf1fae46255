import importlib.util
import math
import tracemalloc
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from scipy.special import gammaincc

from pytest_cpas.metrics import surfaces
from pytest_cpas.metrics.surfaces import Surface, diameter, sample_surface, surface_errors
from pytest_cpas.types import ContractError, Mesh, Pose


def random_pose(rng: np.random.Generator) -> Pose:
    return Pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))


def on_sphere(count: int, seed: int = 0) -> np.ndarray:
    x = np.random.default_rng(seed).normal(size=(count, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def brute_diameter(points: np.ndarray) -> float:
    return max(cdist(points[i : i + 500], points).max() for i in range(0, len(points), 500))


class TestSurfaceErrors:
    def test_agrees_with_all_pairs_in_the_camera_frame(self) -> None:
        rng = np.random.default_rng(1)
        s, estimate = rng.normal(size=(300, 3)), rng.normal(size=(200, 3))
        pose, estimated = random_pose(rng), random_pose(rng)
        distances = cdist(s @ pose.rotation.T + pose.translation, estimated.apply(estimate))
        errors = surface_errors(Surface(s), estimate, truth_pose=pose, estimated_pose=estimated)
        np.testing.assert_allclose(errors.to_estimate, distances.min(axis=1), atol=1e-14)
        np.testing.assert_allclose(errors.to_truth, distances.min(axis=0), atol=1e-14)

    def test_object_frame_ignores_poses_by_not_taking_them(self) -> None:
        rng = np.random.default_rng(2)
        s, estimate = rng.normal(size=(30, 3)), rng.normal(size=(20, 3))
        errors = surface_errors(Surface(s), estimate)
        np.testing.assert_allclose(errors.to_estimate, cdist(s, estimate).min(axis=1), rtol=1e-15)

    def test_moving_the_camera_changes_nothing(self) -> None:
        rng = np.random.default_rng(3)
        truth, estimate = Surface(rng.normal(size=(50, 3))), rng.normal(size=(40, 3))
        poses = [random_pose(rng) for _ in range(3)]
        moved = [Pose((poses[2].matrix @ p.matrix)[:3, :3], poses[2].apply(p.translation))
                 for p in poses[:2]]  # fmt: skip
        a, b = (
            surface_errors(truth, estimate, truth_pose=p, estimated_pose=q)
            for p, q in (poses[:2], moved)
        )
        np.testing.assert_allclose(a.to_truth, b.to_truth, atol=1e-13)
        np.testing.assert_allclose(a.to_estimate, b.to_estimate, atol=1e-13)

    def test_directions_chamfer_and_nad_by_hand(self) -> None:
        # S to S~: 0 and 3; S~ to S: 0 and 1. The diameters are 4 and 1.
        errors = surface_errors(Surface(np.array([[0, 0, 0], [4, 0, 0.0]])), [[0, 0, 0], [1, 0, 0]])
        assert errors.ad_truth_to_estimate == 1.5
        assert errors.ad_estimate_to_truth == 0.5
        assert errors.chamfer == 1.0
        assert errors.nad == 0.5  # the smaller AD over the smaller diameter; 3/8 the other way

    def test_closeness_is_strict(self) -> None:
        errors = surface_errors(Surface(np.zeros((1, 3))), [[0.25, 0, 0]])
        limits = [0.25, np.nextafter(0.25, 1), 0.0]
        for values in (errors.precision(limits), errors.recall(limits), errors.fscore(limits)):
            np.testing.assert_array_equal(values, [0, 1, 0])
        assert errors.fscore(0.25) == 0
        assert errors.fscore(np.nextafter(0.25, 1)) == 1

    @settings(deadline=None)
    @given(
        st.lists(st.integers(-3, 3), min_size=1, max_size=8),
        st.lists(st.integers(-3, 3), min_size=1, max_size=8),
    )
    def test_fscore_is_the_harmonic_mean(self, s: list[int], estimate: list[int]) -> None:
        limits = [0.5, 1, 1.5, 2, 3, 8]
        errors = surface_errors(Surface(np.outer(s, [1.0, 0, 0])), np.outer(estimate, [1.0, 0, 0]))
        for limit, got in zip(limits, errors.fscore(limits), strict=True):
            r = Fraction(sum(min(abs(x - y) for y in estimate) < limit for x in s), len(s))
            p = Fraction(sum(min(abs(x - y) for x in s) < limit for y in estimate), len(estimate))
            expected = 2 / (1 / p + 1 / r) if p and r else Fraction(0)
            assert got == pytest.approx(float(expected), rel=1e-14, abs=0)

    def test_one_threshold_and_many_agree(self) -> None:
        rng = np.random.default_rng(4)
        errors = surface_errors(Surface(rng.integers(0, 9, (80, 3)) / 8), rng.random((70, 3)))
        limits = np.r_[np.linspace(0, 1, 20), errors.to_truth[:5]]
        np.testing.assert_array_equal(errors.fscore(limits), [errors.fscore(t) for t in limits])
        assert errors.fscore(limits.reshape(5, 5)).shape == (5, 5)

    def test_concentric_spheres(self) -> None:
        directions = on_sphere(500)
        errors = surface_errors(Surface(0.05 * directions), 0.06 * directions)
        assert errors.chamfer == pytest.approx(0.01, rel=1e-12)

    def test_the_tree_is_kept_between_samples(self) -> None:
        truth = Surface(on_sphere(100))
        assert truth.tree is truth.tree
        assert truth.diameter == brute_diameter(truth.points)

    def test_points_cannot_change_under_the_tree(self) -> None:
        points = on_sphere(10)
        truth = Surface(points)
        points[:] = 7
        assert np.abs(truth.points).max() <= 1
        with pytest.raises(ValueError, match="read-only"):
            truth.points[0] = 7

    def test_refusals(self) -> None:
        truth, pose = Surface(on_sphere(5)), Pose(np.eye(3), np.zeros(3))
        with pytest.raises(ContractError, match="one pose"):
            surface_errors(truth, on_sphere(5), truth_pose=pose)
        with pytest.raises(ContractError, match=r"shape is \(3, 5\)"):
            surface_errors(truth, on_sphere(5).T)
        with pytest.raises(ContractError, match="6 of 15 values are NaN"):
            surface_errors(truth, np.where(np.arange(5)[:, None] < 2, np.nan, on_sphere(5)))
        with pytest.raises(ContractError, match="coincide"):
            _ = surface_errors(truth, np.ones((4, 3))).nad
        with pytest.raises(ContractError, match="N >= 1"):
            Surface(np.zeros((0, 3)))


class TestSampling:
    # a 1 x 1 square in two halves, a triangle of area 3, and two without area
    mesh = Mesh(
        np.array(
            [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 5], [2, 0, 5], [0, 3, 5]],
            dtype=float,
        ),
        np.array([[4, 4, 4], [0, 1, 2], [3, 3, 0], [0, 2, 3], [4, 5, 6], [1, 1, 1]]),
    )

    def test_uniform_by_area(self) -> None:
        points = sample_surface(self.mesh, 40_000, 5)
        square = points[points[:, 2] == 0]
        triangle = points[points[:, 2] == 5]
        assert len(square) + len(triangle) == len(points)
        # cells of equal area hold equal counts
        cells = np.histogram2d(*square[:, :2].T, bins=4, range=[(0, 1), (0, 1)])[0]
        assert chi_square_probability(cells.ravel(), len(points) / 4 / 16) > 1e-3
        # below y = 3 (1 - sqrt(1 - q)) lies the share q of the triangle
        rows = np.floor(10 * (1 - (1 - triangle[:, 1] / 3) ** 2)).astype(int)
        assert chi_square_probability(np.bincount(rows, minlength=10), len(points) * 0.075) > 1e-3
        assert np.all(triangle[:, 0] / 2 + triangle[:, 1] / 3 <= 1 + 1e-12)

    def test_bit_for_bit_like_plain_floats(self) -> None:
        """Python's floats are IEEE doubles without fused operations, on every machine."""
        mesh = Mesh(
            self.mesh.vertices @ Rotation.from_rotvec([0.3, 1, 2]).as_matrix(), self.mesh.triangles
        )
        where, first, second = (row.tolist() for row in np.random.default_rng(7).random((3, 500)))
        corners = mesh.vertices[mesh.triangles].tolist()
        sums, total = [], 0.0
        for a, b, c in corners:
            u = [q - p for p, q in zip(a, b, strict=True)]
            v = [q - p for p, q in zip(a, c, strict=True)]
            x, y, z = (u[i] * v[j] - u[j] * v[i] for i, j in ((1, 2), (2, 0), (0, 1)))
            total += math.sqrt(x * x + y * y + z * z)
            sums.append(total)
        expected = []
        for w, s, t in zip(where, first, second, strict=True):
            a, b, c = corners[next(i for i, end in enumerate(sums) if end > w * total)]
            s, t = (1 - s, 1 - t) if s + t > 1 else (s, t)
            expected.append(
                [p + s * (q - p) + t * (r - p) for p, q, r in zip(a, b, c, strict=True)]
            )
        points = sample_surface(mesh, 500, 7)
        assert points.tolist() == expected
        assert sample_surface(mesh, 500, np.random.default_rng(7)).tolist() == expected
        assert not np.array_equal(points, sample_surface(mesh, 500, 8))

    def test_refusals(self) -> None:
        with pytest.raises(ContractError, match="count: 0"):
            sample_surface(self.mesh, 0, 0)
        flat = Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
        with pytest.raises(ContractError, match="no area"):
            sample_surface(flat, 10, 0)

    def test_surface_of_mesh_and_points(self) -> None:
        surface = Surface.of(self.mesh, 3, count=50)
        np.testing.assert_array_equal(surface.points, sample_surface(self.mesh, 50, 3))
        points = on_sphere(9)
        np.testing.assert_array_equal(Surface.of(points, 3).points, points)


def chi_square_probability(counts: np.ndarray, expected: float) -> float:
    """Of a deviation at least as large, under Poisson counts with the given expectation."""
    return float(gammaincc(len(counts) / 2, ((counts - expected) ** 2 / expected).sum() / 2))


def constant_width(count: int) -> np.ndarray:
    """A Reuleaux triangle turned about its axis: every boundary point has a partner at width 1."""
    rng = np.random.default_rng(3)
    corners = np.array([[0, 1 / np.sqrt(3)], [-0.5, -0.5 / np.sqrt(3)], [0.5, -0.5 / np.sqrt(3)]])
    corner = rng.integers(0, 3, count)
    angle = np.deg2rad(np.array([240, 0, 120]))[corner] + np.deg2rad(60) * rng.random(count)
    profile = corners[corner] + np.stack([np.cos(angle), np.sin(angle)], axis=1)
    turn = 2 * np.pi * rng.random(count)
    x, y = profile.T
    return np.stack([x * np.cos(turn), y, x * np.sin(turn)], axis=1)


SPHERE = on_sphere(2000)
CLOUDS = {
    "sphere": 0.05 * SPHERE,
    "far from the origin": 0.05 * SPHERE + [100, -50, 3],
    "nearly a sphere": SPHERE * [0.05, 0.04999, 0.04998],
    "ellipsoid": SPHERE * [0.05, 0.04, 0.03],
    "oblate": SPHERE * [0.05, 0.03, 0.05],
    "egg": SPHERE * (1 + 0.2 * SPHERE[:, 2:]),
    "bumpy": SPHERE * (1 + 0.1 * np.sin(3 * SPHERE[:, :1] + 1) * np.cos(4 * SPHERE[:, 1:2])),
    "three-lobed": SPHERE * (1 + 0.1 * (SPHERE[:, :1] ** 3 - 3 * SPHERE[:, :1] * SPHERE[:, 1:2])),
    "constant width": constant_width(2000),
    "cube": np.random.default_rng(0).random((2000, 3)),
    "plane": SPHERE * [1, 0, 1],
    "circle": SPHERE / np.linalg.norm(SPHERE[:, :2], axis=1, keepdims=True) * [1, 1, 0],
    "line": SPHERE[:, :1] * [1.0, 2, 3],
    "few points many times": np.repeat(SPHERE[:40], 50, axis=0),
    "two points many times": np.repeat(SPHERE[:2], 1000, axis=0),
    "one point many times": np.repeat(SPHERE[:1], 2000, axis=0),
    "grid": np.stack(np.meshgrid(*[np.arange(12.0)] * 3), axis=-1).reshape(-1, 3),
    "tetrahedron of clusters": np.concatenate(
        [
            1e-3 * SPHERE[i::4] + c
            for i, c in enumerate([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
        ]
    ),
    "single point": SPHERE[:1],
    "two points": SPHERE[:2],
    "mostly inside": np.concatenate([0.5 * SPHERE, SPHERE[:9]]),
}


class TestDiameter:
    @pytest.mark.parametrize("name", CLOUDS)
    def test_agrees_with_all_pairs(self, name: str) -> None:
        cloud = CLOUDS[name]
        scale = np.abs(cloud).max()
        assert diameter(cloud) == pytest.approx(brute_diameter(cloud), rel=2e-15, abs=1e-15 * scale)

    @settings(max_examples=150, deadline=None)
    @given(st.integers(0, 2**32 - 1), st.integers(1, 400), st.floats(0, 3), st.integers(0, 2))
    def test_random_clouds(self, seed: int, count: int, power: float, flat: int) -> None:
        rng = np.random.default_rng(seed)
        cloud = on_sphere(count, seed) * rng.random((count, 1)) ** power
        cloud[:, :flat] = 0
        assert diameter(cloud) == pytest.approx(brute_diameter(cloud), rel=2e-15)

    @settings(max_examples=100, deadline=None)
    @given(st.integers(0, 2**32 - 1), st.integers(2, 40), st.floats(0, 0.5))
    def test_pruning_keeps_the_farthest_pair(self, seed: int, count: int, depth: float) -> None:
        """With a bound just below the diameter, a partner lies on the very rim of the lens."""
        rng = np.random.default_rng(seed)
        cloud = on_sphere(count, seed) * (1 - depth * rng.random((count, 1)))
        distances = cdist(cloud, cloud)
        farthest = cloud[list(np.unravel_index(np.argmax(distances), distances.shape))]
        centre, radius = surfaces._enclosing_ball(cloud)
        assert np.all(np.linalg.norm(cloud - centre, axis=1) <= radius)
        for ball in ((centre, radius), (np.zeros(3), 1 + 1e-12)):
            kept, _ = surfaces._prune(cloud, *ball, distances.max() * (1 - 1e-14))
            assert all(np.any(np.all(kept == point, axis=1)) for point in farthest)

    def test_the_last_comparison_alone(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(surfaces, "_walk", lambda cloud: 0.0)
        monkeypatch.setattr(surfaces, "_prune", lambda cloud, *ball_and_best: (cloud, 0.0))
        for i, j in ((0, 1), (3, 1999), (1998, 1999), (255, 256)):
            cloud = SPHERE.copy()
            cloud[[i, j]] = [[0, 0, 2], [0, 0, -2]]
            assert diameter(cloud) == 4

    def test_planted_farthest_pair_on_a_sphere(self) -> None:
        cloud = on_sphere(10_000)
        cloud[[17, 4711]] = [[0, 0, 1 + 1e-10], [0, 0, -1]]
        assert diameter(cloud) == pytest.approx(2 + 1e-10, rel=1e-15)

    def test_memory_does_not_grow_with_the_square_of_the_hull(self) -> None:
        peaks = []
        for cloud in (on_sphere(5000), on_sphere(20_000), constant_width(5000)):
            tracemalloc.start()
            diameter(cloud)
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        assert peaks[1] < 6 * peaks[0]
        assert max(peaks) < 30e6  # all pairs of 20 000 points are 3.2 GB, of 5000 are 200 MB

    def test_refusals(self) -> None:
        with pytest.raises(ContractError, match="N >= 1"):
            diameter(np.zeros((0, 3)))
        with pytest.raises(ContractError, match="1 of 6 values are NaN"):
            diameter([[0, 0, 0], [0, np.inf, 0]])


def test_chamfer_depends_on_the_sample_count_and_fscore_settles() -> None:
    """The paper's figure in small; the picture in docs/metrics.md goes to 1e6 points."""
    path = Path(__file__).parents[2] / "docs" / "figures" / "sample_count_convergence.py"
    spec = importlib.util.spec_from_file_location("sample_count_convergence", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    at = {count: module.errors_at(count, seed=0) for count in (100, 10_000, 100_000)}
    chamfer = {n: {name: value[0] for name, value in row.items()} for n, row in at.items()}
    # points of two samples of one surface are as far apart as the samples are thin
    assert chamfer[100_000]["same mug"] < 0.5 * chamfer[10_000]["same mug"]
    ratio = {n: row["large handle"] / row["small handle"] for n, row in chamfer.items()}
    assert ratio[100_000] > 2 * ratio[100]
    for name in at[100]:
        assert abs(at[10_000][name][1] - at[100_000][name][1]) < 0.01
    assert abs(at[100]["large handle"][1] - at[100_000]["large handle"][1]) > 0.1
