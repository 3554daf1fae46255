"""``--cpas-save-predictions``, and what it refuses."""

import json
import shutil

import pytest
from harness import RUN

SAVE = "--cpas-save-predictions"


def again(pytester, *args):
    """A run that judges ``answers.jsonl``, and its rows."""
    named = ("--cpas-predictions=answers.jsonl", "--cpas-dataset=tiny:Tiny")
    result = pytester.runpytest_inprocess(*RUN, *named, "--cpas-results=again", *args)
    return result, rows(pytester.path / "again" / "answers-tiny.jsonl")


def rows(path):
    """The rows in a results file, in the order of their samples."""
    lines = [json.loads(line.split(" ", 1)[1]) for line in path.read_text().splitlines()]
    return sorted(
        [(line["ref"][0], line["row"]["answers"][0]) for line in lines if "row" in line],
        key=lambda pair: pair[0],
    )


def test_saved_answers_are_judged_again(cpas, pytester):
    """The same rows and the same tables; workers give the same file."""
    first = cpas("Several", f"{SAVE}=answers.jsonl", "--cpas-results=first")
    first.stdout.fnmatch_lines(["predictions: 12 answers in *answers.jsonl"])
    result, found = again(pytester)
    assert result.ret == 0
    assert found == rows(pytester.path / "first" / "perfect-tiny.jsonl")
    assert len(found) == 12

    def table(run):
        lines = run.stdout.lines
        start = next(i for i, line in enumerate(lines) if line.startswith("correct "))
        return lines[start : next(i for i, line in enumerate(lines) if "samples judged" in line)]

    assert table(result) == table(first)
    serial = (pytester.path / "answers.jsonl").read_bytes()
    assert cpas("Several", f"{SAVE}=workers.jsonl", "-n2", "--cpas-granularity=scene").ret == 0
    assert (pytester.path / "workers.jsonl").read_bytes() == serial
    assert not [*pytester.path.glob("*unfinished*")]


def test_samples_without_a_row_have_no_answer(cpas, pytester):
    result = cpas("Raises", f"{SAVE}=answers.jsonl")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["predictions: 11 of 12 answers in *answers.jsonl"])
    result, found = again(pytester)
    result.stdout.fnmatch_lines(["*answers about 11 of the 12 samples of its run, which was not*"])
    assert [answer["failure"] for _, answer in found].count(None) == 11


def test_nothing_is_written_of_nothing(cpas, pytester):
    (pytester.path / "answers.jsonl").write_text("old")
    result = cpas("Perfect", f"{SAVE}=answers.jsonl", "-k", "test_contract")
    result.stdout.fnmatch_lines(["predictions: no answers, so nothing was written to *"])
    with pytest.raises(KeyboardInterrupt):  # as the run that this one is in would be
        cpas("Interrupted", f"{SAVE}=answers.jsonl")
    assert (pytester.path / "answers.jsonl").read_text() == "old"
    assert (pytester.path / "answers.jsonl.unfinished").read_text().count("\n") == 5


def test_resumed_rows_have_their_answers_or_are_refused(cpas, pytester):
    keep = ("--cpas-results=kept",)
    assert cpas("Perfect", *keep, "-k", "scene_0").ret in (0, 1)
    refused = cpas("Perfect", *keep, f"{SAVE}=answers.jsonl")
    assert refused.ret == 4
    refused.stderr.fnmatch_lines(
        ["ERROR: --cpas-save-predictions: 4 rows are reused from *the answers of 4*--cpas-results*"]
    )
    other = ("--cpas-results=other", f"{SAVE}=answers.jsonl")
    assert cpas("Perfect", *other, "-k", "scene_0").ret in (0, 1)
    result = cpas("Perfect", *other)
    assert result.ret == 0
    result.stdout.fnmatch_lines(["predictions: 12 answers in *answers.jsonl"])
    assert cpas("Perfect", f"{SAVE}=whole.jsonl").ret == 0
    written = [pytester.path / f"{name}.jsonl" for name in ("answers", "whole")]
    assert written[0].read_bytes() == written[1].read_bytes()


def test_several_runs_and_seeds(cpas, pytester):
    two = ("--cpas-method=tiny:OnlyPose",)
    refused = cpas("Perfect", *two, f"{SAVE}=answers.jsonl")
    assert refused.ret == 4
    refused.stderr.fnmatch_lines(["*there are 2 runs*name a folder: *-predictions=answers"])
    result = cpas("Perfect", *two, f"{SAVE}=answers", "--cpas-jitter=2", "--cpas-shard=1/3")
    names = [f"{name}-tiny-1-of-3.jsonl" for name in ("only-pose", "perfect")]
    assert sorted(path.name for path in (pytester.path / "answers").iterdir()) == names
    result.stdout.fnmatch_lines(
        [f"predictions: 4 answers, those of seed 0, the first of 2, in *{names[1]}"]
    )
    header = json.loads((pytester.path / "answers" / names[1]).read_text().splitlines()[0])
    assert header["provenance"]["answers"] == "of seed 0, the first of 2"


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--cpas-predictions=answers.jsonl", f"{SAVE}=answers.jsonl"), "is in, what is judged"),
        (("--cpas-predictions=answers.jsonl", f"{SAVE}=answers.txt"), "expected a .jsonl, or a"),
        (("--cpas-predictions=answers.jsonl", f"{SAVE}=new.npz"), "expected a .jsonl, or a"),
        (("--cpas-predictions=mine", f"{SAVE}=mine/new.jsonl"), "is in, what is judged"),
        (("--cpas-merge=kept/perfect-tiny.jsonl", f"{SAVE}=x.jsonl"), "does nothing without"),
    ],
)
def test_what_cannot_be_meant(cpas, pytester, args, words):
    assert cpas("Perfect", f"{SAVE}=answers.jsonl", "--cpas-results=kept").ret == 0
    (pytester.path / "answers.txt").touch()
    (pytester.path / "mine").mkdir()
    shutil.copy(pytester.path / "answers.jsonl", pytester.path / "mine")
    data = () if "--cpas-merge" in args[0] else ("--cpas-dataset=tiny:Tiny",)
    result = pytester.runpytest_inprocess(*RUN, *args, *data)
    assert result.ret == 4
    result.stderr.fnmatch_lines([f"*{words}*"])
