"""SDFEst's refinement of several objects at once, for a GPU, where a step takes as long for many as
for one, and a step that looks at no value on the host can be replayed as a graph.

What is found for an object does not depend on the others: there are always as many places, and an
object goes into those whose number of pixels is the next power of two above its own.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from method_adapters._networks.graphs import MOST, capture, numerics
from method_adapters._sdf_renderer import (
    Gradient,
    Placement,
    in_cube,
    interpolated,
    rotation_matrix,
    step_at,
)
from method_adapters._sdfest_estimation import (
    DEPTH_WEIGHT,
    HALF_WIDTH_RATE,
    LATENT_RATE,
    POINT_WEIGHT,
    POSITION_RATE,
    QUATERNION_RATE,
    THRESHOLD,
    Estimate,
    View,
)

#: Objects that are refined together.
PLACES = 8
#: Pixels that the smallest of them may have.
FEWEST = 512
#: Steps in which a ray is followed. An object with one that takes more has no result here.
TRACED = 64
#: Of Adam, as published.
DECAY, SQUARE_DECAY, EPSILON = 0.9, 0.999, 1e-8


class Together:
    """The refinement with one decoder."""

    def __init__(self, vae: nn.Module, gradient: Gradient) -> None:
        self._vae, self._gradient = vae, gradient
        self._places: dict[tuple[Any, ...], _Places] = {}

    def __call__(
        self, starts: Sequence[Estimate], views: Sequence[View], iterations: int
    ) -> list[Estimate | None]:
        """The estimates after so many steps; None for an object with a ray that did not end."""
        found: list[Estimate | None] = [None] * len(starts)
        alike: dict[int, list[int]] = defaultdict(list)
        for i, view in enumerate(views):
            alike[max(FEWEST, 1 << (len(view.points) - 1).bit_length())].append(i)
        for pixels, group in alike.items():
            for first in range(0, len(group), PLACES):
                chosen = group[first : first + PLACES]
                places = self._at(pixels, starts[chosen[0]])
                results = places.refined(
                    [starts[i] for i in chosen], [views[i] for i in chosen], iterations
                )
                for i, result in zip(chosen, results, strict=True):
                    found[i] = result
        return found

    def _at(self, pixels: int, like: Estimate) -> _Places:
        key = (pixels, len(like.latent), *numerics())
        if key not in self._places:
            if len(self._places) == MOST:
                del self._places[next(iter(self._places))]
            self._places[key] = _Places(self._vae, pixels, like, self._gradient)
        return self._places[key]


class _Places:
    """Objects in ``PLACES`` places, whose views have ``pixels`` pixels, some of them empty.

    Of every object ``state`` has latent, position, quaternion and half-width in one row.
    """

    def __init__(self, vae: nn.Module, pixels: int, like: Estimate, gradient: Gradient) -> None:
        self._vae, self._gradient = vae, gradient
        self._sizes = [len(like.latent), 3, 4, 1]
        rates = (LATENT_RATE, POSITION_RATE, QUATERNION_RATE, HALF_WIDTH_RATE)
        each = [rate for rate, size in zip(rates, self._sizes, strict=True) for _ in range(size)]
        new = like.latent.new_zeros
        self._rates = torch.tensor(each, dtype=like.latent.dtype, device=like.latent.device)
        self._state, self._mean, self._square = (new(PLACES, len(each)) for _ in range(3))
        self._steps = new(())
        directions, points = (new(PLACES, pixels, 3) for _ in range(2))
        self._view = View(directions, points, new(PLACES, 3, 3), new(PLACES, 3))
        self._counts = new(PLACES)
        self._filled = new(PLACES, pixels, dtype=torch.bool)
        self._open = new(PLACES, dtype=torch.bool)
        self._replay: Callable[[], object] | None = None

    def refined(
        self, starts: Sequence[Estimate], views: Sequence[View], iterations: int
    ) -> list[Estimate | None]:
        """As :meth:`Together.__call__`, of objects that fit."""
        self._fill(starts, views)
        if self._replay is None:
            self._replay, _ = capture(self._step)
            self._fill(starts, views)
        for _ in range(iterations):
            self._replay()
        open_ = self._open.tolist()
        return [
            None if open_[i] else Estimate(*(part[i].clone() for part in self._parts(self._state)))
            for i in range(len(starts))
        ]

    def _fill(self, starts: Sequence[Estimate], views: Sequence[View]) -> None:
        """Begin anew; places that are left are taken by the first object."""
        for x in (self._mean, self._square, self._steps, self._open, self._filled):
            x.zero_()
        for place in range(PLACES):
            which = place if place < len(starts) else 0
            start, view = starts[which], views[which]
            self._state[place] = torch.cat([part.flatten() for part in start])
            count = len(view.points)
            for kept, part in zip(self._view[:2], view[:2], strict=True):
                kept[place].zero_()[:count] = part
            self._view.rotation[place], self._view.position[place] = view.rotation, view.position
            self._counts[place] = count
            self._filled[place, :count] = True

    def _parts(self, state: Tensor) -> Estimate:
        latent, position, quaternion, half_width = state.split(self._sizes, 1)
        return Estimate(latent, position, quaternion, half_width[:, 0])

    def _step(self) -> None:
        """One step of Adam for all."""
        with torch.enable_grad():
            state = self._state.detach().requires_grad_()
            (gradient,) = torch.autograd.grad(self._losses(self._parts(state)).sum(), state)
        self._steps += 1
        self._mean.mul_(DECAY).add_(gradient, alpha=1 - DECAY)
        self._square.mul_(SQUARE_DECAY).addcmul_(gradient, gradient, value=1 - SQUARE_DECAY)
        mean = self._mean / (1 - DECAY**self._steps)
        root = (self._square / (1 - SQUARE_DECAY**self._steps)).sqrt_() + EPSILON
        self._state -= self._rates * mean / root
        quaternion = self._parts(self._state).quaternion
        quaternion /= quaternion.norm(dim=1, keepdim=True)

    def _losses(self, now: Estimate) -> Tensor:
        """Of every object, see :func:`method_adapters._sdfest_estimation.refine`."""
        view = self._view
        sdf = self._vae(now.latent)[:, 0]
        turned = view.rotation.mT @ rotation_matrix(now.quaternion)
        position = (now.position - view.position)[:, None] @ view.rotation
        place = Placement(position, turned, now.half_width[:, None, None])
        at = in_cube(place, view.points)
        inside = ((at >= -1) & (at < 1)).all(-1) & self._filled
        near = torch.where(inside, interpolated(sdf, at), 0.0) * now.half_width[:, None]
        length, hit = self._traced(sdf.detach(), Placement(*(part.detach() for part in place)))
        at = in_cube(place, length[..., None] * view.directions)
        step = step_at(sdf, at, self._gradient) * now.half_width[:, None]
        depth = -view.directions[..., 2] * (length + step - step.detach())
        apart = torch.where(hit, depth + view.points[..., 2], 0.0).abs().sum(1)
        return POINT_WEIGHT * near.abs().sum(1) / self._counts + DEPTH_WEIGHT * apart / hit.sum(
            1
        ).clamp(min=1)

    @torch.no_grad()
    def _traced(self, sdf: Tensor, place: Placement) -> tuple[Tensor, Tensor]:
        """Lengths of the rays, metres, and which of them meet the surface; see
        :func:`method_adapters._sdf_renderer.ray_depths`."""
        start = -(place.position @ place.rotation) / place.half_width
        slope = self._view.directions @ place.rotation / place.half_width
        half_width = place.half_width[..., 0]
        faces = torch.stack([(-1 - start) / slope, (1 - start) / slope])
        length, leaves = faces.amin(0).amax(-1).clamp(min=0), faces.amax(0).amin(-1)
        on = self._filled & (length < leaves)
        hit = torch.zeros_like(on)
        for _ in range(TRACED):
            step = interpolated(sdf, start + length[..., None] * slope) * half_width
            ends = on & (step < THRESHOLD * length)
            hit |= ends
            on &= ~ends
            length = torch.where(on, length + step, length)
            on &= length < leaves
        self._open |= on.any(1)
        # a ray that meets nothing counts nowhere: it ends in the camera
        return torch.where(hit, length, 0.0), hit
