"""Methods that see objects through the masks of a detector."""

import json
import os
import pickle

import numpy as np
import pytest
import tiny

from pytest_cpas.evaluation import (
    DetectedRun,
    MethodRun,
    Row,
    SavedAnswers,
    StoredRun,
    result_lines,
)
from pytest_cpas.golden import RunTable
from pytest_cpas.protocols import shipped_protocol
from pytest_cpas.reading.pickles import load_numpy_pickle
from pytest_cpas.submissions import DetectedDataset, read_submission, write_submission
from pytest_cpas.types import DataError, Hypothesis, MethodInfo, Prediction

CLASSES = {"bowl": 2, "mug": 6}


def detections(category, boxes=((2, 3, 4, 6),), scores=None, **changed):
    masks = np.zeros((6, 8, len(boxes)), bool)
    for index, (top, left, bottom, right) in enumerate(boxes):
        masks[top : bottom - 1, left:right, index] = True  # a row less than the box
    values = {
        "rois": np.array(boxes, np.int32).reshape(-1, 4),
        "class_ids": np.full(len(boxes), CLASSES[category], np.int32),
        "scores": np.linspace(0.9, 0.5, len(boxes)) if scores is None else np.array(scores),
        "masks": masks,
    }
    return values | changed


def name_of(ref):
    return f"results_test_{ref.id.replace('/', '_')}.pkl"


def wrote(folder, **special):
    """A detection of each sample, or what is special about some: None for no file."""
    folder.mkdir(exist_ok=True)
    for index, ref in enumerate(tiny.Tiny(None).samples):
        values = special.get(f"at{index}", detections(ref.category))
        if values is not None:
            (folder / name_of(ref)).write_bytes(pickle.dumps(values))
    return folder


class Seeing:
    """Answers rightly, but for what is in the corner, and remembers the masks that it was given."""

    info = MethodInfo(
        name="seeing",
        categories=tiny.CATEGORIES,
        needs={"depth"},
        gives={"extents"},
        licence="MIT",
    )

    def load(self, assets, device):
        self.masks = {}

    def predict(self, batch, seed):
        answers = []
        for seen in batch:
            index = round(float(seen.rgb[0, 0, 0]) * 255)
            self.masks.setdefault((index, seen.category), []).append(seen.mask.copy())
            truth = tiny.truth(index)
            pose, aside = truth.pose, [0, float(seen.mask[0, 0]), 0]
            answer = Hypothesis(
                rotation=pose.rotation,
                translation=pose.translation + aside,
                extents=truth.extents,
            )
            answers.append(Prediction((answer,)))
        return answers


def judged(folder, **options):
    method = Seeing()
    run = DetectedRun(method, DetectedDataset(tiny.Tiny(None), folder), **options)
    return run, method, {ref.id: run.judge(ref) for ref in run.samples}


def test_masks_are_the_detectors(tmp_path):
    run, method, rows = judged(wrote(tmp_path / "d"))
    assert len(rows) == tiny.COUNT
    assert all(row.failure is None for row in rows.values())
    expected = detections("mug")["masks"][:, :, 0]
    assert all(np.array_equal(mask, expected) for [mask] in method.masks.values())
    assert run.dataset == "tiny+detections"
    assert run.identity["data"] != MethodRun(Seeing(), tiny.Tiny(None)).identity["data"]


def test_surest_of_several_counts(tmp_path):
    boxes = ((2, 3, 4, 6), (2, 3, 5, 6))
    for scores, rows in (((0.9, 0.3), 1), ((0.3, 0.9), 2)):
        folder = wrote(tmp_path / "d", at1=detections("mug", boxes, scores))
        _, method, _ = judged(folder)
        assert [mask.sum() for mask in method.masks[1, "mug"]] == [3 * rows, 3 * (3 - rows)]


@pytest.mark.parametrize(
    ("special", "reason"),
    [
        (None, "whose image is not among the detections"),
        (detections("mug", ()), "not detected"),
        (detections("bowl"), "not detected"),
        (detections("mug", ((0, 0, 2, 2),)), "not detected"),
    ],
)
def test_what_is_not_detected_counts_as_not_correct(tmp_path, special, reason):
    protocols = [shipped_protocol(name) for name in ("cpas", "bop")]
    _, method, rows = judged(wrote(tmp_path / "d", at1=special), protocols=protocols, seeds=2)
    failed = {name: row for name, row in rows.items() if row.failure}
    assert [*failed] == ["scene_0/0001"]
    [row] = failed.values()
    assert row.failure == reason
    assert len(row.answers) == 2
    asked = special is not None and CLASSES["mug"] in special["class_ids"]
    assert ((1, "mug") in method.masks) == asked, "about a detection of nothing, not the sample"
    other = rows["scene_0/0000"].facts
    assert {k for k, v in row.facts.items() if v is None} == {
        k for k, v in other.items() if v is None
    }


NOCS = [shipped_protocol(name) for name in ("cpas", "nocs")]


def plain(row):
    values = json.loads(json.dumps(row.plain()))
    return {name: value for name, value in values.items() if name not in ("sample", "category")}


def precisions(folder):
    run, method, rows = judged(folder, protocols=NOCS)
    # as they go through results files
    kept = [result_lines.row(ref, plain(rows[ref.id])) for ref in run.samples]
    assert [*rows.values()] == kept == [Row.of(row.plain()) for row in kept]
    table = RunTable.of(run, kept)
    assert table.ranking is not None
    return method, {
        category: cells["nocs.ap_oriented_iou_50"].value
        for category, cells in table.scores.items()
        if cells
    }


def test_all_detections_are_ranked(tmp_path):
    _, sound = precisions(wrote(tmp_path / "d"))
    assert sound == {"bowl": 1, "mug": 1, "all": 1}
    # a mug that nobody sees, surer than all others: right at recalls 1/6, ... with one wrong before
    extra = detections("mug", ((2, 3, 4, 6), (0, 0, 2, 2)), (0.9, 0.99))
    method, one = precisions(wrote(tmp_path / "d", at1=extra))
    assert one["bowl"] == 1
    assert one["mug"] == pytest.approx(6 / 7)
    assert sorted(map(len, method.masks.values())) == [1] * (tiny.COUNT - 1) + [2]
    # less sure than all others: nothing is lost
    extra = detections("mug", ((2, 3, 4, 6), (0, 0, 2, 2)), (0.9, 0.1))
    assert precisions(wrote(tmp_path / "d", at1=extra))[1] == sound
    # another class in the place of the mug: one of six is not found, and a bowl is wrong
    _, other = precisions(wrote(tmp_path / "d", at1=detections("bowl", scores=(0.1,))))
    assert other["mug"] == pytest.approx(5 / 6)
    assert other["bowl"] == 1


def cells(run, path=None):
    """The facts and cells of a run whose answers are saved to ``path``."""
    if path is not None:
        answers = SavedAnswers(path, run)
        answers.begin({})
        run.take_answer = answers.add
    rows = [run.judge(ref) for ref in run.samples]
    if path is not None:
        answers.finish([row.sample for row in rows])
    table = RunTable.of(run, rows)
    values = {key: cell and cell.value for of in table.scores.values() for key, cell in of.items()}
    return [row.facts for row in rows], values


@pytest.mark.parametrize(
    "special",
    [
        None,
        detections("mug", ()),
        detections("mug", ((2, 3, 4, 6), (0, 0, 2, 2)), (0.9, 0.99)),
        detections("mug", ((2, 3, 4, 6), (2, 3, 5, 6)), (0.3, 0.9)),
        detections("bowl", scores=(0.99,)),
        detections("mug", ((2, 3, 4, 6), (2, 3, 3, 6)), (0.9, 0.99)),  # the second has no pixel
    ],
)
@pytest.mark.parametrize("several", [False, True])
def test_a_saved_run_is_ranked_alike(tmp_path, monkeypatch, special, several):
    if several:  # of which one is ranked
        alone = Seeing.predict
        monkeypatch.setattr(
            Seeing,
            "predict",
            lambda *args: [Prediction(answer.hypotheses * 2) for answer in alone(*args)],
        )
    folder, data = wrote(tmp_path / "d", at1=special), tiny.Tiny(None)
    first = DetectedRun(Seeing(), DetectedDataset(data, folder), protocols=NOCS)
    expected = cells(first, tmp_path / "one.jsonl")
    assert expected[1]["nocs.ap_oriented_iou_50"] is not None
    again = StoredRun(tmp_path / "one.jsonl", dataset=data, protocols=NOCS)
    assert cells(again, tmp_path / "two.jsonl") == expected
    write_submission(read_submission(tmp_path / "two.jsonl"), tmp_path / "three.jsonl")
    assert cells(StoredRun(tmp_path / "three.jsonl", dataset=data, protocols=NOCS)) == expected


def test_a_part_is_not_ranked(tmp_path):
    run, _, rows = judged(wrote(tmp_path / "d"), protocols=NOCS)
    assert run.ranking([*rows.values()][1:]) is None


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ("x", "detections is 'x'"),
        ([{}], "detection is {}"),
        ([{"score": float("nan")}], "score is nan"),
        ([{"score": 1}], "score is 1"),
        ([{"name": 3}], "name is 3"),
        ([{"estimate": "AAAA"}], "estimate is 'AAAA'"),
    ],
)
def test_detections_of_rows_are_checked(tmp_path, found, words):
    run, _, rows = judged(wrote(tmp_path / "d"))
    ref = run.samples[0]
    values = plain(rows[ref.id])
    [whole] = values["detections"]
    if isinstance(found, list) and found[0]:
        found = [whole | found[0]]
    with pytest.raises(ValueError, match=words):
        result_lines.row(ref, values | {"detections": found})


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"masks": np.zeros((6, 8, 2), bool)}, r"masks has shape \(6, 8, 2\)"),
        ({"masks": None}, "masks is missing"),
        ({"rois": np.zeros((1, 3))}, "rois"),
        ({"scores": np.array([np.nan])}, "scores are not finite"),
        ({"class_ids": np.array([7])}, "class ids run from 7 to 7"),
        ({"class_ids": np.array([[2]])}, "class_ids has shape"),
    ],
)
def test_damaged_detections(tmp_path, changed, words):
    folder = wrote(tmp_path / "d", at3=detections("mug", **changed))
    with pytest.raises(DataError, match=rf"results_test_scene_0_0003\.pkl: .*{words}"):
        DetectedDataset(tiny.Tiny(None), folder)


def test_masks_of_another_size(tmp_path):

    folder = wrote(tmp_path / "d", at3=detections("mug", masks=np.ones((4, 4, 1), bool)))
    data = DetectedDataset(tiny.Tiny(None), folder)
    with pytest.raises(DataError, match="masks of 4 x 4, but the image is 8 x 6"):
        data.load(data.samples[3])


def test_a_folder_that_is_none(tmp_path):
    for path in (tmp_path / "none", tmp_path):
        with pytest.raises(DataError, match=r"detector"):
            DetectedDataset(tiny.Tiny(None), path)
    os.mkfifo(tmp_path / "results_test_scene_0_0000.pkl")
    with pytest.raises(DataError, match="not a regular file"):
        DetectedDataset(tiny.Tiny(None), tmp_path)


def test_published_detections_are_read(test_data):
    """What Mask R-CNN found on a real frame, as numpy 1.16 wrote it."""
    folder = test_data / "detections"
    content = load_numpy_pickle(folder / "results_test_scene_5_0001.pkl")

    class Frame(tiny.Tiny):
        def __init__(self):
            super().__init__(None)
            ref = tiny.SampleRef(id="scene_5/0001", category="can", scene="scene_5")
            self.samples = [ref]

        def load(self, ref):
            seen = np.zeros((480, 640), bool)
            top, left, bottom, right = content["rois"][0]
            seen[top:bottom, left:right] = True
            camera = tiny.Camera(640, 480, 590.0, 590.0, 320.0, 240.0)
            observation = tiny.Observation(
                category="can",
                rgb=np.zeros((480, 640, 3), np.float32),
                depth=np.zeros((480, 640), np.float32),
                mask=seen,
                camera=camera,
            )
            return tiny.Sample(ref, observation, tiny.truth(0))

    data = DetectedDataset(Frame(), folder)
    mask = data.load(data.samples[0]).observation.mask
    assert np.array_equal(mask, content["masks"][:, :, 0])
