"""A part of the catalogue of method faults, and the sound method; ``nox -s faults`` does all."""

import method_faults
import pytest
from method_faults import DIAGNOSIS, FAULTS
from planted import Planted, Scenes

from pytest_cpas.checks.contract import CONTRACT
from pytest_cpas.evaluation import MethodRun, Selection
from pytest_cpas.session.contract_stage import ContractStage

CAUGHT_BY_CHECKS = [planted for planted in FAULTS if planted.by in CONTRACT]


def stage(make, seed=0):
    return ContractStage(MethodRun(make(), Scenes(), seed=seed))


def of_20(make):
    return MethodRun(make(), Scenes(), selection=Selection(limit=20))


@pytest.mark.parametrize("planted", CAUGHT_BY_CHECKS[::4], ids=lambda planted: planted.name)
def test_planted_faults_are_caught(planted):
    """By the check that the catalogue names, which says more than a word."""
    result = stage(planted.make).result(CONTRACT[planted.by])
    assert result.violated
    assert len(result.message) > 30


def test_the_diagnosis_names_what_no_check_can_see():
    planted = next(planted for planted in FAULTS if planted.name == "NOCS object axes")
    assert method_faults.is_named(planted, method_faults.diagnosed(of_20(planted.make)))
    assert method_faults.diagnosed(of_20(Planted)) == []


@pytest.mark.parametrize("seed", range(2))
def test_no_alarm_about_the_sound_method(seed):
    sound = stage(Planted, seed)
    results = [sound.result(check) for check in CONTRACT.values()]
    assert [result for result in results if result.violated] == []


def test_the_catalogue_is_large_and_unambiguous():
    names = [planted.name for planted in FAULTS]
    assert len(set(names)) == len(names) >= 40
    assert all(planted.by in CONTRACT or planted.by.startswith(DIAGNOSIS) for planted in FAULTS)
    assert {planted.by for planted in CAUGHT_BY_CHECKS} == set(CONTRACT)
