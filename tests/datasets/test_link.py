"""``pytest-cpas link``: the folders of a data set, called and placed as people have them."""

import os

import pytest
from test_nocs_fitted import write_camera25, write_real_train

from pytest_cpas import cli
from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.datasets.nocs_fitted import Camera25, RealTrain
from pytest_cpas.fetching.layouts import link
from pytest_cpas.types import DataError

#: Where somebody has what is published elsewhere.
MOVED = {
    "real275": {
        "real_test": "NOCS/images/REAL/test",
        "gts/real_test": "NOCS/labels/test-gts",
        "obj_models/real_test": "meshes/real/test",
        "fixed_real_test_obj_models": "meshes/fixed",
    },
    "real_train": {
        "real_train": "NOCS/images/REAL/train",
        "obj_models/real_train": "meshes/real/train",
    },
    "camera25": {
        "val": "CAMERA/composed/val",
        "camera_full_depths/val": "CAMERA/depth/val",
        "obj_models/val": "shapenet/val",
    },
}
LOADERS = {"real275": Real275, "real_train": RealTrain, "camera25": Camera25}


@pytest.fixture
def theirs(request, tmp_path):
    """All three data sets in one folder, as somebody has them, and what each lists."""
    published, moved = tmp_path / "published", tmp_path / "theirs"
    published.mkdir()
    write_camera25(published)
    write_real_train(published)
    request.getfixturevalue("tree")
    for name in ("real_test", "gts", "fixed_real_test_obj_models"):
        (tmp_path / name).rename(published / name)
    models = published / "obj_models/real_test"
    (tmp_path / "obj_models/real_test").rename(models)
    for mesh in (published / "fixed_real_test_obj_models").iterdir():
        (models / mesh.name).write_bytes(mesh.read_bytes())
    listed = {name: load(published) for name, load in LOADERS.items()}
    for parts in MOVED.values():
        for here, there in parts.items():
            (moved / there).parent.mkdir(parents=True, exist_ok=True)
            (published / here).rename(moved / there)
    os.symlink(moved, moved / "NOCS/again")
    return moved, listed


@pytest.mark.parametrize("name", MOVED)
def test_parts_are_found_and_linked(theirs, tmp_path, name, capsys):
    moved, listed = theirs
    to = tmp_path / "linked"
    for _ in range(2):  # the second time all is there
        assert cli.main(["link", str(moved), "--as", name, "--to", str(to)]) == 0
        told = capsys.readouterr().out
        for here, there in MOVED[name].items():
            assert f"{to / here} -> {moved / there}" in told
    data = LOADERS[name](to)
    assert (data.samples, data.digest) == (listed[name].samples, listed[name].digest)
    assert (data.missing, data.damaged) == (listed[name].missing, listed[name].damaged)


def test_nothing_is_linked_unless_all_is_found(theirs, tmp_path, capsys):
    moved, _ = theirs
    to = tmp_path / "linked"
    labels = moved / "NOCS/labels/test-gts"
    (moved / "NOCS/copy").mkdir()
    copied = moved / "NOCS/copy/test"
    copied.mkdir()
    for path in labels.iterdir():
        (copied / path.name).write_bytes(path.read_bytes())
    with pytest.raises(
        DataError, match=r"gts/real_test of real275 may be .*copy/test or .*test-gts"
    ):
        link(moved, "real275", to)
    for folder in (labels, copied):
        for path in folder.iterdir():
            path.unlink()
    with pytest.raises(DataError, match=r"is gts/real_test of real275 \(a folder with 'test'"):
        link(moved, "real275", to)
    assert not to.exists()
    assert cli.main(["link", str(moved), "--as", "tod"]) == 1
    assert "tod: expected one of real275, real_train, camera25" in capsys.readouterr().err
    with pytest.raises(DataError, match="no such folder"):
        link(tmp_path / "nowhere", "real275", to)


def test_what_is_there_stays(theirs, tmp_path):
    moved, _ = theirs
    (tmp_path / "linked/val").mkdir(parents=True)
    with pytest.raises(DataError, match="something else is there; name another folder"):
        link(moved, "camera25", tmp_path / "linked")
    assert [path.name for path in (tmp_path / "linked").iterdir()] == ["val"]


def test_a_file_is_no_folder_for_links(theirs, tmp_path, capsys):
    moved, _ = theirs
    (tmp_path / "notes.txt").write_text("mine")
    for to in (tmp_path / "notes.txt", tmp_path / "notes.txt/camera25"):
        assert cli.main(["link", str(moved), "--as", "camera25", "--to", str(to)]) == 1
        told = capsys.readouterr().err
        assert f"{tmp_path / 'notes.txt'}: it is no folder; name another one with --to" in told
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_what_can_be_done_without_is_told(theirs, tmp_path):
    moved, _ = theirs
    (moved / "meshes/fixed").rename(moved / "meshes/other")
    told = link(moved, "real275", tmp_path / "linked")
    assert "fixed_real_test_obj_models: not there; the data set can do without it" in told
    assert "fixed_real_test_obj_models/" in "".join(Real275(tmp_path / "linked").missing)
