"""SDFEst on ellipsoids, whose truth is in closed form, and on what was recorded from networks that
agree with the originals (test_port_sdfest_networks.py, with the shared data).

``python tests/ports/sdfest_cases.py record`` records.
"""

import functools
from collections.abc import Sequence
from pathlib import Path

import cases
import numpy as np
import recipe
import torch
from scipy.spatial.transform import Rotation

from method_adapters import sdfest
from method_adapters._networks.sdfest import InitNet, SdfVae
from method_adapters._sdfest_configuration import Configuration, PointNetLayers, released
from method_adapters._so3_grid import rotation_grid
from pytest_cpas.types import Camera, Observation, Pose

CAMERA = Camera(160, 120, 150.0, 152.0, 81.2, 57.4)
#: Half axes of the ellipsoid in half-widths of its volume.
HALF_AXES = np.array([0.4, 0.55, 0.75])
HALF_WIDTH = 0.12
#: A cell of the grid, and the rotation that the truth is away from it, degrees.
CELL, AWAY = 301, 8.0

#: Object axes of each category's network -> ShapeNet's.
AXES = {"bowl": np.eye(3), "mug": sdfest.SHAPENET_FROM_Z_UP}

LAYERS = {
    "released": released("mug"),
    "older": Configuration(
        ("robust_mug_init.pt", "mug_vae.pt"),
        z_up=True,
        point_net=PointNetLayers((64, 64, 64, 128, 1024), dense=False, residual=False),
    ),
}


@functools.cache
def networks(name: str) -> tuple[InitNet, SdfVae]:
    """In evaluation mode, with the recipe's weights."""
    made = InitNet(LAYERS[name]), SdfVae(LAYERS[name])
    for network in made:
        network.load_state_dict(recipe.state_dict(recipe.inventory_of(network), cases.SEED))
        network.eval().requires_grad_(False)
    return made


def network_outputs(name: str) -> list[np.ndarray]:
    random = np.random.RandomState(3)
    init, vae = networks(name)
    points = torch.from_numpy(0.1 * random.standard_normal((2, 300, 3)).astype(np.float32))
    latent = torch.from_numpy(random.standard_normal((2, 8)).astype(np.float32))
    with torch.inference_mode():
        return [x.numpy() for x in (*init(points), vae(latent), *vae.encoder(vae(latent)))]


def check_networks() -> None:
    """The networks' outputs are those recorded."""
    for name in LAYERS:
        cases.compare("sdfest", name, network_outputs(name))


class Ellipsoids(torch.nn.Module):
    """Stands for the decoder: three latents, the logarithms of the axes' changes."""

    def __init__(self, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        axis = torch.linspace(-1, 1, 32, dtype=dtype)
        self.nodes = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        axes = torch.from_numpy(HALF_AXES).to(self.nodes) * latent[0].exp()
        inside = (self.nodes / axes).norm(dim=-1)
        # first order in the distance from the surface
        return ((inside - 1) * inside / (self.nodes / axes**2).norm(dim=-1))[None, None]


class Guess(torch.nn.Module):
    """Stands for the initialisation network: always the same answer; remembers its input."""

    def forward(self, points: torch.Tensor) -> tuple[torch.Tensor, ...]:
        self.seen = points
        logits = torch.zeros(1, 576)
        logits[0, CELL] = 1
        back = torch.tensor([[0.01, -0.005, -0.05]])  # from the visible surface to the centre
        return torch.tensor([[0.1, -0.05, 0.05]]), back, torch.tensor([0.13]), logits


def method() -> sdfest.Sdfest:
    """As :meth:`load` leaves it, with the two above for bowls and mugs; the mugs' are z up."""
    made = sdfest.Sdfest()
    made._device = torch.device("cpu")
    grid = rotation_grid(1)
    made._models = {
        category: sdfest.Model(Guess(), Ellipsoids(), grid, axes) for category, axes in AXES.items()
    }
    return made


def true_pose() -> Pose:
    """Of the ellipsoid, in the first camera (OpenCV axes), network's object axes."""
    grid = Rotation.from_quat(rotation_grid(1)[CELL])
    turn = Rotation.from_rotvec(np.radians(AWAY) * np.array([0.6, 0.0, 0.8])) * grid
    opengl = np.diag([1.0, -1.0, -1.0])
    return Pose(opengl @ turn.as_matrix(), [0.03, -0.02, 0.6])


def observation(category: str = "bowl", camera: Pose | None = None) -> Observation:
    """The ellipsoid in closed form; ``camera``: another camera's pose in the first one's frame."""
    pose, camera = true_pose(), camera or Pose(np.eye(3), np.zeros(3))
    rotation = pose.rotation.T @ camera.rotation
    origin = pose.rotation.T @ (camera.translation - pose.translation)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 0 * u + 1], -1)
    half_axes = HALF_WIDTH * HALF_AXES
    a, b = rays @ rotation.T / half_axes, origin / half_axes
    aa, ab, bb = (a * a).sum(-1), a @ b, b @ b - 1
    root = ab**2 - aa * bb
    mask = root > 0
    depth = np.where(mask, (-ab - np.sqrt(np.maximum(root, 0))) / aa, 1.5)
    rgb = np.zeros((*mask.shape, 3), np.float32)
    return Observation(
        category=category, rgb=rgb, depth=depth.astype(np.float32), mask=mask, camera=CAMERA
    )


def write_assets(folder: Path, states: Sequence[dict[str, torch.Tensor]] = ()) -> Path:
    """A folder for --cpas-weights in the release's form; ``states``: of both networks, else the
    recipe's weights."""
    target = folder / "sdfest"
    target.mkdir(parents=True, exist_ok=True)
    states = states or [network.state_dict() for network in networks("released")]
    for category in sdfest.CATEGORIES:
        for state, name in zip(states, released(category).weights, strict=True):
            torch.save(state, target / name)
    return folder


def record() -> None:
    cases.save("sdfest", {name: network_outputs(name) for name in LAYERS})


if __name__ == "__main__":
    cases.command(__doc__, record)
