"""SDFEst's estimate: the first from a network, then render and compare (Bruns & Jensfelt, RA-L
2022, section IV)."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from typing import NamedTuple

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from method_adapters._sdf_renderer import (
    Gradient,
    Placement,
    distances,
    ray_depths,
    rotation_matrix,
)
from pytest_cpas.adapting import Array, TorchTaps, tap

#: A ray ends this share of its length before the surface.
THRESHOLD = 0.005
#: Learning rates of Adam, and the weights of the two losses.
POSITION_RATE, QUATERNION_RATE, HALF_WIDTH_RATE, LATENT_RATE = 1e-3, 1e-2, 1e-3, 1e-2
DEPTH_WEIGHT, POINT_WEIGHT = 1.0, 3.0


class Estimate(NamedTuple):
    """An object: its ``latent`` shape (L,), and the volume's ``position`` (3,) and ``half_width``
    (), metres, and orientation as a ``quaternion`` (4,), scalar last, object to world."""

    latent: Tensor
    position: Tensor
    quaternion: Tensor
    half_width: Tensor


class View(NamedTuple):
    """The object's pixels in one image.

    ``directions`` (N, 3) of their rays and ``points`` (N, 3), metres, in the camera frame
    (OpenGL); ``rotation`` (3, 3) and ``position`` (3,) take that frame to the world.
    """

    directions: Tensor
    points: Tensor
    rotation: Tensor
    position: Tensor


@torch.inference_mode()
def first_estimate(init: nn.Module, grid: Array, view: View) -> Estimate:
    """What the initialisation network says of one view: as rotation the most probable cell of
    ``grid`` (n, 4), quaternions."""
    middle = view.points.mean(0)
    with TorchTaps(init):
        latent, position, half_width, logits = init((view.points - middle)[None])
    rotation = Rotation.from_matrix(view.rotation.cpu().numpy()) * Rotation.from_quat(
        grid[int(logits[0].argmax())]
    )
    estimate = Estimate(
        latent[0],
        view.rotation @ (position[0] + middle) + view.position,
        torch.from_numpy(rotation.as_quat()).to(middle),
        half_width[0],
    )
    return tap("first", estimate)


def refine(
    vae: nn.Module, start: Estimate, views: Sequence[View], iterations: int, gradient: Gradient
) -> Estimate:
    """The estimate after so many steps of Adam.

    The loss is summed over the views. Where the rendered object covers none of a view's pixels,
    the view has no loss of depth, and pulls by its points alone.
    """
    latent, position, quaternion, half_width = (
        part.detach().clone().requires_grad_() for part in start
    )
    groups = (
        (latent, LATENT_RATE),
        (position, POSITION_RATE),
        (quaternion, QUATERNION_RATE),
        (half_width, HALF_WIDTH_RATE),
    )
    optimizer = torch.optim.Adam([{"params": [part], "lr": rate} for part, rate in groups])
    for step in range(iterations):
        optimizer.zero_grad()
        # of one step: a volume each is too much of all
        with nullcontext() if step else TorchTaps(vae, "vae"):
            sdf = vae(latent[None])[0, 0]
        rotation = rotation_matrix(quaternion)
        loss = torch.zeros_like(half_width)
        for view in views:
            # a row vector times the rotation is the inverse rotation of the column
            place = Placement(
                (position - view.position) @ view.rotation,
                view.rotation.T @ rotation,
                half_width,
            )
            loss = loss + _view_loss(sdf, place, view, gradient)
        loss.backward()
        tap("loss", loss)
        tap("gradient", [part.grad for part in (latent, position, quaternion, half_width)])
        optimizer.step()
        with torch.no_grad():
            quaternion /= quaternion.norm()
        tap("refined", Estimate(latent, position, quaternion, half_width))
    return Estimate(*(part.detach() for part in (latent, position, quaternion, half_width)))


def _view_loss(sdf: Tensor, place: Placement, view: View, gradient: Gradient) -> Tensor:
    """Only rays of pixels with a depth can be compared, so no other is followed."""
    loss = POINT_WEIGHT * tap("at_points", distances(sdf, place, view.points)).abs().mean()
    hit, depth = tap("rendered", ray_depths(sdf, place, view.directions, THRESHOLD, gradient))
    if len(depth):
        loss = loss + DEPTH_WEIGHT * (depth + view.points[hit, 2]).abs().mean()
    return loss
