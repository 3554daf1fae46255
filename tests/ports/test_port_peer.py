"""Against the published code itself, where cpas_toolbox is installed and runs on a CPU:
pip install --no-deps cpas_toolbox==1.0.0. SGPA and DPDN need CUDA extensions there."""

import importlib
import sys
from importlib.util import find_spec
from unittest.mock import MagicMock

import cases
import numpy as np
import pytest
import torch

from method_adapters._crop import crop_of
from pytest_cpas.similarity import robust_umeyama, umeyama

pytest.importorskip("cpas_toolbox", reason="pip install --no-deps cpas_toolbox==1.0.0")

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture
def peer(monkeypatch):
    """Import a module of the peer; what it needs for training and plots alone is left out."""
    names = ("cv2", "matplotlib", "matplotlib.pyplot", "tqdm")
    for name in [n for n in names if find_spec(n.partition(".")[0]) is None]:
        monkeypatch.setitem(sys.modules, name, MagicMock())
    return lambda path: importlib.import_module(f"cpas_toolbox.cpas_methods.{path}")


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


def test_crop_rule(peer):
    get_bbox = peer("_spd.spd.utils").get_bbox
    random = np.random.default_rng(0)
    for _ in range(500):
        high = random.integers(1, [480, 640])
        low = np.maximum(0, high - random.integers(1, [480, 640]) // random.integers(1, 8))
        mask = np.zeros((480, 640), bool)
        mask[low[0] : high[0] + 1, low[1] : high[1] + 1] = True
        crop = crop_of(mask)
        window = (crop.row, crop.row + crop.height, crop.column, crop.column + crop.width)
        assert window == tuple(get_bbox((*low, *high)))


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
