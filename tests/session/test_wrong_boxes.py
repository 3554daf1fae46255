"""A method whose boxes are wrong does not match its golden table, of whichever form."""

import shutil
from pathlib import Path

import boxes
import pytest
from harness import RUN, unfolded
from older_tables import record_older

from pytest_cpas.evaluation import MethodRun
from pytest_cpas.golden import RunTable, Word, compare, find_golden, record

#: What is wrong, and the columns that must show it.
WRONG = {
    "Larger": ["IoU 0.75"],
    "Thrice": ["IoU 0.25", "IoU 0.5", "IoU 0.75"],
    "Tiniest": ["IoU 0.25", "IoU 0.5", "IoU 0.75"],
    "Shuffled": ["IoU 0.75"],
    "Mean": ["IoU 0.75"],
}


def table_of(method: str, seeds: int = 1) -> RunTable:
    return RunTable.of(MethodRun(getattr(boxes, method)(), boxes.Sizes(None), seeds=seeds))


@pytest.fixture(params=[record, record_older], ids=["new form", "version 1"])
def golden(request, tmp_path):
    request.param(tmp_path, table_of("Usual"))
    return find_golden(tmp_path, "boxed", "sizes")


def test_boxes_as_they_were_match(golden):
    verdicts = [v for v in compare(golden, table_of("Usual")) if v.word is not Word.OUTDATED]
    assert [(v.category, v.word) for v in verdicts] == [
        ("bowl", Word.MATCHES),
        ("mug", Word.MATCHES),
    ]
    assert all(cell.correct == cell.total == 12 for cell in golden.table["all"].values())


@pytest.mark.parametrize("method", WRONG)
def test_wrong_boxes_are_regressed(golden, method):
    verdicts = [v for v in compare(golden, table_of(method)) if v.word is not Word.OUTDATED]
    assert {v.word for v in verdicts} == {Word.REGRESSED}
    for verdict in verdicts:
        for column in WRONG[method]:
            assert f"{column}: 6 -> " in verdict.details
        # pose and shape are what they were, and are not accused
        accused = [line for line in verdict.details.splitlines() if line.endswith(" correct")]
        assert accused
        assert all("IoU" in line for line in accused)
        assert "lost: scene_" in verdict.details


@pytest.mark.parametrize("form", [record, record_older], ids=["new form", "version 1"])
def test_wrong_boxes_end_the_run_red(pytester, form):
    for name in ("boxes.py", "tiny.py"):
        shutil.copy(Path(__file__).parents[1] / name, pytester.path)
    form(pytester.path / "golden", table_of("Usual"))
    names = ("--cpas-dataset=boxes:Sizes", "--cpas-require-golden", "-k", "not contract")

    def run(method):
        return pytester.runpytest_subprocess(*RUN, f"--cpas-method=boxes:{method}", *names)

    good = run("Usual")
    assert good.ret == 0
    good.stdout.fnmatch_lines(["golden: MATCHES (bowl, mug)"])
    told = "golden: OUTDATED completeness: *record it anew with --snapshot-update"
    lines = unfolded(good)
    (lines.fnmatch_lines if form is record_older else lines.no_fnmatch_line)(
        [told] if form is record_older else told
    )
    wrong = run("Thrice")
    assert wrong.ret == 1
    wrong.stdout.fnmatch_lines(
        [
            "golden: REGRESSED bowl: IoU 0.25: 6 -> 0 of 6 correct",
            "golden: REGRESSED mug: IoU 0.25: 6 -> 0 of 6 correct",
        ]
    )
