"""iCaps' inputs made from a seed, and an object whose shape, pose and codebook are known exactly.

The object is a convex body with eight faces, one per octant, of which no two are alike. Its signed
distance is linear in every octant, so that the DeepSDF decoder can be given weights that are it.
"""

import functools
import sys
from pathlib import Path

import cases
import numpy as np
import recipe
import torch
from scipy.spatial.transform import Rotation

from method_adapters._networks.icaps import AutoEncoder, DeepSdf, LatentNet
from method_adapters._networks.icaps_matching import Codebook, Matcher, normalised_crops
from method_adapters._networks.icaps_refinement import Refiner
from method_adapters._particle_filter import towards
from method_adapters.icaps import _ASSETS, RATIOS, ICaps
from pytest_cpas.frames import NOCS_FROM_SHAPENET
from pytest_cpas.types import CATEGORIES, Camera, Observation

NETWORKS = {"icaps_aae": AutoEncoder, "icaps_latentnet": LatentNet, "icaps_deepsdf": DeepSdf}
SEED = 4
#: Slopes of the distance along x, -x, y, -y, z, -z, and the distance at the origin.
SLOPES = np.array([0.8, 0.6, 0.5, 0.6, 0.9, 0.75])
DEPTH = 0.45
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


def corners():
    """The object's corners (6, 3), model units."""
    return np.repeat(np.eye(3), 2, axis=0) * [[1], [-1]] * 3 * (DEPTH / SLOPES)[:, None]


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
    return Observation(category, rgb, depth, mask, camera)


if __name__ == "__main__":
    print(corners())
