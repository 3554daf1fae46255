import cases
import numpy as np
import parity
import pytest
import torch
from scipy.spatial.transform import Rotation

from method_adapters import cass
from method_adapters._crop import Crop, NoAnswerError
from method_adapters._networks import cass as cass_network
from method_adapters._networks import heads, pspnet
from method_adapters.cass import Cass, Inputs, crop_around
from pytest_cpas.types import Camera, Observation
from pytest_cpas.types.frames import to_standard


def test_every_output_and_tap_of_the_original(shared_ports):
    data = parity.read(shared_ports, "cass")
    weights = parity.weights(shared_ports, "cass", data)
    used = {k: v for k, v in weights.items() if not k.startswith(Cass.unused)}
    assert len(weights) - len(used) == 42
    used["foldingnet.reconstructing.grid_buf"] = torch.from_numpy(data["aux__grid_buf"])
    network = cass_network.CassNet()
    network.load_state_dict(used, strict=True)
    seen = {}
    parity.tap(network, data, seen)

    def keep(name):
        def hook(module, arguments, features):
            spread = features.shared.expand(-1, -1, features.local.shape[2])
            seen[f"output__{name}"] = torch.cat([features.local, spread], 1)

        return hook

    network.foldingnet.encoding.register_forward_hook(keep("folding_encode"))
    network.estimator.encoding.register_forward_hook(keep("pose_encode"))
    inputs = [torch.from_numpy(data[f"input__{k}"]) for k in ("points", "img", "choose", "cat_id")]
    with torch.inference_mode():
        result = network.eval()(*inputs)
    seen["output__r"], seen["output__t"] = result.quaternion, result.offset
    seen["output__c"], seen["output__recon"] = result.confidence[..., None], result.shape
    assert parity.compare(seen, data) == 8


@pytest.mark.parametrize(
    ("box", "crop"),
    [
        ((100, 200, 138, 230), (99, 195, 40, 40)),
        ((100, 200, 139, 230), (100, 195, 40, 40)),  # 40 rows stay 40
        ((100, 200, 140, 319), (80, 200, 80, 120)),  # each way its own
        ((0, 300, 100, 320), (0, 290, 120, 40)),
        ((470, 630, 479, 639), (440, 600, 40, 40)),
        ((0, 0, 479, 639), (0, 0, 480, 640)),
        ((3, 5, 450, 639), (0, 0, 480, 640)),
    ],
)
def test_crop_rule(box, crop):
    mask = np.zeros((480, 640), bool)
    mask[box[0], box[1]] = mask[box[2], box[3]] = True
    assert crop_around(mask) == Crop(*crop)


def test_crop_stays_in_small_images():
    assert crop_around(np.ones((95, 130), bool)) == Crop(7, 5, 80, 120)
    with pytest.raises(NoAnswerError, match="the image is 30 pixels"):
        crop_around(np.ones((30, 130), bool))


def ramp(depth):
    """An observation whose colours tell the pixel."""
    camera = Camera(640, 480, 500.0, 400.0, 320.0, 240.0)
    v, u = np.mgrid[:480, :640]
    rgb = np.stack([u / 639, v / 479, 0 * u], axis=-1).astype(np.float32)
    mask = np.zeros((480, 640), bool)
    mask[100:130, 200:270] = True
    return Observation(
        category="can",
        rgb=rgb,
        depth=np.where(mask, depth, 0).astype(np.float32),
        mask=mask,
        camera=camera,
    )


def test_what_the_network_sees():
    seen = ramp(2.0)
    points, image, choose, category = Cass().prepare(seen, np.random.default_rng(0))
    assert (points.shape, image.shape, category) == ((500, 3), (3, 40, 80), 3)
    rows, columns = np.divmod(choose, 80)
    assert (np.diff(choose) > 0).all()
    v, u = rows + 95, columns + 195
    assert seen.mask[v, u].all()
    # x left, y up
    expected = np.stack([-(u - 320) * 2 / 500, -(v - 240) * 2 / 400, np.full(500, 2.0)], axis=-1)
    np.testing.assert_allclose(points, expected, atol=1e-6)
    blue, green, red = image[:, rows, columns]
    np.testing.assert_allclose(blue, -0.51 / 0.29, rtol=1e-6)
    np.testing.assert_allclose(green, (v / 479 - 0.47) / 0.27, atol=1e-5)
    np.testing.assert_allclose(red, (u / 639 - 0.44) / 0.28, atol=1e-5)


def test_pixels_without_depth_do_not_count():
    depth = np.zeros((480, 640))
    depth[101:111, 210:250] = 1.0
    points, image, choose, _ = Cass().prepare(ramp(depth), np.random.default_rng(0))
    assert image.shape == (3, 40, 40)
    assert choose[:400].tolist() == list(range(15 * 40, 25 * 40))
    np.testing.assert_array_equal(points[400:], points[:100])
    np.testing.assert_array_equal(choose[400:], choose[:100])


def known(seed=0):
    """A true pose, and outputs that tell it at the surest point alone, which is the last."""
    random = np.random.default_rng(seed)
    rotation, translation = Rotation.random(rng=random), np.array([0.1, -0.05, 0.9])
    observed = translation + random.uniform(-0.1, 0.1, (500, 3))
    half_turn = Rotation.from_quat([0, 0, 1, 0])
    x, y, z, w = 3.0 * (half_turn * rotation).as_quat()
    quaternion, offset = random.standard_normal((500, 4)), random.standard_normal((500, 3))
    confidence = random.uniform(0.2, 0.8, 500)
    confidence[499], quaternion[499] = 0.9, [w, x, y, z]
    offset[499] = half_turn.apply(translation - observed[499])
    shape = random.uniform(-0.1, 0.05, (500, 3))
    points = half_turn.apply(observed).astype(np.float32)
    inputs = Inputs(points, np.zeros((3, 40, 40)), np.arange(500), np.array(1))
    return rotation, translation, inputs, (quaternion, offset, confidence, shape)


def test_answer_from_known_outputs():
    rotation, translation, inputs, outputs = known()
    found = Cass().interpret(inputs, outputs, np.random.default_rng(0))
    np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(found.translation, translation, atol=1e-7)
    np.testing.assert_array_equal(found.points, outputs[3])
    np.testing.assert_allclose(found.extents, 2 * np.abs(outputs[3]).max(axis=0))
    assert found.score == 0.9
    # as the published wrapper has it, scalar last: (0, 0, 1, 0) * q * o, and o^-1 on the shape
    axes = Rotation.from_quat([0, -np.sqrt(0.5), 0, np.sqrt(0.5)])
    standard = to_standard(found, Cass.info)
    np.testing.assert_allclose(standard.rotation, (rotation * axes).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(standard.points, axes.inv().apply(outputs[3]), atol=1e-12)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_quaternion_that_is_none(value):
    _, _, inputs, outputs = known()
    outputs[0][499] = value
    with pytest.raises(NoAnswerError, match="not a rotation"):
        Cass().interpret(inputs, outputs, np.random.default_rng(0))


def test_shape_depends_on_the_order_of_the_points():
    points, image, choose, category = cases.network_inputs("cass")
    turned = [points.flip(1), image, choose.flip(1), category]
    first, second = (
        cases.outputs_of(cases.network("cass"), x)
        for x in ([points, image, choose, category], turned)
    )
    assert cases.relative(second[0][:, ::-1], first[0]) < 1e-5
    assert cases.relative(second[3][:, ::-1], first[3]) > 5e-4


def test_batch_of_different_crops():
    method = cases.loaded("cass")
    batch = [
        cases.observation("mug", (300, 200), 32),
        cases.observation("can", (300, 200), 13),
        cases.observation("bowl", (310, 240), 32),
    ]
    together = method.predict(batch, 3)
    for observation, prediction in zip(batch, together, strict=True):
        (alone,) = method.predict([observation], 3)
        (a,), (b,) = alone.hypotheses, prediction.hypotheses
        np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-4)
        np.testing.assert_allclose(a.translation, b.translation, atol=1e-4)
        np.testing.assert_allclose(a.points, b.points, atol=1e-4)


# -- faults that ports have ---------------------------------------------------------------------


def align_corners_flipped(patch):
    real = pspnet._resized
    patch(pspnet, "_resized", lambda x, size, align_corners: real(x, size, not align_corners))


def softmax_without_logarithm(patch):
    patch(torch.nn.LogSoftmax, "forward", lambda self, x: x.softmax(self.dim))


def softmax_over_the_rows(patch):
    patch(torch.nn.LogSoftmax, "forward", lambda self, x: x.log_softmax(2))


def next_category(patch):
    real = heads.PerCategory.of
    patch(heads.PerCategory, "of", lambda self, x, category: real(self, x, (category + 1) % 6))


def pixels_of_the_first_sample(patch):
    real = cass_network.at_pixels
    patch(
        cass_network, "at_pixels", lambda image, choose: real(image, choose[:1].expand_as(choose))
    )


def maximum_instead_of_mean(patch):
    patch(torch.Tensor, "mean", lambda self, dim, keepdim: self.amax(dim, keepdim=keepdim))


def parts_concatenated_backwards(patch):
    real = torch.cat
    patch(torch, "cat", lambda parts, dim: real(list(parts)[::-1], dim))


def encoders_swapped(patch):
    real = cass_network.PoseHead.forward
    patch(
        cass_network.PoseHead,
        "forward",
        lambda self, name, pose, shape, category: real(self, name, shape, pose, category),
    )


def one_code_for_all_points(patch):
    real = cass_network.Folding.forward
    patch(
        cass_network.Folding,
        "forward",
        lambda self, code: real(
            self, code._replace(local=code.local.amax(2, keepdim=True).expand_as(code.local))
        ),
    )


def grid_left_out(patch):
    real = cass_network.Fold.forward
    patch(
        cass_network.Fold,
        "forward",
        lambda self, points, code: real(self, points * (points.shape[-1] == 3), code),
    )


def confidence_without_sigmoid(patch):
    patch(torch.Tensor, "sigmoid", lambda self: self)


def red_first(patch):
    real = cass.network_image
    patch(cass, "network_image", lambda rgb, crop: real(rgb[..., ::-1], crop))


def crop_off_by_one(patch):
    real = cass.crop_around

    def fault(mask):
        crop = real(mask)
        return Crop(crop.row - 1, crop.column, crop.height, crop.width)

    patch(cass, "crop_around", fault)


def axes_of_opencv(patch):
    patch(cass, "FLIP", np.eye(3))


def points_out_of_order(patch):
    patch(
        cass,
        "subset_in_order",
        lambda count, generator, wanted: generator.choice(count, wanted, replace=True),
    )


@pytest.mark.parametrize(
    ("check", "plant"),
    [
        (cases.check_network, align_corners_flipped),
        (cases.check_network, softmax_without_logarithm),
        (cases.check_network, softmax_over_the_rows),
        (cases.check_network, next_category),
        (cases.check_network, pixels_of_the_first_sample),
        (cases.check_network, maximum_instead_of_mean),
        (cases.check_network, parts_concatenated_backwards),
        (cases.check_network, encoders_swapped),
        (cases.check_network, one_code_for_all_points),
        (cases.check_network, grid_left_out),
        (cases.check_network, confidence_without_sigmoid),
        (cases.check_inputs, red_first),
        (cases.check_inputs, crop_off_by_one),
        (cases.check_inputs, axes_of_opencv),
        (cases.check_inputs, points_out_of_order),
    ],
)
def test_planted_fault_is_found(monkeypatch, check, plant):
    cases.assert_found(monkeypatch.setattr, plant, check, "cass")


def scalar_last(quaternion, offset, confidence, shape):
    return quaternion[:, [3, 0, 1, 2]], offset, confidence, shape


def point_not_added(quaternion, offset, confidence, shape):
    return quaternion, 0 * offset, confidence, shape


def least_sure(quaternion, offset, confidence, shape):
    return quaternion, offset, -confidence, shape


@pytest.mark.parametrize("fault", [scalar_last, point_not_added, least_sure, axes_of_opencv])
def test_planted_fault_in_the_answer_is_found(monkeypatch, fault):
    if fault is axes_of_opencv:
        fault(monkeypatch.setattr)
    else:
        real = Cass.interpret
        monkeypatch.setattr(
            Cass,
            "interpret",
            lambda self, inputs, outputs, _: real(self, inputs, fault(*outputs), _),
        )
    with pytest.raises(AssertionError):
        test_answer_from_known_outputs()
