"""Of reused rows one of each category is judged again: what a program depends on is never known in
full."""

import pytest
from harness import RUN

RESULTS = "--cpas-results=kept"

#: Depends on a variable that no text names as a whole, and writes down what it is asked about.
METHOD = """
from dataclasses import replace
from tiny import *

class Depends(Perfect):
    def answer(self, index):
        with open(os.environ["AS" + "KED"], "a") as file:
            file.write(f"{{index}} ")
        (best,) = super().answer(index).hypotheses
        off = float(os.environ.get("AS" + "IDE", "0"))
        moved = replace(best, translation=best.translation + off)
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
    assert sorted(asked) == ["0", "1"], "the first of each of two categories"
    result, _ = depends(*how, aside=aside)
    assert result.ret == 1
    told = "failure was None, now gone" if aside == "1" else "position_m was *, now 0.08*"
    result.stdout.fnmatch_lines(
        [f"*scene_0/0000: its row is reused from *is not what the method answers now*({told})*"]
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


def test_rows_of_a_part_are_compared_too(depends):
    assert depends("-k", "0003 or 0004")[0].ret == 0
    result, _ = depends(aside="0.05")
    assert result.ret == 1
    assert result.stdout.str().count("is not what the method answers now") >= 2


def test_what_a_method_may_differ_by_is_what_it_declares(depends):
    assert depends(method="Rough")[0].ret == 0
    assert depends(method="Rough", aside="0.0005")[0].ret == 0
    assert depends(method="Rough", aside="0.05")[0].ret == 1


@pytest.mark.parametrize(
    ("method", "args"), [("Jitters", ()), ("Depends", ("--cpas-results-reuse=any",))]
)
def test_what_may_differ_is_not_judged_again(depends, pytester, method, args):
    assert depends(method=method)[0].ret == 0
    if args:  # of another program, which is known
        path = pytester.path / "depends.py"
        path.write_text(path.read_text() + "\n# another\n")
    result, asked = depends(*args, method=method, aside="0.05")
    assert result.ret == 0
    assert asked == []
