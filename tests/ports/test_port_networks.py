import cases
import numpy as np
import parity
import pytest
import recipe
import torch

# the order in which our networks take what the parity files call otherwise
INPUTS = {
    "spd": ("points", "img", "choose", "cat_id", "prior"),
    "crnet": ("points", "img", "choose", "cat_id", "prior"),
    "sgpa": ("points", "img", "choose", "cat_id", "prior"),
    "dpdn": ("pts", "rgb", "choose", "category_label", "prior"),
}
OUTPUTS = {
    "spd": ("assign", "deltas"),
    "crnet": ("assign", "deltas"),
    "sgpa": ("weighted_xyz", "assign", "deltas"),
    "dpdn": ("pred_attention", "pred_qv", "pred_rotation", "pred_translation", "pred_size"),
}
SAMPLERS = {
    "sgpa": {"instance": ("instance_geometry", "points"), "category": ("category_local", "prior")},
    "dpdn": {
        "pts": ("pts_extractor", "pts"),
        "small_pts": ("pts_extractor", "small_pts"),
        "prior": ("prior_extractor", "prior"),
    },
}


def with_published_weights(shared_ports, name):
    """The network, loaded with the recipe's weights by the published names, and its data."""
    data = parity.read(shared_ports, name)
    weights = parity.weights(shared_ports, name, data)
    unused = cases.METHODS[name].unused
    used = {k: v for k, v in weights.items() if not k.startswith(unused or ("-",))}
    assert len(weights) - len(used) == {"sgpa": 16, "dpdn": 2}.get(name, 0)
    network = cases.METHODS[name].network()
    network.load_state_dict(used, strict=True)
    return network.eval(), data


@pytest.mark.parametrize("name", OUTPUTS)
def test_every_output_and_tap_of_the_original(shared_ports, name):
    network, data = with_published_weights(shared_ports, name)
    seen = {}
    parity.tap(network, data, seen)
    inputs = [torch.from_numpy(data[f"input__{key}"]) for key in INPUTS[name]]
    variants = {"": inputs[0]}
    if name == "dpdn":
        variants["small_"] = torch.from_numpy(data["input__small_pts"])
    with torch.inference_mode():
        for prefix, points in variants.items():
            result = network(points, *inputs[1:])
            for key, output in zip(OUTPUTS[name], result, strict=True):
                seen[f"output__{prefix}{key}"] = output
    assert parity.compare(seen, data) == {"spd": 6, "crnet": 8, "sgpa": 7, "dpdn": 22}[name]


@pytest.mark.parametrize(
    ("name", "cloud"), [(name, cloud) for name, clouds in SAMPLERS.items() for cloud in clouds]
)
def test_samples_of_every_level(shared_ports, name, cloud):
    data = parity.read(shared_ports, name)
    path, key = SAMPLERS[name][cloud]
    xyz = torch.from_numpy(data[f"input__{key}"])
    if name == "dpdn" and cloud != "prior":
        xyz = xyz - xyz.mean(1, keepdim=True)
    encoder = cases.METHODS[name].network().get_submodule(path)
    for level, ours in enumerate(encoder.sampling.levels(xyz)):
        np.testing.assert_array_equal(ours.numpy(), data[f"aux__fps_{cloud}_{level}"])
    assert level == 3


def test_recipe_gives_the_published_numbers():
    values = {
        ("psp.feats.conv1.weight", (64, 3, 7, 7)): (0.0228752606, -0.0310760196, 0.159636706),
        ("a.bn.running_var", (16,)): None,
        ("instance_color.0.bias", (64,)): (0.034735091, 0.0240177065, 0.081075646),
        ("psp.up_1.conv.1.weight", (1,)): (0.863838017,),
        ("transformer64.model.encoder.norm.a_2", (64,)): (1.09468794, 0.984804094, 1.04346859),
    }
    for (key, shape), expected in values.items():
        ours = recipe.value(key, shape, True, 0).ravel()
        if expected is None:
            assert ((ours >= 0.5) & (ours <= 1.5)).all()
        else:
            np.testing.assert_array_equal(ours[:3].numpy(), np.float32(expected))


@pytest.mark.parametrize("name", cases.METHODS)
def test_recorded_outputs(name):
    cases.check_network(name)


@pytest.mark.parametrize("name", cases.METHODS)
def test_batch_equals_its_samples(name):
    network, inputs = cases.network(name), cases.network_inputs(name)
    together = cases.outputs_of(network, inputs)
    for i in range(2):
        alone = cases.outputs_of(network, [x[i : i + 1] for x in inputs])
        for a, b in zip(alone, together, strict=True):
            assert cases.relative(a, b[i : i + 1]) <= cases.TOLERANCE


def test_category_chooses_its_own_channels():
    """As if all categories were computed and one of them picked."""
    from method_adapters._networks.heads import CategoryMlp

    torch.manual_seed(0)
    head = CategoryMlp(12, 8, 5, 7)
    local, shared = torch.randn(6, 9, 20), torch.randn(6, 3, 1)
    category = torch.tensor([3, 0, 5, 3, 1, 2])
    ours = head.of(local, shared, category=category)
    everything = torch.nn.Sequential.forward(head, torch.cat([local, shared.expand(-1, -1, 20)], 1))
    picked = everything.reshape(36, 7, 20)[category + 6 * torch.arange(6)]
    torch.testing.assert_close(ours, picked)


def test_attention_as_torch_has_it():
    """SGPA's outputs hardly see it: its structure features are nearly alike."""
    from method_adapters._networks.attention import MultiHeadAttention

    torch.manual_seed(0)
    ours, theirs = MultiHeadAttention(64, 4), torch.nn.MultiheadAttention(64, 4, batch_first=True)
    with torch.no_grad():
        theirs.in_proj_weight.copy_(torch.cat([linear.weight for linear in ours.linears[:3]]))
        theirs.in_proj_bias.copy_(torch.cat([linear.bias for linear in ours.linears[:3]]))
        theirs.out_proj.weight.copy_(ours.linears[3].weight)
        theirs.out_proj.bias.copy_(ours.linears[3].bias)
        query, key, value = torch.randn(2, 30, 64), torch.randn(2, 50, 64), torch.randn(2, 50, 64)
        torch.testing.assert_close(ours(query, key, value), theirs(query, key, value)[0])
