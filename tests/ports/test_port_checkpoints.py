import pickle
import zipfile

import cases
import numpy as np
import pytest
import torch
from torch import nn

from method_adapters._assets import AssetError, load_priors
from method_adapters._networks.running import Runner, load_weights, read_checkpoint


class Small(nn.Sequential):
    def __init__(self):
        super().__init__(nn.Linear(3, 2), nn.BatchNorm1d(2))


@pytest.fixture
def weights():
    generator = torch.Generator().manual_seed(0)
    return {
        key: torch.rand(value.shape, generator=generator).to(value.dtype)
        for key, value in Small().state_dict().items()
    }


def prefixed(weights):
    return {f"module.{key}": value for key, value in weights.items()}


FORMS = {
    "plain": lambda w: w,
    "parallel": prefixed,
    "model": lambda w: {"model": w, "epoch": 30},
    "state_dict": lambda w: {"state_dict": prefixed(w)},
}


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("form", FORMS)
def test_published_forms(tmp_path, weights, form, old):
    torch.save(FORMS[form](weights), tmp_path / "w.pth", _use_new_zipfile_serialization=not old)
    network = Small()
    load_weights(network, tmp_path / "w.pth")
    for key, value in network.state_dict().items():
        assert torch.equal(value, weights[key])


def test_only_what_is_listed_is_dropped(tmp_path, weights):
    torch.save({**weights, "fc.weight": torch.ones(2), "fcx": torch.ones(1)}, tmp_path / "w.pth")
    with pytest.raises(AssetError, match=r"1 not known \(fcx\)"):
        load_weights(Small(), tmp_path / "w.pth", unused=("fc.",))


def test_counters_may_be_missing(tmp_path, weights):
    del weights["1.num_batches_tracked"]
    torch.save(weights, tmp_path / "w.pth")
    load_weights(Small(), tmp_path / "w.pth")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda w: w.pop("0.bias"), r"1 missing \(0.bias\)"),
        (lambda w: w.update(extra=torch.ones(1)), r"1 not known \(extra\)"),
        (lambda w: w.update({"0.bias": torch.ones(3)}), r"1 of other shape \(0.bias \(3,\) for"),
        (lambda w: w.update(epoch=3), "epoch are no tensors"),
        (lambda w: w.clear(), "expected named tensors"),
    ],
)
def test_keys_that_do_not_fit(tmp_path, weights, change, words):
    change(weights)
    torch.save(weights, tmp_path / "w.pth")
    network = Small()
    before = {k: v.clone() for k, v in network.state_dict().items()}
    with pytest.raises(AssetError, match=words):
        load_weights(network, tmp_path / "w.pth")
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())


def test_checkpoint_of_another_method(tmp_path):
    # without the image network, which is all the same
    weights = cases.network("spd").state_dict()
    small = {k: v for k, v in weights.items() if not k.startswith("psp.")}
    torch.save(small, tmp_path / "real.pth")
    with pytest.raises(AssetError, match=r"not a checkpoint of SgpaNet.*Is it another method's"):
        load_weights(cases.METHODS["sgpa"].network(), tmp_path / "real.pth")


class Evil:
    def __reduce__(self):
        return (eval, ("1/0",))


@pytest.mark.parametrize("protocol", [None, 2, 4])
def test_code_is_not_run(tmp_path, weights, protocol):
    path = tmp_path / "w.pth"
    if protocol is None:
        torch.save({**weights, "evil": Evil()}, path)
    else:
        path.write_bytes(pickle.dumps(Evil(), protocol))
    with pytest.raises(AssetError, match=r"cannot be read as tensors alone"):
        read_checkpoint(path)


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.95])
def test_torn_file(tmp_path, weights, share, old):
    path = tmp_path / "w.pth"
    torch.save(weights, path, _use_new_zipfile_serialization=not old)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(AssetError, match="damaged, torn"):
        read_checkpoint(path)


def test_file_torn_anywhere(tmp_path, weights):
    whole, torn = tmp_path / "whole.pth", tmp_path / "torn.pth"
    torch.save(weights, whole, _use_new_zipfile_serialization=False)
    content = whole.read_bytes()
    for size in range(len(content)):
        torn.write_bytes(content[:size])
        with pytest.raises(AssetError, match="damaged, torn"):
            read_checkpoint(torn)


@pytest.mark.parametrize(
    "content", [b"<!DOCTYPE html><title>Quota exceeded</title>", b"version https://git-lfs"]
)
def test_web_page_instead_of_weights(tmp_path, content):
    (tmp_path / "w.pth").write_bytes(content)
    with pytest.raises(AssetError, match="a web page"):
        read_checkpoint(tmp_path / "w.pth")


def test_archive_that_was_not_unpacked(tmp_path, weights):
    with zipfile.ZipFile(tmp_path / "w.pth", "w") as archive:
        archive.writestr("deformnet_eval/real/model_50.pth", b"...")
    with pytest.raises(AssetError, match="cannot be read as tensors"):
        read_checkpoint(tmp_path / "w.pth")


@pytest.mark.parametrize("name", cases.METHODS)
def test_missing_weights_name_path_address_and_licence(tmp_path, name):
    method = cases.METHODS[name]()
    asset = method.info.assets[0]
    for folder in (tmp_path, None):
        with pytest.raises(FileNotFoundError) as caught:
            method.load(folder, "cpu")
        words = [asset.path, asset.url, asset.licence, "--cpas-weights"]
        words += [str(folder / asset.path)] if folder else []
        assert all(word in str(caught.value) for word in words)


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((6, 1024, 3)),
        np.full((6, 1024, 3), np.nan),
        cases.priors()[:5],
        1000 * cases.priors(),
        np.zeros((6, 1024, 3), int),
        np.array([object()]),
    ],
    ids=["zeros", "nan", "five", "mm", "int", "object"],
)
def test_priors_that_are_none(tmp_path, wrong):
    np.save(tmp_path / "mean_points_emb.npy", wrong)
    with pytest.raises(AssetError, match=r"3d183e58e2353e77c643d236ba7e575c"):
        load_priors(tmp_path)


def test_published_priors(test_data):
    priors = load_priors(test_data / "priors")
    assert priors.shape == (6, 1024, 3)
    middle = (priors[5, :, 0].max() + priors[5, :, 0].min()) / 2
    from method_adapters._prior_method import MUG_OFFSET

    assert middle == pytest.approx(MUG_OFFSET, abs=1e-7)


def test_asset_path_of_a_folder_is_none(tmp_path):
    asset = cases.METHODS["spd"].info.assets[1]
    (tmp_path / asset.path).mkdir()
    with pytest.raises(FileNotFoundError):
        asset.locate(tmp_path)


@pytest.mark.parametrize("device", ["tpu9", "cuda:99", ""])
def test_device_that_is_not_there(device):
    with pytest.raises(ValueError, match=r"device '"):
        Runner(Small(), device)
