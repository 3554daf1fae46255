"""A small tree of our own in the layout of REAL275."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from pytest_cpas.datasets import _index

TURN = Rotation.from_rotvec([2.0, 0.3, -0.4])
EXTENTS_NOCS = np.array([0.1, 0.2, 0.3])

FACES = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]


def write_mesh(path: Path) -> None:
    corners = [
        np.array([x, y, z]) * EXTENTS_NOCS / 2 for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)
    ]
    lines = ["v {} {} {}".format(*corner) for corner in corners]
    lines += [f"f {a} {b} {c}\nf {a} {c} {d}" for a, b, c, d in FACES]
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """scene_1/0000 and scene_1/0001, with a bowl (id 1), a distractor (2) and a mug (5) each."""
    scene = tmp_path / "real_test" / "scene_1"
    truths = tmp_path / "gts" / "real_test"
    models = tmp_path / "obj_models" / "real_test"
    for folder in (scene, truths, models, tmp_path / "fixed_real_test_obj_models"):
        folder.mkdir(parents=True)
    mask = np.full((480, 640), 255, np.uint8)
    mask[100:200, 100:200], mask[100:200, 300:400], mask[300:400, 100:200] = 1, 2, 5
    depth = np.full((480, 640), 1234, np.uint16)
    depth[:50] = 0
    scaled = np.eye(4)
    diagonal = np.linalg.norm(EXTENTS_NOCS)
    scaled[:3, :3] = diagonal * TURN.as_matrix()
    poses = np.stack([scaled, scaled])
    poses[:, :3, 3] = [[-0.26, -0.14, 0.9], [-0.32, 0.2, 1.1]]
    for number in ("0000", "0001"):
        Image.fromarray(np.full((480, 640, 3), 51, np.uint8)).save(scene / f"{number}_color.png")
        Image.fromarray(depth).save(scene / f"{number}_depth.png")
        Image.fromarray(mask).save(scene / f"{number}_mask.png")
        (scene / f"{number}_meta.txt").write_text("5 6 mug_a\n2 0 thing\n1 2 bowl_b\n")
        name = f"results_real_test_scene_1_{number}.pkl"
        (truths / name).write_bytes(pickle.dumps({"gt_RTs": poses}, protocol=3))
    for model in ("mug_a", "bowl_b"):
        write_mesh(tmp_path / "fixed_real_test_obj_models" / f"{model}.obj")
        (models / f"{model}.txt").write_text("\n".join(map(str, EXTENTS_NOCS)))
    return tmp_path


@pytest.fixture
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test's own, which also keeps trees that were written this moment."""
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("CPAS_CACHE", str(folder))
    monkeypatch.setattr(_index, "SETTLED", -10.0)
    return folder
