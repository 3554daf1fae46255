"""Stored predictions: the field's pickles and the .npz form."""

import pickle

import numpy as np
import pytest

from pytest_cpas.evaluation import SampleError
from pytest_cpas.evaluation.predictions import StoredRun
from pytest_cpas.golden import RunTable, Word, compare
from pytest_cpas.protocols import PAPER, count_columns, judge_outcomes, shipped_protocol
from pytest_cpas.report.document import run_document
from pytest_cpas.report.messages import judged_message
from pytest_cpas.submissions import read_submission
from pytest_cpas.submissions.pairing import assign
from pytest_cpas.types import ContractError

RNG_BOXES = np.array([[0, 0, 10, 10], [0, 20, 10, 30], [50, 50, 90, 90]])


def frame(**changed):
    """Three objects, a bowl and two mugs, and a detection of each in reversed order."""
    poses = np.tile(np.diag([0.2, 0.2, 0.2, 1.0]), (3, 1, 1))
    poses[:, :3, 3] = [[0, 0, 1], [0.3, 0, 1], [0, 0.3, 1]]
    values = {
        "gt_class_ids": np.array([2, 6, 6]),
        "gt_bboxes": RNG_BOXES,
        "gt_RTs": poses,
        "gt_scales": np.full((3, 3), 1 / np.sqrt(3)),
        "pred_class_ids": np.array([6, 6, 2]),
        "pred_bboxes": RNG_BOXES[::-1],
        "pred_scores": np.array([0.9, 0.8, 0.7]),
        "pred_RTs": poses[::-1],
        "pred_scales": np.full((3, 3), 1 / np.sqrt(3)),
    }
    return values | changed


def write(path, **changed):
    path.write_bytes(pickle.dumps(frame(**changed), protocol=3))
    return path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "results_test_scene_1_0007.pkl"


def test_perfect_predictions_are_perfect(path):
    run = StoredRun(write(path))
    assert [(s.id, s.category) for s in run.samples] == [
        ("scene_1/0007/gt0", "bowl"),
        ("scene_1/0007/gt1", "mug"),
        ("scene_1/0007/gt2", "mug"),
    ]
    for ref in run.samples:
        row = run.judge(ref)
        assert row.facts == {
            "position_m": pytest.approx(0, abs=1e-9),
            "rotation_deg": pytest.approx(0, abs=1e-9),
            "iou": pytest.approx(1),
            "fscore_1cm": None,
            "nad": None,
        }


def test_extents_are_relative_to_the_pose_scale(path):
    # half as large in the pose, twice in the sizes
    predicted = frame()["pred_RTs"].copy()
    predicted[:, :3, :3] /= 2
    run = StoredRun(write(path, pred_RTs=predicted, pred_scales=np.full((3, 3), 2 / np.sqrt(3))))
    assert all(run.judge(ref).facts["iou"] == pytest.approx(1) for ref in run.samples)
    halved = StoredRun(write(path, pred_RTs=predicted))
    assert all(halved.judge(ref).facts["iou"] == pytest.approx(1 / 8) for ref in halved.samples)


def test_up_axis_is_y_of_both_frames(path):
    """A turn about NOCS y is free for a bowl and counts for a mug; about x it counts for both."""
    for axes, free in (((0, 2), True), ((1, 2), False)):
        angle = np.radians(30)
        turn = np.eye(4)
        turn[np.ix_(axes, axes)] = [
            [np.cos(angle), -np.sin(angle)],
            [np.sin(angle), np.cos(angle)],
        ]
        run = StoredRun(write(path, pred_RTs=frame()["pred_RTs"] @ turn))
        angles = [run.judge(ref).facts["rotation_deg"] for ref in run.samples]
        assert angles == pytest.approx([0 if free else 30, 30, 30], abs=1e-6)


def test_detections_are_assigned_by_descending_box_iou():
    # both detections overlap the first object; the better one gets it, the other falls under 0.5
    boxes = np.array([[0, 0, 10, 10], [0, 4, 10, 14]], float)
    found = np.array([[0, 2, 10, 12], [0, 0, 10, 10]], float)
    same = np.ones((2, 2), bool)
    assert assign(boxes, found, same) == [[1], [0]]
    same[:, 1] = False  # another class is no candidate
    assert assign(boxes, found, same) == [[0], []]
    half, none = np.array([[0, 5, 10, 10]], float), np.array([[0, 5.1, 10, 10]], float)
    same = np.ones((2, 1), bool)
    assert assign(boxes, half, same) == [[0], []], "an IoU of exactly 0.5 is enough"
    assert assign(boxes, none, same) == [[], []]
    assert assign(boxes[:0], half, same[:0]) == []


def test_what_is_left_over_goes_to_the_object_that_it_overlaps_most():
    boxes = np.array([[0, 0, 10, 10], [0, 50, 10, 60]], float)
    found = np.array([[0, 1, 10, 11], [0, 0, 10, 10], [0, 3, 10, 13], [0, 9, 10, 19]], float)
    assert assign(boxes, found, np.ones((2, 4), bool)) == [[1, 0, 2], []]


def test_best_scored_of_several_answers_counts_whatever_their_order(path):
    wrong = frame()["pred_RTs"].copy()
    wrong[:, :3, 3] += 0.5
    for scores in ((0.9, 0.8, 0.7), (0.1, 0.2, 0.3)):
        twice = {
            key: np.concatenate([frame()[key], frame()[key]])
            for key in ("pred_class_ids", "pred_bboxes", "pred_scales")
        }
        poses = np.concatenate([frame()["pred_RTs"], wrong])
        scored = np.concatenate([scores, [0.5] * 3])
        expected = 0 if scores[0] > 0.5 else 0.5 * np.sqrt(3)
        for order in (np.arange(6), np.arange(6)[::-1]):
            content = {key: values[order] for key, values in twice.items()}
            run = StoredRun(
                write(path, **content, pred_RTs=poses[order], pred_scores=scored[order])
            )
            positions = [run.judge(ref).facts["position_m"] for ref in run.samples]
            assert positions == pytest.approx([expected] * 3, abs=1e-9)


def test_undetected_truth_is_not_correct(path):
    nothing = {
        "pred_class_ids": np.array([]),
        "pred_scores": np.array([]),
        "pred_bboxes": np.array([]),
        "pred_RTs": np.zeros((0, 4, 4)),
        "pred_scales": np.zeros((0, 3)),
    }
    run = StoredRun(write(path, **nothing))
    assert {run.judge(ref).failure for ref in run.samples} == {"not detected"}


def broken(index, value):
    poses = frame()["pred_RTs"].copy()
    poses[index] = value
    return poses


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (np.diag([0.2, 0.2, -0.2, 1]), "determinant -0.008"),
        (np.diag([0.1, 0.2, 0.3, 1]), "not orthonormal"),
        (np.diag([0, 0.2, 0.2, 1.0]), "determinant 0"),
    ],
)
def test_broken_prediction_fails_its_sample_only(path, pose, words):
    run = StoredRun(write(path, pred_RTs=broken(0, pose)))
    assert [run.judge(ref).failure for ref in run.samples[:2]] == [None, None]
    with pytest.raises(SampleError, match=rf"scene_1/0007/gt2 \(mug\).*prediction 0.*{words}"):
        run.judge(run.samples[2])


@pytest.mark.parametrize(
    ("changed", "failure"),
    [
        ({"pred_RTs": np.zeros((4, 4))}, "the stored pose is zero"),
        ({"pred_RTs": np.diag([0, 0, 0, 1.0])}, "the stored pose is zero"),
        ({"pred_RTs": np.full((4, 4), np.nan)}, "the stored pose is not finite"),
        ({"pred_scales": np.zeros(3)}, "the stored box is zero"),
        ({"pred_scales": [1, np.nan, 1]}, "the stored box is not finite"),
        ({"pred_scales": [1, np.inf, 1]}, "the stored box is not finite"),
    ],
)
def test_failed_answer_stays_in_the_denominator(path, changed, failure):
    [(key, value)] = changed.items()
    content = frame()[key].copy()
    content[0] = value
    run = StoredRun(write(path, **{key: content}))
    rows = [run.judge(ref) for ref in run.samples]
    assert [row.failure for row in rows] == [None, None, failure]
    assert rows[2].facts["position_m"] == np.inf
    document = run_document(run, RunTable.of(run, rows))
    assert judged_message(document) == f"3 of 3 samples judged, 1 without an answer: 1 {failure}"


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"gt_class_ids": np.array([2, 6, 7])}, "class ids run from 2 to 7"),
        ({"gt_class_ids": np.array([0, 6, 6])}, "class ids run from 0"),
        ({"gt_bboxes": np.zeros((2, 4))}, r"gt_bboxes has shape \(2, 4\), expected \(3, 4\)"),
        ({"pred_RTs": np.zeros((3, 3, 3))}, r"pred_RTs has shape"),
        ({"pred_scales": None}, "pred_scales is missing"),
        ({"gt_RTs": np.array([["a"]])}, "not an array of numbers"),
    ],
)
def test_damaged_file_is_refused(path, changed, words):
    with pytest.raises(ContractError, match=words) as caught:
        StoredRun(write(path, **changed))
    assert path.name in str(caught.value)


def as_npz(target, names, frames):
    counts = {
        side: [0, *np.cumsum([len(f[f"{side}_class_ids"]) for f in frames])]
        for side in ("gt", "pred")
    }
    arrays = {key: np.concatenate([f[key] for f in frames]) for key in frames[0]}
    np.savez(target, frame=names, gt_offset=counts["gt"], pred_offset=counts["pred"], **arrays)


def test_npz_and_folder_of_pickles_are_the_same(tmp_path, path):
    write(path)
    other = write(tmp_path / "results_test_scene_2_0001.pkl", pred_RTs=broken(1, np.eye(4)))
    assert [image.name for image in read_submission(tmp_path).images] == [
        "scene_1_0007",
        "scene_2_0001",
    ]
    as_npz(
        tmp_path / "all.npz",
        ["scene_1_0007", "scene_2_0001"],
        [frame(), pickle.loads(other.read_bytes())],
    )
    pickles, npz = StoredRun(tmp_path), StoredRun(tmp_path / "all.npz")
    assert pickles.samples == npz.samples
    assert pickles.identity == npz.identity
    assert [pickles.judge(r) for r in pickles.samples] == [npz.judge(r) for r in npz.samples]


def crowded(rng, **changed):
    """Two mugs and a bowl, each found several times: equally sure, in one and the same box."""
    content = frame()
    rows = np.array([0, 0, 0, 1, 1, 2, 2])
    for key in ("pred_class_ids", "pred_bboxes", "pred_RTs", "pred_scales"):
        content[key] = content[key][rows].copy()
    content["pred_scores"] = np.array([0.9, 0.9, 0.9, 0.9, 0.5, 0.7, 0.7])
    content["pred_RTs"][:, :3, 3] += rng.normal(0, 0.02, (7, 3))
    return content | changed


def in_order(content, side, order):
    return {k: v[order] if k.startswith(side) else v for k, v in content.items()}


def ranked(folder, frames):
    """The table of frames under the protocols that rank detections."""
    folder.mkdir()
    as_npz(folder / "mine.npz", list(frames), list(frames.values()))
    protocols = [shipped_protocol(name) for name in (PAPER, "nocs", "nocs-legacy")]
    return RunTable.of(StoredRun(folder / "mine.npz", protocols=protocols))


def test_order_of_detections_and_frames_means_nothing(tmp_path):
    """Also where scores are equal, and where a ground truth has several detections of one box."""
    rng = np.random.default_rng(3)
    frames = {f"scene_1_{i:04d}": crowded(rng) for i in range(6)}
    golden = ranked(tmp_path / "golden", frames)
    assert len({d.outcome for d in golden.ranking.detections.values()}) > 2
    for trial in range(4):
        shuffled = {
            name: in_order(frames[name], "pred", rng.permutation(7))
            for name in rng.permutation(list(frames)).tolist()
        }
        new = ranked(tmp_path / f"shuffled{trial}", shuffled)
        assert new.ranking == golden.ranking
        assert new.scores == golden.scores
        assert new.samples == golden.samples
        verdicts = compare(golden, new)
        assert [v.word for v in verdicts] == [Word.MATCHES] * len(verdicts)


def test_detection_more_or_less_changes_no_other(tmp_path):
    """What is called by its box keeps its name, in other categories as in its own."""
    content = crowded(np.random.default_rng(3))
    golden = ranked(tmp_path / "golden", {"scene_1_0000": content})
    fewer = ranked(
        tmp_path / "fewer",
        {"scene_1_0000": in_order(content, "pred", np.array([4, 5, 6]))},
    )
    verdicts = {verdict.category: verdict for verdict in compare(golden, fewer)}
    assert (verdicts["bowl"].word, verdicts["mug"].word) == (Word.MATCHES, Word.REGRESSED)
    kept = {name for name in fewer.ranking.detections if "/mug/" in name}
    assert kept == {"scene_1_0000/mug/0_20_10_30"}
    assert "scene_1_0000/mug/50_50_90_90" in verdicts["mug"].details


@pytest.mark.parametrize("damage", ["offset", "lacks", "truncated", "object"])
def test_damaged_npz_is_refused(tmp_path, damage):
    path = tmp_path / "x.npz"
    as_npz(path, ["scene_1_0007"], [frame()])
    content = dict(np.load(path))
    if damage == "offset":
        content["gt_offset"] = np.array([0, 2])
    elif damage == "lacks":
        del content["pred_RTs"]
    elif damage == "object":
        content["frame"] = np.array([object()])
    np.savez(path, **content)
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(ContractError, match=r"x\.npz"):
        StoredRun(path)


def test_published_predictions(test_data):
    """All of REAL275: the counts were worked out independently of this project."""
    run = StoredRun(test_data / "predictions" / "dualposenet_real275.npz")
    rows = {ref.id: run.judge(ref) for ref in run.samples}
    assert len(rows) == 16118

    def correct(degrees, metres, category=None):
        return sum(
            row.facts["rotation_deg"] <= degrees and row.facts["position_m"] <= metres
            for row in rows.values()
            if category in (None, row.category)
        )

    assert correct(10, 0.02) == 8683
    assert correct(5, 0.01) == 2638
    by_category = {c: correct(10, 0.02, c) for c in ("bottle", "bowl", "camera", "can", "laptop")}
    assert by_category == {"bottle": 1113, "bowl": 2181, "camera": 102, "can": 1954, "laptop": 1544}
    assert correct(10, 0.02, "mug") == 1789

    pickles = StoredRun(test_data / "predictions" / "dualposenet_real275")
    stored = read_submission(test_data / "predictions" / "dualposenet_real275")
    names = [image.name for image in stored.images]
    assert len(names) == 48
    assert len(pickles.samples) == sum(
        ref.id.rpartition("/")[0].replace("/", "_") in names for ref in run.samples
    )
    same = [rows[ref.id] for ref in pickles.samples]
    alone = [pickles.judge(ref) for ref in pickles.samples]
    columns = count_columns([shipped_protocol(PAPER)])
    outcomes = [judge_outcomes(columns, [row.facts for row in given]) for given in (alone, same)]
    assert outcomes[0] == outcomes[1]
    for one, other in zip(alone, same, strict=True):
        assert (one.sample, one.category, one.failure) == (
            other.sample,
            other.category,
            other.failure,
        )
        assert one.facts == pytest.approx(other.facts, abs=1e-9)
