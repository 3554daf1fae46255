"""Draw how chamfer distance and F-score settle with the number of sampled points.

The experiment of Bruns & Jensfelt (2023) on mugs of our own: a 10 cm mug without handle is the
truth; the estimates are the same mug and two mugs with different handles. Writes
``sample_count_convergence.svg`` beside this file and prints what the picture shows:

    python docs/figures/sample_count_convergence.py

Needs matplotlib. Takes about a minute.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.metrics.surfaces import Surface, sample_surface, surface_errors
from pytest_cpas.types import Mesh

Array = NDArray[np.float64]

HEIGHT, RADIUS, WALL = 0.10, 0.04, 0.004


def grid_mesh(points: Array) -> Mesh:
    """The triangle mesh over a (rows, columns, 3) grid of points."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    triangles = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    return Mesh(points.reshape(-1, 3), np.concatenate(triangles))


def joined(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([m.triangles + start for m, start in zip(meshes, starts, strict=False)]),
    )


def mug(handle: tuple[float, float, float] | None = None) -> Mesh:
    """A mug standing along y, its walls ``WALL`` thick, centred on its axis.

    ``handle``: half height, reach and half thickness (metres) of a half-elliptic tube at +x.
    """
    bottom, top = -HEIGHT / 2, HEIGHT / 2
    inner = RADIUS - WALL
    floor = bottom + WALL
    profile = np.array(
        [(0, bottom), (RADIUS, bottom), (RADIUS, top), (inner, top), (inner, floor), (0, floor)]
    )
    turn = np.linspace(0, 2 * np.pi, 97)
    r, y = profile[:, :1], profile[:, 1:]
    cup = grid_mesh(np.stack([r * np.cos(turn), y + 0 * turn, r * np.sin(turn)], axis=-1))
    if handle is None:
        return cup
    half_height, reach, thickness = handle
    along = np.linspace(-np.pi / 2, np.pi / 2, 49)[:, None]
    out = np.stack([half_height * np.cos(along), reach * np.sin(along)], axis=-1)
    out /= np.linalg.norm(out, axis=-1, keepdims=True)
    x = RADIUS - thickness / 2 + reach * np.cos(along) + thickness * out[..., 0] * np.cos(turn)
    y = half_height * np.sin(along) + thickness * out[..., 1] * np.cos(turn)
    return joined([cup, grid_mesh(np.stack([x, y, thickness * np.sin(turn) + 0 * x], axis=-1))])


MUGS = {
    "same mug": mug(),
    "large handle": mug((0.038, 0.036, 0.006)),
    "small handle": mug((0.022, 0.020, 0.003)),
}


def errors_at(count: int, seed: int) -> dict[str, tuple[float, float]]:
    """Chamfer distance (m) and F_1cm of the three estimates, ``count`` points per surface."""
    rng = np.random.default_rng(seed)
    truth = Surface(sample_surface(MUGS["same mug"], count, rng))
    result = {}
    for name, mesh in MUGS.items():
        errors = surface_errors(truth, sample_surface(mesh, count, rng))
        result[name] = errors.chamfer, float(errors.fscore(0.01))
    return result


def main() -> None:
    """Sample, print and draw."""
    import matplotlib

    matplotlib.use("svg")
    # reproducible, and with text as text
    matplotlib.rcParams.update({"svg.hashsalt": "mugs", "svg.fonttype": "none"})
    from matplotlib import pyplot

    counts = np.unique(np.logspace(2, 6, 17).astype(int))
    measured = [errors_at(int(count), seed) for seed, count in enumerate(counts)]
    figure, axes = pyplot.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    for column, (axis, name) in enumerate(
        zip(axes, ("chamfer distance (m)", "F-score at 1 cm"), strict=True)
    ):
        for pair in MUGS:
            values = [row[pair][column] for row in measured]
            axis.plot(counts, values, label=pair)
            print(f"{name:22s} {pair:12s}", " ".join(f"{value:.5f}" for value in values[::4]))
        axis.set(xscale="log", xlabel="sampled points per surface", ylabel=name)
    axes[0].set_yscale("log")
    axes[1].legend()
    target = Path(__file__).with_suffix(".svg")
    figure.savefig(target, metadata={"Date": None})
    print(f"wrote {target.name}")


if __name__ == "__main__":
    main()
