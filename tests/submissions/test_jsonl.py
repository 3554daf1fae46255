"""Our own form: what a method gave, judged again from its file."""

import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest
import tiny

from pytest_cpas import registry
from pytest_cpas.evaluation import (
    MethodRun,
    ResultsError,
    SampleError,
    SavedAnswers,
    Selection,
    StoredRun,
)
from pytest_cpas.metrics import _box_clipping
from pytest_cpas.protocols import shipped_protocol, shipped_protocols
from pytest_cpas.submissions import read_submission
from pytest_cpas.types import DataError, Mesh

ALL = [shipped_protocol(name) for name in shipped_protocols()]


@pytest.fixture(autouse=True)
def one_kernel(monkeypatch):
    """The compiled one, which takes over once it pays, rounds otherwise."""
    monkeypatch.setattr(_box_clipping, "_kernel", lambda pairs: None)


def judged(run):
    """The rows of a run by sample, of those that have one."""
    rows = {}
    for ref in run.samples:
        try:
            rows[ref.id] = run.judge(ref)
        except SampleError:
            continue
    return rows


def saved(path, run):
    """The rows of a run whose answers are written to ``path``."""
    answers = SavedAnswers(path, run)
    answers.begin({})
    run.take_answer = answers.add
    rows = judged(run)
    answers.finish(rows)
    return rows


@pytest.fixture
def several(tmp_path):
    """The file of a method with several hypotheses, shapes and a failure."""
    saved(tmp_path / "several.jsonl", MethodRun(tiny.Several(), tiny.Tiny(None)))
    return tmp_path / "several.jsonl"


@pytest.mark.parametrize(
    "method",
    [tiny.Perfect, tiny.OnlyPose, tiny.OtherFrames, tiny.Refuses, tiny.Several],
)
def test_a_method_is_judged_again_from_its_file(tmp_path, method):
    path = tmp_path / "answers.jsonl"
    rows = saved(path, MethodRun(method(), tiny.Tiny(None), protocols=ALL))
    assert len(rows) == tiny.COUNT
    again = StoredRun(path, dataset=tiny.Tiny(None), protocols=ALL)
    assert judged(again) == rows
    # and a stored run from its own
    stored = StoredRun(path, dataset=tiny.Tiny(None), protocols=ALL)
    assert saved(tmp_path / "twice.jsonl", stored) == rows
    third = StoredRun(tmp_path / "twice.jsonl", dataset=tiny.Tiny(None), protocols=ALL)
    assert judged(third) == rows
    told = [line for line in again.notes if not line.startswith("audit")]
    surer = "the first hypothesis of a line is its answer, and 2 lines have a surer one"
    assert [line[: len(surer)] for line in told] == [surer] * (method is tiny.Several)


def test_real_method_is_judged_again_from_its_file(tmp_path):
    dataset = registry.open_dataset("synthetic-tabletop", None)
    method = registry.resolve("method", "icp")()
    selection = Selection(limit=2)
    path = tmp_path / "answers.jsonl"
    rows = saved(path, MethodRun(method, dataset, selection=selection, protocols=ALL))
    again = StoredRun(path, dataset=dataset, selection=selection, protocols=ALL)
    assert judged(again) == rows
    assert sum(row.facts["fscore_1cm"] is not None for row in rows.values()) == 2


def test_shapes_are_as_they_were_given(several):
    """Single precision where no more was given, rotations and lengths to the last bit."""
    lines = [json.loads(line) for line in several.read_text().splitlines()]
    header, lines = lines[0], {line["sample"]: line for line in lines[1:]}
    assert header["gives"] == ["extents", "score", "shape"]
    assert (header["method"], header["dataset"], header["samples"]) == ("perfect", "tiny", 12)
    assert header["provenance"]["seed"] == "0"
    assert lines["scene_0/0003"]["failure"] == "too few points\nin the mask"
    kinds = set()
    for line in lines.values():
        for each in line.get("hypotheses", ()):
            kinds |= {*each.get("points", ()), *each.get("mesh", {}).get("vertices", ())}
    assert kinds == {"float32", "float64"}
    found = {}
    for image in read_submission(several).images:
        for row, sample in enumerate(image.answers.samples):
            found.setdefault(sample, []).append((image.answers, row))
    run = MethodRun(tiny.Several(), tiny.Tiny(None))
    gl = np.diag([1.0, -1.0, -1.0])
    for index, ref in enumerate(run.samples):
        given = tiny.Several().answer(index).hypotheses
        for hypothesis, (answers, row) in zip(given, found[ref.id], strict=bool(given)):
            assert np.array_equal(answers.poses[row, :3, 3], gl @ hypothesis.translation)
            assert answers.scores[row] == hypothesis.score
            shape = answers.shapes[row]
            assert isinstance(shape, Mesh) is (hypothesis.mesh is not None)
            vertices = shape.vertices if isinstance(shape, Mesh) else shape
            assert np.array_equal(
                np.sort(np.abs(vertices), axis=1),
                np.sort(np.abs(getattr(hypothesis.shape, "vertices", hypothesis.shape)), axis=1),
            )


def written(path, change):
    """The file with its lines, as values, changed in place."""
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    change(lines)
    path.write_text(
        "\n".join(line if isinstance(line, str) else json.dumps(line) for line in lines)
    )
    return path


def put(line, value, *names):
    """A change that puts a value somewhere into a line."""

    def change(lines):
        place = lines[line]
        for name in names[:-1]:
            place = place[name]
        place[names[-1]] = value

    return change


FIRST = ("hypotheses", 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (put(0, "x", "format"), "line 1: expected the header of a file of --cpas-save-predictions"),
        (put(0, 2, "version"), "line 1: version 2, this version reads 1"),
        (put(0, "z-up", "object_frame"), "object_frame is 'z-up', expected shapenet or nocs"),
        (put(0, ["mask"], "gives"), "gives is .*, expected some of extents, shape, score"),
        (put(0, ["mug", "mug"], "classes"), "a category twice"),
        (put(0, [], "classes"), "expected a list of categories"),
        (put(0, -1, "samples"), "samples is -1, expected a count"),
        (put(0, {"seed": 0}, "provenance"), "expected texts by name"),
        (put(0, "a/b", "method"), "line 1: method 'a/b'"),
        (put(0, 1, "mehtod"), "'mehtod' is not known; expected"),
        (lambda lines: lines.insert(1, "{"), "line 2: not readable JSON"),
        (lambda lines: lines.insert(1, "[]"), "line 2: .*expected an object"),
        (lambda lines: lines.append(lines[3]), "sample .* is in .*, line 4 already; keep one"),
        (lambda lines: lines[2].pop("sample"), "line 3: some lines name a sample"),
        (lambda lines: lines[1].pop("image"), "line 2: lacks image"),
        (put(1, "chair", "category"), "category 'chair' is none of the header's classes"),
        (put(1, "a\nb", "image"), "expected at most 500 printable"),
        (put(1, [0, 0, 1], "box"), "box: .*expected 4 numbers"),
        (put(1, [0, 0, 1, 1e10], "box"), "expected y1, x1, y2, x2"),
        (put(1, "why", "failure"), "expected either hypotheses or failure"),
        (put(4, "x", "score"), "score: .*expected 1 numbers"),
        (
            lambda lines: lines[2].pop("sample") and lines[2]["hypotheses"].pop(),
            "line 3: some lines",
        ),
        (put(4, "", "failure"), "failure is '', expected the reason"),
        (put(1, [], "hypotheses"), "expected a list of 1 to 1000"),
        (put(1, [[1, 0], [0, 1]], *FIRST, "rotation"), "rotation: .*expected 3 x 3 numbers"),
        (put(1, [1, 0, "1"], *FIRST, "translation"), "translation: .*expected 3 numbers"),
        (put(1, [1, 0, True], *FIRST, "translation"), "translation: .*expected 3 numbers"),
        (put(1, float("nan"), *FIRST, "score"), "score is nan, expected a finite number"),
        (put(1, 1, *FIRST, "scale"), "'scale' is not known"),
        (
            lambda lines: lines[1]["hypotheses"][0].pop("extents"),
            "line 2: it has score, shape, but",
        ),
        (put(1, {}, *FIRST, "mesh"), "it has points and a mesh"),
        (put(1, {"float16": ""}, *FIRST, "points"), "kinds are float32, float64, int32"),
        (put(1, {"float32": "AAA="}, *FIRST, "points"), "no rows of three float32 in base64"),
        (put(1, {"float32": ""}, *FIRST, "points"), "points: there are none"),
        (put(1, [[0, 0]], *FIRST, "points"), "points: .*expected 1 x 3 numbers"),
        (put(1, [[0, 0, float("nan")]], *FIRST, "points"), "1 of 3 values are NaN"),
        (put(2, [[0, 1, 999]], *FIRST, "mesh", "triangles"), "indices run from 0 to 999"),
    ],
)
def test_what_no_run_writes_is_refused_in_one_line(several, change, words):
    with pytest.raises(DataError, match=words) as raised:
        read_submission(written(several, change))
    assert str(several) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_torn_file_is_refused(several):
    several.write_bytes(several.read_bytes()[:-100])
    with pytest.raises(DataError, match="line 13: not readable JSON"):
        read_submission(several)
    several.write_bytes(b"")
    with pytest.raises(DataError, match="line 1: expected the header"):
        read_submission(several)


def test_lists_and_flat_rotations_are_read(several, tmp_path):
    rows = judged(StoredRun(several, dataset=tiny.Tiny(None)))

    def plain(lines):
        for line in lines[1:]:
            for each in line.get("hypotheses", ()):
                each["rotation"] = [n for row in each["rotation"] for n in row]
        [mesh] = [h["mesh"] for h in lines[2]["hypotheses"][:1]]
        for name, dtype in (("vertices", "<f8"), ("triangles", "<i4")):
            [(kind, text)] = mesh[name].items()
            array = np.frombuffer(base64.b64decode(text), {"float32": "<f4"}.get(kind, dtype))
            mesh[name] = array.reshape(-1, 3).tolist()

    assert judged(StoredRun(written(several, plain), dataset=tiny.Tiny(None))) == rows


def test_lines_of_other_samples_are_named(several):
    def change(lines):
        lines[1]["sample"] = "scene_9/0000"
        lines[2]["image"] = lines[3]["image"]

    run = StoredRun(written(several, change), dataset=tiny.Tiny(None))
    assert any("2 samples of the file are not in tiny" in note for note in run.notes)
    # a pose that is not finite is a failure, as in other forms
    nan = written(several, put(7, [float("nan")] * 3, *FIRST, "translation"))
    row = StoredRun(nan, dataset=tiny.Tiny(None)).judge(run.samples[6])
    assert row.failure == "the stored pose is not finite"


def test_a_shape_without_area_is_its_own_samples_error(several):
    def change(lines):
        best = lines[2]["hypotheses"][0]
        best.pop("points", None)
        best["mesh"] = {"vertices": [[0.0, 0, 0]] * 3, "triangles": [[0, 1, 2]]}

    run = StoredRun(written(several, change), dataset=tiny.Tiny(None))
    assert judged(run).keys() == {ref.id for ref in run.samples} - {"scene_0/0001"}


def test_what_was_not_finished_says_so(several):
    run = StoredRun(written(several, lambda lines: lines.pop(5)), dataset=tiny.Tiny(None))
    assert run.notes[0] == (
        "the file has answers about 11 of the 12 samples of its run, which was not finished, or had"
        " errors"
    )
    other = written(several, put(0, {"data": "tiny-0"}, "provenance"))
    notes = StoredRun(other, dataset=tiny.Tiny(None)).notes
    assert "the answers are about other data of tiny: tiny-0, judged by tiny-1" in notes


def test_shards_are_read_from_their_folder(tmp_path):
    rows = {}
    for shard in (1, 2):
        selection = Selection(shard=shard, shards=2)
        run = MethodRun(tiny.Several(), tiny.Tiny(None), selection=selection)
        rows |= saved(tmp_path / f"part-{shard}.jsonl", run)
    assert judged(StoredRun(tmp_path, dataset=tiny.Tiny(None))) == rows
    saved(tmp_path / "other.jsonl", MethodRun(tiny.Perfect(), tiny.Tiny(None)))
    with pytest.raises(DataError, match=r"gives differs from that of .*, so they are not of one"):
        read_submission(tmp_path)


# -- writing --------------------------------------------------------------------------------


def test_parts_of_workers_become_the_same_file(tmp_path):
    serial = tmp_path / "serial.jsonl"
    rows = saved(serial, MethodRun(tiny.Several(), tiny.Tiny(None)))
    run = MethodRun(tiny.Several(), tiny.Tiny(None))
    target = tmp_path / "workers.jsonl"
    controller = SavedAnswers(target, run)
    (tmp_path / "workers.jsonl.unfinished-gw7").write_text('{"sample":"scene_0/0000","old":1}\n')
    controller.begin({})
    for number, ref in reversed([*enumerate(run.samples)]):
        run.take_answer = SavedAnswers(target, run, f"gw{number % 2}").add
        run.judge(ref)
    controller.finish(rows)
    assert target.read_bytes() == serial.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["serial.jsonl", "workers.jsonl"]


def test_answers_of_reused_rows_are_kept(tmp_path):
    """Of a run that was killed; the last line was cut off."""
    whole = tmp_path / "whole.jsonl"
    rows = saved(whole, MethodRun(tiny.Several(), tiny.Tiny(None)))
    target = tmp_path / "answers.jsonl"
    run = MethodRun(tiny.Several(), tiny.Tiny(None))
    killed = SavedAnswers(target, run)
    killed.begin({})
    run.take_answer = killed.add
    reused = {ref.id: run.judge(ref) for ref in run.samples[:5]}
    run.judge(run.samples[5])
    part = target.with_name("answers.jsonl.unfinished")
    part.write_bytes(part.read_bytes()[:-10])

    again = SavedAnswers(target, run)
    again.check(reused, tmp_path / "results.jsonl")
    with pytest.raises(ResultsError, match=r"6 rows are reused .* 1 of them, such as scene_1/0005"):
        again.check({**reused, "scene_1/0005": rows["scene_1/0005"]}, tmp_path / "results.jsonl")
    moved = {**reused, "scene_0/0001": rows["scene_0/0002"]}
    with pytest.raises(ResultsError, match="such as scene_0/0001"):
        again.check(moved, tmp_path / "results.jsonl")
    again.begin(reused)
    run.take_answer = again.add
    for ref in run.samples[5:]:
        run.judge(ref)
    again.finish(rows)
    assert target.read_bytes() == whole.read_bytes()
    # the file itself has them from then on
    SavedAnswers(target, run).check(rows, tmp_path / "results.jsonl")


def test_a_disk_that_fails_leaves_what_was_there(tmp_path, monkeypatch):
    target = tmp_path / "answers.jsonl"
    rows = saved(target, MethodRun(tiny.Perfect(), tiny.Tiny(None)))
    before = target.read_bytes()
    run = MethodRun(tiny.Several(), tiny.Tiny(None))
    answers = SavedAnswers(target, run)
    answers.begin({})
    run.take_answer = answers.add
    rows = judged(run)
    part = target.with_name("answers.jsonl.unfinished")
    kept = part.read_bytes()
    part.write_bytes(kept[:-10])
    with pytest.raises(ResultsError, match="the answers of 1 samples, such as scene_2/0011, are"):
        answers.finish(rows)
    part.write_bytes(kept)
    monkeypatch.setattr("os.fsync", lambda _: (_ for _ in ()).throw(OSError(28, "full")))
    with pytest.raises(ResultsError, match=r"answers\.jsonl: cannot be written .*full"):
        answers.finish(rows)
    assert target.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == [target.name, part.name]


def test_the_example_of_the_docs_is_read(tmp_path):
    docs = Path(__file__).parents[2] / "docs/predictions.md"
    (block,) = re.findall(r"```\n(\{\"format\".*?)```", docs.read_text(), re.DOTALL)
    path = tmp_path / "mine.jsonl"
    path.write_text(block)
    submission = read_submission(path)
    (image,) = submission.images
    assert image.name == "scene_1/0000"
    assert image.answers.samples == ["scene_1/0000/1"]
    assert submission.category(int(image.answers.class_ids[0])) == "bowl"
