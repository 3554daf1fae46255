"""Draw frames of the embedded data sets: colour, and depth in which what is missing is blue.

Writes ``pictures.jpg`` beside this file:

    python docs/figures/pictures.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pytest_cpas.datasets.nocs import NocsTree
from pytest_cpas.datasets.synthetic import SyntheticHandheld, SyntheticTabletop
from pytest_cpas.datasets.synthetic_2 import SyntheticHandheld2, SyntheticTabletop2

#: Two frames of a data set side by side; the later ones below.
FRAMES = (
    (SyntheticTabletop, "scene_3/0002", SyntheticHandheld, "scene_6/0001"),
    (SyntheticTabletop2, "scene_3/0001", SyntheticHandheld2, "scene_6/0001"),
)


def frame(tree: NocsTree, name: str) -> NDArray[np.uint8]:
    """Colour and depth of a frame side by side, at half their size."""
    stem = f"{tree.root}/real_test/{name}"
    colour = Image.open(f"{stem}_color.png").convert("RGB").reduce(2)
    depth = np.asarray(Image.open(f"{stem}_depth.png")).astype(float)[::2, ::2]
    grey = 255 * ((depth - 400) / 1600).clip(0, 1)
    blue = np.where(depth == 0, 160, grey)
    grey = np.where(depth == 0, 0, grey)
    drawn = np.stack([grey, grey, blue], axis=-1).astype(np.uint8)
    return np.concatenate([np.asarray(colour), drawn], axis=1)


def main() -> None:
    """Render what is not in the cache, and draw."""
    rows = []
    for one, first, other, second in FRAMES:
        rows.append(np.concatenate([frame(one(None), first), frame(other(None), second)], axis=1))
    target = Path(__file__).with_suffix(".jpg")
    Image.fromarray(np.concatenate(rows)).save(target, quality=82)
    print(f"wrote {target.name}")


if __name__ == "__main__":
    main()
