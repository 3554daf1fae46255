"""The embedded data sets with the closer pictures: a few frames of each, made afresh."""

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import picture_statistics
import pytest
from docs_pages import text
from numpy.typing import NDArray

from pytest_cpas.datasets import _scenes, synthetic, synthetic_2
from pytest_cpas.datasets._photographs import Lamp
from pytest_cpas.datasets._scenes import Item, box
from pytest_cpas.datasets.nocs import NocsTree
from pytest_cpas.datasets.synthetic import Split, generate
from pytest_cpas.datasets.synthetic_2 import (
    HANDHELD_2,
    TABLETOP_2,
    SyntheticHandheld2,
    SyntheticTabletop2,
)
from pytest_cpas.types import CATEGORIES, Array, Camera, Mesh, Pose

SPLITS = {split.name: split for split in (TABLETOP_2, HANDHELD_2)}

#: Of these scenes the first frame, and the digest of both; all categories are among them.
FEW = {
    "synthetic-tabletop-2": (
        (2, 3),
        "7778d1d5bf492b7daee52da60f943baabc88f74a886922b3d2d2c6ad29ab81ac",
    ),
    "synthetic-handheld-2": (
        (1, 4, 6, 11),
        "94e03e3c2be6e7614ed9158358678bbc7779c4bdf63a74d8aa30c67fc4c7f3a5",
    ),
}


def few(split: Split, root: Path) -> Path:
    generate(dataclasses.replace(split, frames=1), root, FEW[split.name][0])
    return root


@pytest.fixture(scope="module")
def trees(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Made where Open3D cannot be imported."""
    folder = tmp_path_factory.mktemp("synthetic-2")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "open3d", None)
        return {name: few(split, folder / name) for name, split in SPLITS.items()}


@pytest.mark.parametrize("name", SPLITS)
def test_the_bytes_are_known(trees: dict[str, Path], name: str) -> None:
    assert (trees[name] / "digest.txt").read_text().strip() == FEW[name][1]


def test_another_processor_makes_the_same_bytes(trees: dict[str, Path], tmp_path: Path) -> None:
    """Without numpy's and OpenBLAS' vector instructions, which round sines and sums otherwise."""
    program = (
        "import dataclasses, pathlib, sys\n"
        "from pytest_cpas.datasets.synthetic import generate\n"
        "from pytest_cpas.datasets.synthetic_2 import HANDHELD_2, TABLETOP_2\n"
        "for split, scene in ((TABLETOP_2, 3), (HANDHELD_2, 4)):\n"
        "    one = dataclasses.replace(split, frames=1)\n"
        "    generate(one, pathlib.Path(sys.argv[1], split.name), [scene])\n"
    )
    features = np._core._multiarray_umath.__cpu_dispatch__  # type: ignore[attr-defined]
    slow = {
        "NPY_DISABLE_CPU_FEATURES": " ".join(features),
        "OPENBLAS_CORETYPE": "Nehalem",
        "OMP_NUM_THREADS": "1",
    }
    command = [sys.executable, "-W", "ignore", "-c", program, str(tmp_path)]
    subprocess.run(command, env=os.environ | slow, check=True)
    made = [p for p in tmp_path.rglob("*") if p.is_file() and p.name != "digest.txt"]
    assert len(made) > 20
    for path in made:
        name, *inside = path.relative_to(tmp_path).parts
        assert path.read_bytes() == trees[name].joinpath(*inside).read_bytes(), path.name


def hull(camera: Camera, pose: Pose, mesh: Mesh) -> tuple[Array, Array]:
    pixels = camera.project(pose.apply(mesh.vertices))
    return pixels.min(axis=0), pixels.max(axis=0)


@pytest.mark.parametrize("name", SPLITS)
def test_masks_poses_and_maps_agree(trees: dict[str, Path], name: str) -> None:
    """Through the loader: an object's pixels lie within its projected mesh, its measured points in
    its box, beside it by no more than the shift, and little of it is lost."""
    camera = SPLITS[name].camera
    tree = NocsTree(name, trees[name], camera)
    assert len(tree.samples) >= (8 if name == "synthetic-tabletop-2" else 4)
    for ref in tree.samples:
        sample = tree.load(ref)
        observation, truth = sample.observation, sample.truth
        assert isinstance(truth.surface, Mesh)
        low, high = hull(camera, truth.pose, truth.surface)
        rows, columns = np.nonzero(observation.mask)
        assert columns.min() >= low[0] - 1
        assert columns.max() <= high[0] + 1
        assert rows.min() >= low[1] - 1
        assert rows.max() <= high[1] + 1
        points = camera.back_project(observation.depth, observation.mask)
        local = (points - truth.pose.translation) @ truth.pose.rotation
        outside = np.maximum(np.abs(local) - truth.extents / 2, 0).max(axis=1)
        assert np.median(outside) < 0.008, ref.id  # of a bottle in a hand a fifth is behind it
        lost = np.mean(observation.depth[observation.mask] == 0)
        assert lost <= 0.2, ref.id


def test_the_cameras_are_as_is_said() -> None:
    assert TABLETOP_2.camera == synthetic.TABLETOP.camera
    assert HANDHELD_2.camera.fy == pytest.approx(1.2 * HANDHELD_2.camera.fx)


def test_the_objects_are_those_of_the_first_two(trees: dict[str, Path], tmp_path: Path) -> None:
    old = {"synthetic-tabletop-2": synthetic.TABLETOP, "synthetic-handheld-2": synthetic.HANDHELD}
    for name, root in trees.items():
        for path in (root / "obj_models/real_test").glob("*.txt"):
            category, instance = path.stem.rsplit("_", 1)
            rng = [synthetic.SEED, old[name].key, 0, CATEGORIES.index(category), int(instance)]
            mesh = _scenes.shapes.make(category, np.random.default_rng(rng))
            x, y, z = np.ptp(mesh.bounds, axis=0)
            np.testing.assert_allclose(np.loadtxt(path), [z, y, x], atol=1e-9)


# -- statistics -----------------------------------------------------------------------------------


def recorded() -> dict[str, dict[str, Array]]:
    """The table of docs/pictures.md: least, median and largest value by column and statistic."""
    lines = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in text("pictures.md").splitlines()
        if line.startswith("| ")
    ]
    start = next(i for i, line in enumerate(lines) if line[0] == "of each frame")
    table = lines[start : start + 1 + len(picture_statistics.STATISTICS)]
    assert [line[0] for line in table[1:]] == list(picture_statistics.STATISTICS)
    return {
        column: {line[0]: np.array(line[place].split(", "), dtype=float) for line in table[1:]}
        for place, column in enumerate(table[0][1:], start=1)
    }


@pytest.mark.parametrize("name", SPLITS)
def test_medians_lie_within_those_of_real_frames(name: str) -> None:
    table = recorded()
    for statistic, (least, _, most) in table["real275"].items():
        assert least <= table[name][statistic][1] <= most, statistic
    # and those of the first two did not
    first = table[name.removesuffix("-2")]
    out = [
        s for s, (least, _, most) in table["real275"].items() if not least <= first[s][1] <= most
    ]
    assert len(out) >= 8


@pytest.mark.parametrize("name", SPLITS)
def test_frames_lie_within_what_is_recorded(trees: dict[str, Path], name: str) -> None:
    """What the page says of all frames holds for those made now."""
    table = recorded()[name]
    found = picture_statistics.of_folder(trees[name])
    for statistic, digits in picture_statistics.STATISTICS.items():
        least, _, most = table[statistic]
        half = 0.5 * 10.0**-digits + 1e-12
        assert np.all(found[statistic] >= least - half), statistic
        assert np.all(found[statistic] <= most + half), statistic


def test_the_real_frames_are_as_recorded(test_data: Path) -> None:
    found = picture_statistics.of_folder(test_data / "real275")
    for statistic, digits in picture_statistics.STATISTICS.items():
        ends = np.quantile(found[statistic], [0, 0.5, 1])
        np.testing.assert_allclose(
            recorded()["real275"][statistic], ends, atol=0.5 * 10.0**-digits + 1e-9
        )


@pytest.mark.parametrize("shift", [(0, 0), (4, -2), (-3, 5)])
def test_registration_is_found(shift: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    depth = np.full((480, 640), 1000.0)
    colour = 0.5 + 0.02 * rng.normal(size=depth.shape)
    for row, column in ((100, 120), (260, 300), (150, 430)):
        depth[row : row + 90, column : column + 70] = 800
        colour[row + shift[1] :, column + shift[0] :][:90, :70] += 0.3
    assert picture_statistics.registration(colour, depth) == shift


def test_roughness_is_that_of_the_noise() -> None:
    rng = np.random.default_rng(2)
    slope = np.arange(640) * 0.8 + np.arange(480)[:, None] * 0.5
    depth: NDArray[np.float64] = 700 + slope + 1.3 * rng.normal(size=(480, 640))
    depth[:, 300:] += 300  # an edge is no roughness
    _, deviation = picture_statistics.roughness(depth)
    assert np.median(deviation) == pytest.approx(1.3, rel=0.02)


@pytest.mark.minutes
@pytest.mark.parametrize("kind", [SyntheticTabletop2, SyntheticHandheld2])
def test_all_frames_are_as_recorded(kind: type[NocsTree]) -> None:
    tree = kind(None)  # type: ignore[call-arg, arg-type]
    assert tree.notes == ()
    found = picture_statistics.of_folder(tree.root)
    for statistic, digits in picture_statistics.STATISTICS.items():
        ends = np.quantile(found[statistic], [0, 0.5, 1])
        limit = 0.5 * 10.0**-digits + 1e-9
        np.testing.assert_allclose(recorded()[tree.name][statistic], ends, atol=limit)


@pytest.mark.minutes
@pytest.mark.parametrize("name", SPLITS)
def test_icp_matches_its_golden_tables(pytester: pytest.Pytester, name: str) -> None:
    run = ("--cpas-method=icp", f"--cpas-dataset={name}", "--cpas-require-golden")
    result = pytester.runpytest_inprocess("-q", "-p", "no:dash", *run)
    result.stdout.fnmatch_lines(["golden: MATCHES (bottle, bowl, camera, can, laptop, mug)"])
    assert result.ret == 0


# -- the rest -------------------------------------------------------------------------------------


def test_a_lamp_throws_shadows() -> None:
    floor = Item(
        box(np.array([2.0, 0.02, 2.0])),
        Pose(np.eye(3), [0, 0.31, 1.0]),
        np.zeros((2, 3)),
        "wood",
    )
    lid = dataclasses.replace(
        floor, mesh=box(np.array([0.2, 0.01, 0.2])), pose=Pose(np.eye(3), [0, 0.1, 1.0])
    )
    lamp = Lamp(np.array([0.0, -0.9, 1.0]), np.array([0.0, 0.3, 1.0]), np.ones(3))
    # the lid is 0.1 m from its middle to its side, and seen from the lamp 1.2 times that below it
    x = np.linspace(-0.3, 0.3, 61)
    points = np.stack([x, np.full(61, 0.3), np.full(61, 1.0)], axis=1)
    shines = lamp.shines([floor, lid], points)
    assert np.all(shines[np.abs(x) < 0.115] == 0)
    assert np.all(shines[np.abs(x) > 0.13] == 1)
    np.testing.assert_array_equal(lamp.shines([floor], points), 1)
    assert shines[np.argmin(np.abs(x - 0.12))] < 1


def test_another_digest_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CPAS_CACHE", str(tmp_path))
    small = dataclasses.replace(HANDHELD_2, name="small", scenes=1, frames=1)
    kind = type("Small", (SyntheticHandheld2,), {"split": small})
    tree = kind(None)
    (note,) = tree.notes
    assert note.startswith("small came out otherwise here")
    assert f"digest {tree.digest[:12]}, known {SyntheticHandheld2.known[:12]}" in note
    monkeypatch.setattr(kind, "known", tree.digest)
    assert list(kind(None).notes) == []


def test_the_recipe_has_every_module_that_decides_the_content() -> None:
    makers = {*synthetic.MAKERS, *SyntheticHandheld2.makers}
    assert synthetic_2 in makers
    known = {Path(str(module.__file__)).stem for module in makers} | {"synthetic", "nocs"}
    for module in SyntheticHandheld2.makers:
        source = Path(str(module.__file__)).read_text(encoding="utf-8")
        named = re.findall(r"from pytest_cpas\.datasets\.(\w+) import", source)
        assert set(named) <= known, module.__name__
