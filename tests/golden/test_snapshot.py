"""``assert table == cpas_golden`` in tests of one's own, and the seeds of --cpas-jitter."""

import shutil
from pathlib import Path

import pytest
from harness import RUN, unfolded

from pytest_cpas.golden import read_golden, read_tables

TEST = """
from tiny import {method}, Tiny
from pytest_cpas.evaluation import MethodRun, Selection
from pytest_cpas.golden import RunTable

def test_table(cpas_golden):
    assert RunTable.of(MethodRun({method}(), Tiny(None), selection={selection})) == cpas_golden
"""


@pytest.fixture
def own(cpas, pytester):
    """Run a test of one's own that judges ``method``."""

    def run(method: str, *args: str, selection: str = "None") -> pytest.RunResult:
        source = TEST.format(method=method, selection=selection)
        pytester.makepyfile(test_own=source)
        start = pytester.runpytest_subprocess if "-n2" in args else pytester.runpytest_inprocess
        return start(*RUN, "test_own.py", *args)

    return run


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_without_a_table_it_fails_and_update_records_it(own, cpas, pytester):
    assert own("Perfect").ret == 1
    result = own("Perfect", "--snapshot-update")
    assert result.ret == 0
    result.stdout.fnmatch_lines(["1 snapshot generated."])
    assert own("Perfect").ret == 0
    # the verdict at the end of a run reads the same table, and writes the same bytes
    assert cpas("Perfect", "--cpas-require-golden").ret == 0
    recorded = files(pytester.path / "golden")
    shutil.rmtree(pytester.path / "golden" / "recorded")
    assert cpas("Perfect", "--snapshot-update").ret == 0
    assert files(pytester.path / "golden") == recorded
    assert own("Perfect").ret == 0
    assert not list(pytester.path.rglob("__snapshots__"))


@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
def test_regression_is_told_in_the_words_of_the_verdict(own, recorded, how):
    result = own("Biased", *how)
    assert result.ret == 1
    result.stdout.fnmatch_lines(
        [
            "*REGRESSED mug: 5 deg, 1 cm: 6 -> 0 of 6 correct",
            "*lost: scene_0/0001 (0 cm, 0 deg, IoU 1, F *-> 0 cm, 7 deg, IoU *); scene_0/0003 *",
        ]
    )
    assert recorded("Biased").ret == 1


@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
def test_update_is_seen_by_both_and_deletes_nothing(own, recorded, pytester, how):
    other = pytester.path / "golden" / "recorded" / "other" / "tiny"
    shutil.copytree(other.parents[1] / "perfect" / "tiny", other)
    kept = files(other)
    assert own("Biased", "--snapshot-update", *how).ret == 0
    assert recorded("Biased", "--cpas-require-golden").ret == 0
    assert recorded("Perfect").ret == 1
    assert files(other) == kept


def test_part_of_the_samples_neither_matches_nor_is_recorded(own, recorded, pytester):
    before = files(pytester.path / "golden")
    result = own("Perfect", selection="Selection(limit=5)")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*NOT CHECKED bowl: 3 of 6 judged; *"])
    result = own("Biased", "--snapshot-update", selection="Selection(limit=5)")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*GoldenError: not every sample was judged*"])
    assert files(pytester.path / "golden") == before


def test_damaged_table_is_told(own, recorded, pytester):
    (pytester.path / "golden/recorded/perfect/tiny/facts.csv").write_text("hello")
    result = own("Perfect")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*GoldenError*facts.csv*"])


def test_only_tables_are_compared(own, recorded, pytester):
    pytester.makepyfile(test_own="def test_it(cpas_golden):\n    assert {'mug': 3} == cpas_golden")
    result = pytester.runpytest_inprocess(*RUN, "test_own.py")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*TypeError: cpas_golden is compared with a dict, expected a*"])


def test_another_device_is_another_platform(recorded):
    result = recorded("Perfect", "--cpas-device=cuda", "--cpas-require-golden")
    assert result.ret == 0
    unfolded(result).fnmatch_lines(
        ["*another platform than that of the recording (device was cpu, now cuda)*"]
    )


# -- seeds ------------------------------------------------------------------------------------


def test_recorded_spread_is_allowed(cpas, pytester):
    result = cpas("Wobbles", "--snapshot-update", "--cpas-jitter=4")
    assert result.ret == 0
    # what it can show, and what more seeds would
    result.stdout.fnmatch_lines(
        [
            "golden: RECORDED: *tiny",
            "  how many a later run of one seed must lose to be REGRESSED (PROBABLY WORSE), *",
            "    these 4 seeds: bowl none (4) of 5, mug none (5) of 6, all 9 (6) of 11",
            "    8 seeds that spread like these: *, all 6 (4) of 11",
        ]
    )
    folder = pytester.path / "golden" / "recorded" / "perfect" / "tiny"
    samples = read_golden(folder).samples.values()
    assert all(len(sample.outcomes) == 4 for sample in samples)
    assert {outcome for sample in samples for outcome in sample.outcomes} == {"0" * 11, "1" * 11}
    assert not read_golden(folder).samples["scene_0/0000"].wavers
    assert any(sample.wavers for sample in samples)
    assert "seeds = 4" in (folder / "run.toml").read_text()
    # the same command is green on the same code, however much is required
    for required in ((), ("--cpas-require-golden",), ("--cpas-require-golden=strict",)):
        result = cpas("Wobbles", *required)
        assert result.ret == 0
        result.stdout.fnmatch_lines(["golden: MATCHES (bowl, mug, all)"])
    # a run that would forget the spread does not replace it
    result = cpas("Wobbles", "--snapshot-update")
    assert result.ret == 1
    unfolded(result).fnmatch_lines(["golden: NOT RECORDED: *pass --cpas-jitter 4*"])


UNLUCKY = """
from tiny import Wobbles
from pytest_cpas.types import Prediction

class Unlucky(Wobbles):
    def by_chance(self, index, seed):
        return Prediction.failed("worse") if index < 6 else super().by_chance(index, seed)
"""

#: How a doubtful run is asked for, and what it ends with.
STRICTNESS = {
    (): 0,
    ("--cpas-require-golden",): 0,
    ("--cpas-require-golden=strict",): 1,
    ("--cpas-alarm=0.05",): 1,
    ("--cpas-alarm=1/20",): 1,
    ("-o", "cpas_alarm=1/20"): 1,
    ("-o", "cpas_alarm=1/20", "--cpas-alarm=1/1000"): 0,
}


@pytest.mark.parametrize("how", STRICTNESS, ids=" ".join)
def test_probably_worse_is_told_with_its_p(cpas, pytester, how):
    assert cpas("Wobbles", "--snapshot-update", "--cpas-jitter=4").ret == 0
    pytester.makepyfile(unlucky=UNLUCKY)
    names = ("--cpas-method=unlucky:Unlucky", "--cpas-dataset=tiny:Tiny")
    result = pytester.runpytest_inprocess(*RUN, *names, *how)
    assert result.ret == STRICTNESS[how]
    word = "REGRESSED" if how and how[-1].endswith(("0.05", "1/20")) else "PROBABLY WORSE"
    result.stdout.fnmatch_lines(
        [f"golden: {word}: 10 deg, 2 cm: * of 12 correct (4 recorded seeds: * to *; p = 0.0*)"]
    )
    assert "golden: MATCHES: " not in result.stdout.str()
    assert "within the spread" not in result.stdout.str()


def test_assertion_warns_of_what_is_probably_worse(own, cpas, pytester):
    """As in a run: it passes, and strictness makes it fail."""
    assert cpas("Wobbles", "--snapshot-update", "--cpas-jitter=4").ret == 0
    pytester.makepyfile(unlucky=UNLUCKY)
    source = TEST.format(method="Wobbles", selection="None").replace("Wobbles()", "Unlucky()")
    pytester.makepyfile(test_own=f"from unlucky import Unlucky\n{source}")
    # warnings are errors in the run of this test
    result = pytester.runpytest_inprocess(*RUN, "test_own.py", "-W", "default")
    assert result.ret == 0
    result.stdout.fnmatch_lines(["*PytestWarning: PROBABLY WORSE*"])
    pytester.makeini("[pytest]\naddopts = --cpas-require-golden=strict")
    result = pytester.runpytest_inprocess(*RUN, "test_own.py", "-W", "default")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*PROBABLY WORSE: 10 deg, 2 cm: *"])


def test_path_after_the_plain_option_is_none_of_it(recorded, pytester):
    pytester.makepyfile(test_own="def test_mine():\n    pass")
    result = recorded("Perfect", "--cpas-require-golden", "test_own.py", "-k", "test_mine")
    result.stdout.fnmatch_lines(["*test_own.py *"])
    result = recorded("Perfect", "--cpas-require-golden=often")
    assert result.ret == pytest.ExitCode.USAGE_ERROR


@pytest.mark.parametrize("how", [("--cpas-alarm=often",), ("-o", "cpas_alarm=2")], ids=" ".join)
def test_alarm_that_is_no_probability(recorded, how):
    result = recorded("Perfect", *how)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    name = how[-1].partition("=")[0]
    result.stderr.fnmatch_lines([f"*{name} is '*', expected how probable*such as 0.001 or 1/1000"])


def test_seeds_survive_shards_and_results(cpas, pytester):
    for index in (1, 2):
        cpas("Wobbles", f"--cpas-shard={index}/2", "--cpas-results=out", "--cpas-jitter=3")
    merged = [f"--cpas-merge={path}" for path in sorted((pytester.path / "out").iterdir())]
    assert pytester.runpytest_inprocess(*RUN, "--snapshot-update", *merged).ret == 0
    from_shards = files(pytester.path / "golden")
    shutil.rmtree(pytester.path / "golden" / "recorded")
    assert cpas("Wobbles", "--snapshot-update", "--cpas-jitter=3", "-n2").ret == 0
    assert files(pytester.path / "golden") == from_shards
    again = ("--cpas-shard=1/2", "--cpas-results=out", "--cpas-jitter=2")
    assert "seeds was 3, now 2" in cpas("Wobbles", *again).stderr.str()


def test_seeds_of_a_deterministic_method_allow_no_flip(cpas):
    assert cpas("Perfect", "--snapshot-update", "--cpas-jitter=3").ret == 0
    assert cpas("Perfect", "--cpas-require-golden").ret == 0
    assert cpas("Refuses").ret == 1


def test_orphaned_tables_are_told_when_updating(cpas, recorded, pytester):
    recorded_folder = pytester.path / "golden" / "recorded"
    (recorded_folder / "perfect").rename(recorded_folder / "gone")
    result = cpas("Perfect", "--snapshot-update")
    assert result.ret == 0
    told = "are of what is neither registered nor judged now"
    result.stdout.fnmatch_lines(
        [f"1 golden tables in * {told}: gone; remove those of what is gone"]
    )
    assert told not in cpas("Perfect").stdout.str()


@pytest.mark.parametrize("count", ["0", "-2"])
def test_bad_number_of_seeds(cpas, count):
    result = cpas("Perfect", f"--cpas-jitter={count}")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*expected at least 1*"])


POINTS = """
import pytest
from tiny import {method}, Tiny
from pytest_cpas.datasets.perturbed import PERTURBATIONS, Perturbed
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.golden import RunTable

@pytest.mark.parametrize("perturbation", [None, PERTURBATIONS["light"]])
def test_table(perturbation, cpas_golden):
    dataset = Perturbed(Tiny(None), perturbation, 1)
    assert RunTable.of(MethodRun({method}(), dataset)) == cpas_golden
"""


def test_points_of_a_robustness_profile(cpas, pytester):
    for method, update, failed in (
        ("Perfect", True, 0),
        ("Perfect", False, 0),
        ("Biased", False, 2),
    ):
        pytester.makepyfile(test_own=POINTS.format(method=method))
        result = pytester.runpytest_inprocess(*RUN, "test_own.py", *["--snapshot-update"] * update)
        result.assert_outcomes(passed=2 - failed, failed=failed)
    assert read_tables(
        pytester.path / "golden" / "recorded" / "perfect" / "tiny+robustness"
    ).keys() == {
        "tiny+unperturbed",
        "tiny+light-1",
    }
