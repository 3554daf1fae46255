"""Folders of 4 x 4 matrices."""

import forms
import numpy as np
import pytest
from test_bop_csv import aside, dataset, truths, written  # noqa: F401 - a fixture

from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.evaluation import StoredRun
from pytest_cpas.submissions import read_submission
from pytest_cpas.types import DataError


def facts(run):
    return {ref.id: run.judge(ref).facts for ref in run.samples}


@pytest.mark.parametrize(
    "form", ["obj_{:06d}/{:06d}/{:06d}.txt", "{1}/obj_{0:06d}/ob_in_cam/{2}.txt"]
)
def test_known_objects(form, dataset, tmp_path):  # noqa: F811
    """The same as BOP's table of the same poses, of which it has one of each object."""
    poses = {
        form.format(number, scene, image): aside(place, made)
        for (scene, image, place, number), made in truths().items()
        if (scene, image, place) != (2, 3, 2)
    }
    run = StoredRun(forms.matrices(tmp_path / "mine", poses), dataset=dataset)
    other = StoredRun(written(tmp_path / "x.csv", aside), dataset=dataset)
    found, expected = facts(run), facts(other)
    assert run.judge(run.samples[4]).failure == "not detected"
    del found["000002/000003/2"], expected["000002/000003/2"]
    assert found == {key: pytest.approx(values, abs=1e-9) for key, values in expected.items()}


@pytest.fixture
def one(tmp_path):
    """A data set in NOCS axes with one object in an image."""
    made = {
        name: {f"gt_{k}": values[f"gt_{k}"][1:2] for k in ("class_ids", "RTs", "scales")}
        for name, values in forms.frames().items()
    }
    forms.nocs(tmp_path / "data/gts/real_test", made, "results_real_test_{}.pkl")
    return Real275(tmp_path / "data")


@pytest.mark.parametrize("kind", ["scenes", "one scene", "category"])
def test_one_object_in_an_image(kind, one, tmp_path):
    made = {name: {k: v[1:2] for k, v in values.items()} for name, values in forms.frames().items()}
    if kind == "one scene":
        made = {name: values for name, values in made.items() if name.startswith("scene_1")}
    nocs = forms.nocs(tmp_path / "nocs", made)
    form = {"scenes": "{}/{}.txt", "one scene": "ob_in_cam/{1}.txt", "category": "mug/{}/{}.txt"}
    poses = {
        form[kind].format(*name.split("/")): forms.metric(values, "pred")[0][0]
        for name, values in made.items()
    }
    run = StoredRun(forms.matrices(tmp_path / "scene_1", poses), dataset=one)
    assert not any(note.startswith("audit") for note in run.notes)
    other = StoredRun(nocs, dataset=one)
    for ref in run.samples:
        found, expected = run.judge(ref), other.judge(ref)
        assert found.failure == expected.failure
        for fact in ("position_m", "rotation_deg"):
            assert found.facts[fact] == pytest.approx(expected.facts[fact], abs=1e-9)


def test_several_objects_need_a_category(tmp_path, dataset, one):  # noqa: F811
    folder = forms.matrices(tmp_path / "mine", {"000002/000000.txt": np.eye(4)})
    with pytest.raises(DataError, match=r"000000\.txt: which model .*, such as obj_000001/"):
        read_submission(folder, dataset)
    two = forms.nocs(tmp_path / "two/gts/real_test", forms.frames(), "results_real_test_{}.pkl")
    folder = forms.matrices(tmp_path / "other", {"scene_1/0000.txt": np.eye(4)})
    with pytest.raises(DataError, match=r"no class, and there are 2 objects in image scene_1/0000"):
        StoredRun(folder, dataset=Real275(two.parents[1]))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 2 3", "3 numbers, expected 4 x 4 with blanks between"),
        ("1 " * 15 + "x", "'x' is no number, expected 4 x 4 numbers"),
        ("1 " * 2**16, "131072 bytes, at most 65536 are read"),
        (b"\xff", "not text in UTF-8"),
    ],
)
def test_damaged_matrices(text, words, tmp_path):
    file = tmp_path / "mine/0000.txt"
    file.parent.mkdir()
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(DataError, match=rf"0000\.txt.*{words}"):
        read_submission(file.parent)


def test_a_failed_matrix_counts(one, tmp_path):
    poses = {f"{name}.txt": np.full((4, 4), np.nan) for name in forms.NAMES}
    run = StoredRun(forms.matrices(tmp_path / "mine", poses), dataset=one)
    assert {run.judge(r).failure for r in run.samples} == {"the stored pose is not finite"}
