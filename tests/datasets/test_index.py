"""The index of a tree: used while nothing changes, made again whenever something does."""

import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_bop import write_bop
from test_folder import write_folder
from test_nocs_fitted import write_camera25, write_real_train
from test_other_layouts import WRITERS

from pytest_cpas.datasets import _index
from pytest_cpas.datasets.bop import Bop
from pytest_cpas.datasets.folder import Folder
from pytest_cpas.datasets.nocs import NocsTree, Real275
from pytest_cpas.datasets.nocs_fitted import Camera25, RealTrain

META = "real_test/scene_1/0000_meta.txt"
TRUTH = "gts/real_test/results_real_test_scene_1_0000.pkl"
MESH = "fixed_real_test_obj_models/mug_a.obj"


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


def test_index_of_other_code_is_made_again(tree, cache) -> None:
    first = listing(tree)
    (file,) = (cache / "index").iterdir()
    kept = json.loads(file.read_bytes())
    file.write_text(json.dumps({**kept, "recipe": "of last year", "samples": []}))
    assert listing(tree) == first
    assert list((cache / "index").iterdir()) == [file]


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
    before = Real275(tree)
    before.load(before.samples[0])
    path = tree / "real_test/scene_1/0000_depth.png"
    Image.fromarray(np.full((480, 640), 777, np.uint16)).save(path)
    after = Real275(tree)
    assert after.load(after.samples[0]).observation.depth.max() == np.float32(0.777)


LOADERS = [
    (write_camera25, Camera25),
    (write_real_train, RealTrain),
    (write_folder, Folder),
    (write_bop, Bop),
    *WRITERS,
]


@pytest.mark.parametrize(("write", "load"), LOADERS)
def test_every_data_set_is_the_same_from_its_kept_index(
    tmp_path, cache, monkeypatch, write, load
) -> None:
    write(tmp_path)
    first = load(tmp_path)
    monkeypatch.setattr(load, "scan", lambda self, scan: pytest.fail("scanned again"))
    second = load(tmp_path)
    assert (cache / "index").is_dir()
    for name in ("samples", "missing", "damaged", "absent", "digest"):
        assert getattr(second, name) == getattr(first, name)
    for ref in second.samples:
        ours, theirs = second.load(ref), first.load(ref)
        np.testing.assert_array_equal(ours.observation.mask, theirs.observation.mask)
        np.testing.assert_array_equal(ours.truth.pose.matrix, theirs.truth.pose.matrix)
        np.testing.assert_array_equal(ours.truth.extents, theirs.truth.extents)


@pytest.mark.parametrize(
    ("write", "load", "mask"),
    [
        (write_camera25, Camera25, "val/00000/0003_mask.png"),
        (*WRITERS[0], "test_scene1/instance/000000.png"),
        (*WRITERS[1], "sequence_3/mask/000000.png"),
    ],
)
def test_masks_that_decide_what_is_listed_are_watched(tmp_path, cache, write, load, mask) -> None:
    write(tmp_path)
    before = len(load(tmp_path).samples)
    path = tmp_path / mask
    with Image.open(path) as image:
        pixels = np.zeros_like(image)
    Image.fromarray(pixels).save(path)
    assert len(load(tmp_path).samples) == before - 2


def test_names_that_are_not_text_do_no_harm(tree, cache) -> None:
    """A folder named in no encoding, and one of a digit that is no number."""
    scenes = tree / "real_test"
    for name in (b"scene_\xff", "\u00b2".encode()):
        shutil.copytree(scenes / "scene_1", scenes / os.fsdecode(name))
    assert len(listing(tree)[0]) == 4
    assert listing(tree) == listing(tree)
