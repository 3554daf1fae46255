"""Depth of signed distance fields along rays, by sphere tracing, with gradients; pure torch.

The field: distances (n, n, n) on the nodes of a cube, axes x, y, z, first and last node on its
faces, in units of its half-width, negative inside. Camera frame: OpenGL (y up, looking along -z).
The rendering is that of Bruns & Jensfelt (RA-L 2022, section IV-B).

A ray ends where the distance falls below a share of the way along it. The depth's gradient is
that of one further step of sphere tracing, at a fixed place on the ray: parameters that bring the
surface nearer by a millimetre there shorten the ray by a millimetre.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from method_adapters._networks.graphs import queued
from pytest_cpas.adapting import Camera

#: How a depth's gradient is shared among the eight nodes around the end of its ray: as in trilinear
#: interpolation, or as the published kernel does, with the weights in the wrong order.
Gradient = Literal["correct", "published"]


class Placement(NamedTuple):
    """Where a field is: ``position`` (3,) of its centre and ``half_width`` (), metres, and its
    ``rotation`` (3, 3), field to camera."""

    position: Tensor
    rotation: Tensor
    half_width: Tensor


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """The rotations (..., 3, 3) of quaternions (..., 4), scalar last, of any length."""
    x, y, z, w = (quaternion / quaternion.norm(dim=-1, keepdim=True)).unbind(-1)
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    ]
    rotation: Tensor = torch.stack(entries, -1).unflatten(-1, (3, 3))
    return rotation


def ray_directions(camera: Camera, rows: Tensor, columns: Tensor) -> Tensor:
    """Unit vectors (N, 3) through the centres of pixels."""
    x = (columns - camera.cx) / camera.fx
    y = -(rows - camera.cy) / camera.fy
    return functional.normalize(torch.stack([x, y, -torch.ones_like(x)], -1), dim=-1)


def distances(sdf: Tensor, place: Placement, points: Tensor) -> Tensor:
    """Interpolated distances (N,), metres, at points (N, 3); 0 outside the cube."""
    at = in_cube(place, points)
    inside = ((at >= -1) & (at < 1)).all(-1)
    return torch.where(inside, interpolated(sdf[None], at[None])[0], 0.0) * place.half_width


def ray_depths(
    sdf: Tensor,
    place: Placement,
    directions: Tensor,
    threshold: float,
    gradient: Gradient = "correct",
) -> tuple[Tensor, Tensor]:
    """Which rays (N,) from the camera's centre along unit ``directions`` (N, 3) meet the surface,
    and the depths along the optical axis (M,) of those that do, metres.

    A ray ends where the distance is less than ``threshold`` times its length.
    """
    with torch.no_grad():
        length = _traced(sdf, place, directions, threshold)
        hit = length > 0
        length, directions = length[hit, None], directions[hit]
    at = in_cube(place, length * directions)
    step = step_at(sdf[None], at[None], gradient)[0]
    step = step * place.half_width
    return hit, -directions[:, 2] * (length[:, 0] + step - step.detach())


def render_depth(
    sdf: Tensor,
    place: Placement,
    camera: Camera,
    threshold: float,
    gradient: Gradient = "correct",
) -> Tensor:
    """The depth image (H, W), metres, 0 where no ray meets the surface; see :func:`ray_depths`."""
    shape = (camera.height, camera.width)
    axes = (torch.arange(size, dtype=sdf.dtype, device=sdf.device) for size in shape)
    rows, columns = torch.meshgrid(*axes, indexing="ij")
    directions = ray_directions(camera, rows.flatten(), columns.flatten())
    hit, depth = ray_depths(sdf, place, directions, threshold, gradient)
    image = torch.zeros(len(hit), dtype=sdf.dtype, device=sdf.device)
    return image.masked_scatter(hit, depth).reshape(shape)


def in_cube(place: Placement, points: Tensor) -> Tensor:
    """Camera-frame points in the cube's own frame, where it reaches from -1 to 1."""
    return (points - place.position) @ place.rotation / place.half_width


def step_at(sdf: Tensor, at: Tensor, gradient: Gradient) -> Tensor:
    """The fields' values (B, N), in half-widths, at places (B, N, 3) in their cubes, with the
    gradient that is wanted."""
    if gradient == "correct":
        return interpolated(sdf, at)
    shared = _shared_as_published(sdf, at.detach())
    return interpolated(sdf.detach(), at) + (shared - shared.detach())


def interpolated(sdf: Tensor, at: Tensor) -> Tensor:
    """Trilinear (B, N), of fields (B, n, n, n) at places (B, N, 3) in their cubes; outside, the
    nearest value on the faces."""
    if torch.is_grad_enabled() and queued(sdf):
        return _interpolated_in_order(sdf, at)
    # torch takes the coordinate of the last axis first
    found = functional.grid_sample(
        sdf[:, None], at.flip(-1)[:, None, None], padding_mode="border", align_corners=True
    )
    return found[:, 0, 0, 0]


def _interpolated_in_order(sdf: Tensor, at: Tensor) -> Tensor:
    """The same, of which a GPU adds up the gradient in the same order from run to run."""
    values, (x, y, z) = _corners(sdf, at)
    u, v, w = 1 - x, 1 - y, 1 - z
    order = [u * v * w, u * v * z, u * y * w, u * y * z, x * v * w, x * v * z, x * y * w, x * y * z]
    return (values * torch.stack(order, -1)).sum(-1)


def _shared_as_published(sdf: Tensor, at: Tensor) -> Tensor:
    """Sums (B, N) over the nodes around each place, with the published kernel's weights.

    For the nodes in the order 000, 001, ... 111 (x, y, z) it has the list of weights shifted by
    one, and one of them twice.
    """
    values, (x, y, z) = _corners(sdf, at)
    u, v, w = 1 - x, 1 - y, 1 - z
    order = [u * v * z, u * y * w, u * y * z, x * v * w, x * v * z, x * v * z, x * y * w, x * y * z]
    return (values * torch.stack(order, -1)).sum(-1)


def _corners(sdf: Tensor, at: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The values (B, N, 8) of the nodes around places, z fastest, and how far each place is from
    the first of them in x, y and z, (B, N) each, in cells."""
    side = sdf.shape[-1]
    cell = (at.clamp(-1, 1) + 1) * ((side - 1) / 2)
    # what is no number becomes a node, too, and stays none in the result
    base = cell.detach().floor().clamp(0, side - 2).nan_to_num(0)
    # sums of products written out: CUDA has no product of integer matrices
    i, j, k = base.long().unbind(-1)
    field = torch.arange(len(sdf), device=sdf.device)[:, None]
    corner = torch.arange(8, device=sdf.device)
    ahead = (corner // 4 * side + corner // 2 % 2) * side + corner % 2
    nodes = (((field * side + i) * side + j) * side + k)[..., None] + ahead
    # indexing, not gather: it is sums in order that its gradient takes on a GPU
    return sdf.flatten()[nodes], (cell - base).unbind(-1)


def _traced(sdf: Tensor, place: Placement, directions: Tensor, threshold: float) -> Tensor:
    """Lengths (N,) of the rays, metres, 0 for those that miss."""
    start = -(place.position @ place.rotation) / place.half_width
    slope = directions @ place.rotation / place.half_width
    faces = torch.stack([(-1 - start) / slope, (1 - start) / slope])
    length, leaves = faces.amin(0).amax(-1).clamp(min=0), faces.amax(0).amin(-1)
    found = torch.zeros_like(length)
    ray = torch.nonzero(length < leaves)[:, 0]
    length, leaves, slope = length[ray], leaves[ray], slope[ray]
    while len(ray):
        at = start + length[:, None] * slope
        step = interpolated(sdf[None], at[None])[0] * place.half_width
        ends = step < threshold * length
        found[ray[ends]] = length[ends]
        length = length + step
        on = torch.nonzero(~ends & (length < leaves))[:, 0]
        ray, length, leaves, slope = ray[on], length[on], leaves[on], slope[on]
    return found
