"""Colour images of rendered scenes: a lamp with shadows and highlights, and a camera's faults.

The lamp is a point; light from all sides makes up the rest. Surfaces are those of Lambert, with
Blinn's highlights. The camera blurs by a pixel, darkens the corners, adds noise, and stores square
roots of light, as an exponent that every processor computes alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.datasets._fields import bell
from pytest_cpas.datasets._materials import Material
from pytest_cpas.datasets._scenes import Item
from pytest_cpas.datasets.rasterising import rasterise
from pytest_cpas.datasets.rendering import Rendering, camera_rays, dot, render
from pytest_cpas.types import Array, Camera, Pose

__all__ = ["Lamp", "photograph"]

#: Pixels of the lamp's image, in which what it does not see is in shadow; metres of tolerance.
_MAP, _BIAS = 512, 0.008

#: What is lit by the lamp alone, and what by light from all sides.
_LAMP, _AROUND = 0.75, 0.42

#: Deviation of the noise, in 0..1 of the stored values.
_NOISE = 0.015


class Lamp:
    """A point at ``place`` (3,) metres in the camera frame, of ``colour`` (3,), that shines on
    ``target`` (3,)."""

    def __init__(self, place: Array, target: Array, colour: Array) -> None:
        self.place, self.colour = place, colour
        towards = target - place
        self.reach = float(np.sum(towards**2))  # where it is as bright as at the target, squared
        distance = float(np.sqrt(self.reach))
        forward = towards / distance
        right = np.cross(forward, [1.0, 0.0, 0.0])
        right /= np.sqrt(np.sum(right**2))
        axes = np.stack([right, np.cross(forward, right), forward])
        self._rotation = np.round(axes, 9)
        # 0.75 m around the target
        focal = round(_MAP / 2 * distance / 0.75, 3)
        self._camera = Camera(_MAP, _MAP, focal, focal, (_MAP - 1) / 2, (_MAP - 1) / 2)

    def shines(self, items: list[Item], points: Array) -> Array:
        """How much of the lamp points (N, 3) see, 0 to 1: at a shadow's border a part."""
        r = self._rotation
        posed = []
        for item in items:
            rotation = _turned(r, item.pose.rotation)
            moved = _turned(r, (item.pose.translation - self.place)[:, None])[:, 0]
            posed.append((item.mesh, Pose(np.round(rotation, 9), np.round(moved, 9))))
        nearest = render(posed, self._camera, rasterise).depth
        nearest = np.pad(np.where(nearest > 0, nearest, np.inf), 2, constant_values=np.inf)
        local = points - self.place
        x, y, z = (dot(local, axis) for axis in r)
        z = np.maximum(z, 1e-3)
        c = self._camera
        column = np.floor(x / z * c.fx + c.cx + 0.5).clip(-1, _MAP).astype(np.int64) + 2
        row = np.floor(y / z * c.fy + c.cy + 0.5).clip(-1, _MAP).astype(np.int64) + 2
        seen = np.zeros(len(points))
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                seen += nearest[row + down, column + right] > z - _BIAS
        return seen / 9


def photograph(
    items: list[Item],
    seen: Rendering,
    made_of: Material,
    camera: Camera,
    lamp: Lamp,
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """The colour image (H, W, 3) of a rendering whose pixels are ``made_of`` (H * W)."""
    rays = camera_rays(camera).reshape(-1, 3)
    points = rays * seen.depth.reshape(-1, 1)
    normal = seen.normal.reshape(-1, 3)
    to_lamp = lamp.place - points
    squared = dot(to_lamp, to_lamp)
    to_lamp = to_lamp / np.sqrt(squared)[:, None]
    fading = np.minimum(lamp.reach / squared, 1.6)
    facing = np.maximum(dot(normal, to_lamp), 0)
    lit = lamp.shines(items, points) * fading
    half = to_lamp - rays / np.sqrt(dot(rays, rays))[:, None]
    mirrored = np.maximum(dot(normal, half), 0) ** 2 / np.maximum(dot(half, half), 1e-9)
    for _ in range(4):  # to the power of 32, by squaring
        mirrored = mirrored * mirrored
    highlight = made_of.gloss * lit * np.where(facing > 0, mirrored, 0)
    # light from above more than from below
    around = _AROUND * (1 - 0.35 * normal[:, 1])
    light = lamp.colour * (_LAMP * lit * facing)[:, None] + around[:, None]
    image = (made_of.albedo * light + lamp.colour * highlight[:, None]).reshape(
        *seen.depth.shape, 3
    )
    return _exposed(image, camera, rng)


def _exposed(image: Array, camera: Camera, rng: np.random.Generator) -> NDArray[np.uint8]:
    """What a camera stores of light (H, W, 3)."""
    height, width = image.shape[:2]
    image = _blurred(image, 6)
    x = (np.arange(width) - camera.cx) / width
    y = (np.arange(height) - camera.cy) / width
    image = image * (1 - 0.5 * (x**2 + y[:, None] ** 2))[..., None]
    # exposed for a mean that is drawn; whole numbers have one sum
    mean = int(np.floor(4096 * np.minimum(image, 4)).astype(np.int64).sum()) / (4096 * image.size)
    image = image * (rng.uniform(0.26, 0.36) / max(mean, 1e-6))
    stored = np.sqrt(np.minimum(image, 1))
    # contrast and sharpness, as cameras add them
    stored = stored * stored * (3 - 2 * stored)
    stored += 0.7 * (stored - _blurred(stored, 2))
    stored += _NOISE * bell(image.shape, rng)
    levels: NDArray[np.uint8] = np.round(255 * stored.clip(0, 1)).astype(np.uint8)
    return levels


def _blurred(image: Array, centre: int) -> Array:
    """Averages by (1, ``centre``, 1) along rows and columns of (H, W, 3)."""
    for axis in (0, 1):
        size = image.shape[axis]
        padded = np.concatenate([image.take([0], axis), image, image.take([-1], axis)], axis)
        before, after = padded.take(range(size), axis), padded.take(range(2, size + 2), axis)
        image = (before + centre * image + after) / (centre + 2)
    return image


def _turned(rotation: Array, columns: Array) -> Array:
    """The matrix product of (3, 3) and (3, N), in one order of operations."""
    product: Array = (
        rotation[:, :1] * columns[0] + rotation[:, 1:2] * columns[1] + rotation[:, 2:] * columns[2]
    )
    return product
