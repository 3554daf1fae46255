"""The index of a tree: used while nothing changes, made again whenever something does."""

import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pytest_cpas.datasets import _index
from pytest_cpas.datasets.nocs import NocsTree, Real275

META = "real_test/scene_1/0000_meta.txt"
TRUTH = "gts/real_test/results_real_test_scene_1_0000.pkl"
MESH = "fixed_real_test_obj_models/mug_a.obj"


@pytest.fixture
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test's own, which also keeps trees that were written this moment."""
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("CPAS_CACHE", str(folder))
    monkeypatch.setattr(_index, "SETTLED", -10.0)
    return folder


def listing(root: Path) -> tuple:
    data = Real275(root)
    return data.samples, data.missing, data.damaged, data.absent, data.digest


def fresh(root: Path, monkeypatch: pytest.MonkeyPatch, empty: Path) -> tuple:
    with monkeypatch.context() as other:
        other.setenv("CPAS_CACHE", str(empty))
        return listing(root)


def test_unchanged_tree_is_not_scanned_again(tree, cache, monkeypatch) -> None:
    first = listing(tree)
    monkeypatch.setattr(NocsTree, "scan", lambda self, scan: pytest.fail("scanned again"))
    assert listing(tree) == first
    data = Real275(tree)
    for ref in data.samples:
        data.load(ref)


def in_place(file: str, change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """Rewrite a file and give it back its size and mtime, as the nastiest tool would."""

    def edit(root: Path) -> None:
        path = root / file
        status = path.stat()
        content = change(path.read_bytes())
        assert len(content) == status.st_size
        path.write_bytes(content)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))

    return edit


def copy_scene(root: Path) -> None:
    shutil.copytree(root / "real_test/scene_1", root / "real_test/scene_2")
    for number in ("0000", "0001"):
        truth = root / f"gts/real_test/results_real_test_scene_1_{number}.pkl"
        shutil.copy(truth, str(truth).replace("scene_1", "scene_2"))


def move_object(root: Path) -> None:
    poses = pickle.loads((root / TRUTH).read_bytes())["gt_RTs"]
    poses[0, 2, 3] += 0.5
    (root / TRUTH).write_bytes(pickle.dumps({"gt_RTs": poses}, protocol=3))


@pytest.mark.parametrize(
    "change",
    [
        in_place(META, lambda text: text.replace(b"mug_a", b"mug_c")),
        in_place(META, lambda text: text.replace(b"5 6", b"9 6")),
        in_place(MESH, lambda text: text.replace(b"0.05", b"0.06")),
        move_object,
        copy_scene,
        lambda root: (root / "real_test/scene_1/0001_depth.png").unlink(),
        lambda root: (root / MESH).unlink(),
        lambda root: (root / "obj_models/real_test/mug_a.txt").unlink(),
        lambda root: shutil.rmtree(root / "fixed_real_test_obj_models"),
        lambda root: (root / "real_test/scene_1").rename(root / "real_test/scene_7"),
    ],
    ids=range(10),
)
def test_change_is_noticed(tree, cache, monkeypatch, tmp_path_factory, change) -> None:
    first = listing(tree)
    change(tree)
    expected = fresh(tree, monkeypatch, tmp_path_factory.mktemp("empty"))
    assert listing(tree) == expected
    # an extents file beside a mesh is not what samples are judged by
    assert expected != first or (tree / MESH).exists()
    assert listing(tree) == expected


@pytest.mark.parametrize("torn", [b"", b"{", b"[]", b'{"stamps": {}}', b"null", b"\xff"])
def test_torn_index_is_made_again(tree, cache, torn) -> None:
    first = listing(tree)
    (file,) = (cache / "index").iterdir()
    whole = file.read_bytes()
    file.write_bytes(torn)
    assert listing(tree) == first
    assert json.loads(file.read_bytes()) == json.loads(whole)


def test_tree_that_was_just_written_is_not_kept(tree, cache, monkeypatch) -> None:
    monkeypatch.setattr(_index, "SETTLED", 2.0)
    listing(tree)
    assert not (cache / "index").exists()


def test_cache_that_cannot_be_written_is_done_without(tree, cache, monkeypatch) -> None:
    (cache / "file").write_text("")
    monkeypatch.setenv("CPAS_CACHE", str(cache / "file"))
    assert len(listing(tree)[0]) == 4


def test_two_trees_do_not_share_an_index(tree, cache, tmp_path_factory) -> None:
    other = tmp_path_factory.mktemp("other") / "tree"
    shutil.copytree(tree, other)
    (other / "real_test/scene_1/0001_mask.png").unlink()
    assert len(listing(tree)[0]) == 4
    assert len(listing(other)[0]) == 2
    assert len(listing(tree)[0]) == 4


def test_image_overwritten_in_place_is_read_anew(tree, cache) -> None:
    from PIL import Image

    before = Real275(tree)
    before.load(before.samples[0])
    path = tree / "real_test/scene_1/0000_depth.png"
    Image.fromarray(np.full((480, 640), 777, np.uint16)).save(path)
    after = Real275(tree)
    assert after.load(after.samples[0]).observation.depth.max() == np.float32(0.777)
