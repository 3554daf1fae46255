"""What surfaces are made of: colours, prints, grain, gloss, by place on the object."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.datasets._fields import cells
from pytest_cpas.datasets._patterns import second_colour
from pytest_cpas.datasets._scenes import Item
from pytest_cpas.types import Array

__all__ = ["Material", "material"]

_BLACK, _WHITE = np.array([0.04, 0.04, 0.045]), np.array([0.78, 0.78, 0.75])

#: How much of the light of objects is mirrored, 0 to 1.
_GLOSS = {"bottle": 0.5, "bowl": 0.4, "camera": 0.3, "can": 0.6, "laptop": 0.25, "mug": 0.4}
_GLASS = 0.95


@dataclass(frozen=True, eq=False)
class Material:
    """Of each point: ``albedo`` (N, 3) in 0..1, ``gloss`` (N,), the part of light that is mirrored,
    and ``infrared`` (N,), the part of infrared light that is scattered."""

    albedo: Array
    gloss: Array
    infrared: Array

    @classmethod
    def of(
        cls, albedo: Array, gloss: Array | float, infrared: Array | float | None = None
    ) -> Material:
        """As bright in infrared as in colour, if nothing is said."""
        grey = (albedo[:, 0] + albedo[:, 1] + albedo[:, 2]) / 3
        count = len(albedo)
        return cls(
            albedo,
            np.broadcast_to(gloss, count),
            np.broadcast_to(grey if infrared is None else infrared, count),
        )


def material(item: Item, points: Array) -> Material:
    """What an object is made of at points (N, 3) of its surface, in its own frame, metres."""
    low, high = item.mesh.bounds
    code = int(1e6 * item.colours[0, 0])  # of things that are called alike, each has its own
    seed = zlib.crc32(f"{item.pattern} {item.model} {code}".encode())
    # vertices have 7 digits: a face that lies where a cell of a pattern begins would be on either
    # side of it by the last digits of a pose
    points = np.round(points, 7) + 1.7e-8
    second = second_colour(item.pattern, points, points / (high - low))
    make = _SCENERY.get(item.pattern, _object)
    return make(item, points, second, seed)


def _object(item: Item, points: Array, second: NDArray[np.bool_], seed: int) -> Material:
    """Two colours, a print on the second, grain; what is dark or glass of cameras and laptops."""
    albedo = item.colours[second.astype(int)]
    gloss = np.full(len(points), _GLOSS.get(item.pattern, 0.1))
    infrared = None
    x, y, z = points.T
    match item.pattern:
        case "camera":
            albedo = 0.15 * albedo + 0.03
            gloss = np.where(second, _GLASS, gloss)  # the lens
        case "laptop":
            low, _ = item.mesh.bounds
            keyboard = second & (y < 0.8 * low[1])
            key = (np.mod(x / 0.019, 1) < 0.82) & (np.mod(z / 0.019, 1) < 0.82)
            albedo = np.where((second & (key | ~keyboard))[:, None], _BLACK, item.colours[0])
            display = second & ~keyboard
            gloss = np.where(display, _GLASS, gloss)
            infrared = np.where(display, 0.3, (albedo[:, 0] + albedo[:, 1] + albedo[:, 2]) / 3)
        case _:
            blocks = cells(seed, x / 0.009, y / 0.006, z / 0.009) < 0.3
            lines = (np.mod(y / 0.005, 1) < 0.5) & (cells(seed + 1, x / 0.004, y / 0.005) < 0.5)
            label = lines & (cells(seed + 2, y / 0.03) < 0.5)
            printed = second & (blocks | label)
            albedo = np.where(printed[:, None], 1 - 0.9 * albedo, albedo)
    return Material.of(albedo * _grain(seed, 0.06, x, y, z, size=0.002), gloss, infrared)


def _grain(seed: int, strength: float, *coordinates: Array, size: float) -> Array:
    """Factors (N, 1) around 1 that change from one cell of ``size`` metres to the next."""
    values = cells(seed, *(coordinate / size for coordinate in coordinates))
    return (1 + strength * (2 * values - 1))[:, None]


def _wood(item: Item, points: Array, second: NDArray[np.bool_], seed: int) -> Material:
    """Boards, with grain along x."""
    x, _, z = points.T
    board = 0.5 + 0.5 * cells(seed, x / 3 + 40, z / 0.11)[:, None]
    albedo = item.colours[0] * board + item.colours[1] * (1 - board)
    grain = _grain(seed, 0.09, x / 40, z, size=0.0025) * _grain(
        seed + 1, 0.07, x / 20, z, size=0.011
    )
    return Material.of(albedo * grain, 0.15)


def _tiles(item: Item, points: Array, second: NDArray[np.bool_], seed: int) -> Material:
    """Stone tiles with joints."""
    x, _, z = points.T
    joint = (np.mod(x / 0.2, 1) < 0.025) | (np.mod(z / 0.2, 1) < 0.025)
    albedo = np.where(joint[:, None], 0.45 * item.colours[1], item.colours[0])
    speckle = _grain(seed, 0.08, x, z, size=0.004) * _grain(seed + 1, 0.12, x, z, size=0.03)
    return Material.of(albedo * speckle, 0.2)


def _carpet(item: Item, points: Array, second: NDArray[np.bool_], seed: int) -> Material:
    x, y, z = points.T
    stripe = np.where(np.mod(x / 0.03, 1) < 0.5, 1.12, 0.88)[:, None]
    return Material.of(item.colours[0] * stripe * _grain(seed, 0.18, x, y, z, size=0.006), 0.0)


def _plaster(item: Item, points: Array, second: NDArray[np.bool_], seed: int) -> Material:
    """A wall, with shelves of books on part of it."""
    x, y, z = points.T
    along = x + z
    shelf = cells(seed, along / 1.1, y / 0.36) < 0.475
    book = cells(seed + 1, along / 0.034, y / 0.36)
    gap = (np.mod(y / 0.36, 1) < 0.1) | (np.mod(y / 0.36, 1) > 0.62 + 0.3 * book)
    spine = np.stack([cells(seed + k, along / 0.034, y / 0.36) for k in (2, 3, 4)], axis=-1)
    spine = np.where((np.mod(along / 0.034, 1) < 0.1)[:, None], 0.2, 1.0) * (0.06 + 0.9 * spine)
    plain = item.colours[0] * _grain(seed, 0.03, x, y, z, size=0.006)
    filled = np.where(gap[:, None], 0.12 * item.colours[1], spine)
    albedo = np.where(shelf[:, None], filled, plain)
    return Material.of(albedo, 0.0, 0.05 + 0.45 * albedo[:, 0])


def _card(item: Item, points: Array, second: NDArray[np.bool_], seed: int) -> Material:
    """A printed pattern of black and white squares within a white border."""
    low, high = item.mesh.bounds
    x, z = (points[:, axis] / (high - low)[axis] for axis in (0, 2))
    inside = (np.abs(x) < 0.42) & (np.abs(z) < 0.42)
    black = inside & (cells(seed, 8.4 * x + 20, 8.4 * z + 20) < 0.6)
    paper = np.where(black[:, None], 3.5 * _BLACK, _WHITE)
    return Material.of(paper, 0.05, 0.7)  # ink that infrared light passes


def _glass(item: Item, points: Array, second: NDArray[np.bool_], seed: int) -> Material:
    """The black front of a telephone."""
    return Material.of(np.broadcast_to(_BLACK, points.shape), _GLASS)


def _cloth(item: Item, points: Array, second: NDArray[np.bool_], seed: int) -> Material:
    x, y, z = points.T
    stripe = np.where(np.mod(y / 0.05, 1) < 0.4, 0, 1)
    return Material.of(item.colours[stripe] * _grain(seed, 0.14, x, y, z, size=0.004), 0.0)


def _skin(item: Item, points: Array, second: NDArray[np.bool_], seed: int) -> Material:
    x, y, z = points.T
    return Material.of(item.colours[0] * _grain(seed, 0.05, x, y, z, size=0.006), 0.1)


_SCENERY: dict[str, Callable[[Item, Array, NDArray[np.bool_], int], Material]] = {
    "wood": _wood,
    "tiles": _tiles,
    "carpet": _carpet,
    "plaster": _plaster,
    "card": _card,
    "glass": _glass,
    "cloth": _cloth,
    "skin": _skin,
}
