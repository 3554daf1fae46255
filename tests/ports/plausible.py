"""Seeded random weights with which the ports answer with objects of a likely size where the depth
is, so that the contract checks apply to them.

``python tests/ports/plausible.py DIR`` writes a folder for ``--cpas-weights`` with those of SPD,
CR-Net, SGPA, DPDN, CASS, ASM-Net, RBP-Pose and SDFEst; with it, golden/ beside this file has the
golden tables of

    pytest --cpas-method NAME --cpas-dataset synthetic-handheld \\
        --cpas-weights=DIR --cpas-golden tests/ports/golden --cpas-require-golden

The weights are the recipe's; some of the channels are set to carry coordinates through the network,
and layers that end in something metric are turned down. ASM-Net's are the recipe's as they are:
those of can estimate negative scales. Answers are likely, not right: the tables show which samples
have an answer, and a run names those whose errors moved; what the networks say is guarded by
recorded/.
"""

import sys
from collections.abc import Iterable
from pathlib import Path

import asmnet_cases
import cases
import numpy as np
import plausible_paths
import sdfest_cases
import torch
from plausible_paths import State

from method_adapters._assets import MEAN_SHAPES
from method_adapters._prior_method import MUG_OFFSET
from method_adapters.rbppose import MEAN_SIZES
from pytest_cpas.types import CATEGORIES

#: Of what a layer says, where that is metric.
QUIET = 0.01


def priors() -> np.ndarray:
    """Ellipsoids with a diagonal of 1, of the categories' average proportions."""
    shapes = np.random.RandomState(5).standard_normal((6, 1024, 3))
    shapes /= np.linalg.norm(shapes, axis=2, keepdims=True)
    low, high = shapes.min(axis=1, keepdims=True), shapes.max(axis=1, keepdims=True)
    sizes = np.array([MEAN_SIZES[category] for category in CATEGORIES])
    sizes /= np.linalg.norm(sizes, axis=1, keepdims=True)
    shapes = ((shapes - low) / (high - low) - 0.5) * sizes[:, None]
    shapes[CATEGORIES.index("mug"), :, 0] += MUG_OFFSET
    return shapes.round(6)  # the same on every machine: a golden table knows its weights


def weights(name: str) -> State:
    """The recipe's, some of them changed."""
    state = {key: value.clone() for key, value in cases.network(name).state_dict().items()}
    CHANGES[name](state)
    return state


def turn_down(state: State, *layers: str) -> None:
    for layer in layers:
        for part in ("weight", "bias"):
            state[f"{layer}.{part}"] *= QUIET


def spd(state: State) -> None:
    plausible_paths.spd(state, priors())
    turn_down(state, "deformation.4")


def sgpa(state: State) -> None:
    plausible_paths.sgpa(state, priors())
    turn_down(state, "deformation.4")


def crnet(state: State) -> None:
    plausible_paths.crnet(state, priors())
    turn_down(state, *(f"deformation{stage}.4" for stage in ("", "0", "1")))


def dpdn(state: State) -> None:
    """Of 10 cm in each axis, at the middle of the points; the shape fills that."""
    estimator, last = "posenet.estimator", "posenet.deformer.deform_mlp2.4"
    turn_down(
        state,
        "posenet.deformer.deform_mlp1.7",
        f"{estimator}.translation_estimator.4",
        f"{estimator}.size_estimator.4",
        last,
    )
    state[f"{estimator}.size_estimator.4.bias"] += 0.1
    plausible_paths.dpdn(state)
    network = cases.METHODS["dpdn"].network().eval()
    network.load_state_dict(state)
    points, image, choose, *_ = (
        x[:1].expand(6, *x.shape[1:]) for x in cases.network_inputs("dpdn")
    )
    prior = torch.from_numpy(priors().astype(np.float32))
    shapes = cases.outputs_of(network, [points, image, choose, torch.arange(6), prior])[1]
    # rounded as no machine's order of sums can change
    middle, size = ((shapes.max(1) + shapes.min(1)) / 2).round(2), np.ptp(shapes, axis=1).round(2)
    scale = torch.from_numpy((1 / np.sqrt(3) / size).ravel().astype(np.float32))
    state[f"{last}.weight"] *= scale[:, None, None]
    state[f"{last}.bias"] = (state[f"{last}.bias"] - torch.from_numpy(middle.ravel())) * scale


def cass(state: State) -> None:
    """An average camera at the surest point."""
    turn_down(
        state,
        "estimator.posing.conv4_t",
        "foldingnet.reconstructing.Fold1.mlp.4",
        "foldingnet.reconstructing.Fold2.mlp.4",
    )
    camera = CATEGORIES.index("camera")
    diagonal = np.linalg.norm(MEAN_SIZES["camera"]).round(6)
    plausible_paths.cass(state, priors()[camera, :500] * diagonal)


def rbppose(state: State) -> None:
    """Little is added to the average size, the middle and the prior."""
    turn_down(state, "posenet.ts.conv4", "posenet.deformation.4")


def sdfest() -> list[State]:
    """Of both networks: an ellipsoid of about 10 cm at the middle of the points."""
    init, vae = (
        {key: value.clone() for key, value in network.state_dict().items()}
        for network in sdfest_cases.networks("released")
    )
    for part in ("weight", "bias"):  # position and half-width
        init[f"_head._final_layer.{part}"][8:12] *= QUIET
    init["_head._final_layer.bias"][11] += 0.08
    turn_down(vae, "decoder._conv_layers.3")
    plausible_paths.sdfest(vae)
    return [init, vae]


CHANGES = {
    "spd": spd,
    "crnet": crnet,
    "sgpa": sgpa,
    "dpdn": dpdn,
    "cass": cass,
    "rbppose": rbppose,
}
NAMES = (*CHANGES, "asmnet", "sdfest")


def write_assets(folder: Path, names: Iterable[str] = NAMES) -> None:
    """Weights, and the priors; never into a folder that a link leads to, which is another's."""
    folder.mkdir(parents=True, exist_ok=True)
    if links := [path.name for path in folder.iterdir() if path.is_symlink()]:
        sys.exit(f"{folder}: {links} are links, and not written through; name a new folder")
    np.save(folder / MEAN_SHAPES.path, priors())
    for name in CHANGES.keys() & set(names):
        path = folder / cases.METHODS[name].info.assets[0].path
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save(weights(name), path)
    if "asmnet" in names:
        asmnet_cases.write_assets(folder)
    if "sdfest" in names:
        sdfest_cases.write_assets(folder, sdfest())


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    write_assets(Path(sys.argv[1]))
