"""Words and what they end with; one verdict for runs, speed and data sets."""

from __future__ import annotations

import copy
import json
import pickle

import pytest

from pytest_cpas import diagnosis
from pytest_cpas.checks.dataset.verdicts import DatasetWord
from pytest_cpas.golden import Word
from pytest_cpas.timing.verdicts import SpeedWord
from pytest_cpas.types import Verdict, VerdictWord

#: What could not be judged: skipped, and failed where a golden table is required.
UNJUDGED = [Word.NOT_CHECKED, SpeedWord.UNDECIDED, SpeedWord.NOT_COMPARED]


@pytest.mark.parametrize("word", [*Word, *SpeedWord, *DatasetWord], ids=str)
def test_requiring_a_golden_table_changes_what_could_not_be_judged_alone(word):
    verdict = Verdict(word, "all")
    if word in UNJUDGED:
        assert (verdict.outcome(False), verdict.outcome(True)) == ("skipped", "failed")
        assert not verdict.passed
        assert not verdict.failed
        assert verdict.outcome("strict") == "failed"
    else:
        strict = "failed" if word is Word.PROBABLY_WORSE else verdict.outcome(False)
        assert verdict.outcome("strict") == strict
        assert verdict.outcome(True) == verdict.outcome(False)
        assert verdict.passed == (verdict.outcome(False) == "passed")
        assert verdict.failed == (verdict.outcome(False) == "failed")


@pytest.mark.parametrize("word", [*Word, *SpeedWord, *DatasetWord], ids=str)
def test_a_word_travels_as_its_text(word):
    assert json.loads(json.dumps(word)) == word.value == str(word)
    for copied in (type(word)(word.value), copy.deepcopy(word), pickle.loads(pickle.dumps(word))):
        assert copied is word


def test_a_verdict_in_words():
    assert str(Verdict(Word.REGRESSED, "mug", "2 lost")) == "REGRESSED mug: 2 lost"
    assert str(Verdict(Word.MATCHES, "all", "43 samples")) == "MATCHES: 43 samples"
    assert str(Verdict(SpeedWord.SLOWER, "all", "twice", 1.2)) == "SLOWER: twice"


def test_a_word_needs_an_outcome():
    with pytest.raises(TypeError, match="outcome"):

        class Incomplete(VerdictWord):
            GOOD = "GOOD"


def test_old_names_say_what_to_write():
    verdict = Verdict(DatasetWord.FAILED, "depth", "too far")
    with pytest.deprecated_call(match=r"write Verdict\.subject"):
        assert verdict.check == "depth"
    with pytest.deprecated_call(match=r"write Verdict\.details"):
        assert verdict.message == "too far"
    with pytest.deprecated_call(match=r"write pytest_cpas\.diagnosis\.Explanation"):
        assert diagnosis.Finding is diagnosis.Explanation
    with pytest.deprecated_call(match=r"write pytest_cpas\.checks\.known\.KnownFailure"):
        from pytest_cpas.checks.dataset.verdicts import KnownFault
    assert KnownFault(check="depth", reason="x").category == "*"
    with pytest.deprecated_call(match=r"write .*\.DatasetWord"):
        from pytest_cpas.checks.dataset.verdicts import Word as Old
    assert Old is DatasetWord
