"""Make ``method_adapters/icp_priors.npz``, the shapes that the ``icp`` baseline fits.

For each category a few meshes that stand for the rest: from a population drawn with a seed of its
own (no data set uses it), those are taken one after the other that bring the population nearest to
the chosen, once boxes are scaled to the same size. Run from the project's root::

    python tools/make_icp_priors.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pytest_cpas.datasets.shapes import make, mean_shape
from pytest_cpas.metrics.surfaces import sample_surface
from pytest_cpas.types import CATEGORIES, Mesh

PATH = Path(__file__).parents[1] / "method_adapters" / "icp_priors.npz"
SEED, POPULATION, CANDIDATES, SAMPLES = 20240617, 120, 40, 1500
#: Shapes kept: more where the form varies with what axis scales cannot follow.
KEPT = {"bottle": 4, "bowl": 4, "camera": 4, "can": 2, "laptop": 10, "mug": 4}


def make_priors() -> dict[str, NDArray[np.generic]]:
    """The asset: per category ``C_vertices`` (shapes, V, 3) int16, object frame, in units of 10
    micrometres, and ``C_triangles`` (F, 3) uint16, the same for all of its shapes; ``C_mean`` (3,)
    and ``C_covariance`` (3, 3) float64 of the logarithms of the extents in metres."""
    arrays: dict[str, NDArray[np.generic]] = {}
    for category in CATEGORIES:
        population = _population(category)
        logs = np.log([np.ptp(mesh.bounds, axis=0) for mesh in population])
        arrays[f"{category}_mean"] = logs.mean(axis=0)
        arrays[f"{category}_covariance"] = np.cov(logs.T)
        meshes = _representatives(population, KEPT[category])
        vertices = np.stack([mesh.vertices for mesh in meshes])
        arrays[f"{category}_vertices"] = np.round(vertices * 1e5).astype(np.int16)
        arrays[f"{category}_triangles"] = meshes[0].triangles.astype(np.uint16)
    return arrays


def _population(category: str) -> list[Mesh]:
    rng = np.random.default_rng([SEED, CATEGORIES.index(category)])
    return [mean_shape(category), *(make(category, rng) for _ in range(POPULATION - 1))]


def _representatives(population: list[Mesh], count: int) -> list[Mesh]:
    # only meshes of the same build, so that the asset holds one set of triangles a category
    triangles = population[0].triangles
    population = [m for m in population if np.array_equal(m.triangles, triangles)][:CANDIDATES]
    extents = np.array([np.ptp(mesh.bounds, axis=0) for mesh in population])
    typical = np.exp(np.log(extents).mean(axis=0))
    clouds = [
        sample_surface(mesh, SAMPLES, seed=1) / box * typical
        for mesh, box in zip(population, extents, strict=True)
    ]
    trees = [cKDTree(cloud) for cloud in clouds]
    distance = np.array([[np.mean(tree.query(cloud)[0]) for tree in trees] for cloud in clouds])
    distance += distance.T
    # the mean shape is the first; every further one lowers the population's distance the most
    chosen = [0]
    while len(chosen) < count:
        nearest = distance[:, chosen].min(axis=1)
        gain = np.minimum(distance, nearest[:, None]).sum(axis=0)
        chosen.append(int(np.argmin(gain)))
    return [population[index] for index in chosen]


if __name__ == "__main__":
    np.savez_compressed(PATH, allow_pickle=False, **make_priors())
    print(f"{PATH}: {PATH.stat().st_size} bytes")
