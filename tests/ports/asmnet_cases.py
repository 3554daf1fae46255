"""ASM-Net's inputs made from a seed, and the checks against what was recorded from code that agrees
with the original network; see cases.py.

``python tests/ports/asmnet_cases.py record`` records.
"""

import functools
from pathlib import Path

import cases
import numpy as np
import recipe
import torch

from method_adapters._networks.asmnet import AsmNet
from method_adapters._networks.running import Runner
from method_adapters._shape_model import ShapeModel
from method_adapters.asmnet import AsmNet as Method
from pytest_cpas.types import CATEGORIES

#: Weights of each category's network; those of can estimate negative scales, the others do not.
SEEDS = dict(zip(CATEGORIES, (2, 19, 20, 12, 27, 29), strict=True))


@functools.cache
def network(category: str) -> AsmNet:
    """In evaluation mode, with the recipe's weights."""
    made = AsmNet()
    made.load_state_dict(recipe.state_dict(recipe.inventory_of(made), SEEDS[category]))
    return made.eval()


def network_inputs() -> list[torch.Tensor]:
    """Two clouds, normalised; the second is not centred, and short of points."""
    random = np.random.RandomState(7)
    points = random.standard_normal((2, 3, 800))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points *= np.array([[0.5, 1, 0.7], [0.2, 0.3, 0.6]])[..., None]
    points[1] += 0.3
    points[1, :, 500:] = points[1, :, :300]
    return [torch.from_numpy(points.astype(np.float32))]


@functools.cache
def shape_model(category: str) -> ShapeModel:
    """An ellipsoid of 900 points; the components stretch it along one axis each."""
    random = np.random.RandomState(CATEGORIES.index(category))
    k = np.arange(900) + 0.5
    height, angle = 1 - 2 * k / 900, k * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    sphere = np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], axis=1)
    mean = sphere * random.uniform(0.4, 0.8, 3)
    components = np.stack([sphere[:, [axis]] * np.eye(3)[axis] for axis in (1, 0, 2)]) / 3
    # rounded, the same on every machine: a golden table knows its weights
    return ShapeModel(mean.round(6), components.round(6))


def write_assets(folder: Path) -> Path:
    """A folder for --cpas-weights; the shape models in the layouts that may occur."""
    for i, category in enumerate(CATEGORIES):
        path = folder / "asmnet" / "params" / "weights" / category / "model.pth"
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save(network(category).state_dict(), path)
        model = shape_model(category)
        # two more components, which the network does not estimate
        rows = np.concatenate([model.components, model.components[:2] * 0.1]).reshape(5, -1)
        path = folder / "asmnet" / "params" / "asm_params" / category / "train" / "info.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, mean=model.mean.reshape(-1), basis=rows.T if i % 2 else rows)
    return folder


def method() -> Method:
    """As :meth:`load` leaves it, without files."""
    made = Method()
    made._run = {category: Runner(network(category), "cpu") for category in CATEGORIES}
    made._models = {category: shape_model(category) for category in CATEGORIES}
    return made


def network_sees() -> list[np.ndarray]:
    """What the network gets of the shared observations and of one with background in its mask."""
    inputs = []
    for seed, seen in enumerate([*cases.observations(), with_background()]):
        inputs.append(Method().prepare(seen, np.random.default_rng(seed)))
    points, clouds, centres, factors = zip(*inputs, strict=True)
    return [np.stack(points), np.concatenate(clouds), np.stack(centres), np.array(factors)]


def with_background():
    """Along the mask's upper edge, the wall."""
    seen = cases.observation("bowl", (300.2, 200.7), 40)
    seen.mask[155:163, 285:315] = True
    return seen


def check_network(name: str = "asmnet") -> None:
    cases.compare(name, "network", cases.outputs_of(network("bottle"), network_inputs()))


def check_inputs(name: str = "asmnet") -> None:
    cases.compare(name, "input", network_sees())


def raw_outputs(made: Method) -> list[np.ndarray]:
    """Every category's network on the same points."""
    points = network_sees()[0]
    return [x for category in CATEGORIES for x in made._run[category](points)]


def record() -> None:
    groups = {
        "network": cases.outputs_of(network("bottle"), network_inputs()),
        "input": network_sees(),
        "raw": raw_outputs(method()),
    }
    cases.save("asmnet", groups)


if __name__ == "__main__":
    cases.command(__doc__, record)
