"""The contract of a method before its samples, in whole runs of pytest."""

import json
import random
import re
from dataclasses import replace

import numpy as np
import pytest
import tiny
from harness import KEPT, NOT_DEMANDED, RUN

from pytest_cpas.checks.contract import CONTRACT, ContractResult, MethodSubject, check_contract
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.session.contract_stage import SMOKE_SAMPLES, smoke_samples
from pytest_cpas.types import ContractError

HOW = [(), ("-n2",), ("--cpas-granularity=scene",)]


@pytest.mark.parametrize("how", HOW, ids=" ".join)
def test_wrong_adapter_stops_before_its_samples(recorded, how):
    result = recorded("Millimetres", *how)
    assert result.ret == 1
    groups = 3 if "--cpas-granularity=scene" in how else 12
    outcomes = result.parseoutcomes()
    assert outcomes["failed"] == 1
    assert outcomes["skipped"] >= groups + NOT_DEMANDED
    result.stdout.fnmatch_lines(
        [
            "the adapter is wrong: perfect on tiny, metric_units: 4 of 4 samples, the first: the"
            " object is 800 away*(this looks like millimetres)*",
            "0 of 12 samples judged",
            "golden: NOT CHECKED*",
        ]
    )


def test_skipped_samples_say_why(recorded):
    result = recorded("Millimetres", "-rs")
    result.stdout.fnmatch_lines(["SKIPPED * the adapter is wrong: metric_units: 4 of 4 samples*"])


def test_summary_counts_the_checks(cpas):
    result = cpas("Perfect")
    result.stdout.fnmatch_lines(
        [
            f"contract: {KEPT} of 21 checks passed; 4 not demanded (information): background,"
            " distance, mirror, roll"
        ]
    )
    result = cpas("Inexact")
    assert result.ret == 1
    result.stdout.fnmatch_lines(
        [
            "the adapter is wrong: *the same seed gave another answer: make a generator from the"
            " passed seed *(translation differs by 0.*",
            "demanded: the same observation and seed give the same answer, twice in a row",
            "contract: 8 of 9 checks passed; 1 violated: repeatable",
        ]
    )


def test_method_that_raises_says_where(cpas):
    result = cpas("Explodes")
    assert result.ret == 1
    result.stdout.fnmatch_lines(
        ["*answers: predict raised RuntimeError('the network exploded') at *tiny.py, line *"]
    )


def test_one_sample_accuses_no_adapter(cpas):
    result = cpas("Millimetres", "--cpas-limit=1", "-rs")
    result.stdout.fnmatch_lines(["SKIPPED *a single sample, which may be the method's mistake: *"])
    result.stdout.fnmatch_lines(["1 of 12 samples judged"])


def test_what_is_not_declared_is_not_demanded(cpas):
    assert cpas("DeclaredInexact").ret == 0


def test_samples_are_judged_when_the_contract_is_left_out(recorded):
    result = recorded("Millimetres", "-k", "mug")
    result.stdout.fnmatch_lines(["6 of 12 samples judged", "golden: REGRESSED mug*"])


def test_merged_results_have_the_contract_of_their_shards(cpas, pytester):
    for index in (1, 2):
        cpas("Shifts", f"--cpas-shard={index}/2", "--cpas-results=out")
    merged = [f"--cpas-merge={path}" for path in (pytester.path / "out").iterdir()]
    result = pytester.runpytest_inprocess(*RUN, *merged)
    assert result.ret == 1
    result.stdout.fnmatch_lines(["contract: *violated: *batch*", "12 of 12 samples judged"])
    result = pytester.runpytest_inprocess(*RUN, "--snapshot-update", *merged)
    assert result.ret == 1
    result.stdout.fnmatch_lines(["golden: NOT RECORDED: *"])
    assert not list((pytester.path / "golden").iterdir())


def test_merged_shards_without_the_contract_are_not_recorded(cpas, pytester):
    cpas("Perfect", "--cpas-results=out", "-k", "not test_contract")
    (path,) = (pytester.path / "out").iterdir()
    result = pytester.runpytest_inprocess(*RUN, "--snapshot-update", f"--cpas-merge={path}")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["golden: NOT RECORDED: the contract of the method was not *"])


def test_golden_table_needs_the_contract(cpas, pytester):
    for method, *args in (("Inexact",), ("Perfect", "-k", "not test_contract")):
        result = cpas(method, "--snapshot-update", *args)
        assert result.ret == 1
        result.stdout.fnmatch_lines(["golden: NOT RECORDED: *"])
    assert not list((pytester.path / "golden").iterdir())


def test_known_violations_are_strict(cpas, pytester):
    file = pytester.path / "perfect.known.toml"
    file.write_text('[[contract]]\ncheck = "repeatable"\nreason = "It draws at random."\n')
    for how in ((), ("--runxfail",), ("--runxfail", "-n2")):
        result = cpas("Inexact", *how)
        assert result.ret == 0
        assert result.parseoutcomes()["xfailed"] == 1
        result.stdout.fnmatch_lines(["contract: 8 of 9 checks passed; 1 known: repeatable"])
    # one that does not happen is an error, but not of a part of the samples
    result = cpas("Perfect")
    assert result.parseoutcomes()["failed"] == 1
    result.stdout.fnmatch_lines(["*repeatable is a known violation of perfect, but it holds; rem*"])
    assert cpas("Perfect", "--cpas-limit=6").ret == 0


def test_damaged_known_failures_are_usage_errors(cpas, pytester):
    (pytester.path / "perfect.known.toml").write_text('[[contract]]\ncheck = "odrer"')
    result = cpas("Perfect")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*perfect.known.toml: [[][[]contract]] entry 1: reason missing*"])


def test_samples_are_spread():
    run = MethodRun(tiny.Perfect(), tiny.Tiny(None))
    refs = [sample.ref for sample in smoke_samples(run)]
    assert len(refs) == SMOKE_SAMPLES
    assert {ref.category for ref in refs} == set(tiny.CATEGORIES)
    assert {ref.scene for ref in refs} == {"scene_0", "scene_1", "scene_2"}
    run.samples = run.samples[:2]
    assert len(smoke_samples(run)) == 2


def test_the_sample_with_most_depth_is_taken_and_damaged_ones_are_not(monkeypatch):
    data = tiny.Tiny(None)
    read = data.load

    def load(ref):
        if ref.id in ("scene_0/0000", "scene_0/0001", "scene_0/0003"):
            raise ContractError("torn")
        sample = read(ref)
        if ref.id != "scene_2/0008":
            sample.observation.depth[2, 3] = 0
        return sample

    monkeypatch.setattr(data, "load", load)
    chosen = {sample.ref.id for sample in smoke_samples(MethodRun(tiny.Perfect(), data))}
    assert "scene_2/0008" in chosen
    assert not chosen & {"scene_0/0000", "scene_0/0001", "scene_0/0003"}


def test_every_check_says_what_it_demands():
    assert len(CONTRACT) >= 20
    for check in CONTRACT.values():
        assert check.statement
        assert "\n" not in check.statement


class Draws(tiny.Perfect):
    def answer(self, index):
        random.random()
        np.random.seed(index)  # noqa: NPY002
        return super().answer(index)


def test_global_random_states_are_put_back():
    data = tiny.Tiny(None)
    method = Draws()
    method.load(None, "cpu")
    subject = MethodSubject(method, [data.load(ref) for ref in data.samples[:3]])
    states = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
    results = [check_contract(subject, check) for check in CONTRACT.values()]
    assert states == (random.getstate(), np.random.get_state()[1].tolist())  # noqa: NPY002
    (found,) = [r for r in results if r.check == "global_random_state_untouched"]
    assert "of numpy.random, random:" in found.message
    assert not found.wrong  # it is not demanded


def test_results_travel_as_plain_values():
    result = ContractResult("order", Outcome.VIOLATED, True, "seen", known=True)
    assert ContractResult(**json.loads(json.dumps(result.plain()))) == result


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"tolerance": 1.0}, "tolerance is 1.0, expected metres and radians that float noise"),
        ({"tolerance": float("nan")}, "tolerance is nan"),
        ({"equivariances": frozenset({"rol"})}, "equivariances has ['rol'], expected some of"),
    ],
)
def test_declarations_are_checked(wrong, words):
    with pytest.raises(ContractError, match=re.escape(words)):
        replace(tiny.Perfect.info, **wrong)
