"""What can be amiss with a file of predictions, done to published ones: the right number or the
right sentence."""

import pickle
from collections import Counter

import numpy as np
import pytest

from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.evaluation import StoredRun
from pytest_cpas.reading.pickles import load_numpy_pickle


@pytest.fixture(scope="session")
def frames(test_data):
    """48 frames of REAL275 as DualPoseNet answered them."""
    paths = sorted((test_data / "predictions" / "dualposenet_real275").glob("*.pkl"))
    return {path.stem.removeprefix("results_test_"): load_numpy_pickle(path) for path in paths}


@pytest.fixture
def dataset(frames, tmp_path):
    """The truth about them, no image."""
    folder = tmp_path / "data" / "gts" / "real_test"
    folder.mkdir(parents=True)
    keys = ("gt_class_ids", "gt_RTs", "gt_scales", "gt_bboxes")
    for name, frame in frames.items():
        content = pickle.dumps({key: frame[key] for key in keys})
        (folder / f"results_real_test_{name}.pkl").write_bytes(content)
    return Real275(tmp_path / "data")


def run_of(tmp_path, frames, dataset):
    folder = tmp_path / "mine"
    folder.mkdir(exist_ok=True)
    for name, frame in frames.items():
        (folder / f"results_test_{name}.pkl").write_bytes(pickle.dumps(frame))
    return StoredRun(folder, dataset=dataset)


def correct(run, metres=0.02, degrees=10):
    facts = [run.judge(ref).facts for ref in run.samples]
    return sum(f["position_m"] <= metres and f["rotation_deg"] <= degrees for f in facts)


def changed(frames, **changes):
    return {
        name: frame | {key: change(frame) for key, change in changes.items()}
        for name, frame in frames.items()
    }


@pytest.fixture(scope="session")
def sound(frames, tmp_path_factory):
    """How many are correct by the file's own truth, which is that of the data set."""
    return correct(run_of(tmp_path_factory.mktemp("sound"), frames, None))


def test_sound_file(frames, dataset, sound, tmp_path):
    run = run_of(tmp_path, frames, dataset)
    assert len(run.samples) == sum(len(frame["gt_class_ids"]) for frame in frames.values())
    assert correct(run) == sound > 100
    assert run.notes == [], "all are detected, and nothing is amiss"


def test_truth_overwritten_with_the_answers(frames, dataset, sound, tmp_path):
    forged = {}
    for name, frame in frames.items():
        poses = frame["gt_RTs"].copy()
        count = min(len(poses), len(frame["pred_RTs"]))
        poses[:count] = frame["pred_RTs"][:count]
        forged[name] = frame | {"gt_RTs": poses}
    run = run_of(tmp_path, forged, dataset)
    assert correct(run) == sound
    assert any("own ground truth" in note and "real275 counts" in note for note in run.notes)
    assert any("ground truth to the last bit" in note for note in run.notes)


def test_a_third_of_the_frames_left_out(frames, dataset, sound, tmp_path):
    kept = {name: frame for i, (name, frame) in enumerate(frames.items()) if i % 3}
    run = run_of(tmp_path, kept, dataset)
    assert len(run.samples) == sum(len(frame["gt_class_ids"]) for frame in frames.values())
    assert correct(run) < sound
    assert run.notes[0].startswith(f"{len(frames) - len(kept)} of {len(frames)} images of real275")


@pytest.mark.parametrize("reverse", [False, True])
def test_two_hypotheses_of_one_detection(frames, dataset, sound, tmp_path, reverse):
    """A worse one of a lower score beside each, before or after it."""
    twice = {}
    for name, frame in frames.items():
        keys = ("pred_class_ids", "pred_bboxes", "pred_RTs", "pred_scales", "pred_scores")
        worse = {key: frame[key].copy() for key in keys}
        worse["pred_RTs"][:, :3, 3] += 0.5
        worse["pred_scores"] = worse["pred_scores"] * 0.5
        order = slice(None, None, -1 if reverse else 1)
        both = {key: np.concatenate([frame[key], worse[key]])[order] for key in keys}
        twice[name] = frame | both
    assert correct(run_of(tmp_path, twice, dataset)) == sound


@pytest.mark.parametrize(
    ("key", "change", "words"),
    [
        ("pred_bboxes", lambda b: b[:, [1, 0, 3, 2]], "boxes as x1, y1, x2, y2"),
        (
            "pred_bboxes",
            lambda b: np.column_stack([b[:, 1], b[:, 0], b[:, 3] - b[:, 1], b[:, 2] - b[:, 0]]),
            "boxes as x, y, width, height",
        ),
        (
            "pred_RTs",
            lambda p: np.roll(p, 1, axis=0),
            "the poses of each answer from the row below",
        ),
    ],
)
def test_boxes_and_rows_that_are_mixed_up(frames, dataset, sound, tmp_path, key, change, words):
    run = run_of(tmp_path, changed(frames, **{key: lambda f: change(f[key])}), dataset)
    assert correct(run) < sound / 2
    assert [note for note in run.notes if words in note and note.startswith("audit: ")]


def test_frames_that_are_mixed_up(frames, dataset, sound, tmp_path):
    names, keys = list(frames), [k for k in next(iter(frames.values())) if k.startswith("pred")]
    steps = ((1, "of the previous frame"), (-1, "of the next frame"), (8, "8 before"))
    for step, words in steps:
        others = [*names[step:], *names[:step]]
        moved = {
            name: frames[name] | {key: frames[other][key] for key in keys}
            for name, other in zip(names, others, strict=True)
        }
        run = run_of(tmp_path, moved, dataset)
        assert correct(run) < sound
        assert [note for note in run.notes if words in note and note.startswith("audit: ")]


@pytest.mark.parametrize(("pose", "kind"), [(0.0, "zero"), (np.nan, "not finite")])
def test_failed_instances(frames, dataset, sound, tmp_path, pose, kind):
    failed = {}
    for name, frame in frames.items():
        poses = frame["pred_RTs"].copy()
        poses[::4] = pose
        failed[name] = frame | {"pred_RTs": poses}
    run = run_of(tmp_path, failed, dataset)
    assert len(run.samples) == sum(len(frame["gt_class_ids"]) for frame in frames.values())
    assert correct(run) < sound
    failures = Counter(run.judge(ref).failure for ref in run.samples)
    assert failures[f"the stored pose is {kind}"] == sum(
        len(frame["pred_RTs"][::4]) for frame in frames.values()
    )


def test_half_precision(frames, dataset, sound, tmp_path):
    run = run_of(
        tmp_path, changed(frames, pred_RTs=lambda f: f["pred_RTs"].astype(np.float16)), dataset
    )
    assert abs(correct(run) - sound) < 8
    assert "half precision" in run.notes[0]


def test_handles_that_are_hidden(frames, dataset, tmp_path):
    hidden = changed(frames, gt_handle_visibility=lambda f: np.arange(len(f["gt_class_ids"])) % 2)
    run = run_of(tmp_path, hidden, dataset)
    mugs = sum(int((f["gt_class_ids"][::2] == 6).sum()) for f in frames.values())
    truths = [run.truth(ref) for ref in run.samples]
    assert sum(truth.symmetry_in_view is not None for truth in truths) == mugs > 0
