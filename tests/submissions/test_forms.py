"""Every form that files of predictions have: written as its own code does, the same is read."""

import forms
import numpy as np
import pytest

from pytest_cpas.datasets import housecat
from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.evaluation import StoredRun
from pytest_cpas.submissions import read_submission
from pytest_cpas.types import DataError


def facts(run):
    found = {}
    for ref in run.samples:
        row = run.judge(ref)
        found[ref.id] = (ref.category, row.failure, row.facts)
    return found


def same(run, other, but=()):
    assert isinstance(run.notes, list), "which an audit is part of"
    found, expected = facts(run), facts(other)
    assert found.keys() == expected.keys()
    for sample, (category, failure, values) in expected.items():
        assert found[sample][:2] == (category, failure)
        for fact, value in values.items():
            if fact not in but:
                assert found[sample][2][fact] == pytest.approx(value, abs=1e-9), (sample, fact)


@pytest.fixture
def dataset(tmp_path):
    """The truth of REAL275's test split, as far as the frames go."""
    truths = {
        name: {k: v for k, v in values.items() if k in ("gt_class_ids", "gt_RTs", "gt_scales")}
        for name, values in forms.frames().items()
    }
    forms.nocs(tmp_path / "data/gts/real_test", truths, "results_real_test_{}.pkl")
    return Real275(tmp_path / "data")


@pytest.fixture
def nocs(tmp_path):
    return forms.nocs(tmp_path / "nocs", forms.frames())


WRITERS = {
    "camera": lambda path: forms.nocs(path, forms.frames(), "results_val_{}.pkl"),
    "scenes": lambda path: forms.scenes(path, forms.frames()),
    "nested": lambda path: forms.nocs(path / "a/b", forms.frames()).parents[1],
    "list": lambda path: forms.listed(path / "pred_result.pkl", forms.frames()),
    "lists": lambda path: forms.listed(path / "x.pkl", forms.frames()).parent,
}


@pytest.mark.parametrize("form", WRITERS)
def test_round_trip(form, tmp_path, nocs, dataset):
    path = WRITERS[form](tmp_path / "mine")
    same(StoredRun(path), StoredRun(nocs))
    same(StoredRun(path, dataset=dataset), StoredRun(nocs, dataset=dataset))


def test_images_of_camera25(tmp_path):
    names = ("00000/0000", "00000/0003", "00012/0009")
    path = forms.nocs(tmp_path / "mine", forms.frames(names), "results_val_{}.pkl")
    read = read_submission(path)
    assert [image.name for image in read.images] == [name.replace("/", "_") for name in names]
    assert StoredRun(path).samples[-1].id == "00012/0009/gt1"


@pytest.mark.parametrize("empty", [False, True])
def test_folder_without_predictions_says_what_is_there(empty, tmp_path):
    (tmp_path / "mine/scene_1").mkdir(parents=True)
    if not empty:
        for name in ("a.png", "b.png", "c.png", "d.png", ".hidden"):
            (tmp_path / "mine/scene_1" / name).touch()
    words = "is empty" if empty else r"holds scene_1/a\.png, scene_1/b\.png, .* and 1 more"
    with pytest.raises(DataError, match=rf"in this folder, which {words}"):
        read_submission(tmp_path / "mine")


@pytest.mark.parametrize("lacks", ["gt_bboxes", "gt_scales", "gt_RTs", "gt"])
def test_truth_that_is_not_all_there(lacks, tmp_path, dataset, nocs):
    made = {
        name: {key: value for key, value in values.items() if not key.startswith(lacks)}
        for name, values in forms.frames().items()
    }
    path = forms.nocs(tmp_path / "mine", made)
    if lacks in ("gt_scales", "gt_RTs"):
        with pytest.raises(DataError, match=rf"_0000\.pkl: lacks {lacks}, which belong to its gro"):
            StoredRun(path, dataset=dataset)
        return
    boxes = {name: values["gt_bboxes"].astype(float) for name, values in forms.frames().items()}
    dataset.box_of = lambda ref: boxes[dataset.image_of(ref)][int(ref.id[-1])]
    same(StoredRun(path, dataset=dataset), StoredRun(nocs, dataset=dataset))


# -- other classes and axes -----------------------------------------------------------------


class TenClasses(Real275):
    """A data set that has its own classes, and publishes poses in the harness's axes."""

    class_names = housecat.CATEGORIES
    published_axes = None


def test_classes_and_axes_are_those_of_the_data_set(dataset, tmp_path):
    made = forms.frames(most_classes=10)
    path = forms.scenes(tmp_path / "mine", made)
    with pytest.raises(DataError, match="class ids run from 9 to 10, expected 1 to 6"):
        read_submission(path)
    dataset.__class__ = TenClasses
    read = read_submission(path, dataset)
    assert (read.category(9), read.object_frame) == ("shoe", "shapenet")
    values = made["scene_2/0100"]
    _, sizes = forms.metric(values, "pred")
    assert read.images[-1].answers.extents == pytest.approx(sizes)
    assert read.images[-1].answers.poses == pytest.approx(values["pred_RTs"])
    # of axes that are neither
    dataset.published_axes = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    read = read_submission(path, dataset)
    assert read.images[-1].answers.extents == pytest.approx(sizes[:, [2, 0, 1]])
    corner = read.images[-1].answers.poses[0] @ [0.1, 0.2, 0.3, 1]
    assert corner == pytest.approx(values["pred_RTs"][0] @ [0.2, 0.3, 0.1, 1])


# -- lists of frames ------------------------------------------------------------------------


def test_list_without_names_and_data_set(tmp_path, nocs):
    path = forms.listed(tmp_path / "pred_result.pkl", forms.frames(), names=False)
    found, expected = facts(StoredRun(path)), facts(StoredRun(nocs))
    assert next(iter(found)) == "0000/gt0"
    assert [row[2] for row in found.values()] == [
        pytest.approx(row[2], abs=1e-9) for row in expected.values()
    ]


def order(name):
    return [int(word) for word in name.removeprefix("scene_").split("/")]


@pytest.mark.parametrize("kind", ["natural", "skipped", "alphabetical", "wrong", "no truth"])
def test_order_of_a_list_without_names_is_checked(kind, tmp_path, dataset, nocs):
    names = sorted(forms.NAMES, key=order)
    if kind == "skipped":
        del names[1]
    elif kind == "alphabetical":
        names = sorted(names, key=lambda name: [str(number) for number in order(name)])
        assert [n[-4:] for n in names] == ["0000", "0001", "0010", "0002", "0100"]
    elif kind == "wrong":
        names[0], names[2] = names[2], names[0]  # as many objects, of the same classes
    made = {name: forms.frames()[name] for name in names}
    if kind == "no truth":
        made = {n: {k: v for k, v in m.items() if k[:2] != "gt"} for n, m in made.items()}
    path = forms.listed(tmp_path / "pred_result.pkl", made, names=False)
    if kind == "wrong":
        words = (
            r"truth in the file fits in the order of real275 the first 1, in alph.* the first 1,"
        )
        with pytest.raises(DataError, match=words):
            StoredRun(path, dataset=dataset)
        return
    run = StoredRun(path, dataset=dataset)
    if kind == "skipped":
        assert run.notes[1].startswith("1 of 5 images of real275 are not in the file")
        assert {r[1] for s, r in facts(run).items() if s.startswith("scene_1/0001")} == {
            "whose image is not in the file"
        }
    elif kind == "no truth":
        assert run.notes[0].endswith("in the order of real275, which nothing confirms")
    else:
        words = {"natural": "real275", "alphabetical": "alphabetical order (0, 1, 10, 100, 2)"}[
            kind
        ]
        assert run.notes[0].endswith(f"{words}, as the truth in the file bears out")
        same(run, StoredRun(nocs, dataset=dataset))


def test_images_that_are_alike_follow_each_other(tmp_path):
    made = forms.frames()
    still = dict.fromkeys(made, made[forms.NAMES[0]])
    forms.nocs(tmp_path / "data/gts/real_test", still, "results_real_test_{}.pkl")
    path = forms.listed(tmp_path / "pred_result.pkl", still, names=False)
    run = StoredRun(path, dataset=Real275(tmp_path / "data"))
    assert {failure for _, failure, _ in facts(run).values()} == {None}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: rows.clear(), "an empty list, expected the dict of each image"),
        (lambda rows: rows.__setitem__(1, 3), r"frame 1: a int, expected a dict with pred_RTs"),
        (lambda rows: rows[2].pop("pred_RTs"), "frame 2: pred_RTs is missing"),
        (lambda rows: rows[2].update(image_path=3), "frame 2: image_path is a int, expected the"),
        (lambda rows: rows[2].pop("image_path"), "image 2 has no name, others have"),
        (lambda rows: rows[2].update(rows[1]), "frame scene_1/0001 occurs twice"),
        (lambda rows: rows[2].update(pred_RTs=[[1], [1, 2]]), "frame 2: pred_RTs is missing or"),
    ],
)
def test_damaged_lists(change, words, tmp_path):
    path = forms.listed(tmp_path / "pred_result.pkl", forms.frames())
    rows = forms.pickle.loads(path.read_bytes())
    change(rows)
    forms.dump(path, rows)
    with pytest.raises(DataError, match=rf"pred_result\.pkl.*{words}"):
        StoredRun(path)
