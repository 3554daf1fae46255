"""Whole runs of pytest with our options, in a folder of their own."""

import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from harness import KEPT, NOT_DEMANDED, RUN, DeclaredOptions, unfolded

from pytest_cpas import plugin
from pytest_cpas.session.command_line import add_options

GRID = [(), ("-n2",), ("-n2", "--dist=worksteal"), ("--cpas-granularity=scene",)]


@pytest.mark.parametrize("how", GRID, ids=" ".join)
def test_table_without_a_golden_one(cpas, how):
    result = cpas("Perfect", *how)
    assert result.ret == 0
    result.stdout.re_match_lines(
        [
            r"correct +10 deg, 2 cm +10 deg, 2 cm, F 0.6 +5 deg, 1 cm +5 deg, 1 cm, F 0.8",
            r"bowl( +6/6 100.0 %){4}",
            r"mug( +6/6 100.0 %){4}",
            r"all( +12/12 100.0 %){4}",
            "12 of 12 samples judged",
            "golden: NOT CHECKED: there is no golden table of perfect on tiny",
        ]
    )
    assert cpas("Perfect", "--cpas-require-golden", *how).ret == 1


@pytest.mark.parametrize("how", GRID, ids=" ".join)
def test_good_run_matches_its_golden_table(recorded, how):
    result = recorded("Perfect", "--cpas-require-golden", *how)
    assert result.ret == 0
    result.stdout.fnmatch_lines(["golden: MATCHES (bowl, mug)"])


@pytest.mark.parametrize("how", GRID, ids=" ".join)
def test_regression_fails_and_is_named(recorded, pytester, how):
    result = recorded("Biased", "--junitxml=out.xml", *how)
    assert result.ret == 1
    result.stdout.fnmatch_lines(
        [
            "REGRESSED mug: 5 deg, 1 cm: 6 -> 0 of 6 correct",
            "  5 deg, 1 cm, F 0.8: 6 -> 0 of 6 correct",
            "      lost: scene_0/0001 (0 cm, 0 deg, IoU 1, F 1, * -> 0 cm, 7 deg, IoU *",
            "golden: MATCHES bowl: all 6 samples agree with the golden table",
            "golden: REGRESSED mug: 5 deg, 1 cm: 6 -> 0 of 6 correct",
            "FAILED cpas::golden[[]perfect-tiny-mug] - Failed: REGRESSED mug: 5 deg*",
        ]
    )
    failures = {
        case.get("name"): case.find("failure").get("message")
        for case in ET.parse(pytester.path / "out.xml").iter("testcase")
        if case.find("failure") is not None
    }
    assert list(failures) == ["golden[perfect-tiny-mug]"]
    message = failures["golden[perfect-tiny-mug]"]
    assert message.startswith("Failed: REGRESSED mug: 5 deg, 1 cm: 6 -> 0 of 6")


def test_improvement_does_not_pass_silently(cpas):
    assert cpas("Biased", "--snapshot-update").ret == 0
    result = cpas("Perfect")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["golden: IMPROVED mug: 5 deg, 1 cm: 0 -> 6 of 6 correct"])
    assert cpas("Perfect", "--snapshot-update").ret == 0
    assert cpas("Perfect").ret == 0


def test_failed_prediction_is_not_correct(recorded):
    result = recorded("Refuses")
    assert result.ret == 1
    result.stdout.fnmatch_lines(
        [
            "      lost: scene_0/0003 (* -> failed: too few points)",
            "12 of 12 samples judged, 1 without an answer: 1 *",
            "golden: REGRESSED mug: 10 deg, 2 cm: 6 -> 5 of 6 correct",
        ]
    )


@pytest.mark.parametrize(
    ("args", "judged"),
    [(("--cpas-limit=5",), 5), (("-k", "0003 or 0005"), 2), (("--cpas-shard=2/2",), 6)],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_part_of_the_samples_is_compared_but_not_checked(recorded, args, judged):
    result = recorded("Perfect", *args)
    assert result.ret == 0
    result.stdout.fnmatch_lines([f"{judged} of 12 samples judged", "golden: *NOT CHECKED*"])
    assert recorded("Perfect", "--cpas-require-golden", *args).ret == 1
    assert recorded("Biased", *args).ret == 1


def test_stale_golden_is_not_a_regression(recorded):
    for result in (recorded("Perfect", dataset="Renewed"), recorded("Perfect", "--cpas-seed=1")):
        assert result.ret == 1
        result.stdout.fnmatch_lines(["golden: STALE: *"])
        result.stdout.no_fnmatch_line("*REGRESSED*")


def test_frames_are_converted(recorded):
    assert recorded("OtherFrames", "--cpas-require-golden").ret == 0


def test_what_a_method_does_not_give_is_na(cpas):
    result = cpas("OnlyPose")
    assert result.ret == 0
    result.stdout.fnmatch_lines(
        ["scene_0/0000 *bowl*n/a*n/a", "all *12/12 100.0 %* n/a *12/12 100.0 %* n/a"]
    )


@pytest.mark.parametrize(
    ("method", "words", "how"),
    [
        ("GivesNan", "translation (metres): 1 of 3 values are NaN or infinite", ()),
        ("LeftHanded", "rotation: determinant -1, a reflection (left-handed)", ()),
        ("Scaled", "rotation: not orthonormal", ()),
        ("NegativeExtents", "extents (metres): [-0.1, -0.08, -0.12], expected three positive", ()),
        ("ForgetsShape", "hypothesis: shape is None, but info.gives has 'shape'", ()),
        ("Raises", "the method raised RuntimeError('the network exploded')", ()),
        ("Raises", "the method raised RuntimeError('the network exploded')", ("-n2",)),
    ],
)
def test_broken_answer_fails_its_sample_only(recorded, method, words, how):
    result = recorded(method, *how)
    assert result.ret == 1
    result.assert_outcomes(passed=KEPT + 13, failed=1, skipped=NOT_DEMANDED + 1)
    assert f"perfect on tiny, sample scene_1/0005 (mug): {words}" in result.stdout.str().replace(
        "the answer breaks the contract: ", ""
    )
    result.stdout.fnmatch_lines(
        [
            "11 of 12 samples judged",
            "*NOT CHECKED mug: 5 of 6 judged; the 5 judged agree with the golden table. A*",
        ]
    )


def test_dying_worker_costs_its_sample_only(recorded):
    result = recorded("Dies", "-n2")
    assert result.ret == 1
    result.stdout.fnmatch_lines(
        [
            "worker 'gw?' crashed while running 'cpas::test_sample*mug-scene_1/0005]'",
            "11 of 12 samples judged",
            "golden: MATCHES bowl: all 6 samples agree with the golden table",
            "golden: NOT CHECKED mug: 5 of 6 judged; the 5 judged agree with the golden table. A*",
        ]
    )


def test_method_that_cannot_be_loaded_is_tried_once(recorded):
    result = recorded("CannotLoad")
    assert result.ret == 1
    result.assert_outcomes(passed=1, failed=1, skipped=KEPT + NOT_DEMANDED + 13)
    told = [line for line in result.stdout.lines if "cannot be loaded: w.pt is truncated" in line]
    assert told
    assert all("(try 1)" in line for line in told)
    result = recorded("CannotLoad", "-k", "test_sample")
    result.assert_outcomes(failed=12, skipped=2)


@pytest.mark.parametrize(("how", "workers"), [((), 1), (("-n2",), 2)], ids=str)
def test_method_is_loaded_once_per_process(recorded, pytester, how, workers):
    # a check of the contract loads a second one, to compare it with the first
    args = ("--cpas-require-golden", "-k", "not test_contract", *how)
    assert recorded("CountsLoads", *args).ret == 0
    loads = (pytester.path / "loads").read_text().split()
    assert len(loads) == len(set(loads)) <= workers


def test_wrong_number_of_answers(cpas):
    result = cpas("WrongLength")
    assert result.ret == 1
    result.stdout.fnmatch_lines(
        ["*the adapter is wrong: *predict: 2 for a batch of 1; return one Prediction for each*"]
    )


def test_damaged_listing_fails(cpas):
    result = cpas("Perfect", dataset="Damaged")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["scene_9/0000_meta.txt: line 'x', expected*"])
    assert cpas("Perfect", "--snapshot-update", dataset="Damaged").ret == 1


def test_nothing_is_recorded_from_an_incomplete_or_broken_run(cpas, pytester):
    for method, *args in (("Raises",), ("Perfect", "--cpas-limit=5"), ("Perfect", "-k", "0003")):
        result = cpas(method, "--snapshot-update", *args)
        assert result.ret == 1
        result.stdout.fnmatch_lines(["golden: NOT RECORDED: *"])
    assert not list((pytester.path / "golden").iterdir())


def test_one_category_is_recorded_without_touching_the_others(recorded, pytester):
    folder = pytester.path / "golden" / "recorded" / "perfect" / "tiny"
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert recorded("Perfect", "--snapshot-update", "--cpas-category=mug").ret == 0
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert recorded("Biased", "--snapshot-update", "--cpas-category=mug").ret == 0
    after = (folder / "facts.csv").read_text().splitlines()
    changed = set(after) - set(before["facts.csv"].decode().splitlines())
    assert len(changed) == 6
    assert all(line.startswith("mug,") for line in changed)
    assert recorded("Biased", "--cpas-require-golden").ret == 0
    # cells that are kept must have been made under the same conditions
    result = recorded("Perfect", "--snapshot-update", "--cpas-category=mug", "--cpas-seed=2")
    assert result.ret == 1
    unfolded(result).fnmatch_lines(["golden: NOT RECORDED: *record all categories together"])


def test_method_that_knows_fewer_categories_has_shrunk(recorded):
    result = recorded("OnlyMugs")
    assert result.ret == 1
    unfolded(result).fnmatch_lines(
        [
            "missing: perfect does not know bowl: 6 samples left out",
            "6 of 6 samples judged",
            "golden: CHANGED bowl: the data set and the method have 0 samples in common, the"
            " golden table has 6",
        ]
    )
    assert recorded("Perfect", "--cpas-category=mug").ret == 0  # asked for, so it is no loss


def test_interrupted_run_says_so(recorded, pytester):
    result = recorded("Raises", "-x")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["5 of 12 samples judged", "golden: NOT CHECKED (bowl, mug)"])


@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
def test_named_tests_run_beside_the_suite(cpas, pytester, how):
    pytester.makepyfile(test_own="def test_own(): pass", test_other="def test_other(): pass")
    result = cpas("Perfect", "test_own.py", *how)
    result.assert_outcomes(passed=KEPT + 14, skipped=NOT_DEMANDED + 1)
    assert cpas("Perfect", *how).ret == 0  # without names: only the suite
    result = cpas("Perfect", *how)
    result.assert_outcomes(passed=KEPT + 13, skipped=NOT_DEMANDED + 1)


def test_collect_only_judges_nothing(recorded):
    result = recorded("Perfect", "--collect-only", "-q")
    assert result.ret == 0
    result.stdout.fnmatch_lines(["cpas::test_sample[[]perfect-tiny-bowl-scene_0/0000]"])
    result.stdout.no_fnmatch_line("golden:*")


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--cpas-method=icpp", "--cpas-dataset=real275"), "Did you mean 'icp'?"),
        (("--cpas-method=icp", "--cpas-dataset=real276"), "Did you mean 'real275'?"),
        (("--cpas-method=icp",), "--cpas-method needs --cpas-dataset NAME as well"),
        (("--cpas-dataset=real275",), "--cpas-dataset does nothing without --cpas-method or"),
        (("--cpas-method=icp", "--cpas-dataset=real275"), "real_test.zip"),
        (
            ("--cpas-method=icp", "--cpas-dataset=real275", "--cpas-data=nowhere"),
            "no gts/real_test in",
        ),
        (("--cpas-method=tiny:NoInfo", "--cpas-dataset=tiny:Tiny"), "has no attribute info"),
        (("--cpas-method=tiny:Missing", "--cpas-dataset=tiny:Tiny"), "cannot be imported"),
        (("--cpas-predictions=nowhere.npz",), "nowhere.npz"),
        (("--cpas-predictions=tiny.py",), "expected a .pkl, an .npz, a .csv"),
        (
            ("--cpas-method=tiny:Perfect", "--cpas-dataset=tiny:Tiny", "--cpas-limit=0"),
            "expected at least 1",
        ),
        (
            ("--cpas-method=tiny:Perfect", "--cpas-dataset=tiny:Tiny", "--cpas-category=mugg"),
            "no samples of mugg",
        ),
    ],
)
def test_usage_errors(cpas, pytester, monkeypatch, args, words):
    monkeypatch.delenv("CPAS_DATA", raising=False)
    result = pytester.runpytest_inprocess(*RUN, *args)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    assert words in result.stderr.str()
    assert "Traceback" not in result.stderr.str()


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("raise SystemExit(0)", "(SystemExit: 0)"),
        ("import pytest; pytest.skip('no', allow_module_level=True)", "(Skipped: no)"),
        ("import pytest; pytest.exit('enough', returncode=0)", "(Exit: enough)"),
        ("raise RuntimeError('no')", "(RuntimeError: no)"),
    ],
)
def test_method_that_cannot_be_made_is_a_usage_error(cpas, pytester, code, words):
    pytester.makepyfile(
        unmade=f"import tiny\nclass M(tiny.Perfect):\n    def __init__(self): {code}\n"
    )
    result = pytester.runpytest_inprocess(
        *RUN, "--cpas-method=unmade:M", "--cpas-dataset=tiny:Tiny"
    )
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    assert f"method 'unmade:M' cannot be made {words}" in result.stderr.str()


#: Options that start something, or that a project may keep for tests of its own.
FREE = {
    "--cpas-method",
    "--cpas-predictions",
    "--cpas-merge",
    "--cpas-metrics",
    "--cpas-check-dataset",
    "--cpas-list",
    "--cpas-data",
    "--cpas-weights",
    "--cpas-golden",
    "--cpas-require-golden=strict",
    "--cpas-protocol",
    "--cpas-alarm",
    "--cpas-device",
    "--cpas-seed",
}


@pytest.fixture
def alone(request, pytester):
    """An option, with a value if it takes one, beside a test that has nothing to do with it."""
    pytester.makepyfile(test_x="def test_x(): pass")
    values = {
        "--cpas-profile": "=robustness",
        "--cpas-granularity": "=scene",
        "--cpas-results-reuse": "=any",
    }
    plain = (
        "--cpas-benchmark",
        "--cpas-require-golden",
        "--cpas-allow-gaps",
        "--cpas-no-shrink",
        "--cpas-trace-spread",
    )
    option = request.param
    return option, option + values.get(option, "" if option in plain else "=3")


@pytest.mark.parametrize("alone", plugin.NEEDS, indirect=True)
def test_option_that_does_nothing_is_a_usage_error(pytester, alone):
    option, typed = alone
    result = pytester.runpytest_inprocess(*RUN, typed, "test_x.py")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(
        [f"ERROR: {option} does nothing without {plugin.NEEDS[option][0]}*"]
    )
    assert plugin.EXAMPLES[plugin.NEEDS[option][0]] in result.stderr.str()


@pytest.mark.parametrize("alone", plugin.NEEDS, indirect=True)
def test_option_in_a_configuration_file_may_do_nothing(pytester, alone):
    pytester.makeini(f"[pytest]\naddopts = {alone[1]}")
    result = pytester.runpytest_inprocess(*RUN, "test_x.py")
    result.assert_outcomes(passed=1)
    assert "cpas" not in "".join(line for line in result.outlines if "plugins:" not in line)


def test_value_without_its_equals_sign_is_told(cpas, pytester):
    declared = DeclaredOptions()
    add_options(declared)
    typed = [tuple(name.split("=")) for name in sorted(declared.names) if "=" in name]
    assert typed == [(o, v) for o, values in plugin.OPTIONAL_VALUES.items() for v in values]
    for option, value in typed:
        result = cpas("Perfect", option, value)
        assert result.ret == pytest.ExitCode.USAGE_ERROR
        result.stderr.fnmatch_lines([f"ERROR: {option} {value}: * write {option}={value}"])
        # which may be a path all the same
        pytester.mkdir(value).joinpath("test_own.py").write_text("def test_own(): assert False")
        result = cpas("Perfect", option, value, "-k", "test_own")
        result.assert_outcomes(failed=2)  # and no golden table


def test_id_that_occurs_twice_is_told(cpas, pytester):
    pytester.makepyfile(
        lab_twice="""
        from tiny import *

        class Twice(Tiny):
            def __init__(self, data_dir):
                super().__init__(data_dir)
                self.samples = [*self.samples, *self.samples[:2]]
        """
    )
    result = cpas("Perfect", "--cpas-dataset=lab_twice:Twice", dataset="Renewed")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(
        ["*data set tiny: 2 sample ids occur more than once, first 'scene_0/0000', 2 times;*"]
    )


def test_one_seed_of_a_method_that_varies_is_told(cpas):
    hint = "*declares deterministic=False, and the golden table is of one seed*"
    recorded = cpas("DeclaredInexact", "--snapshot-update")
    assert recorded.ret == 0
    recorded.stdout.fnmatch_lines([hint, "*(--cpas-jitter 10*"])
    worse = cpas("DeclaredBiased")
    assert worse.ret == 1
    worse.stdout.fnmatch_lines([hint, "*(--cpas-jitter 10*"])
    assert "declares" not in cpas("Biased").stdout.str()
    assert "declares" not in cpas("Perfect", "--snapshot-update").stdout.str()
    several = cpas("DeclaredInexact", "--snapshot-update", "--cpas-jitter=2")
    assert several.ret == 0
    assert "declares" not in several.stdout.str()


def test_every_option_is_decided_upon():
    declared = DeclaredOptions()
    add_options(declared)
    assert FREE | plugin.NEEDS.keys() == declared.names
    assert not FREE & plugin.NEEDS.keys()


def test_all_that_was_typed_in_vain_is_named(pytester):
    result = pytester.runpytest_inprocess(*RUN, "--cpas-limit", "3", "--cpas-report=out")
    assert "--cpas-limit does nothing" in result.stderr.str()
    assert "--cpas-report does nothing" in result.stderr.str()


def test_missing_weights_are_a_usage_error(pytester):
    pytester.makepyfile(
        needy="""
        from pytest_cpas.types import Asset, MethodInfo
        class Needy:
            weights = Asset(path="needy/w.pt", url="https://example.org/w", licence="CC0")
            info = MethodInfo(name="needy", categories=("mug",), needs=(), gives=(), licence="MIT",
                              assets=(weights,))
        """,
    )
    shutil.copy(Path(__file__).parents[1] / "tiny.py", pytester.path)
    args = ("--cpas-method=needy:Needy", "--cpas-dataset=tiny:Tiny", "--cpas-weights=w")
    result = pytester.runpytest_inprocess(*RUN, *args)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    for words in ("w/needy/w.pt does not exist", "https://example.org/w (CC0)", "--cpas-weights"):
        assert words in result.stderr.str()


def test_golden_table_that_was_edited_is_refused(recorded, pytester):
    folder = pytester.path / "golden" / "recorded" / "perfect" / "tiny"
    table = folder / "cpas.toml"
    table.write_text(table.read_text().replace('10deg_2cm = "6/6"', '10deg_2cm = "5/6"'))
    result = recorded("Perfect")
    assert result.ret == 1
    unfolded(result).fnmatch_lines(
        ["golden: DAMAGED: *cpas.toml is not what follows from the other files*"]
    )


def test_golden_folder_can_be_named(recorded, pytester):
    (pytester.path / "golden").rename(pytester.path / "elsewhere")
    assert recorded("Perfect", "--cpas-require-golden").ret == 1
    assert recorded("Perfect", "--cpas-require-golden", "--cpas-golden=elsewhere").ret == 0
    pytester.makeini("[pytest]\ncpas_golden = elsewhere")
    assert recorded("Perfect", "--cpas-require-golden").ret == 0


def test_plugin_that_is_not_installed_is_part_of_the_program(cpas, pytester):
    args = ("-p", "plg", "--cpas-method=tiny:Perfect", "--cpas-dataset=tiny:Tiny")
    pytester.syspathinsert()
    said = []
    for content in ("x = 1\n", "x = 1\n", "x = 22\n"):
        pytester.makepyfile(plg=content)
        result = pytester.runpytest_inprocess(*RUN, *args, "--cpas-results=res")
        said.append("plugins was " in result.stdout.str())
    assert said == [False, False, True]
