"""SDFEst's 50 steps of refinement on one object, against the same with a straightforward torch
version of the published kernel's ray marching: every pixel of the image is a thread, as on a GPU,
and every corner of a cell a gather.

    OMP_NUM_THREADS=1 python benchmarks/bench_sdfest.py [DEVICE]

No weights are needed: the object is a ball with a random decoder's dents. Ends with an error if
the two do not find the same, or if ours takes more than half the time.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn

from method_adapters import _sdfest_estimation as estimation
from method_adapters._networks.sdfest import InitNet, SdfVae
from method_adapters._sdf_renderer import (
    Placement,
    ray_depths,
    ray_directions,
    render_depth,
    rotation_matrix,
)
from method_adapters._sdfest_configuration import released
from method_adapters._so3_grid import rotation_grid
from method_adapters.sdfest import ITERATIONS, reconstruct
from pytest_cpas.types import Camera

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
THRESHOLD = estimation.THRESHOLD

Renderer = Callable[..., tuple[Tensor, Tensor]]


class Dented(nn.Module):
    """A decoder whose shapes are balls with dents."""

    def __init__(self) -> None:
        super().__init__()
        self.vae = SdfVae(released("mug")).requires_grad_(False)
        axis = torch.linspace(-1, 1, 64)
        nodes = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
        # untrained, the decoder says little
        self.register_buffer("ball", nodes.norm(dim=-1) - 0.7 - 200 * self.vae(torch.zeros(1, 8)))

    def forward(self, latent: Tensor) -> Tensor:
        return self.ball + 200 * self.vae(latent)


def every_pixel(sdf: Tensor, place: Placement, directions: Tensor, threshold: float) -> Tensor:
    """The published kernel's depth image (H * W,), all threads in step."""
    start = -(place.position @ place.rotation)
    along = directions @ place.rotation
    near = torch.zeros(len(along), device=along.device)
    far = torch.full_like(near, 1e10)
    for axis in range(3):
        first = (-place.half_width - start[axis]) / along[:, axis]
        second = (place.half_width - start[axis]) / along[:, axis]
        near = torch.maximum(near, torch.minimum(first, second))
        far = torch.minimum(far, torch.maximum(first, second))
    length, found = near, torch.zeros_like(near)
    on = near < far
    while on.any():
        step = trilinear(sdf, (start + length[:, None] * along) / place.half_width)
        step = step * place.half_width
        ends = on & (step < threshold * length)
        found = torch.where(ends, length, found)
        length = torch.where(on & ~ends, length + step, length)
        on = on & ~ends & (length < far)
    return found


def trilinear(sdf: Tensor, at: Tensor) -> Tensor:
    cell = (at + 1) * 31.5
    base = cell.detach().floor().clamp(0, 62)
    x, y, z = (cell - base).unbind(-1)
    i, j, k = base.long().unbind(-1)
    c00 = sdf[i, j, k] * (1 - x) + sdf[i + 1, j, k] * x
    c01 = sdf[i, j, k + 1] * (1 - x) + sdf[i + 1, j, k + 1] * x
    c10 = sdf[i, j + 1, k] * (1 - x) + sdf[i + 1, j + 1, k] * x
    c11 = sdf[i, j + 1, k + 1] * (1 - x) + sdf[i + 1, j + 1, k + 1] * x
    return (c00 * (1 - y) + c10 * y) * (1 - z) + (c01 * (1 - y) + c11 * y) * z


def peer(pixels: Tensor, everything: Tensor) -> Renderer:
    """In place of :func:`ray_depths`: the whole image is rendered, and compared in ``pixels``."""

    def ray_depths(
        sdf: Tensor, place: Placement, directions: Tensor, threshold: float, *_: str
    ) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            length = every_pixel(sdf, place, everything, threshold)[pixels]
            hit = length > 0
        length, directions = length[hit, None], directions[hit]
        at = (length * directions - place.position) @ place.rotation / place.half_width
        step = trilinear(sdf, at) * place.half_width
        return hit, -directions[:, 2] * (length[:, 0] + step - step.detach())

    return ray_depths


class Clock:
    """Time in a function, per call of it."""

    def __init__(self, function: Callable[..., Any], device: str) -> None:
        self.function, self.device = function, device
        self.seconds: list[float] = []

    def __call__(self, *args: Any) -> Any:
        self.wait()
        start = time.perf_counter()
        result = self.function(*args)
        self.wait()
        self.seconds.append(time.perf_counter() - start)
        return result

    def wait(self) -> None:
        if self.device.startswith("cuda"):
            torch.cuda.synchronize()


def main(device: str) -> None:
    torch.manual_seed(0)
    decoder = Dented().eval().to(device)
    truth = estimation.Estimate(
        torch.full((8,), 0.5),
        torch.tensor([0.05, 0.02, -0.7]),
        torch.ones(4) / 2,
        torch.tensor(0.1),
    )
    truth = estimation.Estimate(*(part.to(device) for part in truth))
    place = Placement(truth.position, rotation_matrix(truth.quaternion), truth.half_width)
    depth = render_depth(decoder(truth.latent[None])[0, 0], place, CAMERA, 1e-3).flatten()
    size = [torch.arange(float(n), device=device) for n in (CAMERA.height, CAMERA.width)]
    everything = ray_directions(
        CAMERA, *(x.flatten() for x in torch.meshgrid(*size, indexing="ij"))
    )
    pixels = torch.nonzero(depth)[:, 0]
    directions = everything[pixels]
    points = directions * (depth[pixels] / -directions[:, 2])[:, None]
    here = torch.eye(3, device=device), torch.zeros(3, device=device)
    view = estimation.View(directions, points, *here)
    start = truth._replace(
        latent=torch.zeros(8, device=device),
        position=truth.position + 0.01,
        half_width=truth.half_width * 1.1,
    )
    init = InitNet(released("mug")).eval().requires_grad_(False).to(device)
    grid = rotation_grid(1)

    def object_(renderer: Renderer, iterations: int) -> estimation.Estimate:
        with patch.object(estimation, "ray_depths", renderer):
            estimation.first_estimate(init, grid, view)  # its answer is random
            found = estimation.refine(decoder, start, [view], iterations, "correct")
        reconstruct(decoder, found)
        return found

    print(f"{len(pixels)} pixels of an object, {ITERATIONS} iterations, {device}")
    renderers = {"ours": ray_depths, "every pixel": peer(pixels, everything)}
    seconds, found, images = {}, {}, {}
    for name, renderer in renderers.items():
        images[name] = renderer(decoder(truth.latent[None])[0, 0], place, directions, THRESHOLD)
        object_(renderer, 1)
        clock = Clock(renderer, device)
        whole = Clock(object_, device)
        for _ in range(3 if name == "ours" else 1):
            found[name] = whole(clock, ITERATIONS)
        seconds[name], each = statistics.median(whole.seconds), statistics.median(clock.seconds)
        print(
            f"{name:12} {seconds[name]:6.2f} s per object, renderer {1000 * each:7.2f} ms per"
            f" iteration, {each * ITERATIONS / seconds[name]:4.0%} of the whole"
        )
    ratio = seconds["ours"] / seconds["every pixel"]
    hits, depths = zip(*images.values(), strict=True)
    same = torch.equal(*hits) and float((depths[0] - depths[1]).abs().max())
    ours, theirs = (1000 * found[name].position for name in renderers)
    apart, error = float((ours - theirs).norm()), float((ours - 1000 * truth.position).norm())
    print(f"ratio {ratio:.3f} (at most 0.5)")
    print(f"one rendering differs by {same:.1e} m (at most 1e-6)")
    print(
        f"positions after {ITERATIONS} iterations: {apart:.3f} mm apart (at most 0.2),"
        f" {error:.1f} mm from the truth, at the start 17.3 mm"
    )
    if same is False or same > 1e-6 or apart > 0.2:
        sys.exit("the two do not find the same")
    if ratio > 0.5:
        sys.exit("ours takes more than half the time")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(*(sys.argv[1:] or ["cpu"]))
