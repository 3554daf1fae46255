"""The icp baseline, against shapes that the test renders itself at poses that it knows."""

import importlib.util
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray
from observing import CAMERA, observe
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from method_adapters._icp_evidence import Evidence
from method_adapters.icp import Icp
from pytest_cpas.datasets.shapes import mean_shape
from pytest_cpas.metrics.surfaces import sample_surface
from pytest_cpas.types import CATEGORIES, Mesh, Method, Observation, Pose

ROOT = Path(__file__).parents[2]
SYMMETRIC = ("bottle", "bowl", "can")

#: The camera looks down at an upright object by 30 degrees, which is turned by 40 about its axis.
UPRIGHT = Rotation.from_euler("x", 210, degrees=True) * Rotation.from_euler("y", 40, degrees=True)
FREE = Rotation.from_euler("xyz", [70, -35, 160], degrees=True)


@pytest.fixture(scope="module")
def method() -> Icp:
    icp = Icp()
    icp.load(None, "cpu")
    return icp


@pytest.fixture(scope="module")
def mug() -> Observation:
    pose = Pose(UPRIGHT.as_matrix(), [0.02, -0.01, 0.6])
    return observe(mean_shape("mug"), pose, "mug")


def posed(icp: Icp, observation: Observation, seed: int = 0) -> NDArray[np.float64]:
    """Everything that a prediction says, as one array."""
    (prediction,) = icp.predict([observation], seed)
    (best,) = prediction.hypotheses
    return np.concatenate(
        [best.rotation.ravel(), best.translation, best.extents, best.points.ravel()]
    )


def test_is_a_method_of_all_categories(method: Icp) -> None:
    assert isinstance(method, Method)
    assert method.info.name == "icp"
    assert method.info.categories == CATEGORIES
    assert method.info.gives == {"extents", "shape"}


@pytest.mark.parametrize("rotation", [UPRIGHT, FREE], ids=["upright", "free"])
@pytest.mark.parametrize("category", CATEGORIES)
def test_recovers_the_pose_of_a_clean_rendering(
    method: Icp, category: str, rotation: Rotation
) -> None:
    """5 degrees and 1 cm, and 95 % of the surfaces within 1 cm, on the category's mean shape."""
    mesh = mean_shape(category)
    pose = Pose(rotation.as_matrix(), [0.03, -0.02, 0.8])
    (prediction,) = method.predict([observe(mesh, pose, category)], 0)
    (best,) = prediction.hypotheses
    if category in SYMMETRIC:
        cosine = best.rotation[:, 1] @ pose.rotation[:, 1]
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    else:
        angle = np.degrees(Rotation.from_matrix(best.rotation.T @ pose.rotation).magnitude())
    assert angle < 5
    assert np.linalg.norm(best.translation - pose.translation) < 0.01
    surface = pose.apply(sample_surface(mesh, 5000, seed=6))
    recall = cKDTree(best.pose.apply(best.points)).query(surface)[0] < 0.01
    precision = cKDTree(surface).query(best.pose.apply(best.points))[0] < 0.01
    assert recall.mean() > 0.95
    assert precision.mean() > 0.95
    np.testing.assert_allclose(best.extents, np.ptp(mesh.bounds, axis=0), rtol=0.1)


def test_size_follows_the_object(method: Icp) -> None:
    """The same shape a fifth larger gives extents a fifth larger, not the prior's."""
    mesh = mean_shape("can")
    pose = Pose(UPRIGHT.as_matrix(), [0, 0, 0.7])
    large = Mesh(mesh.vertices * 1.2, mesh.triangles)
    (prediction,) = method.predict([observe(large, pose, "can")], 0)
    np.testing.assert_allclose(
        prediction.hypotheses[0].extents, np.ptp(mesh.bounds, axis=0) * 1.2, rtol=0.08
    )


def test_shape_is_centred_on_the_box_that_it_states(method: Icp, mug: Observation) -> None:
    (best,) = method.predict([mug], 0)[0].hypotheses
    np.testing.assert_allclose(best.points.min(axis=0), -best.extents / 2, atol=1e-12)
    np.testing.assert_allclose(best.points.max(axis=0), best.extents / 2, atol=1e-12)


def test_same_seed_same_answer_whatever_ran_before(method: Icp, mug: Observation) -> None:
    np.random.seed(1)  # noqa: NPY002 - the global state must not matter
    first = posed(method, mug)
    np.random.seed(2)  # noqa: NPY002
    fresh = Icp()
    fresh.load(None, "cpu")
    np.testing.assert_array_equal(posed(fresh, mug), first)
    np.testing.assert_array_equal(posed(method, mug), first)


def test_seed_reaches_the_fit(mug: Observation) -> None:
    """Another seed looks at other pixels (the answer may differ, the choice must)."""
    one, same, other = (Evidence.of(mug, np.random.default_rng(s)) for s in (1, 1, 2))
    np.testing.assert_array_equal(one.points, same.points)
    assert not np.array_equal(one.points, other.points)


def test_samples_of_a_batch_do_not_touch_each_other(method: Icp, mug: Observation) -> None:
    pose = Pose(FREE.as_matrix(), [-0.05, 0.02, 0.7])
    can = observe(mean_shape("can"), pose, "can")
    together = method.predict([can, mug, can], 3)
    for observation, prediction in zip([can, mug, can], together, strict=True):
        (best,), (alone,) = prediction.hypotheses, method.predict([observation], 3)[0].hypotheses
        np.testing.assert_array_equal(best.rotation, alone.rotation)
        np.testing.assert_array_equal(best.translation, alone.translation)
        np.testing.assert_array_equal(best.points, alone.points)
    assert method.predict([], 0) == []


def test_inputs_stay_as_they_were(method: Icp, mug: Observation) -> None:
    before = mug.depth.copy(), mug.mask.copy(), mug.rgb.copy()
    for array in (mug.depth, mug.mask, mug.rgb):
        array.setflags(write=False)
    method.predict([mug], 0)
    for array, copy in zip((mug.depth, mug.mask, mug.rgb), before, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_number_of_threads_does_not_matter(mug: Observation, tmp_path: Path) -> None:
    np.savez(tmp_path / "mug.npz", depth=mug.depth, mask=mug.mask)
    code = (
        "import sys, numpy as np; from method_adapters.icp import Icp;"
        "from pytest_cpas.types import Camera, Observation;"
        "d = np.load(sys.argv[1]); icp = Icp(); icp.load(None, 'cpu');"
        "rgb = np.zeros((*d['depth'].shape, 3), np.float32);"
        "o = Observation(category='mug', rgb=rgb, depth=d['depth'], mask=d['mask'],"
        f" camera={CAMERA!r});"
        "h = icp.predict([o], 0)[0].hypotheses[0];"
        "print(*(a.tobytes().hex() for a in (h.rotation, h.translation, h.extents)))"
    )
    outputs = [
        subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / "mug.npz")],
            env={"OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads},
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for threads in ("1", "4")
    ]
    assert outputs[0] == outputs[1] != ""


def test_ignores_flying_pixels_and_far_depth(method: Icp, mug: Observation) -> None:
    """A tenth of the mask shows the wall or hangs in between; the answer stays."""
    (clean,) = method.predict([mug], 0)[0].hypotheses
    rng = np.random.default_rng(0)
    depth = mug.depth.copy()
    rows, columns = np.nonzero(mug.mask)
    wrong = rng.choice(len(rows), len(rows) // 10, replace=False)
    depth[rows[wrong], columns[wrong]] = rng.uniform(0.7, 2.0, len(wrong))
    (noisy,) = method.predict([replace(mug, depth=depth)], 0)[0].hypotheses
    turn = Rotation.from_matrix(clean.rotation.T @ noisy.rotation).magnitude()
    assert np.degrees(turn) < 5
    assert np.linalg.norm(clean.translation - noisy.translation) < 0.01


def test_ignores_background_in_a_shifted_mask(method: Icp) -> None:
    """The mask is 9 pixels off to the side, as real ones are: a strip of it shows the wall."""
    pose = Pose(UPRIGHT.as_matrix(), [0, 0, 0.7])
    can = observe(mean_shape("can"), pose, "can", background=0.95)
    shifted = replace(can, mask=np.roll(can.mask, 9, axis=1))
    assert (shifted.mask & ~can.mask).sum() > 0.2 * can.mask.sum()
    (best,) = method.predict([shifted], 0)[0].hypotheses
    cosine = best.rotation[:, 1] @ pose.rotation[:, 1]
    assert cosine > np.cos(np.deg2rad(10))
    assert np.linalg.norm(best.translation - pose.translation) < 0.02


@pytest.mark.parametrize("pixels", [0, 1, 29])
def test_too_few_depth_values_fail_with_the_count(
    method: Icp, mug: Observation, pixels: int
) -> None:
    depth = np.zeros_like(mug.depth)
    rows, columns = np.nonzero(mug.mask)
    depth[rows[:pixels], columns[:pixels]] = 0.6
    (prediction,) = method.predict([replace(mug, depth=depth)], 0)
    assert prediction.hypotheses == ()
    assert f"only {pixels} " in str(prediction.reason)


def test_depth_that_does_not_hang_together_fails(method: Icp, mug: Observation) -> None:
    depth = np.zeros_like(mug.depth)
    rows, columns = np.nonzero(mug.mask)
    chosen = np.arange(0, len(rows), len(rows) // 31)[:31]
    depth[rows[chosen], columns[chosen]] = np.linspace(0.3, 9, 31)
    (prediction,) = method.predict([replace(mug, depth=depth)], 0)
    assert prediction.hypotheses == ()
    assert "hang together" in str(prediction.reason)


@pytest.mark.parametrize("cut", [1, 2, 40])
def test_thin_and_flat_observations_give_an_answer(method: Icp, mug: Observation, cut: int) -> None:
    """A mask of a few rows, a plane: a finite answer or a reason, never an exception."""
    mask = np.zeros_like(mug.mask)
    mask[100 : 100 + cut, 120:200] = True
    depth = np.full_like(mug.depth, 0.7)
    (prediction,) = method.predict([replace(mug, mask=mask, depth=depth)], 0)
    (best,) = prediction.hypotheses
    assert np.isfinite(best.points).all()


def make_script() -> ModuleType:
    path = ROOT / "tools" / "make_icp_priors.py"
    spec = importlib.util.spec_from_file_location("make_icp_priors", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_asset_is_what_its_script_makes() -> None:
    path = ROOT / "method_adapters" / "icp_priors.npz"
    assert path.stat().st_size < 300_000
    fresh = make_script().make_priors()
    with np.load(path) as shipped:
        assert sorted(shipped) == sorted(fresh)
        for name, array in fresh.items():
            np.testing.assert_allclose(
                shipped[name].astype(float), array.astype(float), atol=2e-3 * np.abs(array).max()
            )


def test_adapter_is_light() -> None:
    code = (
        "import sys, method_adapters.icp;"
        "heavy = {'pytest_cpas.metrics', 'torch', 'open3d', 'trimesh'};"
        "print(*heavy & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == []
