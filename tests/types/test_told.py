"""What error messages quote of others' values is short, whatever they are."""

import pickle

import pytest

from pytest_cpas.evaluation import ResultsError, SampleError
from pytest_cpas.evaluation.method_runs import MethodError
from pytest_cpas.fetching import FetchError
from pytest_cpas.golden import GoldenError
from pytest_cpas.new_adapter import NewAdapterError
from pytest_cpas.reading.archives import ArchiveError
from pytest_cpas.reading.files import NoFileError
from pytest_cpas.registry import RegistryError
from pytest_cpas.report.stored import StoredReportError
from pytest_cpas.timing.records import RecordError
from pytest_cpas.timing.workers import TimingError
from pytest_cpas.types import AnswerError, ContractError, DataError, Prediction, shortened, shown
from pytest_cpas.types.errors import LONGEST_MESSAGE, message_of, words_of

ERRORS = (
    ContractError, DataError, AnswerError, NoFileError, ArchiveError, FetchError, GoldenError,
    MethodError, NewAdapterError, RecordError, RegistryError, ResultsError, SampleError,
    StoredReportError, TimingError,
)  # fmt: skip


@pytest.mark.parametrize("kind", ERRORS)
def test_message_of_any_error_is_short(kind):
    error = kind("a/file.toml: " + "x" * 10**6 + " expected less")
    told = str(error)
    assert len(told) == LONGEST_MESSAGE
    assert told.startswith("a/file.toml: xx")
    assert told.endswith("xx expected less")
    assert "1000027 characters" in told
    assert str(pickle.loads(pickle.dumps(error))) == told
    assert str(kind("short")) == "short"


DEEP: list = []
for _ in range(5000):
    DEEP = [DEEP]


VALUES = {
    "blanks": (" 1  2", "' 1  2'"),
    "lines": ("x\ny", r"'x\ny'"),
    "digits that are not written": (10**5000, "a int"),
    "digits": (-(10**3000), "..."),
    "number": (0.5, "0.5"),
    "text": ("x" * 10**6, "xx...xx"),
    "lists": ([["x" * 10**6] * 10**5] * 10**5, "..."),
    "table": ({n: n for n in range(10**5)}, "..."),
    "depth": (DEEP, "[...]"),
    "bytes": (b"\0" * 10**6, "..."),
    "words of its own": (type("Lines", (), {"__repr__": lambda self: "a\n  b"})(), "a b"),
}


@pytest.mark.parametrize("kind", VALUES)
def test_any_value_is_shown_in_a_short_line(kind):
    value, words = VALUES[kind]
    seen = shown(value)
    assert words in seen
    assert len(seen.splitlines()) == 1
    assert len(seen) <= 100


@pytest.mark.parametrize("length", [30, 31, 100])
def test_shortened_is_as_long_as_it_may_be(length):
    assert shortened("x" * length, length) == "x" * length
    assert len(shortened("ab" * length, length)) == length


class Mute(Exception):
    def __str__(self):
        raise RuntimeError("not even this")


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (ValueError("too few"), "ValueError: too few"),
        (ValueError(), "ValueError"),
        (Mute(), "Mute: its message cannot be told, for that raises RuntimeError"),
    ],
)
def test_words_of_any_error(error, words):
    assert words_of(error) == Prediction.failed(error).reason == words
    assert words.endswith(message_of(error))


def test_words_and_reasons_are_short():
    assert len(words_of(ValueError("x" * 10**6))) == LONGEST_MESSAGE // 2
    assert len(Prediction.failed("x" * 10**6).reason) == LONGEST_MESSAGE
