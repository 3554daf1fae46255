import copy

import cases
import numpy as np
import parity
import pytest
import torch
from scipy.spatial.transform import Rotation

from method_adapters import _prior_method, rbppose
from method_adapters._crop import Crop, NoAnswerError
from method_adapters._networks import gcn3d, heads
from method_adapters._networks import rbppose as rbppose_network
from method_adapters._networks.rbppose import RbpPoseNet
from method_adapters._prior_method import MUG_OFFSET
from method_adapters.rbppose import Inputs, RbpPose, resampled_pixels, rotation_between
from pytest_cpas.types import CATEGORIES, Camera, Observation
from pytest_cpas.types.frames import to_standard

KEPT = ("obs_1", "obs_2", "prior_1", "prior_2")


def test_every_output_and_tap_of_the_original(shared_ports):
    data = parity.read(shared_ports, "rbppose")
    weights = parity.weights(shared_ports, "rbppose", data)
    used = {k: v for k, v in weights.items() if not k.startswith(RbpPose.unused)}
    assert len(weights) - len(used) == 150
    network = RbpPoseNet()
    network.load_state_dict(used, strict=True)
    seen = {}
    parity.tap(network, data, seen)

    def keep(module, arguments, result):
        seen["output__size_residual"] = result[:, 3:]

    network.posenet.ts.register_forward_hook(keep)
    given = ["aux__points", "input__obj_id", "input__shape_prior", "input__mean_shape"]
    inputs = [torch.from_numpy(data[key]) for key in given]
    inputs += [torch.from_numpy(data[f"aux__pool_index_{level}"])[None] for level in KEPT]
    with torch.inference_mode():
        result = network.eval()(*inputs)
    names = ("p_green_R", "p_red_R", "f_green_R", "f_red_R", "Pred_T", "Pred_s", "deform_field")
    seen.update({f"output__{k}": x for k, x in zip(names, result, strict=True)})
    seen["output__recon_model"] = inputs[2] + result.deltas
    assert parity.compare(seen, data) == 13


class Recorded:
    """A generator that draws what the original drew; ``counts`` are what it draws from."""

    def __init__(self, data):
        self.data, self.counts = data, []
        self.pools = [data[f"aux__pool_index_{level}"] for level in KEPT]

    def choice(self, count, size, replace):
        self.counts.append((count, size, replace))
        valid = np.flatnonzero((self.data["input__def_mask"] * self.data["input__depth"]) > 0)
        return np.searchsorted(valid, self.data["aux__pixel_index"])

    def permutation(self, count):
        self.counts.append(count)
        kept = self.pools[(len(self.counts) - 2) % 4]
        return np.concatenate([kept, np.setdiff1d(np.arange(count), kept)])


def test_points_and_indices_of_the_original(shared_ports, monkeypatch):
    """The recorded crop as an image of its own, so that nothing is resampled."""
    data = parity.read(shared_ports, "rbppose")
    depth = (data["input__depth"][0, 0] / 1000).astype(np.float32)
    mask = data["input__def_mask"][0, 0] > 0
    u, v = data["input__gt_2D"][0]
    # where the crop's pixels are in the original image, in steps of a constant
    step = (u[0, 255] - u[0, 0]) / 255
    matrix = data["input__camK"][0]
    camera = Camera(
        256,
        256,
        float(matrix[0, 0] / step),
        float(matrix[1, 1] / step),
        float((matrix[0, 2] - u[0, 0]) / step),
        float((matrix[1, 2] - v[0, 0]) / step),
    )
    monkeypatch.setattr(rbppose, "crop_of", lambda mask: Crop(0, 0, 256, 256))
    generator = Recorded(data)
    seen = Observation(
        category="mug",
        rgb=np.zeros((256, 256, 3), np.float32),
        depth=depth,
        mask=mask,
        camera=camera,
    )
    inputs = cases.unloaded("rbppose").prepare(seen, generator)
    assert generator.counts == [(int(mask.sum()), 1028, False), 1028, 257, 1024, 256]
    np.testing.assert_allclose(inputs.points, data["aux__points"][0], atol=1e-6)
    for ours, level in zip(inputs[4:], KEPT, strict=True):
        np.testing.assert_array_equal(ours, data[f"aux__pool_index_{level}"])


def test_resampling_rule():
    valid = np.zeros((480, 640), bool)
    valid[100:110, 201] = True
    # 40 pixels become 256: each 6 or 7 times; halves go up
    rows, columns = resampled_pixels(valid, Crop(90, 200, 40, 40))
    assert set(columns) == {201}
    counts = [np.count_nonzero(rows == row) for row in range(100, 110)]
    every = [np.floor(90 + i * 40 / 256 + 0.5) for i in range(256)]
    width = sum(np.floor(200 + i * 40 / 256 + 0.5) == 201 for i in range(256))
    assert counts == [width * every.count(row) for row in range(100, 110)]
    assert (np.diff(rows) >= 0).all()
    # 320 pixels become 256: a fifth is left out
    rows, columns = resampled_pixels(np.ones((480, 640), bool), Crop(0, 0, 320, 320))
    assert sorted(set(columns))[:6] == [0, 1, 3, 4, 5, 6]
    assert len(rows) == 256 * 256


def test_resampling_reaches_one_pixel_beyond_the_crop():
    crop = Crop(440, 560, 40, 40)
    rows, columns = resampled_pixels(np.ones((480, 640), bool), crop)
    assert columns.max() == 600
    # behind the image's last row there is nothing
    assert rows.max() == 479
    assert len(rows) < 256 * 256


def test_pixels_that_resampling_misses():
    valid = np.zeros((480, 640), bool)
    valid[[20, 450], [100, 530]] = True  # the crop is 440 wide
    skipped = sorted(
        set(range(20, 450)) - set(resampled_pixels(~valid, Crop(15, 100, 440, 440))[0])
    )
    mask = valid.copy()
    mask[skipped, 300] = True
    depth = np.where(mask & ~valid, 1, 0).astype(np.float32)
    assert np.count_nonzero(depth) > 100
    rgb, camera = np.zeros((480, 640, 3), np.float32), Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    (found,) = cases.unloaded("rbppose").predict(
        [Observation(category="can", rgb=rgb, depth=depth, mask=mask, camera=camera)], 0
    )
    assert found.reason == "the pixels with a depth are too scattered: resampling meets none"


def disc(radius, category="can"):
    return cases.observation(category, (320, 240), radius)


def test_what_the_network_sees():
    seen = disc(30, "laptop")
    inputs = cases.unloaded("rbppose").prepare(seen, np.random.default_rng(0))
    assert inputs.points.shape == (1028, 3)
    pixels = np.rint(seen.camera.project(inputs.points.astype(float))).astype(int)
    assert seen.mask[pixels[:, 1], pixels[:, 0]].all()
    depth = seen.depth[pixels[:, 1], pixels[:, 0]]
    np.testing.assert_allclose(inputs.points[:, 2], depth, rtol=1e-6)
    assert depth.all()
    np.testing.assert_allclose(inputs.mean_size, [0.346, 0.2, 0.335])
    np.testing.assert_array_equal(inputs.prior, cases.priors()[4].astype(np.float32))
    for kept, before, after in zip(
        inputs[4:], (1028, 257, 1024, 256), (257, 64, 256, 64), strict=1
    ):
        assert len(set(kept.tolist())) == after
        assert 0 <= kept.min() <= kept.max() < before


def test_pixels_are_drawn_with_replacement_only_if_they_must():
    method = cases.unloaded("rbppose")

    class Counting:
        def __init__(self):
            self.real, self.replaced = np.random.default_rng(0), []

        def choice(self, count, size, replace):
            self.replaced.append((count < size, replace))
            return self.real.choice(count, size, replace)

        def permutation(self, count):
            return self.real.permutation(count)

    generator = Counting()
    camera, mask = Camera(640, 480, 500.0, 500.0, 320.0, 240.0), np.zeros((480, 640), bool)
    mask[10:450, 10] = True  # a line of 440 pixels: with 256 steps, 256 of them
    rgb, depth = np.zeros((480, 640, 3), np.float32), np.ones((480, 640), np.float32)
    method.prepare(
        Observation(category="can", rgb=rgb, depth=depth, mask=mask, camera=camera), generator
    )
    method.prepare(disc(30), generator)
    assert generator.replaced == [(True, True), (False, False)]


def known(category, seed=0):
    """A true pose and size, and outputs that tell it."""
    random = np.random.default_rng(seed)
    rotation, translation = Rotation.random(rng=random).as_matrix(), np.array([0.1, -0.05, 0.9])
    size, index = np.array([0.1, 0.2, 0.2]), CATEGORIES.index(category)
    prior, deltas = cases.priors()[index], 0.05 * random.standard_normal((1024, 3))
    inputs = Inputs(*(np.zeros(1),) * 8)._replace(category=np.array(index), prior=prior)
    outputs = (rotation[:, 1], rotation[:, 0], np.array(0.9), np.array(0.3))
    return rotation, inputs, (*outputs, translation, size, deltas)


@pytest.mark.parametrize("category", CATEGORIES)
def test_answer_from_known_outputs(category):
    rotation, inputs, outputs = known(category)
    found = RbpPose().interpret(inputs, outputs, np.random.default_rng(0))
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    np.testing.assert_array_equal(found.extents, [0.1, 0.2, 0.2])
    # the mug's middle is moved to the origin; what is seen stays where it is
    offset = np.array([0.3 * MUG_OFFSET if category == "mug" else 0, 0, 0])
    shape = 0.3 * (inputs.prior + outputs[6])
    np.testing.assert_allclose(found.points, shape - offset, atol=1e-12)
    seen = shape @ rotation.T + outputs[4]
    np.testing.assert_allclose(found.pose.apply(found.points), seen, atol=1e-12)
    standard = to_standard(found, RbpPose.info)
    np.testing.assert_allclose(standard.extents, [0.2, 0.2, 0.1])


def angle(a, b):
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


@pytest.mark.parametrize("between", [60.0, 90.0, 120.0, 170.0])
@pytest.mark.parametrize(("sure_green", "sure_red"), [(0.9, 0.3), (0.2, 0.8), (0.5, 0.0)])
def test_surer_axis_turns_less(between, sure_green, sure_red):
    turn = Rotation.random(rng=np.random.default_rng(0)).as_matrix()
    green = turn @ [0, 1, 0]
    red = turn @ [np.sin(np.radians(between)), np.cos(np.radians(between)), 0]
    found = rotation_between(green, red, sure_green, sure_red)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1)
    # both stay in their plane, on their sides
    np.testing.assert_allclose(found[:, 2] @ np.stack([green, red], axis=1), 0, atol=1e-9)
    moved = abs(between - 90)
    share = sure_red / (sure_green + sure_red)
    assert angle(found[:, 1], green) == pytest.approx(moved * share, abs=1e-5)
    assert angle(found[:, 0], red) == pytest.approx(moved * (1 - share), abs=1e-5)


@pytest.mark.parametrize("category", CATEGORIES)
def test_x_axis_counts_only_where_it_is_known(category):
    _, inputs, outputs = known(category)
    green, red = outputs[0], outputs[1] + 0.4 * outputs[0]
    red = red / np.linalg.norm(red)
    found = RbpPose().interpret(inputs, (green, red, *outputs[2:]), np.random.default_rng(0))
    assert (angle(found.rotation[:, 1], green) < 1e-5) == (category in ("bottle", "bowl", "can"))


@pytest.mark.parametrize("bad", [-0.01, 0.0, np.nan])
def test_size_that_is_not_positive(bad):
    _, inputs, outputs = known("can")
    outputs = (*outputs[:5], np.array([0.1, bad, 0.2]), outputs[6])
    with pytest.raises(NoAnswerError, match="not positive"):
        RbpPose().interpret(inputs, outputs, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("red", "sure"), [([0, 1, 0], 0.5), ([0, -1, 0], 0.5), ([1, 0, 0], 0.0), ([np.nan] * 3, 0.5)]
)
def test_axes_that_define_no_rotation(red, sure):
    with pytest.raises(NoAnswerError, match="they define no rotation"):
        rotation_between(np.array([0.0, 1, 0]), np.array(red, float), sure, sure)


def test_graph_convolution_of_a_simple_cloud():
    """The definition, point by point, in float64."""
    torch.manual_seed(0)
    xyz, features = torch.rand(2, 40, 3), torch.randn(2, 40, 5)
    layer = gcn3d.GraphConvolution(5, 4)
    for parameter in layer.parameters():
        torch.nn.init.normal_(parameter)
    with torch.no_grad():
        ours = layer(gcn3d.Neighbourhood(xyz, 6), features).numpy()
        weights, bias = layer.weights.double().numpy(), layer.bias.double().numpy()
        directions = layer.directions.double().numpy().reshape(3, 7, 4)
    directions /= np.linalg.norm(directions, axis=0)
    for cloud, given, result in zip(
        xyz.double().numpy(), features.double().numpy(), ours, strict=1
    ):
        x = given @ weights + bias
        for i, point in enumerate(cloud):
            near = np.argsort(np.linalg.norm(cloud - point, axis=1))[1:7]
            to = (cloud[near] - point) / np.linalg.norm(cloud[near] - point, axis=1)[:, None]
            cosine = np.maximum(np.einsum("nd,dsc->nsc", to, directions), 0)
            best = (cosine * x[near, 4:].reshape(-1, 7, 4)).max(axis=0)
            np.testing.assert_allclose(result[i], x[i, :4] + best.sum(axis=0), atol=1e-4)


# -- faults that ports have ---------------------------------------------------------------------


def batch_norm_in_training_mode(patch):
    network = copy.deepcopy(cases.network("rbppose")).train()
    patch(cases, "network", lambda name: network)


def neighbour_of_its_own(patch):
    real = gcn3d.squared_distances
    patch(
        gcn3d,
        "neighbours",
        lambda xyz, count: real(xyz, xyz).topk(count, largest=False).indices,
    )


def farthest_neighbours(patch):
    real = gcn3d.squared_distances
    patch(gcn3d, "neighbours", lambda xyz, count: real(xyz, xyz).topk(count).indices)


def directions_not_normalised(patch):
    real = gcn3d.Neighbourhood.responses

    def fault(self, kernel, supports=None):
        return real(self, kernel, supports) * kernel.norm()

    patch(gcn3d.Neighbourhood, "responses", fault)


def supports_interleaved(patch):
    real = gcn3d.Neighbourhood.responses

    def fault(self, kernel, supports=None):
        turned = kernel.view(3, 7, -1).mT.flatten(1)
        return real(self, turned, supports)

    patch(gcn3d.Neighbourhood, "responses", fault)


def pooled_without_neighbours(patch):
    patch(
        gcn3d.Neighbourhood,
        "pooled",
        lambda self, features, kept: gcn3d.at_points(features, kept),
    )


def prior_centred(patch):
    real = rbppose_network.Encoder.forward

    def fault(self, xyz, *rest):
        return real(self, xyz - xyz.mean(1, keepdim=True), *rest)

    patch(rbppose_network.Encoder, "forward", fault)


def next_category(patch):
    real = heads.PerCategory.of
    patch(heads.PerCategory, "of", lambda self, x, category: real(self, x, (category + 1) % 6))


def first_points_kept(patch):
    real = rbppose_network.Encoder.forward

    def fault(self, xyz, category, kept, again):
        return real(self, xyz, category, kept.sort().values, again)

    patch(rbppose_network.Encoder, "forward", fault)


def parts_backwards(patch):
    real = rbppose_network.Head.forward
    patch(
        rbppose_network.Head, "forward", lambda self, parts: real(self, [*parts[2::-1], *parts[3:]])
    )


def axes_swapped(patch):
    real = rbppose_network.RbpPoseNet.forward

    def fault(self, *inputs):
        result = real(self, *inputs)
        return result._replace(green=result.red, red=result.green)

    patch(rbppose_network.RbpPoseNet, "forward", fault)


def mean_size_left_out(patch):
    real = rbppose_network.RbpPoseNet.forward
    patch(
        rbppose_network.RbpPoseNet,
        "forward",
        lambda self, points, category, prior, mean_size, *kept: real(
            self, points, category, prior, 0 * mean_size, *kept
        ),
    )


def centre_not_added(patch):
    real = rbppose_network.RbpPoseNet.forward

    def fault(self, points, *rest):
        result = real(self, points, *rest)
        return result._replace(translation=result.translation - points.mean(1))

    patch(rbppose_network.RbpPoseNet, "forward", fault)


def pixels_cut_not_rounded(patch):
    def fault(valid, crop):
        steps = np.arange(256) * crop.width // 256
        rows, columns = crop.row + steps, crop.column + steps
        at_row, at_column = np.nonzero(valid[np.ix_(rows, columns)])
        return rows[at_row], columns[at_column]

    patch(rbppose, "resampled_pixels", fault)


def millimetres(patch):
    real = rbppose.back_project
    patch(rbppose, "back_project", lambda v, u, depth, camera: real(v, u, 1000 * depth, camera))


def sizes_of_the_other_frame(patch):
    turned = {name: (z, y, x) for name, (x, y, z) in rbppose.MEAN_SIZES.items()}
    patch(rbppose, "MEAN_SIZES", turned)


@pytest.mark.parametrize(
    ("check", "plant"),
    [
        (cases.check_network, batch_norm_in_training_mode),
        (cases.check_network, neighbour_of_its_own),
        (cases.check_network, farthest_neighbours),
        (cases.check_network, directions_not_normalised),
        (cases.check_network, supports_interleaved),
        (cases.check_network, pooled_without_neighbours),
        (cases.check_network, prior_centred),
        (cases.check_network, next_category),
        (cases.check_network, first_points_kept),
        (cases.check_network, parts_backwards),
        (cases.check_network, axes_swapped),
        (cases.check_network, mean_size_left_out),
        (cases.check_network, centre_not_added),
        (cases.check_inputs, pixels_cut_not_rounded),
        (cases.check_inputs, millimetres),
        (cases.check_inputs, sizes_of_the_other_frame),
    ],
)
def test_planted_fault_is_found(monkeypatch, check, plant):
    cases.assert_found(monkeypatch.setattr, plant, check, "rbppose")


def test_planted_fault_in_the_rotation_is_found(monkeypatch):
    """Each axis turns by its own confidence instead of the other's."""
    real = rotation_between
    monkeypatch.setitem(
        globals(), "rotation_between", lambda a, b, sure_a, sure_b: real(a, b, sure_b, sure_a)
    )
    with pytest.raises((AssertionError, NoAnswerError)):
        test_surer_axis_turns_less(60.0, 0.9, 0.3)


def test_planted_fault_in_the_symmetry_is_found(monkeypatch):
    monkeypatch.setattr(rbppose, "SYMMETRIC", ())
    with pytest.raises(AssertionError):
        test_x_axis_counts_only_where_it_is_known("bowl")


def test_planted_fault_in_the_position_is_found(monkeypatch):
    monkeypatch.setattr(_prior_method, "MUG_OFFSET", 0.0)
    with pytest.raises(AssertionError):
        test_answer_from_known_outputs("mug")
