import parity
import pytest
import sdfest_cases as own
import torch
from torch.nn import functional

from method_adapters._networks import sdfest
from method_adapters._sdfest_configuration import EncoderLayer, PointNetLayers


@torch.inference_mode()
def test_every_output_and_tap_of_the_original(shared_ports):
    data = parity.read(shared_ports, "sdfest_nets")
    init, vae = sdfest.InitNet(own.LAYERS["released"]), sdfest.SdfVae(own.LAYERS["released"])
    for network, inventory in ((init, "sdfest_init"), (vae, "sdfest_vae")):
        network.load_state_dict(parity.weights(shared_ports, inventory, data), strict=True)
        network.eval()
    seen = {}
    parity.tap(init, data, seen)
    names = ("init_latent", "init_pos", "init_scale", "init_orient_logits")
    outputs = init(torch.from_numpy(data["input__init_points"]))
    seen.update(zip((f"output__{name}" for name in names), outputs, strict=True))
    seen["output__vae_sdf"] = vae(torch.from_numpy(data["input__vae_latent"]))
    encoded = vae.encoder(torch.from_numpy(data["output__vae_sdf"]))
    names = ("vae_enc_mean", "vae_enc_logvar")
    seen.update(zip((f"output__{name}" for name in names), encoded, strict=True))
    assert parity.compare(seen, data) == 8


def test_recorded_outputs():
    own.check_networks()


@pytest.mark.parametrize("channels", [(1, 1, 1), (3, 2, 3), (5, 4, 2)])
def test_convolution_by_slices_as_torch_has_it(channels):
    torch.manual_seed(0)
    given, made, size = channels
    layer = sdfest._Convolution(given, made, size)
    x = torch.randn(2, given, 5, 6, 7)
    torch.testing.assert_close(layer(x), torch.nn.Conv3d.forward(layer, x))


@pytest.mark.parametrize("sides", [(6, 16), (14, 32), (30, 64), (9, 9), (7, 5)])
def test_resizing_by_matrices_as_torch_has_it(sides):
    torch.manual_seed(0)
    old, new = sides
    x = torch.randn(2, 3, old, old, old)
    expected = functional.interpolate(x, size=(new,) * 3, mode="trilinear", align_corners=False)
    torch.testing.assert_close(sdfest._resized(x, new), expected)


def test_gradient_after_inference():
    """What is kept between calls may not forbid gradients to whoever comes next."""
    sdfest._interpolation.cache_clear()
    _, vae = own.networks("released")
    latent = torch.zeros(1, 8)
    with torch.inference_mode():
        vae(latent)
    latent.requires_grad_()
    vae(latent).sum().backward()
    assert latent.grad.isfinite().all()


def test_point_network_does_not_mind_the_order():
    init, _ = own.networks("released")
    torch.manual_seed(0)
    points = torch.randn(1, 50, 3) / 10
    with torch.inference_mode():
        for a, b in zip(init(points), init(points.flip(1)), strict=True):
            torch.testing.assert_close(a, b)


def test_point_network_written_out():
    """Dense and residual layers by their description, batch norm left out."""
    torch.manual_seed(0)
    layers = PointNetLayers((4, 4, 4, 6), dense=True, residual=True, batch_norm=False)
    network = sdfest._PointNet(layers)
    points = torch.randn(1, 20, 3)
    x = points[0]
    for i, linear in enumerate(network._linear_layers):
        y = torch.relu(x @ linear.weight.T + linear.bias)
        if i < 3:
            y = torch.cat([y, y.max(0).values.expand(20, 4)], 1)
        x = x + y if i in (1, 2) else y
    torch.testing.assert_close(network(points)[0], x.max(0).values)


def test_encoder_of_another_size():
    layers = [EncoderLayer(1, 2, 5, 3), EncoderLayer(2, 3, 3, 1)]
    means, log_variances = sdfest._Encoder(layers, 4)(torch.zeros(2, 1, 64, 64, 64))
    assert means.shape == log_variances.shape == (2, 4)
