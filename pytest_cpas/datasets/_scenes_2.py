"""What stands beside the objects of the embedded data sets with the closer pictures."""

from __future__ import annotations

import dataclasses

import numpy as np

from pytest_cpas.datasets._scenes import (
    HandheldScene,
    Item,
    Stock,
    TabletopScene,
    about_y,
    box,
    free_place,
    rounded_pose,
)
from pytest_cpas.datasets.rasterising import rasterise
from pytest_cpas.types import Array, Camera

__all__ = ["FurnishedTabletop", "HandheldIndoors"]

#: Colours (2, 3) of table tops by what they are made of.
_TOPS = {
    "wood": [[0.62, 0.45, 0.26], [0.45, 0.30, 0.16]],
    "tiles": [[0.52, 0.49, 0.45], [0.40, 0.38, 0.36]],
    "carpet": [[0.24, 0.22, 0.17], [0.2, 0.18, 0.15]],
}


class FurnishedTabletop(TabletopScene):
    """On wood, tiles or carpet, with printed cards and a telephone that lie about."""

    distances = (0.7, 1.2)

    def __init__(self, stock: Stock, seed: int, split: int, number: int, camera: Camera) -> None:
        super().__init__(stock, seed, split, number, camera)
        rng = np.random.default_rng([seed, split, 3, number])
        top = list(_TOPS)[number % len(_TOPS)]
        self._room = (
            (top, np.array(_TOPS[top]) * rng.uniform(0.8, 1.3)),
            ("carpet", np.array(_TOPS["carpet"])),
            ("plaster", np.array([[0.72, 0.69, 0.62], [0.6, 0.5, 0.4]]) * rng.uniform(0.7, 1.2)),
        )
        self._flat: list[tuple[Item, Array, Array]] = []
        for pattern in ("card", "card", "card", "card", "glass"):
            wide, long, high = rng.uniform(0.10, 0.14), rng.uniform(0.10, 0.14), 0.004
            if pattern == "glass":
                wide, long, high = 0.075, 0.15, 0.008
            place = free_place(self._placed, float(np.sqrt(wide**2 + long**2)) / 2, rng)
            self._placed.append((place, float(np.sqrt(wide**2 + long**2)) / 2))
            turn = about_y(rng.uniform(0, 2 * np.pi))
            at = np.array([place[0], high / 2, place[1]])
            item = Item(
                box(np.array([wide, high, long])),
                rounded_pose(turn, at),
                rng.uniform(0, 1, (2, 3)),
                pattern,
            )
            self._flat.append((item, turn, at))

    def compose(self, rng: np.random.Generator) -> list[Item]:
        """The same objects from another side."""
        items = super().compose(rng)
        room, things = items[: len(self._room)], items[len(self._room) :]
        table = room[0].pose
        # the world's origin is on the table, half its thickness above its centre
        origin = table.translation - table.rotation @ np.array([0.0, -0.02, 0.0])
        flat = [
            dataclasses.replace(
                item,
                pose=rounded_pose(table.rotation @ turn, table.rotation @ at + origin),
            )
            for item, turn, at in self._flat
        ]
        made = [
            dataclasses.replace(item, pattern=pattern, colours=colours)
            for item, (pattern, colours) in zip(room, self._room, strict=True)
        ]
        return [*made, *flat, *things]


class HandheldIndoors(HandheldScene):
    """Before a wall with shelves, held by somebody in striped clothes."""

    cast = staticmethod(rasterise)

    def compose(self, rng: np.random.Generator) -> list[Item]:
        """The object in another pose and grip."""
        items = super().compose(rng)
        wall = items[0].colours
        pale = 0.3 * wall + 0.7 * (wall[:, :1] + wall[:, 1:2] + wall[:, 2:]) / 3
        items[0] = dataclasses.replace(items[0], colours=pale)
        patterns = ("plaster", "cloth", "skin")
        made = [
            dataclasses.replace(item, pattern=pattern)
            for item, pattern in zip(items, patterns, strict=False)
        ]
        return [*made, *items[len(patterns) :]]
