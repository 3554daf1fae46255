"""Random weights with which CASS and RBP-Pose answer with objects of a likely size where the depth
is, so that the contract checks apply to them.

``python tests/ports/plausible.py DIR`` writes a folder for ``--cpas-weights``; with it, golden/
beside this file has the golden tables of

    pytest --cpas-method cass --cpas-method rbppose --cpas-dataset synthetic-handheld \\
        --cpas-weights=DIR --cpas-golden tests/ports/golden --cpas-require-golden
"""

import sys
from pathlib import Path

import cases
import numpy as np
import torch

from method_adapters._assets import MEAN_SHAPES
from method_adapters._prior_method import MUG_OFFSET
from method_adapters.rbppose import MEAN_SIZES
from pytest_cpas.types import CATEGORIES


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


def weights(name: str) -> dict[str, torch.Tensor]:
    """The recipe's, some of them changed."""
    state = {key: value.clone() for key, value in cases.network(name).state_dict().items()}
    if name == "rbppose":  # little is added to the average size, the middle and the prior
        for layer in ("ts.conv4", "deformation.4"):
            for part in ("weight", "bias"):
                state[f"posenet.{layer}.{part}"] *= 0.01
        return state
    # the object is at the surest point, and its shape, which is always the same, around it
    for part in ("weight", "bias"):
        state[f"estimator.posing.conv4_t.{part}"] *= 0.01
    for fold, coordinates in (("Fold1", 9), ("Fold2", 3)):
        state[f"foldingnet.reconstructing.{fold}.mlp.0.weight"][:, coordinates:] = 0
    network = cases.NETWORKS[name]()
    network.load_state_dict(state)
    with torch.inference_mode():
        shape = network(*cases.network_inputs(name)).shape[0]
    low, high = shape.amin(0), shape.amax(0)
    middle, extents = ((low + high) / 2).round(decimals=6), (high - low).round(decimals=6)
    last = "foldingnet.reconstructing.Fold2.mlp.4"
    scale = 0.15 / extents
    state[f"{last}.weight"] *= scale[:, None]
    state[f"{last}.bias"] = (state[f"{last}.bias"] - middle) * scale
    return state


def write_assets(folder: Path) -> None:
    """The weights of both, and the priors."""
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / MEAN_SHAPES.path, priors())
    for name in ("cass", "rbppose"):
        path = folder / cases.METHODS[name].info.assets[0].path
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save(weights(name), path)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    write_assets(Path(sys.argv[1]))
