"""Pose and shape of iCaps, refined in turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from method_adapters._networks.graphs import Graphs, queued
from method_adapters._networks.icaps import POINT_COUNT, DeepSdf, LatentNet, Shape
from method_adapters._networks.pointnet2 import farthest_points
from method_adapters._networks.running import full_precision
from pytest_cpas.adapting import TorchTaps, heard_by, tap

Array = NDArray[np.float64]

ROUNDS, STEPS, LEARNING_RATE = 3, 50, 0.002
#: The parts of LatentNet that are tapped: what the layers within them make is too much.
LEVELS = ("SA_modules.?", "cls_layer", "cls_layer.*")
#: Signed distances count up to this, model units.
CLAMP = 0.1
#: First values of the rotation, where a norm would have no derivative at 0.
START = 1e-12
#: The gradient of the rotation counts so many times.
ROTATION_WEIGHT = 2
#: The distance function is taken for linear around a point where it was evaluated, until the
#: point has moved further than this, model units.
LINEAR_REACH = 0.02
#: Nodes per axis of the grids for the mesh: the first finds where the second is worth evaluating.
COARSE, FINE = 32, 64
#: Nodes whose distance, interpolated between coarse ones, is below this are evaluated. A surface
#: crosses an edge only if both of its ends are no further than its length; interpolated distances
#: are wrong by half a coarse cell's diagonal at most.
NEAR = 3**0.5 / (COARSE - 1) + 2 / (FINE - 1)


@dataclass(frozen=True)
class Placed:
    """Where a model with a unit of ``unit`` metres is: ``rotation`` (3, 3), ``translation`` (3,)
    metres, ShapeNet axes to camera axes."""

    rotation: Array
    translation: Array
    unit: float

    def to_object(self, points: Array) -> Array:
        """Camera-frame points (N, 3), metres, in model units."""
        coordinates: Array = (points - self.translation) @ self.rotation / self.unit
        return coordinates

    def after(self, rotation: Array, shift: Array) -> Placed:
        """The placement under which points have the coordinates rotation @ x + shift that have
        x under this one."""
        turned = self.rotation @ rotation.T
        return Placed(turned, self.translation - self.unit * turned @ shift, self.unit)


def spread(cloud: Array, generator: np.random.Generator) -> Array:
    """4873 of an object's points (N, 3): farthest points, or all and random ones again."""
    if len(cloud) <= POINT_COUNT:
        again = generator.choice(len(cloud), POINT_COUNT - len(cloud))
        return np.concatenate([cloud, cloud[again]])
    points = torch.from_numpy(cloud.astype(np.float32))[None]
    (chosen,) = farthest_points(points, POINT_COUNT, max_threads=1024)
    picked: Array = cloud[chosen.numpy()]
    return picked


class Refiner:
    """The shape networks of a category, on a device."""

    def __init__(self, latent_net: LatentNet, decoder: DeepSdf, ratio: float) -> None:
        """``ratio``: diagonal of the object's box in model units."""
        self._latent_net, self._decoder = latent_net.eval(), decoder.eval()
        self._graphs = Graphs(self._latent_net)
        self._ratio = ratio

    def shape_of(self, coordinates: Tensor) -> Shape:
        """The shape of an object seen at (4873, 3), model units."""
        taps = TorchTaps(self._latent_net, "latent_net", include=LEVELS)
        with taps, torch.inference_mode(), full_precision():
            replayed = queued(coordinates) and heard_by() is None
            network = self._graphs if replayed else self._latent_net
            (latent,) = network(tap("coordinates", coordinates[None] / self._ratio))
        tap("latent", latent)
        return Shape(self._decoder, latent)

    def __call__(self, points: Array, placed: Placed) -> tuple[Placed, Shape]:
        """Where the object with observed points (4873, 3), camera frame, metres, is, and its shape,
        from a first placement.

        Every round estimates the shape from the pose and then improves the pose.
        """
        increment = _Increment(points, placed, self._device)
        for _ in range(ROUNDS):
            shape = self.shape_of(increment.coordinates())
            increment.descend(shape)
        return increment.placed(), shape

    def follow(self, points: Array, placed: Placed, shape: Shape) -> Placed:
        """Where the object of a known shape is, from a first placement."""
        increment = _Increment(points, placed, self._device)
        for _ in range(ROUNDS):
            increment.descend(shape)
        return increment.placed()

    @property
    def _device(self) -> torch.device:
        return next(self._decoder.parameters()).device


class _Increment:
    """What is changed of a placement: shift and rotation vector, model units; and Adam's memory,
    which rounds share."""

    def __init__(self, points: Array, placed: Placed, device: torch.device) -> None:
        self._from = placed
        self._start = torch.from_numpy(placed.to_object(points).astype(np.float32)).to(device)
        # repeated points need the network once
        self._points, self._counts = torch.unique(self._start, dim=0, return_counts=True)
        self._vector = torch.tensor([0.0] * 3 + [START] * 3, device=device, requires_grad=True)
        self._adam = torch.optim.Adam([self._vector], lr=LEARNING_RATE)
        self._weights = torch.tensor([1.0] * 3 + [ROTATION_WEIGHT] * 3, device=device)

    def coordinates(self) -> Tensor:
        """All points as the object now has them, (4873, 3), model units."""
        return moved(self._start, self._vector.detach())

    def placed(self) -> Placed:
        """The changed placement."""
        vector = self._vector.detach().double().cpu()
        return self._from.after(
            torch.linalg.matrix_exp(skew(vector[3:])).numpy(), vector[:3].numpy()
        )

    def descend(self, shape: Shape) -> None:
        """One round of steps towards a shape."""
        where = torch.full_like(self._points, torch.inf)
        distance, slope = torch.empty_like(where[:, 0]), torch.empty_like(where)
        for _ in range(STEPS):
            at = moved(self._points, self._vector)
            now = at.detach()
            stale = (now - where).norm(dim=1) > LINEAR_REACH
            if queued(now):
                # evaluating all is quicker than asking how many need it
                anew = shape.distances_and_gradients(now)
                where = torch.where(stale[:, None], now, where)
                distance = torch.where(stale, anew[0], distance)
                slope = torch.where(stale[:, None], anew[1], slope)
            elif bool(stale.any()):
                where[stale] = now[stale]
                distance[stale], slope[stale] = shape.distances_and_gradients(now[stale])
            linear = distance + ((at - where) * slope).sum(1)
            loss = (self._counts * linear.clamp(-CLAMP, CLAMP).abs()).sum()
            (gradient,) = torch.autograd.grad(loss, self._vector)
            self._vector.grad = self._weights * gradient
            tap("loss", loss)
            tap("gradient", gradient)
            self._adam.step()
            tap("increment", self._vector)


def moved(points: Tensor, increment: Tensor) -> Tensor:
    """Points (N, 3) rotated and shifted by an increment (6,)."""
    placed: Tensor = points @ torch.linalg.matrix_exp(skew(increment[3:])).T + increment[:3]
    return placed


def skew(vector: Tensor) -> Tensor:
    """The matrix (3, 3) of the cross product with a vector (3,)."""
    x, y, z = vector
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)


def distance_grid(shape: Shape) -> NDArray[np.float32]:
    """Signed distances (64, 64, 64), model units, on nodes from -1 to 1 along x, y and z.

    Far from the surface they are interpolated between those on (32, 32, 32).
    """
    device = shape.device
    coarse = shape.distances(_nodes(COARSE, device)).view(1, 1, *(COARSE,) * 3)
    fine = torch.nn.functional.interpolate(
        coarse, (FINE,) * 3, mode="trilinear", align_corners=True
    ).flatten()
    near = torch.nonzero(fine.abs() < NEAR)[:, 0]
    fine[near] = shape.distances(_nodes(FINE, device)[near])
    return fine.view(FINE, FINE, FINE).cpu().numpy()


def _nodes(count: int, device: torch.device) -> Tensor:
    axis = torch.linspace(-1, 1, count, device=device)
    return torch.cartesian_prod(axis, axis, axis)
