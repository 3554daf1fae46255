"""What a method names inside in another interpreter is heard here, and draws are replayed there."""

import os
import sys

import numpy as np
import pytest
import tiny
import workers
from tapping_here import Here

from pytest_cpas.remote import remote_method
from pytest_cpas.traces.comparing import compare
from pytest_cpas.traces.files import Header, read_sample, samples_in, write_sample
from pytest_cpas.traces.recording import draws_of, record
from pytest_cpas.types import AnswerError

DATA = tiny.Tiny(None)
SEEN = DATA.load(DATA.samples[3]).observation


@pytest.fixture
def remote():
    made = []

    def make(name, **changes):
        made.append(workers.spec(f"tapping:{name}", **changes))
        method = remote_method(made[-1])()
        method.load(None, "cpu")
        return method

    yield make
    for asked in made:
        assert workers.left_of(asked) == []


@pytest.fixture
def tapping(remote):
    method = remote("Tapping")
    yield record(method, [SEEN], 3)
    method.remote.close()


def test_values_come_in_their_order_with_their_stages(tapping):
    told = [(v.name, v.kind, v.stage) for v in tapping.values if v.kind in ("tap", "draw")]
    assert told == [
        ("input.depth", "tap", "pre-processing"),
        ("chosen", "draw", "pre-processing"),
        ("features.points", "tap", "network"),
        ("features.pair.0", "tap", "network"),
        ("features.pair.1", "tap", "network"),
    ]
    values = {value.name: value.kept for value in tapping.values}
    np.testing.assert_array_equal(values["input.depth"], 2 * SEEN.depth)
    assert values["features.pair.1"].dtype == np.uint8


@pytest.mark.parametrize(
    ("name", "place"), [("OtherSeed", "chosen"), ("OtherInside", "input.depth")]
)
def test_parting_is_found_there(remote, tapping, name, place):
    method = remote(name)
    found = compare(record(method, [SEEN], 3), tapping)
    method.remote.close()
    assert found.parting.name == place


def test_what_the_reference_drew_is_replayed_there(remote, tapping):
    method = remote("OtherSeed")
    again = record(method, [SEEN], 3, draws_of(tapping))
    method.remote.close()
    assert compare(again, tapping).parting.name == "chosen"  # what it would have drawn itself
    assert compare(again, tapping, ["chosen"]).parting is None


def test_recorded_trace_from_there_is_replayed_here(tapping, tmp_path):
    header = Header(method="tapping", dataset="tiny", sample="s", category="mug", seed=3)
    write_sample(tmp_path, header, tapping)
    theirs = read_sample(samples_in(tmp_path)["s"]).trace
    assert compare(record(Here(), [SEEN], 3), theirs).parting.name == "chosen"
    found = compare(record(Here(), [SEEN], 3, draws_of(theirs)), theirs, ["chosen"])
    assert {each.word for each in found.differences} == {"EXACT"}
    assert "features.points" in [each.name for each in found.differences]


def test_draw_of_another_shape_is_told(remote):
    method = remote("Tapping")
    with pytest.raises(Exception, match=r"draw 'chosen': the reference drew \(4,\), expected"):
        record(method, [SEEN], 3, {("chosen", 1): np.arange(4)})
    method.remote.close()


def test_nothing_is_named_where_nobody_hears(remote):
    method = remote("TooMany")
    [answer] = method.predict([SEEN.copy()], 3)
    assert answer.hypotheses
    with pytest.raises(AnswerError, match="more than 8000 values"):
        record(method, [SEEN], 3)
    method.remote.close()


def test_adapter_that_imports_the_package_is_heard_as_well(tapping, tmp_path):
    """Its taps are those of ``pytest_cpas.stages``, there as here."""
    code = (workers.HERE / "tapping.py").read_text().replace("from cpas_worker", "from none_such")
    (tmp_path / "by_package.py").write_text(code)
    asked = workers.spec(
        "by_package:Tapping", path=(str(tmp_path), *filter(os.path.exists, sys.path))
    )
    method = remote_method(asked)()
    method.load(None, "cpu")
    found = compare(record(method, [SEEN], 3), tapping)
    method.remote.close()
    assert workers.left_of(asked) == []
    assert {each.word for each in found.differences} == {"EXACT"}
    assert not found.only_there
