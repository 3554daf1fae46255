"""The embedded data sets, read back from disk without any of the package's readers.

The truth that the files are held against is found from the written meshes, poses and images with
numpy, scipy and trimesh alone; no test of content goes through the renderer that made it.
"""

import os
import pickle
import pickletools
import re
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage, stats
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pytest_cpas.datasets import _scenes, synthetic
from pytest_cpas.datasets.nocs import NocsTree
from pytest_cpas.datasets.rendering import render
from pytest_cpas.datasets.synthetic import HANDHELD, TABLETOP, generate
from pytest_cpas.types import CATEGORIES, Array, Mesh

INTRINSICS = {
    "synthetic-tabletop": (591.0125, 590.16775, 322.525, 244.11084),
    "synthetic-handheld": (525.0, 525.0, 319.5, 239.5),
}
# quick subsets that have all categories between them, and a distractor (tabletop scene 3)
SUBSETS = {"synthetic-tabletop": (3,), "synthetic-handheld": (1, 4, 12)}


class NumpyOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        assert (module, name) in {
            ("numpy._core.multiarray", "_reconstruct"),
            ("numpy", "ndarray"),
            ("numpy", "dtype"),
        }
        return super().find_class(module, name)


def read_pickle(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        content = NumpyOnly(file).load()
    assert isinstance(content, dict)
    return content


@dataclass
class Seen:
    """An object of a frame, read back. Vertices and pose are in the files' own axes (NOCS)."""

    where: str
    category: str
    model: str
    mask: NDArray[np.bool_]
    points: Array  # (N, 3) measured, camera frame
    nocs: Array  # (N, 3) of the same pixels, centred, unit = box diagonal
    depth: Array  # (H, W) m
    vertices: Array
    faces: NDArray[np.int64]
    rotation: Array
    translation: Array
    scale: float
    intrinsics: tuple[float, float, float, float]

    @property
    def surface(self) -> Array:
        """Points sampled densely on the posed mesh, camera frame."""
        body = trimesh.Trimesh(self.vertices, self.faces, process=False)
        sampled = trimesh.sample.sample_surface(body, 60_000, seed=0)[0]
        return np.asarray(sampled) @ self.rotation.T + self.translation


def read_tree(root: Path, name: str) -> list[Seen]:
    fx, fy, cx, cy = INTRINSICS[name]
    objects = []
    meshes: dict[str, trimesh.Trimesh] = {}
    for meta in sorted(root.glob("real_test/scene_*/*_meta.txt")):
        stem = str(meta)[: -len("_meta.txt")]
        mask = np.asarray(Image.open(f"{stem}_mask.png"))
        depth = np.asarray(Image.open(f"{stem}_depth.png")) / 1000.0
        coord = np.asarray(Image.open(f"{stem}_coord.png")) / 255.0
        scene, number = meta.parent.name, meta.name[:4]
        truth = read_pickle(root / f"gts/real_test/results_real_test_{scene}_{number}.pkl")
        lines = [line.split() for line in meta.read_text().splitlines()]
        assert {int(line[0]) for line in lines} | {255} == set(np.unique(mask).tolist())
        valid = [line for line in lines if line[1] != "0"]
        assert [int(line[0]) for line in valid] == sorted(int(line[0]) for line in valid)
        assert truth["gt_RTs"].shape == (len(valid), 4, 4)
        for (mask_id, class_id, model), scaled in zip(valid, truth["gt_RTs"], strict=True):
            if model not in meshes:
                path = root / f"fixed_real_test_obj_models/{model}.obj"
                meshes[model] = trimesh.load_mesh(path, process=False)
            pixels = mask == int(mask_id)
            v, u = np.nonzero(pixels & (depth > 0))
            z = depth[v, u]
            nocs = coord[v, u].copy()
            nocs[:, 2] = 1 - nocs[:, 2]
            scale = np.cbrt(np.linalg.det(scaled[:3, :3]))
            objects.append(
                Seen(
                    f"{name}/{scene}/{number}/{mask_id}",
                    CATEGORIES[int(class_id) - 1],
                    model,
                    pixels,
                    np.stack([(u - cx) * z / fx, (v - cy) * z / fy, z], axis=-1),
                    nocs - 0.5,
                    depth,
                    np.asarray(meshes[model].vertices),
                    np.asarray(meshes[model].faces),
                    scaled[:3, :3] / scale,
                    scaled[:3, 3],
                    float(scale),
                    INTRINSICS[name],
                )
            )
    return objects


@pytest.fixture(scope="module")
def trees(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A few scenes of each split, made afresh."""
    folder = tmp_path_factory.mktemp("synthetic")
    for split in (TABLETOP, HANDHELD):
        generate(split, folder / split.name, SUBSETS[split.name])
    return {split.name: folder / split.name for split in (TABLETOP, HANDHELD)}


@pytest.fixture(scope="module")
def seen(trees: dict[str, Path]) -> list[Seen]:
    objects = [item for name, root in trees.items() for item in read_tree(root, name)]
    assert {item.category for item in objects} == set(CATEGORIES)
    return objects


def rotation_error(a: Array, b: Array) -> float:
    return float(np.rad2deg(2 * np.arcsin(min(1, np.linalg.norm(a - b) / np.sqrt(8)))))


# -- layout ---------------------------------------------------------------------------------


def test_layout_is_that_of_real275(trees: dict[str, Path]) -> None:
    known = [
        r"real_test/scene_\d+/\d{4}_(color\.png|depth\.png|mask\.png|coord\.png|meta\.txt)",
        r"gts/real_test/results_real_test_scene_\d+_\d{4}\.pkl",
        r"obj_models/real_test/\w+\.(obj|txt)",
        r"fixed_real_test_obj_models/\w+\.obj",
        r"digest\.txt",
    ]
    for name, root in trees.items():
        files = [p.relative_to(root).as_posix() for p in root.rglob("*") if p.is_file()]
        assert all(any(re.fullmatch(k, f) for k in known) for f in files)
        frames = len(SUBSETS[name]) * {"synthetic-tabletop": 5, "synthetic-handheld": 7}[name]
        for pattern in ("color.png", "depth.png", "mask.png", "coord.png", "meta.txt", ".pkl"):
            assert sum(f.endswith(pattern) for f in files) == frames


def test_images_have_the_published_modes(trees: dict[str, Path], test_data: Path) -> None:
    def kind_of(path: Path) -> tuple[tuple[int, int], str]:
        with Image.open(path) as image:
            return image.size, image.mode

    published = test_data / "real275/real_test/scene_1"
    for root in trees.values():
        for kind in ("color", "depth", "mask", "coord"):
            real = kind_of(published / f"0000_{kind}.png")
            for path in root.glob(f"real_test/*/*_{kind}.png"):
                assert kind_of(path) == real


def test_pickles_have_the_published_keys_and_types(trees: dict[str, Path], test_data: Path) -> None:
    def shape(path: Path) -> tuple[list[str], list[str]]:
        """Keys and globals of a pickle, with numpy's old name of its core."""
        text = path.read_bytes()
        named = [str(a) for op, a, _ in pickletools.genops(text) if op.name == "GLOBAL"]
        named = [n.replace("numpy._core", "numpy.core") for n in named]
        keys = [str(a) for op, a, _ in pickletools.genops(text) if op.name == "BINUNICODE"]
        return [k for k in keys if k in ("gt_RTs", "image_path")], named

    published = shape(test_data / "real275/gts/real_test/results_real_test_scene_1_0000.pkl")
    for root in trees.values():
        for path in (root / "gts/real_test").iterdir():
            assert shape(path) == published
            content = read_pickle(path)
            assert list(content) == ["gt_RTs", "image_path"]
            assert content["gt_RTs"].dtype == np.float64
            assert (root / content["image_path"]).is_file()
            np.testing.assert_array_equal(
                content["gt_RTs"][:, 3], np.tile([0.0, 0, 0, 1], (len(content["gt_RTs"]), 1))
            )


def test_a_distractor_is_listed_but_is_no_sample(trees: dict[str, Path]) -> None:
    root = trees["synthetic-tabletop"]
    lines = [
        line.split()
        for path in root.glob("real_test/*/*_meta.txt")
        for line in path.read_text().splitlines()
    ]
    distractors = [line for line in lines if line[1] == "0"]
    assert distractors
    tree = NocsTree("t", root, TABLETOP.camera)
    assert len(tree.samples) == len(lines) - len(distractors)


# -- content --------------------------------------------------------------------------------


def test_meshes_are_closed_centred_and_their_extents_are_written(trees: dict[str, Path]) -> None:
    for root in trees.values():
        for path in (root / "fixed_real_test_obj_models").iterdir():
            mesh = trimesh.load_mesh(path, process=False)
            assert mesh.is_watertight
            assert mesh.volume > 0
            np.testing.assert_allclose(mesh.bounds[0], -mesh.bounds[1], atol=1e-9)
            original = root / "obj_models/real_test" / path.name
            assert original.read_bytes() == path.read_bytes()
            np.testing.assert_allclose(
                np.loadtxt(original.with_suffix(".txt")), mesh.extents, atol=1e-9
            )


def test_scale_is_the_box_diagonal(seen: list[Seen]) -> None:
    for item in seen:
        diagonal = np.linalg.norm(np.ptp(item.vertices, axis=0))
        assert item.scale == pytest.approx(diagonal, abs=1e-7), item.where
        np.testing.assert_allclose(item.rotation @ item.rotation.T, np.eye(3), atol=1e-7)


def test_measured_points_lie_on_the_posed_mesh(seen: list[Seen]) -> None:
    for item in seen:
        distance = cKDTree(item.surface).query(item.points)[0]
        assert np.median(distance) < 0.003, item.where
        assert np.quantile(distance, 0.99) < 0.02, item.where


def test_masks_are_what_is_visible_of_the_silhouettes(seen: list[Seen]) -> None:
    for item in seen:
        fx, fy, cx, cy = item.intrinsics
        height, width = item.mask.shape
        x, y, z = item.surface.T
        column = np.round(fx * x / z + cx).astype(int)
        row = np.round(fy * y / z + cy).astype(int)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        nearest = np.full(item.mask.shape, np.inf)
        np.minimum.at(nearest, (row[inside], column[inside]), z[inside])
        silhouette = np.isfinite(nearest)
        around = ndimage.binary_dilation(silhouette, iterations=2)
        assert not np.any(item.mask & ~around), item.where
        # what is not in the mask is at the border, or something nearer hides it
        hidden = ndimage.binary_erosion(silhouette, iterations=2) & ~item.mask
        measured = hidden & (item.depth > 0)
        nearer = item.depth[measured] < nearest[measured] + 0.01
        assert nearer.mean() > 0.95 if nearer.size else True, item.where


def test_nocs_maps_fit_depth_at_the_ground_truth(seen: list[Seen]) -> None:
    """Umeyama's fit of the map to the measured points finds rotation, translation and scale."""
    for item in seen:
        source, target = item.nocs, item.points
        a, b = source - source.mean(axis=0), target - target.mean(axis=0)
        u, s, vt = np.linalg.svd(b.T @ a / len(a))
        sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
        rotation = u @ sign @ vt
        scale = np.trace(np.diag(s) @ sign) / a.var(axis=0).sum()
        translation = target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
        # a sliver of a laptop's screen, seen edge-on, is fitted worst
        assert rotation_error(rotation, item.rotation) < 3, item.where
        assert np.linalg.norm(translation - item.translation) < 0.01, item.where
        assert scale == pytest.approx(item.scale, rel=0.05), item.where
        residual = item.scale * source @ item.rotation.T + item.translation - target
        assert np.median(np.linalg.norm(residual, axis=1)) < 0.004, item.where


def test_enough_of_each_sample_is_seen(seen: list[Seen]) -> None:
    for item in seen:
        assert len(item.points) >= 500, item.where
        assert item.points[:, 2].min() > 0.25
        assert item.translation[2] < 2


def test_loader_gives_the_same_in_the_shapenet_frame(
    trees: dict[str, Path], seen: list[Seen]
) -> None:
    """Surface points posed by the loader's pose are those posed in the files' axes."""
    by_id = {item.where: item for item in seen}
    for name, root in trees.items():
        split = {"synthetic-tabletop": TABLETOP, "synthetic-handheld": HANDHELD}[name]
        tree = NocsTree(name, root, split.camera)
        assert len(tree.samples) == sum(where.startswith(name) for where in by_id)
        for ref in tree.samples:
            sample = tree.load(ref)
            item = by_id[f"{name}/{ref.id}"]
            assert isinstance(sample.truth.surface, Mesh)
            np.testing.assert_allclose(
                sample.truth.pose.apply(sample.truth.surface.vertices),
                item.vertices @ item.rotation.T + item.translation,
                atol=1e-7,
            )
            x, y, z = np.ptp(item.vertices, axis=0)
            np.testing.assert_allclose(sample.truth.extents, [z, y, x], atol=1e-9)
            np.testing.assert_array_equal(sample.observation.mask, item.mask)


# -- the full splits ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def full() -> dict[str, tuple[NocsTree, list[Seen]]]:
    """Both splits as a user has them, in the cache (made there if they are not)."""
    loaded = [synthetic.SyntheticTabletop(None), synthetic.SyntheticHandheld(None)]
    return {tree.name: (tree, read_tree(tree.root, tree.name)) for tree in loaded}


def test_counts(full: dict[str, tuple[NocsTree, list[Seen]]]) -> None:
    for name, (tree, objects) in full.items():
        assert len(objects) == len(tree.samples) >= 120
        counts = Counter(item.category for item in objects)
        assert set(counts) == set(CATEGORIES)
        assert min(counts.values()) >= 0.8 * max(counts.values()), counts
        assert tree.digest == (tree.root / "digest.txt").read_text().strip()
        models = {item.model for item in objects}
        assert Counter(m.rsplit("_", 1)[0] for m in models) == dict.fromkeys(CATEGORIES, 3), name
        size = sum(path.stat().st_size for path in tree.root.rglob("*"))
        assert size < 50e6


def test_a_scene_is_made_again_byte_for_byte(
    trees: dict[str, Path], full: dict[str, tuple[NocsTree, list[Seen]]]
) -> None:
    """Made alone, now, it has the bytes of the full split in the cache, made some time ago."""
    for name, root in trees.items():
        files = [p for p in root.rglob("*") if p.is_file() and p.name != "digest.txt"]
        assert len(files) > 20
        for path in files:
            cached = full[name][0].root / path.relative_to(root)
            assert path.read_bytes() == cached.read_bytes(), path.name


def test_another_processor_makes_the_same_bytes(trees: dict[str, Path], tmp_path: Path) -> None:
    """Without numpy's and OpenBLAS' vector instructions, which round sines and sums otherwise."""
    program = (
        "import pathlib, sys\n"
        "from pytest_cpas.datasets.synthetic import HANDHELD, TABLETOP, generate\n"
        "for split in (TABLETOP, HANDHELD):\n"
        "    generate(split, pathlib.Path(sys.argv[1], split.name), [3 if split.key == 0 else 4])\n"
    )
    features = np._core._multiarray_umath.__cpu_dispatch__  # type: ignore[attr-defined]
    slow = {
        "NPY_DISABLE_CPU_FEATURES": " ".join(features),
        "OPENBLAS_CORETYPE": "Nehalem",
        "OMP_NUM_THREADS": "1",
    }
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program, str(tmp_path)],
        env=os.environ | slow,
        check=True,
    )
    made = [p for p in tmp_path.rglob("*") if p.is_file() and p.name != "digest.txt"]
    assert len(made) > 60
    for path in made:
        relative = path.relative_to(tmp_path)
        assert (
            path.read_bytes() == (trees[relative.parts[0]] / Path(*relative.parts[1:])).read_bytes()
        )


def test_tabletop_is_upright_and_handheld_is_not(
    full: dict[str, tuple[NocsTree, list[Seen]]],
) -> None:
    up = {n: np.stack([o.rotation[:, 1] for o in objects]) for n, (_, objects) in full.items()}
    # on a table: all objects of a frame share their up axis, and the camera looks down on it
    frames: dict[str, list[Seen]] = {}
    for item in full["synthetic-tabletop"][1]:
        frames.setdefault(item.where.rsplit("/", 1)[0], []).append(item)
    for objects in frames.values():
        axes = np.stack([item.rotation[:, 1] for item in objects])
        np.testing.assert_allclose(axes, axes[:1].repeat(len(axes), axis=0), atol=1e-6)
        # and they stand on one plane
        feet = [
            item.translation - item.rotation[:, 1] * np.ptp(item.vertices[:, 1]) / 2
            for item in objects
        ]
        heights = np.stack(feet) @ axes[0]
        assert np.ptp(heights) < 1e-6
    elevation = np.rad2deg(np.arcsin(-up["synthetic-tabletop"][:, 2]))
    assert elevation.min() > 14
    assert elevation.max() < 61
    assert np.ptp(elevation) > 30
    # uniform over SO(3): the up axis is uniform on the sphere, so are its coordinates
    free = up["synthetic-handheld"]
    for axis in range(3):
        assert stats.kstest(free[:, axis], stats.uniform(-1, 2).cdf).pvalue > 0.001
    assert np.linalg.norm(free.mean(axis=0)) < 0.2
    assert np.linalg.norm(up["synthetic-tabletop"].mean(axis=0)) > 0.9


def test_free_orientations_are_uniform() -> None:
    """The angle of a rotation that is uniform over SO(3) has the CDF (angle - sin angle) / pi."""
    rng = np.random.default_rng(8)
    drawn = np.stack([_scenes._random_rotation(rng) for _ in range(4000)])
    for fixed in (np.eye(3), drawn[0]):  # uniform means: as seen from any rotation
        angles = Rotation.from_matrix(fixed.T @ drawn[1:]).magnitude()
        assert stats.kstest(angles, lambda a: (a - np.sin(a)) / np.pi).pvalue > 0.01


def test_objects_occlude_each_other(full: dict[str, tuple[NocsTree, list[Seen]]]) -> None:
    for name, (tree, _) in full.items():
        shares = []
        for ref in tree.samples[:: 2 if name == "synthetic-tabletop" else 3]:
            sample = tree.load(ref)
            assert isinstance(sample.truth.surface, Mesh)
            alone = render([(sample.truth.surface, sample.truth.pose)], tree.camera)
            shares.append(sample.observation.mask.sum() / (alone.instance == 0).sum())
        assert np.mean(np.array(shares) < 0.95) > (0.15 if name == "synthetic-tabletop" else 0.7)
        assert min(shares) > 0.25
