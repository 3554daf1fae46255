"""The ports with seeded weights as they are traced: against small recorded traces of themselves,
and with one planted fault at a time.

``python tests/ports/parity_cases.py record [NAME ...]`` records the traces of ``traces/``, with the
spread that was measured: only ever from code that agrees with the original networks.
"""

import copy
import functools
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import asmnet_cases
import cases
import icaps_cases
import numpy as np
import plausible
import sdfest_cases
import torch
from torch import nn

from method_adapters import _prior_method, cass, icaps, rbppose, sdfest
from method_adapters._networks import gcn3d, icaps_matching, pointnet2, pspnet
from method_adapters._networks import sdfest as sdfest_networks
from method_adapters._networks.icaps_refinement import Refiner
from method_adapters._particle_filter import View
from method_adapters._so3_grid import rotation_grid
from pytest_cpas.traces.files import Header, TracedSample, read_sample, samples_in, write_sample
from pytest_cpas.traces.recording import Trace, record
from pytest_cpas.traces.spread import with_spread
from pytest_cpas.types import Camera, Method, Observation

FOLDER = Path(__file__).with_name("traces")
#: Bytes of the arrays of a recorded trace.
MOST = 16_000
#: Dots of a name that is recorded.
DEEPEST = 4
NAMES = (*cases.METHODS, "asmnet", "icaps", "sdfest")
SEED = 3


class _Shrunk(nn.Module):
    """iCaps' stand-in for the encoder, as a part of a network."""

    def __init__(self, encode: Callable[[torch.Tensor], torch.Tensor]) -> None:
        super().__init__()
        self._encode = encode

    def forward(self, crops: torch.Tensor) -> torch.Tensor:
        return self._encode(crops)


def _icaps() -> icaps.ICaps:
    """With the object's decoder, and LatentNet with the recipe's weights."""
    made = icaps_cases.method()
    matcher = icaps_matching.Matcher.__new__(icaps_matching.Matcher)
    matcher._encoder = _Shrunk(icaps_cases.matcher()._encoder)
    matcher.codebook = icaps_cases.matcher().codebook
    latent_net = icaps_cases.network("icaps_latentnet")
    refiner = Refiner(latent_net, icaps_cases.decoder_with_code(), icaps.RATIOS["mug"])
    made._networks = dict.fromkeys(made._networks, (matcher, refiner))
    return made


def _sdfest() -> sdfest.Sdfest:
    """With an ellipsoid where the points are, and a few steps of refinement."""
    made = sdfest_cases.method()
    made.iterations = 3
    networks = copy.deepcopy(sdfest_cases.networks("released"))
    for network, weights in zip(networks, plausible.sdfest(), strict=True):
        network.load_state_dict(weights)
    model = sdfest.Model(*networks, rotation_grid(1), np.eye(3))
    made._models = dict.fromkeys(made._models, model)
    return made


@functools.cache
def method(name: str) -> Method:
    """A port, loaded."""
    own = {"asmnet": asmnet_cases.method, "icaps": _icaps, "sdfest": _sdfest}
    return own[name]() if name in own else cases.loaded(name)


@functools.cache
def observation(name: str) -> Observation:
    """What it sees."""
    if name == "sdfest":
        return sdfest_cases.observation()
    if name == "icaps":
        turn = icaps_cases.rotations()[7].as_matrix()
        return icaps_cases.render(turn, np.array([0.05, -0.03, 0.7]), 0.08)
    return cases.observations(large=name == "rbppose")[0]


def trace(name: str) -> Trace:
    """A prediction as the code is now."""
    return record(method(name), [observation(name)], SEED)


@functools.cache
def reference(name: str) -> Trace:
    """The same before anything is broken; what is cached of networks is made."""
    return trace(name)


def recorded(name: str) -> TracedSample:
    """From its files."""
    return read_sample(samples_in(FOLDER / name)["case"])


def record_all(names: Sequence[str]) -> None:
    for name in names:
        made, told = with_spread(method(name), observation(name), SEED, trace(name))
        header = Header(
            method=name,
            dataset="cases",
            sample="case",
            category=observation(name).category,
            seed=SEED,
            most=MOST,
            spread_of=told,
        )
        # a part of a part of a part is guarded by what it is a part of
        kept = [v for v in made.values if not v.is_open and v.name.count(".") <= DEEPEST]
        size = write_sample(FOLDER / name, header, replace(made, values=kept))
        print(f"{name}: {len(made.values)} values, {size} bytes, {dict(told)}")


# -- faults -------------------------------------------------------------------------------------

Patch = Callable[..., None]


def network(name: str) -> nn.Module:
    if name == "asmnet":
        return asmnet_cases.network(observation(name).category)
    return cases.network(name)


def aligned_corners(patch: Patch) -> None:
    real = pspnet._resized
    patch(pspnet, "_resized", lambda x, size, align_corners: real(x, size, not align_corners))


def aligned_corners_of_volumes(patch: Patch) -> None:
    def fault(old: int, new: int, *like: object) -> torch.Tensor:
        nodes = torch.eye(old)[None]
        resized = nn.functional.interpolate(nodes, size=new, mode="linear", align_corners=True)
        return resized[0].T.to(*reversed(like))

    patch(sdfest_networks, "_interpolation", fault)


def training_mode(layer: Callable[[], nn.Module]) -> Callable[[Patch], None]:
    """A batch norm that takes the mean and deviation of what it gets."""

    def plant(patch: Patch) -> None:
        patch(layer(), "training", True)
        patch(layer(), "momentum", 0.0)  # and keeps what it has

    return plant


def half_precision(layer: Callable[[], nn.Module]) -> Callable[[Patch], None]:
    def plant(patch: Patch) -> None:
        half = copy.deepcopy(layer()).half()
        patch(layer(), "forward", lambda x: half(x.half()).float())

    return plant


def other_axis(layer: Callable[[], nn.Module]) -> Callable[[Patch], None]:
    def plant(patch: Patch) -> None:
        patch(layer(), "dim", 3 - layer().dim)

    return plant


def neighbours_backwards(patch: Patch) -> None:
    real = pointnet2.ball_query
    patch(pointnet2, "ball_query", lambda *given: real(*given).flip(-1))


def neighbours_of_graphs_backwards(patch: Patch) -> None:
    real = gcn3d.neighbours
    patch(gcn3d, "neighbours", lambda xyz, count: real(xyz, count).flip(-1))


def prior_not_added(module, function: str) -> Callable[[Patch], None]:
    def plant(patch: Patch) -> None:
        real = getattr(module, function)

        def fault(*given):
            place = next(i for i, part in enumerate(given) if hasattr(part, "prior"))
            inputs = given[place]._replace(prior=np.zeros_like(given[place].prior))
            return real(*given[:place], inputs, *given[place + 1 :])

        patch(module, function, fault)

    return plant


def crop_off_by_one(module, function: str) -> Callable[[Patch], None]:
    def plant(patch: Patch) -> None:
        real = getattr(module, function)

        def fault(mask):
            crop = real(mask)
            return replace(crop, row=crop.row - 1)

        patch(module, function, fault)

    return plant


def view_off_by_one(patch: Patch) -> None:
    real = View.of.__func__

    def fault(cls, seen):
        view = real(cls, seen)
        return replace(view, corner=view.corner + np.array([1, 0]))

    patch(View, "of", classmethod(fault))


def other_colours(module) -> Callable[[Patch], None]:
    def plant(patch: Patch) -> None:
        real = module.network_image
        patch(module, "network_image", lambda rgb, crop: real(rgb[..., ::-1], crop))

    return plant


def focal_length(module) -> Callable[[Patch], None]:
    def plant(patch: Patch) -> None:
        real = module.back_project
        patch(
            module,
            "back_project",
            lambda v, u, depth, camera: real(v, u, depth, replace(camera, fx=1.02 * camera.fx)),
        )

    return plant


def focal_length_of_cameras(patch: Patch) -> None:
    real = Camera.back_project
    patch(
        Camera,
        "back_project",
        lambda camera, depth, mask: real(replace(camera, fx=1.02 * camera.fx), depth, mask),
    )


def other_seed(patch: Patch) -> None:
    real = np.random.default_rng
    patch(np.random, "default_rng", lambda seed: real(seed + 1))


def codes_normalised_across_crops(patch: Patch) -> None:
    real = nn.functional.normalize
    patch(icaps_matching.F, "normalize", lambda x, dim: real(x, dim=1 - dim))


def axes_not_changed(patch: Patch) -> None:
    patch(icaps, "NOCS_FROM_SHAPENET", np.eye(3))


def scalar_first(patch: Patch) -> None:
    made = method("sdfest")
    turned = {category: _turned(model) for category, model in made._models.items()}
    patch(made, "_models", turned)


def _turned(model: sdfest.Model) -> sdfest.Model:
    return replace(model, grid=np.roll(model.grid, 1, axis=1))


def _part(name: str, path: str) -> Callable[[], nn.Module]:
    return lambda: network(name).get_submodule(path)


def _of_init(path: str) -> Callable[[], nn.Module]:
    return lambda: method("sdfest")._models["bowl"].init.get_submodule(path)


_FINAL = "estimator.encoding.cnn.model.final.1"
_LAYER = "transformer64.model.encoder.layers.0.feed_forward.w_1"
_NORM = "rgb_extractor.model.feats.bn1"

#: Of each family: the port, the fault, and the value at which it parts from itself.
FAULTS: dict[str, list[tuple[str, str, Callable[[Patch], None], str]]] = {
    "prior": [
        ("spd", "align_corners", aligned_corners, "network.resized"),
        ("dpdn", "batch norm", training_mode(_part("dpdn", _NORM)), f"network.{_NORM}"),
        (
            "sgpa",
            "softmax axis",
            other_axis(_part("sgpa", "conv1d_stpts_prob.3")),
            "network.conv1d_stpts_prob.3",
        ),
        ("sgpa", "neighbour order", neighbours_backwards, "network.neighbours"),
        (
            "crnet",
            "prior not added",
            prior_not_added(_prior_method, "pose_from_coordinates"),
            "shape",
        ),
        ("spd", "crop", crop_off_by_one(_prior_method, "crop_of"), "crop"),
        ("crnet", "BGR for RGB", other_colours(_prior_method), "input.image"),
        ("dpdn", "focal length", focal_length(_prior_method), "input.points"),
        ("crnet", "float16", half_precision(_part("crnet", _LAYER)), f"network.{_LAYER}"),
        ("sgpa", "seed", other_seed, "picked"),
    ],
    "direct": [
        ("cass", "align_corners", aligned_corners, "network.resized"),
        ("asmnet", "batch norm", training_mode(_part("asmnet", "feat.bn2")), "network.feat.bn2"),
        (
            "cass",
            "softmax axis",
            other_axis(_part("cass", _FINAL)),
            f"network.{_FINAL}",
        ),
        ("rbppose", "neighbour order", neighbours_of_graphs_backwards, "network.neighbours"),
        ("rbppose", "prior not added", prior_not_added(rbppose.RbpPose, "interpret"), "shape"),
        ("cass", "crop", crop_off_by_one(cass, "crop_around"), "crop"),
        ("cass", "RGB for BGR", other_colours(cass), "input.image"),
        ("rbppose", "focal length", focal_length(rbppose), "input.points"),
        ("asmnet", "float16", half_precision(_part("asmnet", "feat.conv2")), "network.feat.conv2"),
        ("asmnet", "seed", other_seed, "picked"),
    ],
    # these see no colours, and have no softmax and no prior
    "optimising": [
        ("sdfest", "align_corners", aligned_corners_of_volumes, "vae.decoder._conv_layers.1"),
        (
            "sdfest",
            "batch norm",
            training_mode(_of_init("_backbone._bn_layers.0")),
            "network._backbone._bn_layers.0",
        ),
        ("icaps", "axis of the norm", codes_normalised_across_crops, "codes"),
        ("icaps", "neighbour order", neighbours_backwards, "network.neighbours"),
        ("icaps", "axes not changed", axes_not_changed, "coordinates"),
        ("icaps", "crop", view_off_by_one, "input.corner"),
        ("sdfest", "quaternion order", scalar_first, "first.quaternion"),
        ("sdfest", "focal length", focal_length_of_cameras, "input.directions"),
        (
            "sdfest",
            "float16",
            half_precision(_of_init("_backbone._linear_layers.1")),
            "network._backbone._linear_layers.1",
        ),
        ("icaps", "seed", other_seed, "spread"),
    ],
}

if __name__ == "__main__":
    if sys.argv[1:2] != ["record"]:
        sys.exit(__doc__)
    record_all(sys.argv[2:] or NAMES)
