"""Stored predictions beside the truth of a data set, of which the images are not there."""

import pickle

import numpy as np
import pytest

from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.evaluation import SampleError, StoredRun
from pytest_cpas.protocols import shipped_protocol
from pytest_cpas.types import DataError

BOXES = np.array([[0, 0, 10, 10], [0, 20, 10, 30], [50, 50, 90, 90]])
NAMES = ("scene_1_0000", "scene_1_0001", "scene_2_0010")


def frame(shift=0.0):
    """A bowl and two mugs, each found where it is."""
    poses = np.tile(np.diag([0.2, 0.2, 0.2, 1.0]), (3, 1, 1))
    poses[:, :3, 3] = [[shift, 0, 1], [0.3 + shift, 0, 1], [shift, 0.3, 1]]
    objects = {
        "class_ids": np.array([2, 6, 6]),
        "bboxes": BOXES,
        "RTs": poses,
        "scales": np.full((3, 3), 1 / np.sqrt(3)),
    }
    sides = {f"{side}_{key}": value for side in ("gt", "pred") for key, value in objects.items()}
    found = poses.copy()
    found[:, 0, 3] += 1e-12
    return sides | {"pred_RTs": found, "pred_scores": np.array([0.9, 0.8, 0.7])}


def wrote(folder, frames):
    folder.mkdir(parents=True, exist_ok=True)
    for name, values in frames.items():
        (folder / name).write_bytes(pickle.dumps(values))
    return folder


@pytest.fixture
def dataset(tmp_path):
    """The truth of three frames of REAL275, no image."""
    keys = ("gt_class_ids", "gt_RTs", "gt_scales", "gt_bboxes")
    truths = {
        f"results_real_test_{name}.pkl": {key: frame(0.01 * i)[key] for key in keys}
        for i, name in enumerate(NAMES)
    }
    wrote(tmp_path / "data" / "gts" / "real_test", truths)
    return Real275(tmp_path / "data")


def submitted(tmp_path, frames=None, form="results_test_{}.pkl"):
    made = {name: frame(0.01 * i) for i, name in enumerate(NAMES)} if frames is None else frames
    return wrote(tmp_path / "mine", {form.format(name): value for name, value in made.items()})


def positions(run):
    return {ref.id: run.judge(ref).facts["position_m"] for ref in run.samples}


def test_truth_alone_is_a_data_set(dataset):
    assert [ref.id for ref in dataset.samples[:3]] == [f"scene_1/0000/gt{i}" for i in range(3)]
    assert {ref.id for ref in dataset.samples} == set(dataset.absent)
    truth = dataset.truth(dataset.samples[4])
    assert truth.pose.translation == pytest.approx([0.31, 0, 1])
    assert truth.extents == pytest.approx([0.2 / np.sqrt(3)] * 3)
    assert dataset.missing == [
        "images of 3 frames, first scene_1/0000: only their truth is there, by which stored"
        " predictions are judged, and no method"
    ]
    with pytest.raises(DataError, match="mask"):
        dataset.load(dataset.samples[0])


@pytest.mark.parametrize("form", ["results_test_{}.pkl", "{}.pkl", "results_real_test_{}.pkl"])
def test_answers_of_the_file_and_truth_of_the_data_set(dataset, tmp_path, form):
    run = StoredRun(submitted(tmp_path, form=form), dataset=dataset)
    assert (run.dataset, len(run.samples)) == ("real275", 9)
    assert max(positions(run).values()) < 1e-9
    assert run.notes == []
    assert run.identity["truth"] == "real275"


def test_truth_in_the_file_is_not_believed(dataset, tmp_path):
    frames = {name: frame(0.01 * i) for i, name in enumerate(NAMES)}
    for values in frames.values():
        values["pred_RTs"] = values["pred_RTs"].copy()
        values["pred_RTs"][:, 2, 3] += 0.05
        values["gt_RTs"] = values["pred_RTs"]
    path = submitted(tmp_path, frames)
    assert max(positions(StoredRun(path)).values()) < 1e-9
    assert set(np.round([*positions(StoredRun(path, dataset=dataset)).values()], 9)) == {0.05}


def test_frames_that_the_file_lacks_count(dataset, tmp_path):
    run = StoredRun(
        submitted(tmp_path, {NAMES[0]: frame(), "scene_9_0001": frame()}), dataset=dataset
    )
    rows = [run.judge(ref) for ref in run.samples]
    assert [row.failure for row in rows] == [None] * 3 + ["whose image is not in the file"] * 6
    assert rows[-1].facts["position_m"] == np.inf
    assert run.notes == [
        "2 of 3 images of real275 are not in the file, and count as not correct: scene_1/0001,"
        " scene_2/0010",
        "1 of 2 images of the file are not among those of real275 that are here, and do not count:"
        " scene_9_0001",
    ]


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        ({"scene_7_0001": frame()}, "none of its 1 images, such as scene_7_0001, is one of"),
        (
            {"a_scene_1_0000": frame(), "b_scene_1_0000": frame()},
            "1 images are there twice: scene_1_0000 and scene_1_0000",
        ),
    ],
)
def test_frames_that_cannot_be_told(dataset, tmp_path, frames, words):
    with pytest.raises(DataError, match=words):
        StoredRun(submitted(tmp_path, frames, form="{}.pkl"), dataset=dataset)


def test_answers_alone_are_enough(dataset, tmp_path):
    """Where the file has no truth, the 2-D boxes are the data set's."""
    answers = {key: value for key, value in frame().items() if key.startswith("pred")}
    path = submitted(tmp_path, dict.fromkeys(NAMES, answers))
    with pytest.raises(DataError, match="no ground truth of its own; name the data set"):
        StoredRun(path)
    assert max(positions(StoredRun(path, dataset=dataset)).values()) < 0.03
    # where nobody has boxes, those of the projected objects
    dataset.box_of = lambda ref: None
    run = StoredRun(path, dataset=dataset)
    assert {run.judge(ref).failure for ref in run.samples} == {"not detected"}
    half, camera = 0.1 / np.sqrt(3), dataset.camera
    projected = np.zeros((3, 4))
    for row, (x, y) in enumerate(((0, 0), (0.3, 0), (0, 0.3))):
        for place, at, f, c in ((0, y, camera.fy, camera.cy), (1, x, camera.fx, camera.cx)):
            ends = [f * (at + s * half) / z + c for s in (-1, 1) for z in (1 - half, 1 + half)]
            projected[row, [place, place + 2]] = min(ends), max(ends)
    path = submitted(tmp_path, dict.fromkeys(NAMES, answers | {"pred_bboxes": projected}))
    assert max(positions(StoredRun(path, dataset=dataset)).values()) < 0.03


@pytest.mark.parametrize("kind", ["float16", "rounded"])
def test_half_precision_is_taken_as_such(dataset, tmp_path, kind):
    turn = np.eye(4)
    turn[:3, :3] = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn[:3, :3] *= np.sign(np.linalg.det(turn[:3, :3]))
    frames = {name: frame(0.01 * i) for i, name in enumerate(NAMES)}
    for values in frames.values():
        exact = values["pred_RTs"] @ turn
        values["pred_RTs"] = exact.astype(np.float16)
        if kind == "rounded":
            values["pred_RTs"] = values["pred_RTs"].astype(np.float64)
    run = StoredRun(submitted(tmp_path, frames), dataset=dataset)
    assert max(positions(run).values()) < 5e-4
    assert "half precision" in run.notes[0]
    frames[NAMES[0]]["pred_RTs"] = frame()["pred_RTs"] + 1e-4
    run = StoredRun(submitted(tmp_path, frames), dataset=dataset)
    assert not any("half" in note for note in run.notes), "one pose shows that it is not"


def test_broken_truth_is_told_by_its_samples_alone(dataset, tmp_path):
    """Neither what is noticed nor a ranking ends a run because of it."""
    path = submitted(tmp_path)
    real = dataset.truth

    def truth(ref):
        if ref.id.startswith("scene_1/0001"):
            raise DataError("damaged")
        return real(ref)

    dataset.truth = truth
    run = StoredRun(path, dataset=dataset, protocols=[shipped_protocol("nocs")])
    for ref in run.samples:
        if ref.id.startswith("scene_1/0001"):
            with pytest.raises(SampleError, match="damaged"):
                run.judge(ref)
        else:
            run.judge(ref)
    assert run.notes == ["the file was not audited: damaged"]
    assert run.ranking(()) is None
