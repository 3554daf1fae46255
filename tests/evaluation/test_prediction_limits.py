"""Stored predictions of a size, form or pose that nobody stores: refused where they are read."""

import pickle
import time
from types import SimpleNamespace

import numpy as np
import pytest

from pytest_cpas.evaluation import ResultsError, SampleError, bop_export
from pytest_cpas.evaluation.estimates import Estimates
from pytest_cpas.evaluation.predictions import StoredRun
from pytest_cpas.metrics import average_precision
from pytest_cpas.metrics.average_precision import Detections
from pytest_cpas.protocols import RankedDetection, Ranking
from pytest_cpas.submissions import nocs, read_submission
from pytest_cpas.submissions.nocs import MOST_IN_IMAGE, MOST_PAIRS
from pytest_cpas.types import ContractError, DataError


def side(name, count):
    poses = np.tile(np.diag([0.2, 0.2, 0.2, 1.0]), (count, 1, 1))
    poses[:, 2, 3] = 1
    return {
        f"{name}_class_ids": np.full(count, 6),
        f"{name}_bboxes": np.tile([0, 0, 10, 10], (count, 1)),
        f"{name}_RTs": poses,
        f"{name}_scales": np.full((count, 3), 0.5),
    }


def content(truths=1, found=1, **changed):
    scores = {"pred_scores": np.linspace(0, 1, found)}
    return side("gt", truths) | side("pred", found) | scores | changed


def stored(tmp_path, **changed):
    path = tmp_path / "results_test_scene_1_0000.pkl"
    path.write_bytes(pickle.dumps(content(**changed)))
    return path


def stored_npz(path, frames_of, each):
    """As many frames of ``each`` objects and detections."""
    total = frames_of * each
    names = np.array([f"scene_1_{index}" for index in range(frames_of)])
    offset = np.arange(frames_of + 1) * each
    offsets = {"frame": names, "gt_offset": offset, "pred_offset": offset}
    np.savez_compressed(path, **content(total, total), **offsets)
    return path


@pytest.mark.parametrize("name", ["truths", "found"])
def test_rows_of_a_frame(name, tmp_path):
    start = time.process_time()
    with pytest.raises(DataError, match=r"_0000\.pkl: \w+_class_ids has 5000 rows, at most 300 of"):
        StoredRun(stored(tmp_path, **{name: 5000}))
    assert time.process_time() - start < 1


def test_frames_as_full_as_they_may_be_are_read_in_time(tmp_path):
    path = stored(tmp_path, truths=MOST_IN_IMAGE, found=MOST_IN_IMAGE)
    run = StoredRun(path)
    start = time.process_time()
    assert all(row.failure is None for row in map(run.judge, run.samples)), "all are detected"
    assert time.process_time() - start < 1


def test_pairs_of_all_frames(tmp_path):
    many = MOST_PAIRS // MOST_IN_IMAGE**2 + 1
    path = stored_npz(tmp_path / "x.npz", many, MOST_IN_IMAGE)
    start = time.process_time()
    with pytest.raises(DataError, match=r"x\.npz: up to frame scene_1_11 there are 1080000 pairs"):
        StoredRun(path)
    assert time.process_time() - start < 1


def test_frames_of_a_file(tmp_path, monkeypatch):
    monkeypatch.setattr(nocs, "MOST_IMAGES", 2)
    assert len(read_submission(stored_npz(tmp_path / "x.npz", 2, 1)).images) == 2
    with pytest.raises(DataError, match=r"x\.npz: 3 frames, at most 2 are read"):
        read_submission(stored_npz(tmp_path / "x.npz", 3, 1))


def test_frame_without_a_name(tmp_path):
    np.savez(
        tmp_path / "x.npz",
        **content(),
        frame=np.array([""]),
        gt_offset=np.array([0, 1]),
        pred_offset=np.array([0, 1]),
    )
    with pytest.raises(DataError, match=r"x\.npz: a frame has no name"):
        StoredRun(tmp_path / "x.npz")


@pytest.mark.parametrize("row", [(0, 0, 0, 2), (0, 0, 0, -1), (1, 2, 3, 1), (0, 0, 0, 0)])
@pytest.mark.parametrize(("name", "words"), [("gt", "ground truth"), ("pred", "prediction 0")])
def test_last_row_of_a_pose(name, words, row, tmp_path):
    poses = side("gt", 1)["gt_RTs"]
    poses[0, 3] = row
    run = StoredRun(stored(tmp_path, **{f"{name}_RTs": poses}))
    with pytest.raises(SampleError, match=rf"{words}.*: the pose's last row is .*, expected 0, 0"):
        run.judge(run.samples[0])


@pytest.mark.parametrize("box", [(10, 0, 0, 10), (0, 10, 10, 0), (10, 10, 0, 0)])
def test_boxes_that_are_inside_out(box, tmp_path):
    with pytest.raises(DataError, match=r"_0000\.pkl: gt_bboxes: row 0 is .*, expected y1, x1, y2"):
        StoredRun(stored(tmp_path, gt_bboxes=np.array([box])))
    run = StoredRun(stored(tmp_path, pred_bboxes=np.array([box])))
    assert run.judge(run.samples[0]).failure == "not detected"


@pytest.mark.parametrize("key", [*side("gt", 1), *side("pred", 1)])
def test_truth_values_are_no_numbers(key, tmp_path):
    wrong = content()[key].astype(bool)
    with pytest.raises(DataError, match=rf"{key} is missing or not an array of numbers"):
        StoredRun(stored(tmp_path, **{key: wrong}))


def test_pairs_that_are_matched(monkeypatch):
    def detections(found, truths):
        return Detections([0] * found, [1] * found, [0.5] * found, [0] * truths, [1] * truths, [1])

    with pytest.raises(ContractError, match=r"25000000 pairs .* at most 4000000 are matched"):
        detections(5000, 5000)
    monkeypatch.setattr(average_precision, "MOST_PAIRS", 6)
    assert len(detections(2, 3).pairs) == 6


def test_detections_are_ranked_in_time():
    """Sixty thousand of one object, and chains in which each pair waits for the one before."""
    count = 60_000
    scores = np.linspace(1, 0, count)
    many = Detections(np.zeros(count), np.zeros(count), scores, [0], [0], [0])
    start = time.process_time()
    assert many.iou_ap(np.full(count, 0.9), 0.5).mean == 1
    side_by_side = 700
    scores = np.linspace(1, 0, side_by_side)
    one = np.zeros(side_by_side)
    chain = Detections(one, one, scores, one, one, [0])
    left, right = chain.pairs.T
    matches = chain.iou_matches(1 - right / 1000, 0.2)
    assert matches.matched.all()
    assert len(left) == side_by_side**2
    assert time.process_time() - start < 2


RANKED = {"a": RankedDetection("mug", 0.5, "10"), "b": RankedDetection("mug", 0.4, "1-")}


@pytest.mark.parametrize(
    ("detections", "counted", "words"),
    [
        (RANKED, (1, 5), r"\[2, 0\] are right by column, but \[1, 5\] objects"),
        (RANKED, (int("1" + "0" * 400), 5), "objects counted of mug: 1000"),
        (RANKED, (2, -1), "objects counted of mug: -1, expected an integer"),
        (RANKED, (2, 1.5), "objects counted of mug: 1.5, expected an integer"),
        (RANKED, (2,), "outcomes of 4 characters, expected 1 for each of 2"),
        ({"a": RankedDetection("mug", float("inf"), "10")}, (1, 1), "'a': score inf"),
        ({"a": RankedDetection("mug", float("nan"), "10")}, (1, 1), "'a': score nan"),
    ],
)
def test_rankings_add_up(detections, counted, words):
    with pytest.raises(ContractError, match=words):
        Ranking(detections, {"mug": counted})
    assert Ranking(RANKED, {"mug": (2, 5), "can": (1, 1)}).without(["mug"]).counted == {
        "can": (1, 1)
    }


EXPORTED = {
    "no place": (("a", "obj_000001"), np.eye(3), "sample 'a': expected scene, image and place"),
    "words": (("a/b/c", "obj_000001"), np.eye(3), "'a/b/c': expected scene, image and place"),
    "negative": (("-1/2/0", "obj_000001"), np.eye(3), "'-1/2/0': expected scene"),
    "other digits": (("\u0661/2/0", "obj_000001"), np.eye(3), "/2/0': expected scene"),
    "long": (("9" * 400 + "/2/0", "obj_000001"), np.eye(3), "99': expected scene"),
    "four": (("1/2/0/4", "obj_000001"), np.eye(3), "'1/2/0/4': expected scene"),
    "category": (("1/2/0", "can"), np.eye(3), "'can' is no object, expected a name such as obj_0"),
    "short": (("1/2/0", "obj_1"), np.eye(3), "'obj_1' is no object"),
    "unknown": (("1/2/0", "obj_000007"), np.eye(3), "obj_000007 is not in the models of"),
    "zero": (("1/2/0", "obj_000001"), np.zeros((3, 3)), "'1/2/0': rotation: not orthonormal"),
    "mirrored": (("1/2/0", "obj_000001"), np.diag([1, 1, -1.0]), "'1/2/0': rotation: determinant"),
}


@pytest.mark.parametrize("attack", EXPORTED)
def test_export_of_strange_rows(attack, tmp_path, monkeypatch):
    (sample, category), rotation, words = EXPORTED[attack]
    row = SimpleNamespace(sample=sample, category=category, failure=None, estimate="x")
    results = SimpleNamespace(rows={sample: row}, header=SimpleNamespace(dataset="bop-x-test"))
    estimates = Estimates(rotation[None], np.ones((1, 3)), np.ones((1, 3)))
    monkeypatch.setattr(bop_export, "read_results", lambda path: results)
    monkeypatch.setattr(bop_export, "find_split", lambda data: (data, "test"))
    monkeypatch.setattr(bop_export, "find_models", lambda root: "models_info.json")
    monkeypatch.setattr(
        bop_export,
        "read_models",
        lambda path: ({1: SimpleNamespace(centre=np.zeros(3))}, []),
    )
    monkeypatch.setattr(bop_export, "decode_estimates", lambda texts: estimates)
    with pytest.raises(ResultsError, match=rf"mine\.jsonl: .*{words}"):
        bop_export.export_bop(tmp_path / "mine.jsonl", tmp_path, tmp_path / "out.csv")
    assert not (tmp_path / "out.csv").exists()
