from pathlib import Path

import pytest
import sdfest_cases as own
import torch
from tiny import Tiny

from method_adapters._assets import AssetError
from method_adapters._networks.running import load_weights, read_checkpoint
from method_adapters._networks.sdfest import InitNet, SdfVae
from method_adapters._sdfest_configuration import read_configuration, released
from method_adapters.sdfest import CATEGORIES, Sdfest, configuration
from pytest_cpas.evaluation import MethodRun

yaml = pytest.importorskip("yaml", reason="pip install 'pytest-cpas[sdf]'")


@pytest.fixture
def older(test_data):
    return test_data / "weights" / "sdfest_v1"


def content():
    """As published with the older networks, less what only training uses."""
    convolution = {"kernel_size": 3, "stride": 2}
    layers = []
    for given, made in ((1, 4), (4, 8), (8, 16)):
        sizes = {"in_channels": given, "out_channels": made, **convolution}
        layers += [
            {"type": "torch.nn.Conv3d", "args": sizes},
            {"type": "torch.nn.ReLU", "args": {}},
        ]
    decoder = [
        {"in_size": 8, "in_channels": 16, "out_channels": 16, "kernel_size": 3, "relu": True},
        {"in_size": 16, "in_channels": 16, "out_channels": 8, "kernel_size": 3, "relu": True},
        {"in_size": 32, "in_channels": 8, "out_channels": 4, "kernel_size": 3, "relu": True},
        {"in_size": 64, "in_channels": 4, "out_channels": 1, "kernel_size": 1, "relu": False},
    ]
    return {
        "vae": {
            "decoder": {
                "fc_layers": [{"out": 20}, {"out": 50}, {"out": 8192}],
                "conv_layers": decoder,
            },
            "latent_size": 8,
            "tsdf": False,
            "encoder": {"layer_infos": [*layers, {"type": "torch.nn.Flatten", "args": {}}]},
            "model": "./mug_vae.pt",
        },
        "init": {
            "generated_dataset": {"width": 640},
            "backbone_type": "VanillaPointNet",
            "backbone": {
                "in_size": 3,
                "mlp_out_sizes": [64, 64, 64, 128, 1024],
                "batchnorm": True,
            },
            "head_type": "SDFPoseHead",
            "head": {
                "in_size": 1024,
                "mlp_out_sizes": [512, 256, 128],
                "batchnorm": True,
                "orientation_repr": "discretized",
                "orientation_grid_resolution": 1,
            },
            "model": "~/.sdfest/model_weights/robust_mug_init.pt",
            "normalize_pose": True,
        },
        "category": "cup",
    }


def read(tmp_path, changed):
    path = tmp_path / "mug.yaml"
    path.write_text(yaml.safe_dump(changed))
    return read_configuration(path)


def test_older_configuration(tmp_path):
    found, expected = read(tmp_path, content()), own.LAYERS["older"]
    assert found.weights == ("robust_mug_init.pt", "mug_vae.pt")  # beside the file, wherever else
    assert (found.z_up, found.latent) == (True, 8)
    assert (found.point_net.dense, found.point_net.residual) == (False, False)
    assert list(found.point_net.widths) == list(expected.point_net.widths)
    assert list(found.head.widths) == list(expected.head.widths)
    for key in ("encoder", "linear", "decoder"):
        assert list(getattr(found, key)) == list(getattr(expected, key))


def test_configuration_of_the_release_equals_what_is_built_without(tmp_path):
    given = content()
    del given["init"]["generated_dataset"]
    given["init"]["datasets"] = {"generated_dataset": {"type": "SDFVAEViewDataset"}}
    given["init"]["backbone"] |= {
        "mlp_out_sizes": [128, 128, 128, 128, 1024],
        "dense": True,
        "residual": True,
    }
    given["init"]["model"] = "./mug_init.pt"
    found, expected = read(tmp_path, given), released("mug")
    assert not found.z_up
    for networks in zip(*((InitNet(x), SdfVae(x)) for x in (found, expected)), strict=True):
        shapes = [{k: v.shape for k, v in net.state_dict().items()} for net in networks]
        assert shapes[0] == shapes[1]
    assert found.weights == expected.weights
    assert (found.point_net.dense, found.point_net.residual) == (True, True)


def change(given, path, value):
    *parents, last = path.split(".")
    for key in parents:
        given = given[key]
    given[last] = value


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("init.backbone_type", "PointTransformer", "'PointTransformer'; only 'VanillaPointNet'"),
        ("init.head.orientation_repr", "quaternion", "'quaternion'; only 'discretized'"),
        ("init.normalize_pose", False, "False; only True is built"),
        ("vae.tsdf", 0.1, "0.1; only False"),
        ("init.backbone.in_size", 6, "6; only 3"),
        ("vae.encoder.layer_infos", [{"type": "os.system", "args": {}}], "not a configuration"),
        ("vae.decoder", None, "not a configuration"),
        ("init", {}, "not a configuration of SDFEst as published: KeyError 'backbone'"),
        ("vae.decoder.conv_layers", [{"in_size": 8}], "not a configuration"),
    ],
)
def test_what_is_not_built_is_refused(tmp_path, path, value, words):
    given = content()
    change(given, path, value)
    with pytest.raises(AssetError, match=words):
        read(tmp_path, given)


@pytest.mark.parametrize(
    "text", ["", "[1, 2]", "a: [", "!!python/object/apply:os.system [exit 3]", "\xff\xfe"]
)
def test_other_files_are_refused_and_nothing_is_run(tmp_path, text):
    path = tmp_path / "mug.yaml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(AssetError, match="not a configuration of SDFEst"):
        read_configuration(path)


def test_which_files_are_taken(tmp_path):
    folder = tmp_path / "sdfest"
    folder.mkdir()
    assert configuration(tmp_path, "bowl") == (released("bowl"), None)
    for name in ("mug.yaml", "robust_mug.yaml"):
        given = content()
        given["init"]["model"] = f"{name}.pt"
        (folder / name).write_text(yaml.safe_dump(given))
        layers, file = configuration(tmp_path, "mug")
        assert (layers.weights[0], file) == (f"{name}.pt", folder / name)


def test_identity_covers_what_is_loaded(tmp_path):
    """A change of any file that is read, and of no other, is another set of weights."""
    folder = own.write_assets(tmp_path) / "sdfest"
    released_files = Sdfest.assets_in(tmp_path)
    assert released_files == Sdfest.info.assets
    given = content()
    (folder / "robust_mug.yaml").write_text(yaml.safe_dump(given))
    (folder / "robust_mug_init.pt").write_bytes((folder / "mug_init.pt").read_bytes())
    names = {Path(asset.path).name for asset in Sdfest.assets_in(tmp_path)}
    assert names == {
        *(f"{category}_{part}.pt" for category in ("bottle", "bowl") for part in ("init", "vae")),
        *("robust_mug.yaml", "robust_mug_init.pt", "mug_vae.pt"),
    }

    def identity():
        return MethodRun(Sdfest(), Tiny(None), weights=tmp_path).identity["weights"]

    before = identity()
    (folder / "mug_init.pt").write_bytes(b"not read")
    assert identity() == before
    for name in names:
        content_before = (folder / name).read_bytes()
        (folder / name).write_bytes(content_before + b"\n")
        assert identity() != before, name
        (folder / name).write_bytes(content_before)
    (folder / "robust_mug_init.pt").unlink()
    with pytest.raises(FileNotFoundError):
        identity()


def test_released_form(tmp_path):
    made = Sdfest()
    made.load(own.write_assets(tmp_path), "cpu")
    assert tuple(made._models) == CATEGORIES
    init, vae = own.networks("released")
    for expected, found in ((init, made._models["mug"].init), (vae, made._models["bowl"].vae)):
        for key, value in found.state_dict().items():
            assert torch.equal(value, expected.state_dict()[key])
    (tmp_path / "sdfest" / "bowl_vae.pt").unlink()
    with pytest.raises(FileNotFoundError, match=r"bowl_vae.pt.*releases/download/v0.1.0"):
        Sdfest().load(tmp_path, "cpu")


@pytest.mark.parametrize("kind", ["", "robust_"])
@pytest.mark.parametrize("category", CATEGORIES)
def test_older_files_as_they_are(older, category, kind):
    """Plain tensors by name, some of them from a GPU, with nothing to run."""
    layers = read_configuration(older / f"{kind}{category}.yaml")
    assert layers.z_up
    for network, name in zip((InitNet(layers), SdfVae(layers)), layers.weights, strict=True):
        load_weights(network, older / name)
        assert read_checkpoint(older / name).keys() == network.state_dict().keys()
    assert layers.weights == (f"{kind}{category}_init.pt", f"{category}_vae.pt")
