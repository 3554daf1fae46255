"""Slips of people who write files: the right number, or a sentence that says what was seen."""

import json
import os
import pickle

import numpy as np
import pytest
import tiny
from test_audit import run_of, scene, told
from test_beside_a_dataset import NAMES, frame, positions, submitted, wrote
from test_detections import Seeing, detections
from test_detections import wrote as detected

from pytest_cpas import cli
from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.evaluation import (
    DetectedRun,
    ResultsError,
    ResultsFile,
    SavedAnswers,
    Shard,
    StoredRun,
    read_results,
)
from pytest_cpas.submissions import DetectedDataset, read_submission, write_submission
from pytest_cpas.types import DataError

TRUTH = ("gt_class_ids", "gt_RTs", "gt_scales", "gt_bboxes")


@pytest.fixture
def dataset(tmp_path):
    """The truth of three frames of REAL275, no image."""
    truths = {
        f"results_real_test_{name}.pkl": {key: frame(0.01 * i)[key] for key in TRUTH}
        for i, name in enumerate(NAMES)
    }
    wrote(tmp_path / "data" / "gts" / "real_test", truths)
    return Real275(tmp_path / "data")


# -- folders --------------------------------------------------------------------------------


def test_a_folder_of_two_kinds_is_refused(tmp_path, dataset):
    folder = submitted(tmp_path)
    (folder / "other.jsonl").write_text("{}\n")
    with pytest.raises(DataError, match=r"holds \.jsonl files and results_test_.*name one of them"):
        read_submission(folder, dataset)


def test_other_pickles_beside_results_are_named(tmp_path, dataset):
    folder = submitted(tmp_path)
    (folder / "mAP_Acc.pkl").write_bytes(pickle.dumps({"aps": 1}))
    run = StoredRun(folder, dataset=dataset)
    assert run.notes[0] == "read are results_*.pkl; not read: mAP_Acc.pkl"
    assert max(positions(run).values()) < 1e-9


@pytest.mark.parametrize("name", ["nothing", "nothing.d/x", "nothing.xyz"])
def test_what_is_not_there(tmp_path, name):
    with pytest.raises(DataError, match=f"{name}: no such file or folder"):
        read_submission(tmp_path / name)


# -- truth that is mended -------------------------------------------------------------------


def test_a_truth_that_is_mended_is_read_anew(tmp_path):
    folder = tmp_path / "data" / "gts" / "real_test"
    whole = {f"results_real_test_{name}.pkl": {k: frame()[k] for k in TRUTH} for name in NAMES}
    name = f"results_real_test_{NAMES[1]}.pkl"
    wrote(folder, whole | {name: {"gt_RTs": frame()["gt_RTs"]}})
    before = os.stat(folder)
    broken = Real275(tmp_path / "data")
    assert len(broken.samples) == 6
    assert any("gt_class_ids, which say what is there" in line for line in broken.missing)
    (folder / name).write_bytes(pickle.dumps(whole[name]))
    os.utime(folder, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert len(Real275(tmp_path / "data").samples) == 9


# -- names ----------------------------------------------------------------------------------


def saved(run, path):
    answers = SavedAnswers(path, run)
    answers.begin({})
    run.take_answer = answers.add
    for ref in run.samples:
        run.judge(ref)
    answers.finish([ref.id for ref in run.samples])
    return path


@pytest.mark.parametrize("own", [False, True])
def test_samples_of_another_tree_are_found_by_their_boxes(tmp_path, dataset, own):
    """A file that was judged by its own truth, or a tree with images, has other names."""
    run = StoredRun(submitted(tmp_path), dataset=None if own else dataset)
    path = saved(run, tmp_path / "mine.jsonl")
    if not own:
        path.write_text(path.read_text().replace("/gt", "/"))
    again = StoredRun(path, dataset=dataset)
    assert max(positions(again).values()) < 1e-9
    assert any(note.startswith("samples are called scene_1/0000/") for note in again.notes)


def test_samples_that_a_file_lacks_are_not_called_undetected(tmp_path, dataset):
    path = saved(StoredRun(submitted(tmp_path), dataset=dataset), tmp_path / "mine.jsonl")
    header, *lines = path.read_text().splitlines()
    path.write_text("\n".join([header, *lines[1:]]) + "\n")
    run = StoredRun(path, dataset=dataset)
    assert run.judge(run.samples[0]).failure == "not in the file"
    assert any(
        note.startswith("1 samples of images that are in the file are not in it")
        for note in run.notes
    )


def test_a_file_about_another_data_set_says_so(tmp_path, dataset):
    path = saved(StoredRun(submitted(tmp_path), dataset=dataset), tmp_path / "mine.jsonl")
    path.write_text(path.read_text().replace('"dataset":"real275"', '"dataset":"camera25"'))
    run = StoredRun(path, dataset=dataset)
    assert "the answers are about camera25, and are judged by real275" in run.notes


@pytest.mark.parametrize("all_of_them", [False, True])
def test_categories_that_a_data_set_lacks_are_named(tmp_path, dataset, all_of_them):
    path = saved(StoredRun(submitted(tmp_path), dataset=dataset), tmp_path / "mine.jsonl")
    header, *lines = map(json.loads, path.read_text().splitlines())
    header["classes"] = ["class_1", *header["classes"]]
    for line in lines if all_of_them else lines[:1]:
        line["category"] = "class_1"
        line.pop("sample")
    for line in lines:
        line.pop("sample", None)
    path.write_text("\n".join(map(json.dumps, [header, *lines])) + "\n")
    if all_of_them:
        with pytest.raises(DataError, match=r"9 of 9 answers are of categories .*: class_1"):
            StoredRun(path, dataset=dataset)
    else:
        notes = StoredRun(path, dataset=dataset).notes
        told = "1 of 9 answers are of categories of which no sample of real275 is here"
        assert any(note.startswith(told) for note in notes)


@pytest.mark.parametrize("which", ["one", "all"])
def test_a_category_that_is_not_that_of_the_sample_is_no_answer(tmp_path, dataset, which):
    path = saved(StoredRun(submitted(tmp_path), dataset=dataset), tmp_path / "mine.jsonl")
    header, *lines = map(json.loads, path.read_text().splitlines())
    others = {line["category"]: line["category"] for line in lines}
    others = dict(zip(others, [*list(others)[1:], *list(others)[:1]], strict=True))
    changed = lines if which == "all" else lines[:1]
    named = {line["sample"]: line["category"] for line in changed}
    for line in changed:
        line["category"] = others[line["category"]]
    path.write_text("\n".join(map(json.dumps, [header, *lines])) + "\n")
    run = StoredRun(path, dataset=dataset)
    sample, was = next(iter(named.items()))
    told = f"{len(named)} answers name another category than that of their sample, and do not count"
    assert any(note.startswith(f"{told}: {sample} ({was}) as {others[was]}") for note in run.notes)
    rows = {ref.id: run.judge(ref) for ref in run.samples}
    assert {sample for sample, row in rows.items() if row.estimate is None} == {*named}


def test_results_and_predictions_are_told_apart(tmp_path, dataset):
    """Both are .jsonl, and may lie in one folder."""
    run = StoredRun(submitted(tmp_path), dataset=dataset)
    path = saved(run, tmp_path / "mine.jsonl")
    with pytest.raises(
        ResultsError, match=r"line 1: this is JSON without checksums, .*predictions"
    ):
        read_results(path)
    with ResultsFile(tmp_path / "kept", run, Shard.parse("1/1")) as file:
        file.add(run.judge(run.samples[0]))
    with pytest.raises(DataError, match=r"line 1: this is a results file .*pytest-cpas merge"):
        read_submission(file.path, dataset)
    file.path.write_bytes(file.path.read_bytes().replace(b"\n", b"\r\n"))
    with pytest.raises(ResultsError, match="line 1: its line ends were changed to CRLF"):
        read_results(file.path)


def test_images_without_names_are_not_written_as_one(tmp_path, dataset, capsys):
    path = tmp_path / "list.pkl"
    path.write_bytes(pickle.dumps([frame(0.01 * i) for i in range(3)]))
    assert cli.main(["convert", str(path), str(tmp_path / "out.jsonl")]) == 1
    error = capsys.readouterr().err
    assert "its images have no names" in error
    assert "--dataset NAME" in error
    assert "--cpas" not in error
    write_submission(read_submission(path, dataset), tmp_path / "out.jsonl", dataset=dataset)
    assert max(positions(StoredRun(tmp_path / "out.jsonl", dataset=dataset)).values()) < 1e-9


@pytest.mark.parametrize("name", ["x.json", "x.pkl", "x.txt"])
def test_forms_that_are_not_written_are_no_folders(tmp_path, dataset, name):
    submission = read_submission(submitted(tmp_path), dataset)
    with pytest.raises(DataError, match="this form is not written"):
        write_submission(submission, tmp_path / name, dataset=dataset)


# -- answers --------------------------------------------------------------------------------


def test_the_best_scored_answer_counts_even_if_it_is_none(tmp_path, dataset):
    values = frame()
    twice = {k: np.concatenate([v, v]) for k, v in values.items() if k.startswith("pred")}
    twice["pred_RTs"][3] = 0
    twice["pred_scores"] = np.array([0.5, 0.5, 0.5, 0.9, 0.4, 0.4])
    run = StoredRun(submitted(tmp_path, {NAMES[0]: values | twice}), dataset=dataset)
    failures = [run.judge(ref).failure for ref in run.samples[:3]]
    assert failures == ["the stored pose is zero", None, None]
    assert any(
        note.startswith("of 6 answers 3 are about samples that have a better one, and 0 are")
        for note in run.notes
    )


def test_ties_are_told(tmp_path, dataset):
    values = frame()
    twice = {k: np.concatenate([v, v]) for k, v in values.items() if k.startswith("pred")}
    run = StoredRun(submitted(tmp_path, {NAMES[0]: values | twice}), dataset=dataset)
    assert any(note.startswith("3 samples have several best answers") for note in run.notes)


@pytest.mark.parametrize("whole", [False, True])
def test_none_is_a_failed_instance(tmp_path, dataset, whole):
    values = frame()
    poses = [None, *values["pred_RTs"][1:]] if not whole else np.empty(3, object)
    if whole:
        poses[1:] = [*values["pred_RTs"][1:]]
    run = StoredRun(submitted(tmp_path, {NAMES[0]: values | {"pred_RTs": poses}}), dataset=dataset)
    failures = [run.judge(ref).failure for ref in run.samples[:3]]
    assert failures == ["the stored pose is not finite", None, None]


@pytest.mark.parametrize(
    "change",
    [
        lambda boxes: boxes[:, [0, 2, 1, 3]],
        lambda boxes: boxes / 640,
        lambda boxes: boxes / 4,
        np.zeros_like,
        lambda boxes: boxes[::-1],
    ],
)
def test_boxes_of_nothing(tmp_path, change):
    frames = [{**each, "pred_bboxes": change(each["pred_bboxes"])} for each in scene()]
    [line] = told(run_of(tmp_path, frames))
    assert "by class and position, not by their 2-D boxes" in line
    assert "bring 96 instead of " in line


def test_one_answer_for_all_objects_of_an_image(tmp_path):
    frames = [{**each, "pred_RTs": each["pred_RTs"][:1].repeat(4, axis=0)} for each in scene()]
    assert any(
        line.startswith("audit: 72 of 96 answers have the pose of an answer of another class")
        for line in told(run_of(tmp_path, frames))
    )


# -- detections -----------------------------------------------------------------------------


def run_on(folder):
    return DetectedRun(Seeing(), DetectedDataset(tiny.Tiny(None), folder))


def test_detections_that_contradict_their_masks(tmp_path):
    swapped = [
        values | {"rois": values["rois"][:, [1, 0, 3, 2]]}
        for values in (detections(ref.category, ((1, 3, 3, 8),)) for ref in tiny.Tiny(None).samples)
    ]
    special = {f"at{index}": values for index, values in enumerate(swapped)}
    [line, *_] = run_on(detected(tmp_path / "d", **special)).notes
    assert line.startswith(f"audit: the 2-D boxes of {tiny.COUNT} of {tiny.COUNT} detections")
    assert f"of which {tiny.COUNT} would be if they were x1, y1, x2, y2" in line
    assert run_on(detected(tmp_path / "sound")).notes == []


def test_classes_of_detections_that_are_off_by_one(tmp_path):
    off = {
        f"at{index}": values | {"class_ids": values["class_ids"] - 1}
        for index, values in enumerate(detections(ref.category) for ref in tiny.Tiny(None).samples)
    }
    assert any(
        line.startswith(
            f"audit: to read class ids as one more would find {tiny.COUNT} instead of 0"
        )
        for line in run_on(detected(tmp_path / "d", **off)).notes
    )


def test_masks_are_part_of_the_data(tmp_path):
    sound = run_on(detected(tmp_path / "one")).identity
    fewer = detections("bowl")
    fewer["masks"][2, 3, 0] = False
    assert run_on(detected(tmp_path / "two", at0=fewer)).identity != sound
