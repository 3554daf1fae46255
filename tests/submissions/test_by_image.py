"""CATRE's dict, and PACE's pair of files."""

import pickle

import forms
import numpy as np
import pytest
from test_forms import dataset, same  # noqa: F401 - a fixture

from pytest_cpas.evaluation import StoredRun
from pytest_cpas.submissions import by_image, read_submission
from pytest_cpas.types import DataError


@pytest.fixture
def boxed(dataset):  # noqa: F811
    """REAL275 with 2-D boxes, as it has where there are masks."""
    boxes = {name: values["gt_bboxes"].astype(float) for name, values in forms.frames().items()}
    dataset.box_of = lambda ref: boxes[dataset.image_of(ref)][int(ref.id[-1])]
    return dataset


def test_the_last_step_of_catre(boxed, tmp_path):
    path = forms.catre(tmp_path / "catre_nocs_test_preds.pkl", forms.frames())
    run = StoredRun(path, dataset=boxed)
    assert run.notes[0] == "of 3 steps of refinement the last, iter2, is judged"
    same(run, StoredRun(forms.nocs(tmp_path / "nocs", forms.frames()), dataset=boxed))
    last = pickle.loads(path.read_bytes())["iter2"]
    same(StoredRun(forms.dump(tmp_path / "x.pkl", last), dataset=boxed), run)
    with pytest.raises(DataError, match=r"it has no truth; name the data set .*=DIR$"):
        read_submission(path)


@pytest.mark.parametrize("given", ["folder", "file"])
def test_pair_of_pace(given, tmp_path):
    path = forms.pace(tmp_path / "mine", forms.frames())
    run = StoredRun(path if given == "file" else path.parent)
    other = StoredRun(forms.nocs(tmp_path / "nocs", forms.frames()))
    assert (
        {ref.category for ref in run.samples}
        == {"bowl", "box-link3"}
        == {by_image.PACE[class_id - 1] for class_id in (2, 6)}
    )
    assert run.notes[0] == (
        "which objects are symmetric is told by their categories, not as PACE does"
    )
    for ref, theirs in zip(run.samples, other.samples, strict=True):
        assert ref.id == theirs.id
        assert run.judge(ref).facts == pytest.approx(other.judge(theirs).facts, abs=1e-9)


def test_images_without_predictions_count(tmp_path):
    path = forms.pace(tmp_path / "mine", forms.frames())
    found = pickle.loads(path.read_bytes())
    del found["test/scene_1/rgb/0001.png"]
    forms.dump(path, found)
    run = StoredRun(path)
    failures = {ref.id: run.judge(ref).failure for ref in run.samples}
    assert sorted(key for key, why in failures.items() if why) == [
        f"scene_1/0001/gt{place}" for place in range(3)
    ]


def test_pace_without_its_truth(tmp_path, dataset):  # noqa: F811
    path = forms.pace(tmp_path / "mine", forms.frames())
    truth = path.with_name("catpose_gts_test.pkl")
    truth.rename(truth.with_name("catpose_gts_val.pkl"))
    read_submission(path)
    truth.write_bytes(b"x")
    with pytest.raises(DataError, match=r"_gts_test\.pkl and catpose_gts_val\.pkl are beside it"):
        read_submission(path)
    truth.unlink()
    truth.with_name("catpose_gts_val.pkl").unlink()
    with pytest.raises(DataError, match=r"no truth; .*; of PACE put catpose_gts_SPLIT\.pkl beside"):
        read_submission(path)
    run = StoredRun(path, dataset=dataset)
    same(run, StoredRun(forms.nocs(tmp_path / "nocs", forms.frames()), dataset=dataset))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda v: v.update({3: next(iter(v.values()))}),
            "image 3, expected scene_1/0000",
        ),
        (lambda v: v.update({"x": 3}), "image 'x': a int, expected a dict"),
        (lambda v: v["scene_2/0100"].pop("pred_RTs"), "image 'scene_2/0100': pred_RTs is missing"),
        (lambda v: v["scene_2/0100"].update(pred_class_ids=np.array([1])), "shape .*, expected"),
    ],
)
def test_damaged_images(change, words, tmp_path, dataset):  # noqa: F811
    path = forms.catre(tmp_path / "x.pkl", forms.frames())
    value = pickle.loads(path.read_bytes())
    change(value["iter2"])
    forms.dump(path, value)
    with pytest.raises(DataError, match=rf"x\.pkl, iter2.*{words}"):
        read_submission(path, dataset)
