"""What a GPU does otherwise than a CPU, without one: nothing is looked at where it would be waited
for, graphs replay with other inputs, and objects that are refined together do not mix."""

import asmnet_cases
import cases
import device_cases
import numpy as np
import plausible
import pytest
import torch

from method_adapters import _sdfest_together, sdfest
from method_adapters._networks import graphs, icaps, pointnet2, sgpa
from method_adapters._networks.running import Runner
from method_adapters._networks.sdfest import InitNet, SdfVae
from method_adapters._sdfest_configuration import released
from method_adapters._sdfest_estimation import first_estimate, refine
from method_adapters._sdfest_together import Together
from method_adapters._so3_grid import rotation_grid
from pytest_cpas.types import Pose


@pytest.fixture
def device(monkeypatch):
    with device_cases.as_on_a_device(monkeypatch.setattr):
        yield


def given(name):
    """Two batches of one kind."""
    if name == "asmnet":
        points = np.random.RandomState(0).standard_normal((2, 3, 800)).astype(np.float32)
        return [points], [points[::-1].copy()]
    first = [x.numpy() for x in cases.network_inputs(name)]
    return first, [x[::-1].copy() for x in first]


#: The others are made of the same parts.
QUICK = ("sgpa", "rbppose", "asmnet")
NAMES = [
    name if name in QUICK else pytest.param(name, marks=pytest.mark.minutes)
    for name in (*cases.METHODS, "asmnet")
]


@pytest.mark.parametrize("name", NAMES)
def test_networks_are_replayed(name, monkeypatch):
    network = asmnet_cases.network("mug") if name == "asmnet" else cases.network(name)
    first, second = given(name)
    run = Runner(network, "cpu")
    expected = [run(*batch) for batch in (first, second)]
    with device_cases.as_on_a_device(monkeypatch.setattr):
        run = Runner(network, "cpu")
        found = [run(*batch) for batch in (second, first, second)]
    assert [x is not None for x in run._graphs._captured.values()] == [True]
    for ours, theirs in zip(found, (expected * 2)[1:], strict=True):
        for x, y in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(x, y)


def test_kinds_that_come_once_are_not_captured(device, monkeypatch):
    monkeypatch.setattr(graphs, "MOST", 2)
    double = graphs.Graphs(lambda x: (2 * x,))
    for _ in range(3):
        for size in (1, 2, 3, 4):
            (found,) = double(torch.full((size,), 3.0))
            assert found.tolist() == [6.0] * size
    kept = [key[0][0][0] for key, value in double._captured.items() if value is not None]
    assert kept == [1, 2]


def test_graph_is_of_one_way_of_computing(device):
    double = graphs.Graphs(lambda x: (2 * x,))
    for _ in range(2):
        double(torch.ones(1))
    torch.use_deterministic_algorithms(True)
    try:
        double(torch.ones(1))
    finally:
        torch.use_deterministic_algorithms(False)
    assert [x is not None for x in double._captured.values()] == [True, False]


def test_results_outlive_the_next_replay(device):
    double = graphs.Graphs(lambda x: (2 * x,))
    found = [double(torch.tensor([float(i)]))[0] for i in range(4)]
    assert [x.item() for x in found] == [0, 2, 4, 6]


@pytest.mark.parametrize("look", [torch.Tensor.item, torch.nonzero, lambda x: x[x > 0]])
def test_look_at_a_value_is_found(device, look):
    looking = graphs.Graphs(lambda x: (look(x) * x,))
    looking(torch.ones(1))
    with pytest.raises(RuntimeError, match="not permitted when stream is capturing"):
        looking(torch.ones(1))


def test_neighbours_at_once_are_those_row_by_row():
    random = np.random.RandomState(2)
    for n, count, radius in ((60, 8, 0.5), (7, 16, 0.3), (200, 3, 0.001), (50, 50, 9.0)):
        cloud = torch.from_numpy(random.randint(0, 6, (2, n, 3)).astype(np.float32) * 0.25)
        squared = pointnet2.squared_distances(cloud[:, ::2] + 0.1, cloud)
        rows, limit = squared.flatten(0, 1), radius**2
        for ours, theirs in zip(
            pointnet2._first_at_once(rows, limit, count),
            pointnet2._first(rows, limit, count),
            strict=True,
        ):
            enough = theirs.clamp(max=count) if theirs.ndim == 1 else theirs
            assert torch.equal(ours.clamp(max=count) if ours.ndim == 1 else ours, enough)


@pytest.mark.minutes
def test_latent_net_is_replayed(device):
    network = icaps.LatentNet().eval()
    clouds = torch.rand((2, 1, icaps.POINT_COUNT, 3), generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        expected = [network(cloud)[0] for cloud in clouds]
        run = graphs.Graphs(network)
        found = [run(clouds[i])[0] for i in (0, 1, 1, 0)]
    for i, ours in zip((0, 1, 1, 0), found, strict=True):
        assert torch.equal(ours, expected[i])


def test_two_clouds_sampled_together_are_as_apart():
    made = sgpa._encoder()
    clouds = torch.rand((2, 3, 1024, 3), generator=torch.Generator().manual_seed(0))
    together = made.sampling.levels(torch.cat(list(clouds)))
    for half, cloud in enumerate(clouds):
        for index, alone in zip(together, made.sampling.levels(cloud), strict=True):
            assert torch.equal(index.chunk(2)[half], alone)


# -- SDFEst -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def method():
    init, vae = InitNet(released("mug")), SdfVae(released("mug"))
    for network, state in zip((init, vae), plausible.sdfest(), strict=True):
        network.load_state_dict(state)
        network.eval().requires_grad_(False)
    made = sdfest.Sdfest()
    made._device = torch.device("cpu")
    model = sdfest.Model(init, vae, rotation_grid(1), np.eye(3))
    made._models = dict.fromkeys(made.info.categories, model)
    made.iterations = 4
    return made


@pytest.fixture(scope="module")
def seen():
    """Of three sizes; the last takes places of its own."""
    places = (("mug", (300, 200), 12), ("mug", (200, 300), 11), ("bowl", (400, 100), 24))
    return [cases.observation(*place) for place in places]


def near(a, b, within):
    for x, y in zip(a.hypotheses, b.hypotheses, strict=True):
        np.testing.assert_allclose(x.rotation, y.rotation, rtol=0, atol=within)
        np.testing.assert_allclose(x.translation, y.translation, rtol=0, atol=within)
        np.testing.assert_allclose(x.extents, y.extents, rtol=0, atol=within)


@pytest.mark.parametrize("gradient", ["correct", "published"])
def test_refined_together_as_alone(method, seen, monkeypatch, gradient):
    monkeypatch.setattr(_sdfest_together, "PLACES", 2)
    monkeypatch.setattr(method, "gradient", gradient)
    monkeypatch.setattr(method, "_together", {})
    expected = method.predict(seen, 0)
    with device_cases.as_on_a_device(monkeypatch.setattr):
        found = method.predict(seen, 0)
        alone = [method.predict(seen[:1], 0)[0], method.predict(seen[2:], 0)[0]]
        moved = method.predict(seen[1::-1], 0)
    for ours, theirs in zip(found, expected, strict=True):
        near(ours, theirs, 2e-5)
    # whoever else is there
    near(alone[0], found[0], 0)
    near(alone[1], found[2], 0)
    # in another place, sums may be rounded in another way
    near(moved[0], found[1], 1e-6)
    near(moved[1], found[0], 1e-6)
    assert sum(len(together._places) for together in method._together.values()) == 2


def start_and_view(method, seen):
    model = method._models["mug"]
    view = method._view(seen, Pose(np.eye(3), np.zeros(3)))
    return model, first_estimate(model.init, model.grid, view), view


def test_object_with_a_ray_that_does_not_end_is_refined_alone(method, seen, device, monkeypatch):
    monkeypatch.setattr(_sdfest_together, "PLACES", 2)
    monkeypatch.setattr(_sdfest_together, "TRACED", 1)
    monkeypatch.setattr(method, "_together", {})
    model, start, view = start_and_view(method, seen[0])
    assert Together(model.vae, "correct")([start], [view], 1) == [None]
    alone = refine(model.vae, start, [view], method.iterations, "correct")
    (found,) = method._refined(model, [start], [[view]])
    for ours, theirs in zip(found, alone, strict=True):
        assert torch.equal(ours, theirs)


def test_estimate_that_is_no_number_harms_no_other(method, seen, device, monkeypatch):
    monkeypatch.setattr(_sdfest_together, "PLACES", 2)
    model, start, view = start_and_view(method, seen[0])
    lost = start._replace(position=torch.full((3,), torch.nan))
    together = Together(model.vae, "correct")
    (alone,) = together([start], [view], 2)
    found = together([start, lost], [view, view], 2)
    assert found[1].position.isnan().all()
    for ours, theirs in zip(found[0], alone, strict=True):
        assert torch.equal(ours, theirs)
