"""Of reused rows two of each category are judged again: what a program depends on is never known
in full."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import pytest
import tiny
from harness import RUN

from pytest_cpas.evaluation import MethodRun, ResultsFile, Shard
from pytest_cpas.session.collected import CollectedRun

RESULTS = "--cpas-results=kept"

#: Depends on a variable that no text names as a whole, and writes down what it is asked about.
METHOD = """
from dataclasses import replace
import pytest
from tiny import *

class Depends(Perfect):
    def answer(self, index):
        with open(os.environ["AS" + "KED"], "a") as file:
            file.write(f"{{index}} ")
        (best,) = super().answer(index).hypotheses
        off = float(os.environ.get("AS" + "IDE", "0"))
        moved = replace(best, translation=best.translation + off)
        if off > 1:
            pytest.skip("gone")
        return Prediction((moved,)) if off < 1 else Prediction.failed("gone")

class Rough(Depends):
    info = replace(Perfect.info, tolerance=0.05)

class Jitters(Depends):
    info = replace(Perfect.info, deterministic=False)
"""


@pytest.fixture
def depends(cpas, pytester, tmp_path, monkeypatch):
    pytester.makepyfile(depends=METHOD.replace("{{", "{").replace("}}", "}"))
    pytester.syspathinsert()
    asked = tmp_path / "asked"
    monkeypatch.setenv("ASKED", str(asked))

    def run(*args, method="Depends", aside=None):
        asked.write_text("")
        if aside is None:
            monkeypatch.delenv("ASIDE", raising=False)
        else:
            monkeypatch.setenv("ASIDE", aside)
        names = (f"--cpas-method=depends:{method}", "--cpas-dataset=tiny:Tiny", RESULTS)
        result = pytester.runpytest_subprocess(*RUN, *names, "-k", "test_sample", *args)
        return result, asked.read_text().split()

    return run


@pytest.mark.parametrize("aside", ["0.05", "1"])
@pytest.mark.parametrize("how", [(), ("-n2",), ("--cpas-granularity=dataset",)], ids=" ".join)
def test_what_is_not_seen_is_found(depends, aside, how):
    assert depends()[0].ret == 0
    result, asked = depends(*how)
    assert result.ret == 0
    assert len({*asked}) == 4, "two of each of two categories"
    assert sum(int(index) % 2 for index in asked) == 2
    result, _ = depends(*how, aside=aside)
    assert result.ret == 1
    told = "failure was None, now gone" if aside == "1" else "position_m was *, now 0.08*"
    result.stdout.fnmatch_lines(
        [f"*scene_?/00??: its row is reused from *is not what the method answers now*({told})*"]
    )
    assert "Name another folder" in result.stdout.str()
    # of what another program answered there is no verdict
    result.stdout.fnmatch_lines(
        ["0 of 12 samples judged", "rows: *left out (not what the method answers now) 12 from *"]
    )
    result.stdout.fnmatch_lines(["golden: NOT CHECKED*"])
    assert depends(*how)[0].ret == 0, "and the file is as good as before"


@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
def test_rows_of_a_method_that_breaks_the_contract_are_not_judged(depends, how):
    """Nothing would be computed, and what was computed before tells nothing of it."""
    assert depends("--snapshot-update", "-k", "")[0].ret == 0
    result, _ = depends("-k", "")
    result.stdout.fnmatch_lines(["rows: reused 12 from *", "*MATCHES*"])
    result, _ = depends("-k", "", *how, aside="nan")
    assert result.ret == 1
    assert "MATCHES" not in result.stdout.str()
    result.stdout.fnmatch_lines(["rows: *left out (the adapter is wrong) 12 from *"])


@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
def test_a_way_out_is_no_answer(depends, how):
    """Of an item that was skipped while it was judged again nothing is known."""
    assert depends()[0].ret == 0
    result, _ = depends(*how, aside="2")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["rows: *left out (not what the method answers now) 12 from *"])


def test_rows_of_a_part_are_compared_too(depends):
    assert depends("-k", "0003 or 0004")[0].ret == 0
    result, _ = depends(aside="0.05")
    assert result.ret == 1
    assert result.stdout.str().count("is not what the method answers now") >= 2


def test_what_a_method_may_differ_by_is_what_it_declares(depends):
    assert depends(method="Rough")[0].ret == 0
    assert depends(method="Rough", aside="0.0005")[0].ret == 0
    assert depends(method="Rough", aside="0.05")[0].ret == 1


def test_rows_of_another_program_are_not_judged_again(depends, pytester):
    assert depends()[0].ret == 0
    path = pytester.path / "depends.py"
    path.write_text(path.read_text() + "\n# another\n")
    result, asked = depends("--cpas-results-reuse=any", aside="0.05")
    assert result.ret == 0
    assert asked == []


def test_a_method_that_is_not_deterministic_is_gone_on_with(depends):
    """Nothing could be compared with what it answers now."""
    assert depends("-k", "0003 or 0004", method="Jitters")[0].ret == 0
    result, asked = depends(method="Jitters", aside="0.05")
    assert result.ret == 0
    assert sorted(asked, key=int) == ["0", "1", "2", "5", "6", "7", "8", "9", "10", "11"]
    result.stdout.fnmatch_lines(["rows: computed 10, reused 2 from *"])


def test_a_finished_run_of_such_a_method_is_computed_anew(depends):
    assert depends(method="Jitters")[0].ret == 0
    result, asked = depends(method="Jitters", aside="0.05")
    assert len(asked) == 12
    result.stdout.fnmatch_lines(
        ["rows: computed 12, not reused 12 (of a finished run, and the method is not*"]
    )
    result, asked = depends("--cpas-results-reuse=any", method="Jitters")
    assert asked == []
    result.stdout.fnmatch_lines(["rows: reused 12 from *"])


@pytest.fixture
def drawn():
    """Which samples of a run are judged again, all of whose rows are reused."""
    dataset = tiny.Tiny(None)
    row = MethodRun(tiny.Perfect(), dataset).judge(dataset.samples[0])

    def draw(choice, refs=dataset.samples):
        dataset.samples = refs
        rows = {ref.id: replace(row, sample=ref.id, category=ref.category) for ref in refs}
        file = SimpleNamespace(rows=rows, choice=choice, another_program=False)
        return CollectedRun(MethodRun(tiny.Perfect(), dataset), file).judged_again

    return draw


def test_which_ones_nobody_knows_before_the_file_is_read(drawn):
    """Every sample is among them some time, and it is the same ones in all processes."""
    seen = Counter()
    for index in range(100):
        again = drawn(b"%d" % index)
        assert Counter(row.category for row in again.values()) == {"bowl": 2, "mug": 2}
        assert again.keys() == drawn(b"%d" % index).keys()
        seen.update(again.keys())
    # each is drawn a third of the time; 5 standard deviations are 24
    assert len(seen) == 12
    assert all(10 < count < 57 for count in seen.values())


def test_the_choice_is_that_of_the_file(tmp_path):
    run = MethodRun(tiny.Perfect(), tiny.Tiny(None))
    with ResultsFile(tmp_path, run, Shard(1, 1)) as file:
        file.add(run.judge(run.samples[0]))
        before = ResultsFile(tmp_path, run, Shard(1, 1)).choice
        file.add(run.judge(run.samples[1]))
    after = [ResultsFile(tmp_path, run, Shard(1, 1)).choice for _ in range(2)]
    assert len({before, *after}) == 2


def test_they_are_few_however_many_categories_there_are(drawn):
    [first, *_] = tiny.Tiny(None).samples
    refs = [replace(first, id=f"s/{index}", category=f"c{index % 20}") for index in range(60)]
    counts = Counter(row.category for row in drawn(b"", refs).values())
    assert len(counts) == 20
    assert counts.total() == 24
