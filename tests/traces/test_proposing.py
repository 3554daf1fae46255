"""A map of names, found from numbers and shapes."""

import numpy as np
import pytest

from pytest_cpas.traces.comparing import compare
from pytest_cpas.traces.maps import Named, read_map
from pytest_cpas.traces.proposing import map_text, propose
from pytest_cpas.traces.recording import Recorder, Trace

RANDOM = np.random.default_rng(0)
X, Y = RANDOM.standard_normal((2, 3, 20, 8))
Q = RANDOM.standard_normal((5, 4))
NOISE = 1 + 1e-7 * RANDOM.standard_normal(X.shape)


def trace(*values: tuple[str, np.ndarray]) -> Trace:
    recorder = Recorder()
    for name, array in values:
        recorder.tapped(name, array)
    return Trace(values=recorder.values)


def found(tmp_path, own, theirs):
    """The map that is proposed, and the comparison under it."""
    path = tmp_path / "parity.toml"
    path.write_text(map_text([propose(own, theirs)]))
    made = read_map(path)
    return made, compare(own, made.applied(theirs))


@pytest.mark.parametrize(
    ("own", "theirs", "change"),
    [
        (X * NOISE, X, {}),
        (X.transpose(0, 2, 1), X, {"transpose": [0, 2, 1]}),
        (X.reshape(60, 8), X, {"reshape": [60, 8]}),
        (X.transpose(2, 0, 1).reshape(8, 60), X, {"transpose": [2, 0, 1], "reshape": [8, 60]}),
        (X[:, 4:9], X, {"take": [4, 9], "axis": 1}),
        (Q[:, [1, 2, 3, 0]], Q, {"quaternion": "scalar-first"}),
    ],
)
def test_same_numbers_are_found(tmp_path, own, theirs, change):
    made, compared = found(tmp_path, trace(("a", own), ("c", Y)), trace(("b", theirs), ("c", Y)))
    assert made.values == (Named(reference="b", here="a", **change),)
    assert [each.word for each in compared.differences][-1] == "EXACT"
    assert compared.parting is None
    assert len(compared.differences) == 2


def test_one_value_is_two_here_only_if_asked_for_by_hand(tmp_path):
    """Each of the reference's values is proposed once."""
    own = trace(("a", X[:, :5]), ("b", X[:, 5:]), ("c", Y))
    made, _ = found(tmp_path, own, trace(("both", X), ("c", Y)))
    assert len(made.values) == 1


def test_of_several_the_one_whose_name_is_most_alike(tmp_path):
    own = trace(("net.block", X), ("net.block.conv", X), ("c", Y))
    theirs = trace(("model.block.conv", X), ("model.block", X), ("c", Y))
    made, _ = found(tmp_path, own, theirs)
    assert {(each.reference, each.here) for each in made.values} == {
        ("model.block", "net.block"),
        ("model.block.conv", "net.block.conv"),
    }


def test_name_that_is_called_for_other_things_is_not_proposed(tmp_path):
    """Of a name that stands for several of the reference's, the first call alone is the same."""
    own = trace(("pooled", X), ("pooled", Q), ("pooled", Y), ("end", X - Y))
    theirs = trace(("first", X), ("second", Q), ("first", Y), ("end", X - Y))
    made, compared = found(tmp_path, own, theirs)
    assert made.values == ()
    assert compared.parting is None


def test_of_several_the_one_that_is_the_same_at_every_call(tmp_path):
    own = trace(("model.block", X), ("net.other", X), ("model.block", Y), ("net.other", Y - X))
    made, _ = found(tmp_path, own, trace(("net.block", X), ("net.block", Y - X)))
    assert made.values == (Named(reference="net.block", here="net.other"),)
    # what parts at a later call is still that value
    made, compared = found(tmp_path, trace(("a", X), ("a", Y)), trace(("b", X), ("b", Y - X)))
    assert made.values == (Named(reference="b", here="a"),)
    assert compared.parting.name == "a, call 2"


def test_calls_in_another_order(tmp_path):
    own = trace(("m", X), ("m", Y), ("m", X + Y))
    made, compared = found(tmp_path, own, trace(("m", Y), ("m", X + Y), ("m", X)))
    assert made.values == (Named(reference="m", here="m", calls=[3, 1, 2]),)
    assert [each.word for each in compared.differences] == ["EXACT"] * 3


def test_name_of_something_else_is_ignored(tmp_path):
    own = trace(("a", X), ("norm", Y), ("end", X + 1))
    made, compared = found(tmp_path, own, trace(("a", X), ("norm", Y - X), ("end", X + 1)))
    assert made.ignore == ("norm",)
    assert compared.parting is None


def test_branch_that_parts_is_not_ignored_although_another_agrees(tmp_path):
    """What comes after it in order need not come of it."""
    values = ("a", X), ("norm", Y), ("other", Q), ("end", X + 1)
    own, theirs = trace(*values), trace(("a", X), ("norm", Y - X), ("other", Q), ("end", X + 2))
    made, compared = found(tmp_path, own, theirs)
    assert made.ignore == ()
    assert compared.parting.name == "norm"
    text = map_text([propose(own, theirs)])
    assert '# ignore = [\n#     "norm",\n# ]\n' in text
    # in another sample the end is the same: it is not sure of both
    sure = propose(own, trace(("a", X), ("norm", Y - X), ("other", Q), ("end", X + 1)))
    assert map_text([sure, propose(own, theirs)]) == text
    assert '\nignore = [\n    "norm",\n]\n' in map_text([sure, sure])


def test_what_parts_is_not_ignored(tmp_path):
    made, compared = found(tmp_path, trace(("a", X), ("b", Y)), trace(("a", X), ("b", Y - X)))
    assert made.ignore == ()
    assert compared.parting.name == "b"


def test_shapes_alone_where_nothing_agrees(tmp_path):
    own = trace(("a", X), ("b", Q), ("c", Y[0]), ("d", Y[1]))
    theirs = trace(("p", X + 1), ("q", Q + 1), ("r", Y[0] + 1), ("s", Y[1] + 1))
    text = map_text([propose(own, theirs)])
    assert "# By their shapes alone, which no other value has." in text
    made, _ = found(tmp_path, own, theirs)
    assert [(each.reference, each.here) for each in made.values] == [("p", "a"), ("q", "b")]
    agreeing = [trace(*((v.name, v.kept) for v in t.values), ("e", Y)) for t in (own, theirs)]
    assert propose(*agreeing) == {}


def test_only_what_all_samples_propose():
    some, other = propose(trace(("a", X)), trace(("b", X))), propose(trace(("a", X)), trace())
    assert 'here = "a"' in map_text([some, some])
    assert "[[values]]" not in map_text([some, other])
