"""Against the published code itself, where cpas_toolbox is installed and runs on a CPU:

    pip install --no-deps cpas_toolbox==1.0.0 absl-py "opencv-python-headless<5"

RBP-Pose asks for a GPU in one place, which is taken out. All networks, with those that need CUDA
extensions there, are compared stage by stage in test_port_peer_parity.py.
"""

import asmnet_cases
import cases
import numpy as np
import published
import pytest
import torch

from method_adapters._crop import crop_of
from method_adapters.cass import Cass, crop_around
from method_adapters.rbppose import (
    MEAN_SIZES,
    SYMMETRIC,
    RbpPose,
    resampled_pixels,
    rotation_between,
)
from pytest_cpas.similarity import robust_umeyama, umeyama
from pytest_cpas.types import CATEGORIES

pytest.importorskip("cpas_toolbox", reason="pip install --no-deps cpas_toolbox==1.0.0")

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture
def peer(monkeypatch):
    """Import a module of the peer."""
    return published.importer(monkeypatch)


@pytest.mark.parametrize(
    ("name", "path"), [("spd", "_spd.spd.network"), ("crnet", "_crnet.crnet.network")]
)
def test_networks(peer, name, path):
    published = peer(path).DeformNet(n_cat=6, nv_prior=1024).eval()
    published.load_state_dict(cases.network(name).state_dict(), strict=True)
    inputs = cases.network_inputs(name)
    ours = cases.outputs_of(cases.network(name), inputs)
    with torch.inference_mode():
        theirs = published(*inputs)
    for a, b in zip(ours, theirs, strict=True):
        assert cases.relative(a, b.numpy()) <= cases.TOLERANCE


def boxes(count):
    """First and last row and column of random boxes, and masks of them."""
    random = np.random.default_rng(0)
    for _ in range(count):
        high = random.integers(1, [480, 640])
        low = np.maximum(0, high - random.integers(1, [480, 640]) // random.integers(1, 8))
        mask = np.zeros((480, 640), bool)
        mask[low[0] : high[0] + 1, low[1] : high[1] + 1] = True
        yield (*low.tolist(), *high.tolist()), mask


def limits(crop):
    return crop.row, crop.row + crop.height, crop.column, crop.column + crop.width


def test_crop_rule(peer):
    get_bbox = peer("_spd.spd.utils").get_bbox
    for box, mask in boxes(500):
        assert limits(crop_of(mask)) == tuple(get_bbox(box))


def test_cass(peer):
    published = peer("_cass")
    for _, mask in boxes(500):
        assert limits(crop_around(mask)) == tuple(published.get_bbox(mask))
    ours, theirs = cases.network("cass"), published.CASS(num_points=500, num_obj=6).eval()
    loaded = theirs.load_state_dict(ours.state_dict(), strict=False)
    assert not loaded.unexpected_keys
    assert all(key.startswith(Cass.unused) for key in loaded.missing_keys)
    inputs = cases.network_inputs("cass")
    for sample in range(2):
        points, image, choose, category = given = [x[sample : sample + 1] for x in inputs]
        with torch.inference_mode():
            shape = theirs.foldingnet.encode(image, points, choose)
            pose = theirs.estimator.encode(image, points, choose)
            expected = theirs.estimator.pose(torch.cat([pose, shape], 1), category)
            expected = [*expected, theirs.foldingnet.recon(shape)]
        for a, b in zip(cases.outputs_of(ours, given), expected, strict=True):
            assert cases.relative(a.ravel(), b.numpy().ravel()) <= cases.TOLERANCE


@pytest.fixture
def rbppose_peer(peer, monkeypatch):
    pytest.importorskip("absl", reason="pip install absl-py")
    monkeypatch.setattr(np, "int", int, raising=False)  # of older numpy
    monkeypatch.setattr(torch.Tensor, "cuda", lambda self: self)
    return peer("_rbppose")


def test_rbppose_network(rbppose_peer, monkeypatch):
    """Where both take the first of everything."""
    monkeypatch.setattr(np.random, "choice", lambda count, size, replace: np.arange(size))
    monkeypatch.setattr(torch, "randperm", torch.arange)
    ours, theirs = cases.network("rbppose"), rbppose_peer.SSPN(...).eval()
    loaded = theirs.load_state_dict(ours.state_dict(), strict=False)
    assert not loaded.unexpected_keys
    assert all(key.startswith(RbpPose.unused) for key in loaded.missing_keys)
    given, batch = published.rbppose_inputs()
    with torch.inference_mode():
        expected = theirs(**batch)
    *result, deltas = cases.outputs_of(ours, given)
    prior = cases.priors()[5].astype(np.float32)
    names = ("p_green_R", "p_red_R", "f_green_R", "f_red_R", "Pred_T", "Pred_s", "recon_model")
    for name, output in zip(names, [*result, prior + deltas], strict=True):
        assert cases.relative(output, expected[name].numpy()) <= cases.TOLERANCE, name


def test_rbppose_sizes_and_rotations(rbppose_peer):
    random = np.random.default_rng(0)

    def batch(x):
        return torch.tensor(np.asarray(x, np.float32))[None]

    for category in CATEGORIES:
        size = np.asarray(rbppose_peer.get_mean_shape(category)) / 1000
        np.testing.assert_allclose(size, MEAN_SIZES[category])
        symmetry = rbppose_peer.get_sym_info(category)
        for _ in range(50):
            green, red = random.standard_normal((2, 3))
            green, red = green / np.linalg.norm(green), red / np.linalg.norm(red)
            sure_green, sure_red = random.random(2)
            (expected,) = rbppose_peer.generate_RT(
                [batch(green), batch(red)],
                [batch(sure_green), batch(sure_red)],
                batch([0, 0, 1]),
                mode="vec",
                sym=batch(symmetry),
            )
            known = 0 if category in SYMMETRIC else sure_red
            ours = rotation_between(green, red, sure_green, known)
            np.testing.assert_allclose(ours, expected[:3, :3], atol=1e-5)


def test_rbppose_resampling(rbppose_peer):
    """Of validity and of coordinates; OpenCV 5 resamples one differently from the other."""
    cv2 = pytest.importorskip("cv2")
    if int(cv2.__version__.partition(".")[0]) > 4:
        pytest.skip(f"OpenCV {cv2.__version__}: needs one before 5")
    random = np.random.default_rng(0)
    coordinates = rbppose_peer.get_2d_coord_np(640, 480).transpose(1, 2, 0)
    for box, mask in boxes(40):
        valid = random.random((480, 640)) < 0.5
        top, bottom, left, right = (int(x) for x in rbppose_peer.get_bbox(list(box)))
        middle, side = np.array([0.5 * (left + right), 0.5 * (top + bottom)]), bottom - top
        kept, places = (
            rbppose_peer.crop_resize_by_warp_affine(
                x, middle, side, 256, interpolation=cv2.INTER_NEAREST
            )
            for x in (valid.astype(np.float32), coordinates)
        )
        v, u = resampled_pixels(valid, crop_of(mask))
        np.testing.assert_array_equal(np.stack([u, v], axis=1), places[kept > 0])


def test_similarity(peer):
    align = peer("_spd.spd.align")
    random = np.random.default_rng(0)
    source = random.uniform(-0.5, 0.5, (400, 3))
    turn = np.linalg.qr(random.standard_normal((3, 3)))[0]
    target = 0.2 * source @ (turn * np.linalg.det(turn)).T + [0, 0, 0.8]
    target += 0.004 * random.standard_normal(target.shape)
    ones = np.ones((1, 400))
    *_, theirs = align.estimateSimilarityUmeyama(
        np.vstack([source.T, ones]), np.vstack([target.T, ones])
    )
    ours = umeyama(source, target)
    np.testing.assert_allclose(ours.scale * ours.rotation, theirs[:3, :3], atol=1e-12)
    np.testing.assert_allclose(ours.translation, theirs[:3, 3], atol=1e-12)
    wrong = random.random(400) < 0.3
    target[wrong] += random.uniform(-1, 1, (wrong.sum(), 3))
    scale, rotation, translation, _ = align.estimateSimilarityTransform(source, target)
    ours = robust_umeyama(source, target, random)
    np.testing.assert_allclose(ours.rotation, rotation, atol=1e-3)
    np.testing.assert_allclose(ours.translation, translation, atol=1e-4)
    np.testing.assert_allclose(ours.scale, np.mean(scale), rtol=1e-3)


@pytest.mark.parametrize("category", ["bottle", "can"])
def test_asmnet(peer, category):
    published = peer("_asmnet.ASM_Net.pointnet").ASM_Net(num_points=800, k=4).eval()
    ours = asmnet_cases.network(category)
    published.load_state_dict(ours.state_dict(), strict=True)
    inputs = asmnet_cases.network_inputs()
    with torch.inference_mode():
        theirs = published(*inputs)
    for a, b in zip(cases.outputs_of(ours, inputs), theirs, strict=True):
        assert cases.relative(a, b.numpy()) <= cases.TOLERANCE
