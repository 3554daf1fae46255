"""Predictions in one form, written in another: the same answers, and what is lost is said."""

import pickle
from types import MappingProxyType

import numpy as np
import pytest
import tiny

from pytest_cpas import cli
from pytest_cpas.evaluation import MethodRun, SavedAnswers, StoredRun
from pytest_cpas.submissions import read_submission, write_submission
from pytest_cpas.types import DataError
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET, SHAPENET_FROM_Z_UP

NAMES = ("scene_1_0000", "scene_1_0001", "scene_2_0010")


def frame(number):
    """A bowl and two mugs beside their truth; a zero pose for the last one of the second frame."""
    rng = np.random.default_rng(number)
    poses = np.zeros((2, 3, 4, 4))
    for pose in poses.reshape(-1, 4, 4):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose[:3, :3] = rng.uniform(0.1, 0.3) * np.linalg.det(turn) * turn
        pose[:3, 3] = rng.normal(size=3) + np.array([0, 0, 2])
        pose[3, 3] = 1
    if number == 1:
        poses[1, 2] = 0
    values = {}
    for side, each in zip(("gt", "pred"), poses, strict=True):
        values |= {
            f"{side}_class_ids": np.array([2, 6, 6]),
            f"{side}_bboxes": np.array([[0, 0, 10, 10], [0, 20, 10, 30], [50, 50, 90, 90]]),
            f"{side}_RTs": each,
            f"{side}_scales": rng.uniform(0.3, 0.7, (3, 3)),
        }
    return values | {
        "pred_scores": rng.uniform(size=3),
        "gt_handle_visibility": np.array([1, 0, 1]),
    }


@pytest.fixture
def nocs(tmp_path):
    """A folder of NOCS's pickles."""
    folder = tmp_path / "nocs"
    folder.mkdir()
    for number, name in enumerate(NAMES):
        (folder / f"results_test_{name}.pkl").write_bytes(pickle.dumps(frame(number)))
    return folder


@pytest.fixture
def several(tmp_path):
    """The answers of a method with shapes, several hypotheses and a failure, and its run."""
    run = MethodRun(tiny.Several(), tiny.Tiny(None))
    answers = SavedAnswers(tmp_path / "several.jsonl", run)
    run.take_answer = answers.add
    answers.finish({ref.id: run.judge(ref) for ref in run.samples})
    return tmp_path / "several.jsonl"


def facts(run):
    """The facts of all samples, None where there are none, and their failures."""
    rows = [run.judge(ref) for ref in run.samples]
    names = rows[0].facts
    values = [[np.nan if row.facts[n] is None else row.facts[n] for n in names] for row in rows]
    return np.array(values), [row.failure for row in rows]


@pytest.mark.parametrize("forms", [("a",), ("a.npz",), ("a", "b.npz", "c", "d.npz")], ids="-".join)
def test_forms_of_nocs_hold_the_same(nocs, tmp_path, forms):
    source = nocs
    for form in forms:
        assert write_submission(read_submission(source), tmp_path / form) == []
        source = tmp_path / form
    expected, failures = facts(StoredRun(nocs))
    found, same = facts(StoredRun(source))
    assert same == failures
    assert np.isinf(found[5]).any()
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    one, other = (read_submission(path).images[1] for path in (nocs, source))
    assert np.array_equal(one.answers.scores, other.answers.scores)
    assert np.array_equal(one.truths.visible_handles, other.truths.visible_handles)


def test_json_lines_hold_all_but_the_truth(nocs, tmp_path):
    target = tmp_path / "answers.jsonl"
    assert write_submission(read_submission(nocs), target) == [
        "the truth about 9 objects; judge the file with --cpas-dataset"
    ]
    one, other = read_submission(nocs), read_submission(target)
    assert other.gives == {"extents", "score"}
    for image, same in zip(one.images, other.images, strict=True):
        assert same.name == image.name
        for key in ("class_ids", "scores", "boxes"):
            assert np.array_equal(getattr(same.answers, key), getattr(image.answers, key))
        sound = [reason is None for reason in same.answers.reasons]
        np.testing.assert_allclose(
            same.answers.extents[sound], image.answers.extents[sound], rtol=1e-12
        )
        np.testing.assert_allclose(
            same.answers.poses[sound, :3, 3], image.answers.poses[sound, :3, 3]
        )
    assert list(other.images[1].answers.reasons) == [None, None, "the stored pose is zero"]
    # and back: judged by the truth of the original
    again = tmp_path / "again.jsonl"
    assert write_submission(other, again) == []
    assert again.read_bytes() == target.read_bytes()


@pytest.mark.parametrize("axes", [None, NOCS_FROM_SHAPENET, SHAPENET_FROM_Z_UP])
def test_what_a_form_cannot_say_is_named(several, tmp_path, axes):
    dataset = tiny.Tiny(None)
    dataset.published_axes = axes
    target = tmp_path / "answers.npz"
    lost = write_submission(read_submission(several), target)
    assert lost.pop(0) == (
        "the object axes, if tiny has others than NOCS's; --dataset NAME writes those"
    )
    assert lost == [
        "the reasons of 1 failures, which are left out",
        "the names of 11 samples: objects are found by class and place in their image",
        "3 further hypotheses, which NOCS's form would take for the best ones",
        "the shapes of 20 answers",
    ]
    source = read_submission(several)
    assert write_submission(source, target, dataset=dataset, force=True) == lost
    expected, failures = facts(StoredRun(several, dataset=dataset))
    found, same = facts(StoredRun(target, dataset=dataset))
    assert failures[3] == "too few points\nin the mask"
    assert same == [*[None] * 3, "not detected", *[None] * 8]
    known = ~np.isnan(found).all(axis=0)
    np.testing.assert_allclose(found[:, known], expected[:, known], rtol=1e-9, atol=1e-9)
    assert 0 < known.sum() < len(known)


def test_the_command_says_what_it_did(nocs, tmp_path, capsys):
    target = tmp_path / "out.jsonl"
    assert cli.main(["convert", str(nocs), str(target)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{target}: from 9 answers about 3 images",
        "lost: the truth about 9 objects; judge the file with --cpas-dataset",
    ]
    assert cli.main(["convert", str(nocs), str(target)]) == 1
    assert capsys.readouterr().err == (
        f"pytest-cpas convert: {target}: it is there already; name another, or pass --force\n"
    )
    assert cli.main(["convert", str(nocs), str(target), "--force"]) == 0
    assert cli.main(["convert", str(tmp_path / "none.pkl"), str(tmp_path / "x.npz")]) == 1
    assert "no such file" in capsys.readouterr().err
    assert not (tmp_path / "x.npz").exists()


def test_what_is_in_the_way_stays(nocs, tmp_path):
    submission = read_submission(nocs)
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "notes.md").write_text("mine")
    with pytest.raises(DataError, match=r"it holds notes\.md, which --force would remove"):
        write_submission(submission, folder, force=True)
    (folder / "notes.md").rename(folder / "old.pkl")
    assert write_submission(submission, folder, force=True) == []
    assert sorted(path.name for path in folder.iterdir()) == [f"results_{n}.pkl" for n in NAMES]
    file = tmp_path / "a-file"
    file.touch()
    with pytest.raises(DataError, match="a file would take the place of a folder, or"):
        write_submission(submission, file, force=True)
    assert not list(tmp_path.glob(".*"))


def test_nothing_is_left_of_what_breaks_off(nocs, tmp_path, monkeypatch):
    monkeypatch.setattr("os.fsync", lambda _: (_ for _ in ()).throw(OSError(28, "full")))
    for form in ("a", "a.npz", "a.jsonl"):
        with pytest.raises(OSError, match="full"):
            write_submission(read_submission(nocs), tmp_path / form)
    assert [path.name for path in tmp_path.iterdir()] == ["nocs"]


def test_what_cannot_be_said_at_all(several, tmp_path):
    run = MethodRun(tiny.OnlyPose(), tiny.Tiny(None))
    answers = SavedAnswers(tmp_path / "poses.jsonl", run)
    run.take_answer = answers.add
    answers.finish({ref.id: run.judge(ref) for ref in run.samples})
    poses = read_submission(tmp_path / "poses.jsonl")
    with pytest.raises(DataError, match=r"NOCS's form needs extents, .* none; write a \.jsonl"):
        write_submission(poses, tmp_path / "poses.npz")
    with pytest.raises(DataError, match="poses of BOP's table are those of its models"):
        write_submission(poses, tmp_path / "poses.csv")


class Bop(tiny.Tiny):
    """The same with the names of BOP, whose models have another origin."""

    name = "bop-tiny"
    class_names = ("obj_000001", "obj_000002")
    published_centres = MappingProxyType(dict.fromkeys(class_names, np.array([0.01, -0.02, 0.3])))

    def __init__(self, data_dir):
        super().__init__(data_dir)
        named = dict(zip(tiny.CATEGORIES, self.class_names, strict=True))
        self.samples = [
            type(ref)(id=f"1/{i:04d}", category=named[ref.category], scene=ref.scene)
            for i, ref in enumerate(self.samples)
        ]

    def image_of(self, ref):
        return f"000001/{ref.id[2:]:0>6}"


class Posed(tiny.OnlyPose):
    info = type(tiny.OnlyPose.info)(
        name="posed",
        categories=Bop.class_names,
        needs=frozenset(),
        gives=frozenset(),
        licence="MIT",
    )


def test_a_table_of_bop(tmp_path):
    run = MethodRun(Posed(), Bop(None))
    answers = SavedAnswers(tmp_path / "posed.jsonl", run)
    run.take_answer = answers.add
    answers.finish({ref.id: run.judge(ref) for ref in run.samples})
    target = tmp_path / "posed.csv"
    lost = write_submission(read_submission(tmp_path / "posed.jsonl"), target, dataset=Bop(None))
    assert lost == ["the names of 12 samples: objects are found by class and place in their image"]
    assert len(target.read_text().splitlines()) == 13
    expected, _ = facts(run)
    found, failures = facts(StoredRun(target, dataset=Bop(None)))
    assert set(failures) == {None}
    np.testing.assert_allclose(found, expected, atol=1e-5)
