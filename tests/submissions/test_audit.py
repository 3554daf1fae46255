"""Files in which something is mixed up: what it is, is said; of sound files nothing is."""

import pickle

import numpy as np
import pytest

from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.evaluation import StoredRun

FRAMES, OBJECTS = 24, 4
ABOUT_UP = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])


def scene(seed=0):
    """Frames of four objects of other categories, each answered within a few millimetres."""
    rng = np.random.default_rng(seed)
    frames = []
    at = rng.uniform(-0.4, 0.4, (OBJECTS, 3))
    for index in range(FRAMES):
        corner = rng.uniform(100, 300, (OBJECTS, 2)).round() + 60 * np.arange(OBJECTS)[:, None]
        poses = np.tile(np.eye(4), (OBJECTS, 1, 1))
        turns = np.linalg.qr(rng.normal(size=(OBJECTS, 3, 3)))[0]
        poses[:, :3, :3] = 0.2 * turns * np.sign(np.linalg.det(turns))[:, None, None]
        poses[:, :3, 3] = at + np.array([0.05 * index, 0, 1.2])
        objects = {
            "class_ids": np.array([1, 3, 5, 6]),
            "bboxes": np.concatenate([corner, corner + rng.uniform(30, 90, (OBJECTS, 2))], axis=1),
            "RTs": poses,
            "scales": rng.uniform(0.3, 0.8, (OBJECTS, 3)),
        }
        frame = {f"{side}_{key}": v for side in ("gt", "pred") for key, v in objects.items()}
        frame["pred_RTs"] = poses.copy()
        frame["pred_RTs"][:, :3, 3] += rng.normal(0, 0.003, (OBJECTS, 3))
        frame["pred_scores"] = rng.uniform(0.5, 1, OBJECTS)
        frames.append(frame)
    return frames


def run_of(tmp_path, frames, names=None):
    folder = tmp_path / "mine"
    folder.mkdir()
    for index, frame in enumerate(frames):
        name = names[index] if names else f"scene_1_{index:04d}"
        (folder / f"results_test_{name}.pkl").write_bytes(pickle.dumps(frame))
    return StoredRun(folder)


def told(run):
    return [note for note in run.notes if note.startswith("audit")]


def changed(key, change):
    def mistake(frames):
        return [{**frame, key: change(frame[key])} for frame in frames]

    return mistake


def from_frame(step, *keys):
    def mistake(frames):
        other = [*frames[step:], *frames[:step]]
        return [
            {**frame, **{key: source[key] for key in keys}}
            for frame, source in zip(frames, other, strict=True)
        ]

    return mistake


def alphabetical(frames):
    """What was written in the order 0, 1, 10, 11, ... was given the names in their own."""
    order = sorted(range(len(frames)), key=str)
    keys = [key for key in frames[0] if key.startswith("pred")]
    return [
        {**frame, **{key: frames[other][key] for key in keys}}
        for frame, other in zip(frames, order, strict=True)
    ]


PREDICTED = ("pred_RTs", "pred_scales", "pred_bboxes", "pred_class_ids", "pred_scores")

MISTAKES = {
    "x1 y1 x2 y2": (
        changed("pred_bboxes", lambda b: b[:, [1, 0, 3, 2]]),
        "boxes as x1, y1, x2, y2",
    ),
    "x y w h": (
        changed(
            "pred_bboxes",
            lambda b: np.column_stack([b[:, 1], b[:, 0], b[:, 3] - b[:, 1], b[:, 2] - b[:, 0]]),
        ),
        "boxes as x, y, width, height",
    ),
    "y x h w": (
        changed("pred_bboxes", lambda b: np.column_stack([b[:, :2], b[:, 2:] - b[:, :2]])),
        "boxes as y, x, height, width",
    ),
    "centres": (
        changed(
            "pred_bboxes",
            lambda b: np.column_stack([(b[:, 1::-1] + b[:, :1:-1]) / 2, b[:, :1:-1] - b[:, 1::-1]]),
        ),
        "boxes as centre x, centre y, width, height",
    ),
    "rows rolled": (
        lambda frames: changed("pred_RTs", lambda p: np.roll(p, 1, axis=0))(
            changed("pred_scales", lambda p: np.roll(p, 1, axis=0))(frames)
        ),
        "poses of each answer from the row below",
    ),
    "rows rolled back": (
        changed("pred_RTs", lambda p: np.roll(p, -1, axis=0)),
        "poses of each answer from the row above",
    ),
    "classes rolled": (
        changed("pred_class_ids", lambda p: np.roll(p, 1)),
        "classes of each answer from the row below",
    ),
    "classes one less": (
        changed("pred_class_ids", lambda ids: np.where(ids > 1, ids - 1, ids)),
        "class ids as one more",
    ),
    "two classes exchanged": (
        changed("pred_class_ids", lambda ids: np.choose(ids, [0, 1, 2, 5, 4, 3, 6])),
        "the class ids 3 as laptop, 5 as camera",
    ),
    "classes sorted otherwise": (
        changed("pred_class_ids", lambda ids: np.choose(ids, [0, 6, 4, 1, 5, 2, 3])),
        "the class ids ",
    ),
    "next frame": (from_frame(1, *PREDICTED), "the previous frame"),
    "previous frame": (from_frame(-1, *PREDICTED), "the next frame"),
    "poses of the next frame": (
        from_frame(1, "pred_RTs", "pred_scales"),
        "the poses of the previous frame",
    ),
    "alphabetical": (alphabetical, "sorted alphabetically"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake_is_told(name, tmp_path):
    mistake, words = MISTAKES[name]
    lines = told(run_of(tmp_path, mistake(scene())))
    assert len(lines) == 1, lines
    assert words in lines[0]


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_told_of_a_sound_file(seed, tmp_path):
    assert told(run_of(tmp_path, scene(seed))) == []


def test_nothing_is_told_of_answers_that_are_merely_bad(tmp_path):
    rng = np.random.default_rng(0)
    frames = scene()
    for frame in frames:
        frame["pred_RTs"][:, :3, 3] += rng.normal(0, 0.05, (OBJECTS, 3))
    assert told(run_of(tmp_path, frames)) == []


def test_truth_in_the_place_of_answers(tmp_path):
    frames = scene()
    for frame in frames[:10]:
        frame["pred_RTs"] = frame["gt_RTs"]
    [line] = told(run_of(tmp_path, frames))
    assert "40 of 96 answers are the file's own ground truth to the last bit" in line


def test_one_answer_for_all(tmp_path):
    frames = scene()
    for frame in frames[3:]:
        frame["pred_RTs"] = frames[0]["pred_RTs"][:1].repeat(OBJECTS, axis=0)
    assert told(run_of(tmp_path, frames))[-1] == (
        "audit: 85 of 96 answers have one and the same pose"
    )


@pytest.mark.parametrize("share", [0, 0.5])
def test_truth_of_the_file_beside_that_of_the_data_set(share, tmp_path):
    frames = scene()
    folder = tmp_path / "data" / "gts" / "real_test"
    folder.mkdir(parents=True)
    for index, frame in enumerate(frames):
        truth = {key: frame[key].copy() for key in ("gt_class_ids", "gt_RTs", "gt_scales")}
        if index < share * FRAMES:
            truth["gt_RTs"][1, :3, 3] += [0, 0.03, 0]
            # of a bottle this is nothing, of a camera it is a turn by 90 degrees
            truth["gt_RTs"][:2, :3, :3] = truth["gt_RTs"][:2, :3, :3] @ ABOUT_UP
        if share and index == FRAMES - 1:
            truth["gt_RTs"][2, :3, 3] += 1
        name = f"results_real_test_scene_1_{index:04d}.pkl"
        (folder / name).write_bytes(pickle.dumps(truth))
    path = run_of(tmp_path, frames)._submission.path
    notes = StoredRun(path, dataset=Real275(tmp_path / "data")).notes
    assert [note for note in notes if "ground truth" in note] == (
        [
            "1 of 96 objects of the file's own ground truth are not within 10 cm of one of"
            " real275's of their class and image, and do not count",
            "1 objects of real275 are not in the file's own ground truth",
            "the file's own ground truth differs from real275's for 12 of 95 objects that are in"
            " both, by up to 30.0 mm (centres), 0.0 mm (sides) and 90.0 deg; that of real275"
            " counts",
        ]
        if share
        else []
    )


def test_neighbours_are_those_of_the_data_set_whatever_the_order_of_the_file(tmp_path):
    frames = scene()
    folder = tmp_path / "data" / "gts" / "real_test"
    folder.mkdir(parents=True)
    for index, frame in enumerate(frames):
        truth = {key: frame[key] for key in ("gt_class_ids", "gt_RTs", "gt_scales", "gt_bboxes")}
        name = f"results_real_test_scene_1_{index:04d}.pkl"
        (folder / name).write_bytes(pickle.dumps(truth))
    order = np.random.default_rng(1).permutation(FRAMES)
    moved = from_frame(1, *PREDICTED)(frames)
    rows = {key: np.concatenate([moved[i][key] for i in order]) for key in moved[0]}
    offsets = np.arange(FRAMES + 1) * OBJECTS
    path = tmp_path / "mine.npz"
    frame = [f"scene_1_{index:04d}" for index in order]
    np.savez(path, **rows, frame=frame, gt_offset=offsets, pred_offset=offsets)
    [line] = told(StoredRun(path, dataset=Real275(tmp_path / "data")))
    assert "the answers of the previous frame" in line
