import copy
import dataclasses
import shutil

import asmnet_cases
import cases
import numpy as np
import parity
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch.nn import functional as F

from method_adapters import asmnet
from method_adapters._assets import AssetError
from method_adapters._crop import NoAnswerError
from method_adapters._networks import asmnet as networks
from method_adapters._shape_model import read_shape_model
from method_adapters.asmnet import AsmNet, Inputs, interpret, registration, without_outliers
from pytest_cpas.evaluation import check_answers
from pytest_cpas.types import CATEGORIES, Observation

# the functions under test read these names, so that a fault can be planted
real_interpret, real_registration = asmnet.interpret, asmnet.registration
real_without_outliers = asmnet.without_outliers


def test_every_output_and_tap_of_the_original(shared_ports):
    data = parity.read(shared_ports, "asmnet")
    network = networks.AsmNet()
    network.load_state_dict(parity.weights(shared_ports, "asmnet", data), strict=True)
    seen = {}
    parity.tap(network.eval(), data, seen)
    with torch.inference_mode():
        result = network(torch.from_numpy(data["input__points"]))
    seen.update({"output__dparam": result.shape, "output__quat": result.quaternion})
    assert parity.compare(seen, data) == 4


def test_recorded():
    asmnet_cases.check_network()
    asmnet_cases.check_inputs()


def test_loaded_from_files(tmp_path):
    """Every category with its own network and shape model."""
    folder = asmnet_cases.write_assets(tmp_path / "weights")
    method = AsmNet()
    method.load(folder, "cpu")
    shutil.rmtree(folder)
    cases.compare("asmnet", "raw", asmnet_cases.raw_outputs(method))
    for category in CATEGORIES:
        expected, ours = asmnet_cases.shape_model(category), method._models[category]
        np.testing.assert_array_equal(ours.mean, expected.mean)
        np.testing.assert_array_equal(ours.components, expected.components)


def test_missing_file_is_named(tmp_path):
    folder = asmnet_cases.write_assets(tmp_path)
    for asset in (AsmNet.info.assets[4], AsmNet.info.assets[11]):
        (folder / asset.path).rename(tmp_path / "away")
        with pytest.raises(FileNotFoundError) as caught:
            AsmNet().load(folder, "cpu")
        for word in (str(folder / asset.path), "drive.google.com", "no licence stated"):
            assert word in str(caught.value)
        (tmp_path / "away").rename(folder / asset.path)


# ---- preparation


def outliers_removed(points, neighbours, deviations):
    """As published, in other words: a point is its own first neighbour."""
    distances, _ = cKDTree(points).query(points, min(neighbours, len(points)))
    mean = distances.mean(axis=1)
    return points[mean < mean.mean() + deviations * mean.std(ddof=1)]


@pytest.mark.parametrize("setting", [(100, 2.0), (20, 1.0)])
def test_outliers_by_definition(setting):
    points = np.random.default_rng(0).standard_normal((500, 3)) ** 3
    expected = outliers_removed(points, *setting)
    assert 400 < len(expected) < 500
    np.testing.assert_array_equal(without_outliers(points, *setting), expected)


def check_preparation():
    """Pixels of the wall do not count, the farthest point is at distance 1."""
    seen = asmnet_cases.with_background()
    inputs = AsmNet().prepare(seen, np.random.default_rng(0))
    depth = np.rint(seen.depth * 1000.0) / 1000
    values = depth[seen.mask & (depth > 0)]
    kept = seen.mask & (depth > 0) & (depth < values.mean() + 2 * values.std())
    cloud = outliers_removed(seen.camera.back_project(depth, kept), 100, 2.0)
    np.testing.assert_allclose(inputs.cloud, cloud, atol=1e-12)
    assert depth[kept].max() < 0.81
    assert cloud.shape[0] < np.count_nonzero(kept)
    np.testing.assert_allclose(inputs.centre, cloud.mean(axis=0))
    distances = np.linalg.norm(cloud - cloud.mean(axis=0), axis=1)
    assert inputs.factor == pytest.approx(distances.max())
    metric = inputs.points.T * inputs.factor + inputs.centre
    distance, index = cKDTree(cloud).query(metric)
    assert distance.max() < 1e-6
    assert len(set(index)) == 800


def test_preparation():
    check_preparation()


def test_depth_from_three_metres_on_does_not_count():
    seen = cases.observation("can", (300, 200), 20)
    depth = (seen.depth > 0) * np.float32(2.9)
    depth[:, 295:] *= np.float32(3.0001 / 2.9)
    inputs = AsmNet().prepare(
        Observation(category="can", rgb=seen.rgb, depth=depth, mask=seen.mask, camera=seen.camera),
        np.random.default_rng(0),
    )
    assert np.allclose(inputs.cloud[:, 2], 2.9)
    assert len(inputs.cloud) > 300


def test_fewer_points_than_the_network_takes_are_repeated():
    inputs = AsmNet().prepare(cases.observations()[1], np.random.default_rng(0))
    assert len(inputs.cloud) < 800
    assert len(np.unique(inputs.points, axis=1).T) < len(inputs.cloud)
    assert inputs.points.shape == (3, 800)


def test_depth_is_read_in_whole_millimetres():
    seen = cases.observation("can", (300, 200), 20)
    depth = seen.depth + np.where(seen.depth > 0, np.float32(0.0003), 0).astype(np.float32)
    cloud = (
        AsmNet()
        .prepare(
            Observation(
                category="can", rgb=seen.rgb, depth=depth, mask=seen.mask, camera=seen.camera
            ),
            np.random.default_rng(0),
        )
        .cloud
    )
    np.testing.assert_allclose(cloud[:, 2] * 1000, np.rint(cloud[:, 2] * 1000), atol=1e-9)


# ---- the answer


def view(points, normals, pose, translation):
    """The points (N, 3), camera frame, of a convex shape whose outside faces the camera."""
    posed, normals = points @ pose.T + translation, normals @ pose.T
    return posed[np.einsum("ij,ij->i", posed, normals) < 0]


def ellipsoid(radii, count=4000):
    random = np.random.default_rng(5)
    sphere = random.standard_normal((count, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    normals = sphere / radii
    return sphere * radii, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def check_answer():
    """The network's estimate is perfect but for the position, which ICP must find."""
    model = asmnet_cases.shape_model("mug")
    coefficients = np.array([0.5, -0.2, 0.3])
    shape = model.deformed(coefficients)
    radii = np.abs(shape).max(axis=0)
    size = 0.07
    rotation = Rotation.from_euler("yxz", [30, 25, -10], degrees=True).as_matrix()
    true = np.array([0.05, -0.03, 0.7])
    cloud = view(*ellipsoid(size * radii), rotation, true)
    factor = np.linalg.norm(cloud - cloud.mean(axis=0), axis=1).max()
    inputs = Inputs(np.zeros((3, 800), np.float32), cloud, cloud.mean(axis=0), factor)
    quaternion = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    found = asmnet.interpret(inputs, model, np.array([*coefficients, size / factor]), quaternion)
    assert np.linalg.norm(inputs.centre - true) > 0.015  # the mean of what is seen lies in front
    np.testing.assert_allclose(found.translation, true, atol=0.002)
    turn = Rotation.from_matrix(found.rotation @ rotation.T).magnitude()
    assert np.degrees(turn) < 5
    # sparse ends of the shape are taken for outliers, as published
    share = np.ptp(found.points, axis=0) / (2 * size * radii)
    assert np.all((share > 0.8) & (share < 1.0001))
    np.testing.assert_allclose(found.extents, 2 * np.abs(found.points).max(axis=0))


def test_answer_from_a_perfect_estimate():
    check_answer()


def check_box_centre():
    """Of a shape whose points are denser on one side, not registered: the cloud is one point."""
    points = np.random.default_rng(0).uniform(0, 1, (2000, 3)) ** [2, 1, 1]
    model = dataclasses.replace(asmnet_cases.shape_model("mug"), mean=points)
    model = dataclasses.replace(model, components=np.zeros((3, 2000, 3)))
    at = np.array([0.1, 0, 0.8])
    inputs = Inputs(np.zeros((3, 800), np.float32), np.tile(at, (50, 1)), at, 0.5)
    turn = Rotation.from_euler("z", 90, degrees=True)
    found = asmnet.interpret(
        inputs, model, np.array([0, 0, 0, 0.2]), turn.as_quat(scalar_first=True)
    )
    kept = 0.1 * outliers_removed(points, 20, 1.0)
    low, high = kept.min(axis=0), kept.max(axis=0)
    np.testing.assert_allclose(found.translation, at + turn.apply((low + high) / 2), atol=1e-9)
    np.testing.assert_allclose(found.pose.apply(found.points), at + turn.apply(kept), atol=1e-9)
    np.testing.assert_allclose(found.extents, high - low, atol=1e-9)


def test_position_is_the_centre_of_the_box():
    check_box_centre()


def test_what_is_hidden_does_not_take_part():
    check_hidden()


def check_hidden():
    """A plate of 16 mm, seen from the front: its back would pull it forward."""
    side = np.linspace(-0.05, 0.05, 26)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    front = np.stack([x, y, np.full(x.shape, 0.6)], axis=1)
    plate = np.concatenate([front, front + np.array([0, 0, 0.016])]) + np.array([0, 0, 0.004])
    motion = asmnet.registration(plate, front)
    moved = motion[:3, :3] @ [0, 0, 0.604] + motion[:3, 3]
    np.testing.assert_allclose(moved, [0, 0, 0.6], atol=5e-4)


def test_registration_finds_the_shift_of_a_view():
    points, normals = ellipsoid(np.array([0.03, 0.06, 0.04]))
    at, shift = np.array([0, 0, 0.7]), np.array([0.006, -0.004, 0.005])
    motion = registration(points + at, view(points, normals, np.eye(3), at + shift))
    np.testing.assert_allclose(motion[:3, :3] @ at + motion[:3, 3], at + shift, atol=1e-3)


def test_too_few_points_are_left_where_they_are():
    cloud = np.random.default_rng(0).uniform(0, 0.004, (900, 3)) + np.array([0, 0, 0.7])
    shape = ellipsoid(np.array([0.03, 0.06, 0.04]))[0] + np.array([0, 0, 0.7])
    np.testing.assert_array_equal(registration(shape, cloud), np.eye(4))
    np.testing.assert_array_equal(registration(cloud, shape), np.eye(4))


def inputs_of_a_ball():
    return AsmNet().prepare(cases.observations()[0], np.random.default_rng(0))


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ([0, 0, 0, -0.1], "scale is -0.1, not positive"),
        ([0, 0, 0, 0], "scale is 0, not positive"),
        ([0, 0, 0, np.nan], "nan"),
        ([0, np.inf, 0, 1], "inf"),
    ],
)
def test_no_shape_is_turned_inside_out(shape, words):
    check_no_shape(shape, words)


def check_no_shape(shape=(0, 0, 0, -0.1), words="not positive"):
    model = asmnet_cases.shape_model("can")
    with pytest.raises(NoAnswerError, match=words):
        asmnet.interpret(
            inputs_of_a_ball(), model, np.array(shape, float), np.array([1.0, 0, 0, 0])
        )


def test_degenerate_shapes_are_no_answer():
    inputs = inputs_of_a_ball()
    model = asmnet_cases.shape_model("can")
    quaternion, shape = np.array([1.0, 0, 0, 0]), np.array([0.0, 0, 0, 1])
    point = dataclasses.replace(model, mean=0 * model.mean)
    with pytest.raises(NoAnswerError, match="they are one point"):
        interpret(inputs, point, shape, quaternion)
    line = np.linspace(0, 1, 900)[:, None] * (inputs.centre / np.linalg.norm(inputs.centre))
    with pytest.raises(NoAnswerError, match="in a plane with the camera"):
        interpret(inputs, dataclasses.replace(model, mean=line), shape, quaternion)


@pytest.fixture(scope="module")
def method():
    return asmnet_cases.method()


def same(a, b):
    assert a.reason == b.reason
    for x, y in zip(a.hypotheses, b.hypotheses, strict=True):
        for part in ("rotation", "translation", "extents", "points"):
            np.testing.assert_array_equal(getattr(x, part), getattr(y, part))


def test_answer_keeps_the_contract_and_repeats_with_its_seed(method):
    mug, can = cases.observations()
    (prediction,) = method.predict([mug], 3)
    check_answers([prediction], method.info)
    assert prediction.hypotheses
    few = cases.observation("mug", (300, 200), 3)
    strange = cases.observation("teapot", (300, 200), 45)
    flat = Observation(
        category="can", rgb=can.rgb, depth=0 * can.depth, mask=can.mask, camera=can.camera
    )
    answers = method.predict([few, strange, mug, flat, can], 3)
    same(answers[2], prediction)
    assert "depth that counts, expected at least 32" in answers[0].reason
    assert "category 'teapot': asmnet knows bottle," in answers[1].reason
    assert answers[3].reason.startswith("0 pixels of the mask")
    assert "not positive" in answers[4].reason
    other = method.predict([mug], 4)[0].hypotheses[0]
    assert not np.array_equal(other.rotation, prediction.hypotheses[0].rotation)
    assert method.predict([], 3) == []


def test_wall_of_one_depth_is_seen(method):
    seen = cases.observation("mug", (300, 200), 30)
    depth = np.full_like(seen.depth, 0.777)
    flat = Observation(
        category="mug", rgb=seen.rgb, depth=depth, mask=seen.mask, camera=seen.camera
    )
    assert len(method.prepare(flat, np.random.default_rng(0)).cloud) > 2000


# ---- shape models


def arrays(**changes):
    random = np.random.default_rng(0)
    return {"mean": random.random((50, 3)), "basis": random.random((7, 150)), **changes}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"mean": arrays()["mean"].ravel()},
        {"mean": arrays()["mean"].reshape(1, -1)},
        {"mean": arrays()["mean"].reshape(-1, 1)},
        {"basis": arrays()["basis"].T},
        {"basis": arrays()["basis"].reshape(7, 50, 3)},
        {"variance": np.ones(7), "names": np.array(["a", "b"]), "n": np.array(7)},
        {"training": np.array([object()])},
        {"mean": arrays()["mean"].astype(np.float32)},
    ],
)
def test_shape_model_layouts(tmp_path, changes):
    np.savez(tmp_path / "info.npz", **arrays(**changes))
    model = read_shape_model(tmp_path / "info.npz")
    np.testing.assert_allclose(model.mean, arrays()["mean"], rtol=1e-6)
    np.testing.assert_array_equal(model.components, arrays()["basis"][:3].reshape(3, 50, 3))
    ours = model.deformed(np.array([2.0, 0, -1]))
    rows = arrays()["basis"].reshape(7, 50, 3)
    np.testing.assert_allclose(ours, arrays()["mean"] + 2 * rows[0] - rows[2], rtol=1e-5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"basis": arrays()["basis"][:2]}, "0 pairs"),
        ({"basis": arrays()["basis"].astype(int)}, "0 pairs"),
        ({"basis": np.full((7, 150), np.nan)}, "0 pairs"),
        ({"mean": np.ones((49, 3))}, r"mean \(49, 3\) of float64"),
        ({"other": np.ones((5, 150))}, "2 pairs"),
    ],
)
def test_shape_model_that_is_none(tmp_path, changes, words):
    np.savez(tmp_path / "info.npz", **arrays(**changes))
    with pytest.raises(AssetError, match=words):
        read_shape_model(tmp_path / "info.npz")


@pytest.mark.parametrize("content", [b"", b"<!DOCTYPE html>", b"PK\x03\x04torn"])
def test_shape_model_that_is_no_file_of_arrays(tmp_path, content):
    (tmp_path / "info.npz").write_bytes(content)
    with pytest.raises(AssetError, match=r"not a readable \.npz"):
        read_shape_model(tmp_path / "info.npz")
    np.savez_compressed(tmp_path / "info.npz", **arrays())
    whole = (tmp_path / "info.npz").read_bytes()
    for cut in (len(whole) // 3, len(whole) - 30):
        (tmp_path / "info.npz").write_bytes(whole[:cut])
        with pytest.raises(AssetError, match=r"not a readable \.npz"):
            read_shape_model(tmp_path / "info.npz")


# ---- planted faults


def transformer_without_the_identity(patch):
    patch(torch, "eye", lambda n, device: torch.zeros((n, n)))


def transformer_transposed(patch):
    real = networks.SpatialTransformer.forward
    patch(networks.SpatialTransformer, "forward", lambda self, x: real(self, x).mT)


def batch_norm_in_training_mode(patch):
    real = asmnet_cases.network
    patch(asmnet_cases, "network", lambda category: copy.deepcopy(real(category)).train())


def rectified_features(patch):
    real = networks.PointFeatures.forward
    patch(networks.PointFeatures, "forward", lambda self, x: (F.relu(real(self, x)[0]), None))


def mean_over_the_points(patch):
    patch(torch.Tensor, "amax", lambda self, dim: self.mean(dim))


def quaternion_left_unnormalised(patch):
    patch(F, "normalize", lambda x, dim: x)


def heads_exchanged(patch):
    real = networks.AsmNet._head
    other = {"ssm": "pose", "pose": "ssm"}
    patch(networks.AsmNet, "_head", lambda self, name, x: real(self, other[name], x))


def background_left_in(patch):
    patch(asmnet, "FAR_DEVIATIONS", 9.0)


def outliers_left_in(patch):
    patch(asmnet, "without_outliers", lambda points, neighbours, deviations: points)


def other_outlier_settings(patch):
    patch(asmnet, "OBSERVED_OUTLIERS", asmnet.SHAPE_OUTLIERS)


def half_a_pixel(patch):
    real = asmnet.AsmNet.prepare

    def fault(self, observation, generator):
        camera = dataclasses.replace(observation.camera, cx=observation.camera.cx - 0.5)
        return real(self, dataclasses.replace(observation, camera=camera), generator)

    patch(AsmNet, "prepare", fault)


def scalar_last(patch):
    class Last:
        from_quat = staticmethod(lambda q, scalar_first: Rotation.from_quat(q))

    patch(asmnet, "Rotation", Last)


def not_registered(patch):
    patch(asmnet, "registration", lambda posed, cloud: np.eye(4))


def registered_backwards(patch):
    patch(
        asmnet,
        "registration",
        lambda posed, cloud: np.linalg.inv(real_registration(posed, cloud)),
    )


def size_without_the_factor(patch):
    patch(asmnet, "interpret", lambda inputs, *rest: real_interpret(
        inputs._replace(factor=1.0), *rest))  # fmt: skip


def hidden_points_kept(patch):
    patch(asmnet, "HIDDEN_RADIUS", 1e9)


def negative_scale_taken(patch):
    def fault(inputs, model, shape, quaternion):
        return real_interpret(inputs, model, np.append(shape[:3], abs(shape[3])), quaternion)

    patch(asmnet, "interpret", fault)


def centroid_for_the_box(patch):
    def fault(*args):
        found = real_interpret(*args)
        middle = found.points.mean(axis=0)
        return dataclasses.replace(
            found, translation=found.pose.apply(middle), points=found.points - middle
        )

    patch(asmnet, "interpret", fault)


@pytest.mark.parametrize(
    ("check", "plant"),
    [
        (asmnet_cases.check_network, transformer_without_the_identity),
        (asmnet_cases.check_network, transformer_transposed),
        (asmnet_cases.check_network, batch_norm_in_training_mode),
        (asmnet_cases.check_network, rectified_features),
        (asmnet_cases.check_network, mean_over_the_points),
        (asmnet_cases.check_network, quaternion_left_unnormalised),
        (asmnet_cases.check_network, heads_exchanged),
        (asmnet_cases.check_inputs, outliers_left_in),
        (asmnet_cases.check_inputs, other_outlier_settings),
        (asmnet_cases.check_inputs, half_a_pixel),
        (asmnet_cases.check_inputs, background_left_in),
        (check_preparation, background_left_in),
        (check_preparation, outliers_left_in),
        (check_answer, scalar_last),
        (check_answer, not_registered),
        (check_answer, registered_backwards),
        (check_answer, size_without_the_factor),
        (check_box_centre, centroid_for_the_box),
        (check_hidden, hidden_points_kept),
        (check_no_shape, negative_scale_taken),
    ],
    ids=lambda value: value.__name__,
)
def test_planted_fault_is_found(monkeypatch, check, plant):
    asmnet_cases.network("bottle")  # made before anything is broken
    plant(monkeypatch.setattr)
    with pytest.raises((AssertionError, pytest.fail.Exception)):
        check()
