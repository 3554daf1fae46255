import json

import cases
import numpy as np
import pytest
import recipe
import torch

from method_adapters._networks.sdfest import InitNet, SdfVae
from method_adapters._sdfest_configuration import released

NETWORKS = {"sdfest_init": InitNet, "sdfest_vae": SdfVae}


@pytest.fixture
def published(shared_ports):
    with np.load(shared_ports / "parity" / "sdfest_nets.npz") as file:
        return dict(file)


def with_published_weights(shared_ports, published, name):
    """The release's network with the recipe's weights by the published names."""
    inventory = json.loads((shared_ports / "inventory" / f"{name}.json").read_text())
    weights = recipe.state_dict(inventory, int(published["weights_seed"]))
    assert recipe.sha256(weights) == str(published[f"weights_sha256__{name}"])
    network = NETWORKS[name](released("mug"))
    network.load_state_dict(weights, strict=True)
    return network.eval()


def check(ours, expected):
    ours = ours.numpy()
    assert ours.shape == expected.shape
    assert cases.relative(ours, expected) <= cases.TOLERANCE
    middle = expected.mean()  # what is nearly constant must not hide behind its mean
    if expected.size > 1:
        assert cases.relative(ours - middle, expected - middle) <= 1e-4


@torch.inference_mode()
def test_initialisation_network(shared_ports, published):
    network = with_published_weights(shared_ports, published, "sdfest_init")
    points = torch.from_numpy(published["input__init_points"])
    features = []
    network._backbone.register_forward_hook(lambda module, given, result: features.append(result))
    outputs = network(points)
    check(features[0], published["tap___backbone__call0__out0__sub"].reshape(1, -1))
    for key, output in zip(("latent", "pos", "scale", "orient_logits"), outputs, strict=True):
        check(output, published[f"output__init_{key}"])


@torch.inference_mode()
def test_auto_encoder(shared_ports, published):
    network = with_published_weights(shared_ports, published, "sdfest_vae")
    check(network(torch.from_numpy(published["input__vae_latent"])), published["output__vae_sdf"])
    means, log_variances = network.encoder(torch.from_numpy(published["output__vae_sdf"]))
    check(means, published["output__vae_enc_mean"])
    check(log_variances, published["output__vae_enc_logvar"])
