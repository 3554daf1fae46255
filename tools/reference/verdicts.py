"""The words of verdicts, and exit codes."""

import enum

import pytest

from pytest_cpas.checks.dataset.verdicts import DatasetWord
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.golden.words import Word
from pytest_cpas.timing.verdicts import SpeedWord
from pytest_cpas.traces.parity import ParityWord
from pytest_cpas.types import VerdictWord
from reference.code import doc_comments
from reference.markdown import code, table

#: The exit code of a run in which nothing but one verdict could fail.
_EXIT = {
    "passed": pytest.ExitCode.OK,
    "skipped": pytest.ExitCode.OK,
    "failed": pytest.ExitCode.TESTS_FAILED,
}


def golden_words() -> str:
    """The verdicts on a run."""
    return _verdicts("verdict", Word)


def speed_words() -> str:
    """The verdicts on a method's speed."""
    return _verdicts("verdict on speed", SpeedWord)


def parity_words() -> str:
    """The verdicts on two codes."""
    return _verdicts("verdict on parity", ParityWord)


def _verdicts(head: str, words: type[VerdictWord]) -> str:
    """What each means, and what it alone makes a run end with."""
    told = doc_comments(words)
    return table(
        [head, "meaning", "exit code", "with `--cpas-require-golden`", "with `=strict`"],
        (
            (
                word.value,
                told[word.name],
                *(str(int(_EXIT[word.outcome(required)])) for required in (False, True, "strict")),
            )
            for word in words
        ),
    )


def dataset_words() -> str:
    """The verdicts on a data set."""
    return _meanings(DatasetWord)


def metric_outcomes() -> str:
    """What a property of metrics, or a check of the contract, can end with."""
    return _meanings(Outcome)


def _meanings(words: type[enum.Enum]) -> str:
    told = doc_comments(words)
    return table(["word", "meaning"], ((w.value, told[w.name]) for w in words))


#: What pytest's exit codes mean of a run with this plugin.
_MEANT = {
    "OK": "Every item and every verdict passed, or failed as is known.",
    "TESTS_FAILED": "A sample, a check or a verdict failed.",
    "INTERRUPTED": "Somebody interrupted the run, or the disk is full. With `--cpas-results`"
    " nothing that was judged is lost.",
    "INTERNAL_ERROR": "A mistake of pytest or of a plugin.",
    "USAGE_ERROR": "A mistake in the command, or data or weights are missing. Nothing was judged.",
    "NO_TESTS_COLLECTED": "`-k` or the like left nothing to do.",
    "MAX_WARNINGS_ERROR": "More warnings than `--max-warnings` allows (pytest 9.1 or newer).",
}


def exit_codes() -> str:
    """pytest's, all of them."""
    return table(
        ["exit code", "meaning"],
        ((code(int(each)), _MEANT[each.name]) for each in pytest.ExitCode),
    )
