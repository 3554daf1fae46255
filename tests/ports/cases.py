"""Inputs made from a seed, and the checks against recorded outputs that the tests share.

``python tests/ports/cases.py record [NAME ...]`` records: only ever from code that agrees with the
original networks (the tests with the shared data).
"""

import functools
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
import recipe
import torch

from method_adapters._assets import MEAN_SHAPES
from method_adapters._network_method import NetworkMethod
from method_adapters._networks.running import Runner
from method_adapters.cass import Cass
from method_adapters.crnet import CrNet
from method_adapters.dpdn import Dpdn
from method_adapters.rbppose import RbpPose
from method_adapters.sgpa import Sgpa
from method_adapters.spd import Spd
from pytest_cpas.types import Camera, Observation

METHODS: dict[str, type[NetworkMethod]] = {
    "spd": Spd,
    "crnet": CrNet,
    "sgpa": Sgpa,
    "dpdn": Dpdn,
    "cass": Cass,
    "rbppose": RbpPose,
}
#: Those that measure the size, instead of taking it from the shape.
MEASURED = ("dpdn", "rbppose")
#: Relative L2 difference that the order of float32 sums explains.
TOLERANCE = 1e-5
# beside other workers, more threads only get in each other's way
torch.set_num_threads(1)

#: With these weights DPDN and RBP-Pose estimate positive sizes.
SEED, SEEDS = 12, {"rbppose": 27}
GOLDEN = Path(__file__).with_name("recorded")


@functools.cache
def network(name: str) -> torch.nn.Module:
    """In evaluation mode, with the recipe's weights."""
    made = METHODS[name].network()
    made.load_state_dict(recipe.state_dict(recipe.inventory_of(made), SEEDS.get(name, SEED)))
    return made.eval()


def relative(actual: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(actual - expected) / np.linalg.norm(expected))


def priors() -> np.ndarray:
    """Stands for the mean shapes: six ellipsoids with a diagonal of 1, the mug's off the origin."""
    random = np.random.RandomState(5)
    points = random.standard_normal((6, 1024, 3))
    points /= np.linalg.norm(points, axis=2, keepdims=True)
    points *= random.uniform(0.4, 1, (6, 1, 3))
    points /= np.linalg.norm(np.ptp(points, axis=1), axis=1)[:, None, None]
    points[5, :, 0] += 0.08
    return points


def network_inputs(name: str) -> list[torch.Tensor]:
    """Two samples with images of 48 x 48: a camera of 10 cm, a mug of 5 cm with repeated points."""
    random = np.random.RandomState(7)
    extents = np.array([[0.12, 0.2, 0.1], [0.05, 0.09, 0.05]])
    points = random.uniform(-0.5, 0.5, (2, 1024, 3)) * extents[:, None] + [0.05, 0.02, 0.8]
    points[1, 700:] = points[1, :324]
    image = random.standard_normal((2, 3, 48, 48))
    choose = random.randint(0, 48 * 48, (2, 1024))
    arrays = [points, image, choose, np.array([2, 5]), priors()[[2, 5]]]
    if name == "cass":
        arrays = [points[:, :500], image, choose[:, :500], np.array([2, 5])]
    if name == "rbppose":
        kept = [random.permutation(n)[: n // 4] for n in (512, 128, 512, 128, 1024, 256, 1024, 256)]
        pairs = [np.stack(kept[i : i + 4 : 2]) for i in (0, 1, 4, 5)]
        size = random.uniform(0.05, 0.3, (2, 3))
        # neighbours among repeated points are a matter of rounding
        arrays = [points[:, :512], np.array([2, 5]), priors()[[2, 5]], size, *pairs]
    return [torch.from_numpy(x if x.dtype.kind == "i" else x.astype(np.float32)) for x in arrays]


def outputs_of(net: torch.nn.Module, inputs: list[torch.Tensor]) -> list[np.ndarray]:
    with torch.inference_mode():
        return [x.numpy() for x in net(*inputs)]


def thinned(x: np.ndarray) -> np.ndarray:
    return np.ravel(x)[:: max(1, x.size // 1500)]


def check_network(name: str) -> None:
    """The network's outputs are those recorded."""
    compare(name, "network", outputs_of(network(name), network_inputs(name)))


def observation(category: str, centre: tuple[float, float], radius: float) -> Observation:
    """A ball in front of a wall, coloured by place, with holes in the depth; 640 x 480."""
    camera = Camera(640, 480, 577.0, 579.0, 319.5, 239.5)
    v, u = np.mgrid[:480, :640]
    away = np.hypot(u - centre[0], v - centre[1])
    mask = away < radius
    depth = np.where(mask, 0.8 - 0.05 * np.sqrt(np.maximum(1 - (away / radius) ** 2, 0)), 1.3)
    depth[(u * 7 + v * 13) % 29 == 0] = 0
    rgb = np.stack([u / 639, v / 479, (u * v % 97) / 96], axis=-1)
    return Observation(
        category=category,
        rgb=rgb.astype(np.float32),
        depth=depth.astype(np.float32),
        mask=mask,
        camera=camera,
    )


def observations(large: bool = False) -> list[Observation]:
    """At the image's corner with more pixels than points; fewer pixels than points, if not
    ``large``: then RBP-Pose's resampled crop repeats no pixel."""
    if large:
        return [observation("mug", (520, 400), 150), observation("can", (300.3, 230.8), 131)]
    return [observation("mug", (620, 463), 32), observation("can", (420.3, 330.8), 14.2)]


def write_assets(folder: Path, names: Iterable[str] = METHODS) -> Path:
    """A folder for --cpas-weights with the recipe's weights and made-up priors."""
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / MEAN_SHAPES.path, priors())
    for name in names:
        path = folder / METHODS[name].info.assets[0].path
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save(network(name).state_dict(), path)
    return folder


def network_sees(method: NetworkMethod) -> list[tuple[np.ndarray, ...]]:
    """What a method makes of each of the observations."""
    generator = np.random.default_rng
    batch = observations(large=method.info.name == "rbppose")
    return [method.prepare(seen, generator(seed)) for seed, seen in enumerate(batch)]


def together(parts: list[tuple[np.ndarray, ...]]) -> list[np.ndarray]:
    """The parts of several samples, which may differ in shape, one after the other."""
    return [np.concatenate([np.ravel(x) for x in part]) for part in zip(*parts, strict=True)]


def raw_outputs(method: NetworkMethod) -> list[np.ndarray]:
    """What a loaded method's network says to each of the observations."""
    return together([method._run(*(x[None] for x in seen)) for seen in network_sees(method)])


def unloaded(name: str) -> NetworkMethod:
    """A method with priors if it has any, but without a network."""
    method = METHODS[name]()
    if MEAN_SHAPES in method.info.assets:
        method._priors = priors().astype(np.float32)
    return method


def loaded(name: str) -> NetworkMethod:
    """As :meth:`load` leaves it, without files: checkpoints are large."""
    method = unloaded(name)
    method._run = Runner(network(name), "cpu")
    return method


def check_inputs(name: str) -> None:
    """What the network sees is what was recorded."""
    compare(name, "input", together(network_sees(unloaded(name))))


def check_raw_outputs(method: NetworkMethod) -> None:
    """A loaded method's raw outputs are those recorded."""
    compare(method.info.name, "raw", raw_outputs(method))


def compare(name: str, what: str, arrays: list[np.ndarray]) -> None:
    """What a method sees or says is what was recorded."""
    with np.load(GOLDEN / f"{name}.npz") as data:
        recorded = dict(data)
    for i, array in enumerate(arrays):
        difference = relative(thinned(array), recorded[f"{what}_{i}"])
        limit = 0 if array.dtype.kind == "i" else TOLERANCE
        assert difference <= limit, f"{name}, {what} {i}: {difference:.2e}"


def assert_found(
    patch: Callable[..., None],
    plant: Callable[[Callable[..., None]], None],
    check: Callable[[str], None],
    name: str,
) -> None:
    """A check of a method fails with a fault that ``plant`` plants; ``patch``: setattr."""
    network(name)  # made before anything is broken
    plant(patch)
    with pytest.raises(AssertionError):
        check(name)


def record(names: Iterable[str]) -> None:
    GOLDEN.mkdir(exist_ok=True)
    for name in names:
        method = loaded(name)
        groups = {
            "network": outputs_of(network(name), network_inputs(name)),
            "input": together(network_sees(method)),
            "raw": raw_outputs(method),
        }
        save(name, groups)


def save(name: str, groups: Mapping[str, Sequence[np.ndarray]]) -> None:
    """What :func:`compare` compares with."""
    arrays = {f"{k}_{i}": thinned(x) for k, g in groups.items() for i, x in enumerate(g)}
    small = {k: v if v.dtype.kind == "i" else v.astype(np.float32) for k, v in arrays.items()}
    np.savez_compressed(GOLDEN / f"{name}.npz", **small)


def command(doc: str, record: Callable[[], None]) -> None:
    """The command line of a module that records."""
    if sys.argv[1:] != ["record"]:
        sys.exit(doc)
    record()


if __name__ == "__main__":
    if sys.argv[1:2] == ["record"]:
        record(sys.argv[2:] or METHODS)
    else:
        sys.exit(__doc__)
