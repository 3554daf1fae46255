"""iCaps' inputs made from a seed, and an object whose shape, pose and codebook are known exactly.

The object is a convex body with eight faces, one per octant, of which no two are alike. Its signed
distance is linear in every octant, so that the DeepSDF decoder can be given weights that are it.

``python tests/ports/icaps_cases.py record`` records; see cases.py. ``... weights DIR`` writes a
folder for ``--cpas-weights`` with which iCaps answers with objects of a likely size where the depth
is, so that the contract applies; golden/ beside this file has the golden table of

    PYTHONPATH=tests/ports pytest --cpas-method icaps --cpas-dataset icaps_cases:Few \\
        --cpas-weights=DIR --cpas-golden tests/ports/golden --cpas-require-golden
"""

import copy
import functools
import sys
from pathlib import Path

import cases
import numpy as np
import recipe
import torch
from scipy.spatial.transform import Rotation

from method_adapters._networks.icaps import LATENT_SIZE, AutoEncoder, DeepSdf, LatentNet
from method_adapters._networks.icaps_matching import (
    ROTATIONS,
    Codebook,
    Matcher,
    normalised_crops,
)
from method_adapters._networks.icaps_refinement import Refiner
from method_adapters._particle_filter import View
from method_adapters.icaps import _ASSETS, RATIOS, ICaps
from pytest_cpas.datasets.synthetic import SyntheticHandheld
from pytest_cpas.types import CATEGORIES, Camera, Observation
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET

NETWORKS = {"icaps_aae": AutoEncoder, "icaps_latentnet": LatentNet, "icaps_deepsdf": DeepSdf}
SEED = 4
#: Where the object's corners are along x, -x, y, -y, z, -z, model units.
CORNERS = np.array([0.625, 0.83, 1.0, 0.83, 0.55, 0.67])
#: The distance's slopes along them, at most 1 together, and minus the distance at the origin.
DEPTH = 0.3
SLOPES = DEPTH / CORNERS
CAMERA = Camera(640, 480, 577.0, 579.0, 319.5, 239.5)


def distance(points):
    """The object's signed distance, model units, without the decoder's tanh."""
    sides = np.concatenate([points, -points], axis=-1)[..., [0, 3, 1, 4, 2, 5]]
    return np.maximum(sides, 0) @ SLOPES - DEPTH


@functools.cache
def network(name: str) -> torch.nn.Module:
    """In evaluation mode, with the recipe's weights."""
    made = NETWORKS[name]()
    made.load_state_dict(recipe.state_dict(recipe.inventory_of(made), SEED))
    return made.eval()


@functools.cache
def decoder() -> DeepSdf:
    """The object's distance, whatever the latent code."""
    made = DeepSdf()
    with torch.no_grad():
        for i in range(8):
            layer = made.get_submodule(f"lin{i}")
            weight = torch.zeros_like(layer.weight_v)
            if i == 0:
                weight[:6, -3:] = torch.tensor(np.repeat(np.eye(3), 2, axis=0))
                weight[1:6:2] *= -1
            else:
                weight[:6, :6] = torch.eye(6)
            # rows of length 0 have no direction: they point anywhere and their length is 0
            layer.weight_g.copy_(weight.norm(dim=1, keepdim=True))
            weight[6:, -1] = 1
            layer.weight_v.copy_(weight)
            layer.bias.zero_()
        made.lin8.weight.zero_()
        made.lin8.weight[0, :6] = torch.from_numpy(SLOPES)
        made.lin8.bias.fill_(-DEPTH)
    return made.eval()


@functools.cache
def decoder_with_code() -> DeepSdf:
    """The object, a little larger or smaller by its latent code."""
    made = copy.deepcopy(decoder())
    share = torch.from_numpy(np.random.RandomState(2).uniform(-0.03, 0.03, LATENT_SIZE)).float()
    with torch.no_grad():
        for i in range(8):  # a seventh feature, carried to the last layer
            layer = made.get_submodule(f"lin{i}")
            layer.weight_v[6] = 0
            if i == 0:
                layer.weight_v[6, :LATENT_SIZE] = share
                layer.bias[6] = 0.1
            else:
                layer.weight_v[6, 6] = 1
            layer.weight_g[6] = layer.weight_v[6].norm()
        made.lin8.weight[0, 6] = 1
        made.lin8.bias -= 0.1
    return made


def corners():
    """The object's corners (6, 3), model units."""
    return np.stack([np.eye(3), -np.eye(3)], axis=1).reshape(6, 3) * CORNERS[:, None]


def render(rotation, translation, unit, category="mug", camera=CAMERA):
    """The object, ``unit`` metres large, in front of a wall at 1.5 m; ShapeNet axes."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1 + 0 * u], -1)
    signs = np.array([[x, y, z] for x in (0, 1) for y in (2, 3) for z in (4, 5)])
    faces = SLOPES[signs] * np.array([1, -1, 1, -1, 1, -1])[signs]
    normals = faces @ rotation.T / unit  # n . (x - t) <= DEPTH inside
    along = rays @ normals.T
    reach = (DEPTH + normals @ translation) / np.where(along == 0, 1e-12, along)
    enter = np.where(along < 0, reach, -np.inf).max(-1)
    leave = np.where(along > 0, reach, np.inf).min(-1)
    mask = enter < leave
    depth = np.where(mask, enter, 1.5).astype(np.float32)
    rgb = np.zeros((*depth.shape, 3), np.float32)
    return Observation(category=category, rgb=rgb, depth=depth, mask=mask, camera=camera)


def shrunk(crops):
    """In place of the auto-encoder: codes are small pictures."""
    return torch.nn.functional.adaptive_avg_pool2d(crops, (8, 16)).flatten(1)


class NoLatent(torch.nn.Module):
    """In place of LatentNet, where the decoder does without a code."""

    def forward(self, points):
        return (torch.zeros((len(points), 256)),)


def crops_of(view, position):
    """What is compared with the codebook, if the object is at a position (3,)."""
    particle = view.particles(position[None])
    radius = view.radii(position[None])
    image = np.stack([view.depth, view.depth > 0])
    region = view.regions(particle, radius)
    parts = [torch.from_numpy(x.astype(np.float32)) for x in (region, particle[:, 2], radius)]
    return normalised_crops(torch.from_numpy(image), *parts)


@functools.cache
def rotations() -> Rotation:
    """Of the codebook, ShapeNet axes: around one of them, up to a right angle away."""
    turns = np.random.default_rng(3).normal(0, [[0.25]] * 300 + [[0.6]] * 200, (500, 3))
    return Rotation.from_rotvec(turns) * Rotation.random(rng=3)


@functools.cache
def matcher() -> Matcher:
    """With the codes of the object in all of ``rotations``, seen along the optical axis."""
    at = np.array([0, 0, 0.7])
    camera = Camera(160, 160, 577.0, 577.0, 80, 80)
    views = [View.of(render(r.as_matrix(), at, 0.08, camera=camera)) for r in rotations()]
    codes = shrunk(torch.cat([crops_of(view, at) for view in views]))
    mean = codes.mean(0)  # what all have in common would make them all alike
    made = Matcher.__new__(Matcher)
    made._encoder = lambda crops: shrunk(crops) - mean
    made.codebook = Codebook.__new__(Codebook)
    made.codebook.codes = torch.nn.functional.normalize(codes - mean, dim=1)
    nocs = rotations() * Rotation.from_matrix(NOCS_FROM_SHAPENET.T)
    made.codebook.quaternions = nocs.as_quat(scalar_first=True)
    return made


def method() -> ICaps:
    """For the object: as :meth:`load` leaves it, but for what finds the codes."""
    made = ICaps()
    refiner = Refiner(NoLatent(), decoder(), RATIOS["mug"])
    made._networks = {category: (matcher(), refiner) for category in CATEGORIES}
    return made


def codebook(count: int = 500) -> tuple[torch.Tensor, torch.Tensor]:
    """A published file's content, of ``count`` rotations."""
    random = np.random.RandomState(1)
    codes = random.standard_normal((count, 128)).round(4)
    poses = np.concatenate([np.zeros((count, 3)), random.standard_normal((count, 4))], axis=1)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    # the same on every machine: a golden table knows its weights
    return torch.from_numpy(codes).float(), torch.from_numpy(poses.round(6)).float()


def write_assets(folder: Path, rotations: int = 500) -> Path:
    """A folder for --cpas-weights: the recipe's weights, but a decoder that has a surface, and a
    codebook of ``rotations``. All categories share their files."""
    files = {}
    for name in ("icaps_aae", "icaps_latentnet"):
        files[name] = {"aae_state_dict": network(name).state_dict(), "epoch": 1}
    inside = {
        key.replace("encoder.", "encoder.module.", 1): value
        for key, value in files["icaps_aae"]["aae_state_dict"].items()
    }
    sdf = {f"module.{key}": value for key, value in decoder_with_code().state_dict().items()}
    contents = (
        {"aae_state_dict": inside},
        codebook(rotations),
        files["icaps_latentnet"],
        {"model_state_dict": sdf, "epoch": 2000},
    )
    for i, content in enumerate(contents):
        first = None
        for category in CATEGORIES:
            path = folder / _ASSETS[category][i].path
            path.parent.mkdir(parents=True, exist_ok=True)
            path.unlink(missing_ok=True)
            if first is None:
                first = path
                torch.save(content, path)
            else:
                path.hardlink_to(first)
    return folder


class Few(SyntheticHandheld):
    """One sample each of three categories: the whole data set takes iCaps most of an hour."""

    def __init__(self, data_dir: Path | None) -> None:
        super().__init__(data_dir)
        self.name = "synthetic-handheld-few"
        first = {ref.category: ref for ref in reversed(self.samples)}
        self.samples = [first[category] for category in ("bottle", "laptop", "mug")]


def network_outputs(name: str) -> list[np.ndarray]:
    """What a network makes of inputs from a seed."""
    random = np.random.RandomState(7)
    made = network(name)

    def given(*shape):
        return torch.from_numpy(random.random_sample(shape).astype(np.float32))

    with torch.inference_mode():
        if name == "icaps_aae":
            code = made.encoder(given(2, 1, 128, 128))
            return [code.numpy(), made.decoder(code).numpy()]
        if name == "icaps_latentnet":
            points = given(1, 4873, 3) - 0.5
            points[:, 4500:] = points[:, :373]
            return [made(points)[0].numpy()]
        distances = made(given(1, 256) - 0.5, 2 * given(200, 3) - 1)
        return [(distances - distances.mean()).numpy()]  # they are nearly constant


def check_network(name: str) -> None:
    """The network's outputs are those recorded."""
    cases.compare("icaps", name, network_outputs(name))


if __name__ == "__main__":
    if sys.argv[1:] == ["record"]:
        arrays = {
            f"{name}_{i}": cases.thinned(x)
            for name in NETWORKS
            for i, x in enumerate(network_outputs(name))
        }
        np.savez_compressed(cases.GOLDEN / "icaps.npz", **arrays)
    elif sys.argv[1:2] == ["weights"] and len(sys.argv) == 3:
        write_assets(Path(sys.argv[2]), ROTATIONS)
    else:
        sys.exit(__doc__)
