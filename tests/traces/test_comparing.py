"""Two traces, value by value; traces in files; maps of names; the verdict on all samples."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from pytest_cpas.traces.comparing import NOISE, compare, difference
from pytest_cpas.traces.files import Header, fitting, read_sample, samples_in, write_sample
from pytest_cpas.traces.maps import Named, NameMap, read_map
from pytest_cpas.traces.parity import ParityWord, SampleParity, judge_parity
from pytest_cpas.traces.recording import Recorder, Trace
from pytest_cpas.traces.references import trace_folder
from pytest_cpas.traces.values import Value, parts_of, plain_array
from pytest_cpas.types import AnswerError, DataError

X = np.random.default_rng(0).standard_normal((40, 30)).astype(np.float32)
HEADER = Header(method="m", dataset="d", sample="a/0", category="mug", seed=3)


def value(array, name="x", kind="tap", **changes):
    return Value.of(name, 1, kind, "network", np.asarray(array)).replaced(**changes)


def trace(*arrays, reason=None, **named):
    values = [value(x, name) for name, x in named.items()]
    return Trace(values=[*map(value, arrays), *values], reason=reason)


def word(own, theirs):
    return difference(own, theirs).word


@pytest.mark.parametrize(
    ("own", "expected"),
    [
        (X, "EXACT"),
        (X.astype(float), "EXACT"),
        (np.asfortranarray(X), "EXACT"),
        (X * np.float32(1 + 1e-6), "FLOAT NOISE"),
        (X * np.float32(1 + 3e-5), "PARTS"),
        (X.T, "PARTS"),
        (np.where(X.max() == X, np.nan, X), "PARTS"),
        (np.where(X.max() == X, np.inf, X), "PARTS"),
        (np.array(["x"]), "PARTS"),
        (np.zeros((40, 30), np.int64), "PARTS"),
    ],
)
def test_word(own, expected):
    assert word(value(own), value(X)) == expected


def test_what_is_not_finite_may_be_the_same():
    odd = np.where(X > 1, np.nan, np.where(X < -1, -np.inf, X))
    assert word(value(odd), value(odd.astype(float))) == "EXACT"
    assert word(value(odd * np.float32(1 + 1e-6)), value(odd)) == "FLOAT NOISE"


@pytest.mark.parametrize("theirs", [0.0676, [0.0676], np.full((3, 4), 0.0676)], ids=str)
def test_last_bit_of_a_single_number_or_of_a_constant_is_noise(theirs):
    theirs = np.array(theirs)
    assert word(value(np.nextafter(theirs, 1)), value(theirs)) == "FLOAT NOISE"
    assert word(value(theirs * (1 + 3e-5)), value(theirs)) == "PARTS"


def test_mean_does_not_hide_a_difference():
    assert word(value(1000 + X), value(1000 + X[::-1])) == "PARTS"
    shifted = (1 + 3e-6) * 1000 + X.astype(float)
    assert word(value(shifted), value(1000 + X.astype(float))) == "PARTS"


@pytest.mark.parametrize("shape", [(), (1,), (7, 3)])
def test_one_number_has_no_mean_to_hide_behind(shape):
    number = np.full(shape, 105.8)
    assert word(value(number * (1 + 1e-6)), value(number)) == "FLOAT NOISE"
    assert word(value(number * (1 + 3e-5)), value(number)) == "PARTS"


def test_integers_must_be_equal():
    index = np.arange(100)
    other = index.copy()
    other[3] = 4
    assert word(value(other), value(index)) == "PARTS"
    assert word(value(other), value(index, spread=1e-3)) == "PARTS"


def test_nothing_is_compared_from_where_right_codes_may_choose_otherwise():
    theirs = Trace(values=[value(X, "a"), value(X, "b", spread=np.inf), value(X, "c")])
    found = compare(trace(a=X, b=X, c=2 * X), theirs)
    assert (found.parting.name, found.undecided) == ("c", "")
    found = compare(trace(a=X, b=X + 1, c=2 * X), theirs)
    assert (found.parting, found.undecided, len(found.differences)) == (None, "b", 1)
    verdict = judge_parity([SampleParity.of("s", found)], "r")
    assert verdict.word is ParityWord.EXACT
    assert "nothing is compared from b on: float noise makes another choice" in verdict.details


def test_measured_spread_is_what_is_allowed():
    own = X * np.float32(1 + 5e-6)
    assert word(value(own), value(X)) == "FLOAT NOISE"
    assert word(value(own), value(X, spread=1e-8)) == "PARTS"
    assert word(value(own * np.float32(1 + 1e-3)), value(X, spread=2e-4)) == "FLOAT NOISE"


def test_where_the_largest_difference_is():
    own = X.copy()
    own[7, 11] += 1
    found = difference(value(own), value(X))
    assert found.at == (7, 11)
    assert found.largest == pytest.approx(1, rel=1e-6)
    thin = difference(value(own).thinned(1), value(X).thinned(13))
    assert thin.word == "PARTS"  # by the norm of the whole, or by what was kept


def test_thinned_values_are_compared_by_digest_norm_and_what_was_kept():
    whole, thin = value(X), value(X).thinned(7)
    assert word(whole, thin) == "EXACT"
    assert word(value(X.astype(float)), thin) == "FLOAT NOISE"
    hidden = X.copy()
    hidden[0, 1] += 5  # between those that were kept
    assert word(value(hidden), thin) == "PARTS"


def test_parts_are_named():
    Pair = type(trace(X))  # not a named tuple
    assert Pair is Trace
    named = {"a": [X, (X, None)], "b": np.float64(1), "size": (1, 2.0)}
    assert [name for name, _ in parts_of("x", named)] == ["x.a.0", "x.a.1.0", "x.b", "x.size"]


@pytest.mark.parametrize("dtype", ["float16", "bfloat16", "float32", "int64", "bool", "complex64"])
def test_tensors_become_arrays(dtype):
    tensor = torch.ones(2, 3, dtype=getattr(torch, dtype), requires_grad=dtype == "float32")
    array = plain_array("x", tensor)
    assert array.shape == ((2, 3, 2) if "complex" in dtype else (2, 3))
    assert array.dtype.kind in "biuf"


def test_what_is_no_array_is_told():
    with pytest.raises(AnswerError, match=r"tap 'x': object of object, expected numbers"):
        plain_array("x", object())


def test_copies_are_kept():
    recorder, array = Recorder(), X.copy()
    recorder.tapped("x", array)
    array[:] = 0
    recorder.tapped("x", array)
    assert [v.key for v in recorder.values] == [("x", 1), ("x", 2)]
    assert recorder.values[0].norm == pytest.approx(np.linalg.norm(X), rel=1e-6)


@pytest.mark.parametrize("kind", ["array", "tensor", "number"])
def test_draws_are_replayed_as_what_they_are(kind):
    value_ = {"array": np.arange(3), "tensor": torch.arange(3), "number": 5}[kind]
    other = np.array(7) if kind == "number" else np.array([2, 1, 0])
    recorder = Recorder({("x", 1): other})
    handed = recorder.drawn("x", value_)
    assert type(handed) is type(value_)
    np.testing.assert_array_equal(np.asarray(handed), other)
    np.testing.assert_array_equal(recorder.values[0].kept, np.asarray(value_))
    assert recorder.drawn("x", value_) is value_  # the second call, of which nothing is known


def test_draw_of_another_shape_is_told():
    with pytest.raises(AnswerError, match=r"draw 'x': \(2,\) were drawn by the reference"):
        Recorder({("x", 1): np.zeros(2)}).drawn("x", np.zeros(3))


def test_first_that_parts_is_in_the_order_of_the_reference():
    found = compare(trace(b=2 * X, a=X, c=X + 1), trace(a=X, b=X, c=X, d=X))
    assert found.parting.name == "b"
    assert found.explanation.fits == ["a is added here, and not in the reference", "scaled by 2"]
    assert found.only_there == ["d"]


def test_one_answer_and_none():
    found = compare(trace(a=X, reason="no pose fits"), trace(a=X))
    assert found.parting.name == "answer"
    assert found.parting.problem == "none (no pose fits), the reference has an answer"
    assert compare(trace(a=X, reason="why"), trace(a=X, reason="why")).parting is None


def answered(angle, shift):
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    parts = {"answer.rotation": turn, "answer.translation": np.array([0, 0, 0.5 + shift])}
    return Trace(values=[value(x, name, "answer") for name, x in parts.items()])


@pytest.mark.parametrize("angle", [1e-9, 1e-3, 1.0, np.pi - 1e-6])
def test_how_far_answers_are_apart(angle):
    found = compare(answered(angle, 0.002), answered(0, 0))
    assert found.degrees == pytest.approx(np.degrees(angle), rel=1e-6)
    assert found.millimetres == pytest.approx(2)


def hypotheses(count, **more):
    best = answered(0, 0).values
    others = [
        each.replaced(name=each.name.replace("answer.", f"answer.{number}."))
        for number in range(2, count + 1)
        for each in best
    ]
    more_parts = [value(x, f"answer.{name}", "answer") for name, x in more.items()]
    return Trace(values=[value(X), *best, *more_parts, *others])


@pytest.mark.parametrize(
    ("here", "reference", "first"),
    [
        (hypotheses(1), hypotheses(2), "answer.2.rotation: the reference alone has it"),
        (hypotheses(2), hypotheses(1), "answer.2.rotation: the reference has none"),
        (hypotheses(1), hypotheses(1, extents=np.ones(3)), "answer.extents: the reference alone"),
    ],
)
def test_answers_that_one_side_lacks_part(here, reference, first):
    parting = compare(here, reference).parting
    assert f"{parting.name}: {parting.problem}".startswith(first)


def test_more_of_an_answer_than_the_reference_has_is_told_alone():
    found = compare(hypotheses(1, extents=np.ones(3)), hypotheses(1))
    assert found.parting is None
    assert found.only_here == ["answer.extents"]


@pytest.mark.parametrize("kind", [np.int64, np.uint64])
def test_integers_are_compared_beyond_the_digits_of_floats(kind):
    theirs = np.array([2**53, 5], kind)
    assert word(value(theirs + np.array([1, 0], kind)), value(theirs)) == "PARTS"
    assert word(value(theirs.astype(np.int64)), value(theirs)) == "EXACT"


def test_integers_that_were_not_kept_must_be_the_same_too():
    theirs = np.arange(300)
    swapped = theirs.copy()
    swapped[[1, 2]] = swapped[[2, 1]]
    assert word(value(swapped).thinned(7), value(theirs).thinned(7)) == "PARTS"
    assert word(value(theirs.copy()).thinned(7), value(theirs).thinned(7)) == "EXACT"


@pytest.mark.parametrize("shape", [(96, 3), (500, 3), (3, 64, 64), (7, 5, 3, 2), (1000,)])
@pytest.mark.parametrize("most", [100, 500, 1500])
def test_what_is_kept_of_large_values_is_of_every_channel(shape, most):
    size = int(np.prod(shape))
    [kept] = fitting([value(np.arange(size, dtype=np.float32).reshape(shape))], most)
    for axis, length in enumerate(shape):
        places = np.unravel_index(kept.kept.astype(int).ravel(), shape)[axis]
        if len(shape) > 1 and kept.kept.size >= 3 * length:
            assert len(np.unique(places)) == length


def test_what_differs_as_little_as_noise_is_explained_by_nothing():
    tight = value(X, spread=1e-9)
    found = compare(Trace(values=[value(X * np.float32(1 + 3e-6))]), Trace(values=[tight]))
    assert found.parting is not None
    assert not found.explanation.fits


# -- files --------------------------------------------------------------------------------------


def test_files_hold_the_trace(tmp_path):
    texts = Value.of("t", 1, "tap", "", np.array("häß"))
    made = Trace(values=[*trace(X, y=np.arange(5), z=np.array(True)).values, texts], reason="why")
    write_sample(tmp_path, HEADER, made)
    [path] = samples_in(tmp_path).values()
    read = read_sample(path)
    assert read.header == HEADER
    assert read.trace.reason == "why"
    assert [d.word for d in compare(read.trace, made).differences] == ["EXACT"] * 5


def test_limit_is_kept_and_small_values_are_whole():
    values = [value(np.zeros(10**5), "a"), value(np.zeros(10**4), "b"), value(np.zeros(9), "c")]
    kept = fitting(values, 20_000)
    assert sum(v.kept.nbytes for v in kept) <= 20_000 * 1.1
    assert [v.is_whole for v in kept] == [False, False, True]
    assert fitting(values, 10**7) == values
    assert all(v.kept.size >= 8 for v in fitting(values, 10))


def test_file_without_its_lines_is_no_trace(tmp_path):
    write_sample(tmp_path, HEADER, trace(X))
    next(tmp_path.glob("*.jsonl")).unlink()
    assert samples_in(tmp_path) == {}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"shape": [40, 31]}, "(40, 30) in the .npz, expected (40, 31)"),
        ({"stride": 2}, "(40, 30) in the .npz, expected (600,)"),
        ({"array": "0009"}, "the .npz has no array '0009'"),
        ({"kind": "other"}, "$.kind is 'other'"),
        ({"call": 0}, "$.call is 0"),
    ],
)
def test_damaged_line_is_told(tmp_path, change, words):
    write_sample(tmp_path, HEADER, trace(X))
    [path] = tmp_path.glob("*.jsonl")
    head, line = path.read_text().splitlines()
    path.write_text(f"{head}\n{json.dumps(json.loads(line) | change)}\n")
    with pytest.raises(DataError) as caught:
        read_sample(path)
    assert f"{path}, line 2: " in str(caught.value)
    assert words in str(caught.value)


@pytest.mark.parametrize("kept", range(1, 6))
def test_torn_file_is_no_trace(tmp_path, kept):
    whole = Trace(values=[*trace(X, y=X + 1, z=X[0]).values, *answered(0, 0).values])
    write_sample(tmp_path, HEADER, whole)
    [path] = tmp_path.glob("*.jsonl")
    lines = path.read_text().splitlines(keepends=True)
    assert len(lines) == 6
    read_sample(path)
    path.write_text("".join(lines[:kept]))
    with pytest.raises(DataError, match=r"values, expected \d+; it is torn"):
        read_sample(path)


def test_arrays_of_another_sample_are_told(tmp_path):
    for sample, x in (("a", X), ("b", 2 * X)):
        write_sample(
            tmp_path / sample,
            replace(HEADER, sample="s"),
            Trace(values=[value(x), *answered(0, 0).values]),
        )
    [path] = (tmp_path / "a").glob("*.jsonl")
    [other] = (tmp_path / "b").glob("*.npz")
    path.with_suffix(".npz").write_bytes(other.read_bytes())
    with pytest.raises(DataError, match=r"is another one in the .npz"):
        read_sample(path)


def test_answer_that_is_none_is_told(tmp_path):
    write_sample(
        tmp_path,
        HEADER,
        Trace(values=[*answered(0, 0).values[1:], value(X[:3, :3], "answer.rotation", "answer")]),
    )
    [path] = tmp_path.glob("*.jsonl")
    with pytest.raises(DataError, match="its answer is none: rotation: not orthonormal"):
        read_sample(path)


def test_other_format_is_told(tmp_path):
    (tmp_path / "x.jsonl").write_text('{"format": "else"}\n')
    with pytest.raises(DataError, match=r"line 1: format 'else', expected 'pytest-cpas trace 1'"):
        samples_in(tmp_path)


def test_folder_of_a_trace(tmp_path):
    for method in ("a", "b"):
        write_sample(tmp_path / method / "d", replace(HEADER, method=method), trace(X))
    assert trace_folder(tmp_path, "a", "d") == tmp_path / "a" / "d"
    assert trace_folder(tmp_path / "a", "x", "d") == tmp_path / "a" / "d"
    assert trace_folder(tmp_path / "b" / "d", "x", "d") == tmp_path / "b" / "d"
    with pytest.raises(DataError, match=r"traces of a, b, expected one of x on d; name the folder"):
        trace_folder(tmp_path, "x", "d")
    with pytest.raises(DataError, match=r"no trace of e, expected one of a on e"):
        trace_folder(tmp_path, "a", "e")


# -- maps ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("named", "expected"),
    [
        (Named(reference="r", here="x", transpose=[1, 0]), X.T),
        (Named(reference="r", here="x", take=[5, 9], axis=1), X[:, 5:9]),
        (Named(reference="r", here="x", reshape=[30, -1]), X.reshape(30, -1)),
        (Named(reference="r", here="x", quaternion="scalar-first"), np.roll(X[:, :4], -1, 1)),
    ],
)
def test_map_turns_the_reference(named, expected):
    seen = X if named.quaternion is None else X[:, :4]
    theirs = NameMap(values=[named]).applied(trace(r=seen))
    assert [d.word for d in compare(trace(x=expected), theirs).differences] == ["EXACT"]


def test_one_value_may_be_several_here():
    halves = [Named(reference="r", here=h, take=t) for h, t in (("a", [0, 20]), ("b", [20, 40]))]
    theirs = NameMap(values=halves).applied(trace(r=X, same=X))
    found = compare(trace(a=X[:20], b=X[20:], same=X), theirs)
    assert [(d.name, d.word) for d in found.differences] == [
        ("a", "EXACT"), ("b", "EXACT"), ("same", "EXACT"),
    ]  # fmt: skip


def test_map_that_does_not_fit_is_told():
    with pytest.raises(DataError, match=r"r \(40, 30\) cannot be turned as the map says: .*axes"):
        NameMap(values=[Named(reference="r", here="x", transpose=[0, 1, 2])]).applied(trace(r=X))
    thin = Trace(values=[value(X, "r").thinned(9)])
    with pytest.raises(DataError, match=r"record it with a larger --cpas-trace-max"):
        NameMap(values=[Named(reference="r", here="x", transpose=[1, 0])]).applied(thin)


def test_map_is_read(tmp_path):
    path = tmp_path / "parity.toml"
    path.write_text(
        'replay = ["picked"]\n[[values]]\nreference = "a.b"\nhere = "c"\ntranspose = [1, 0]\n'
    )
    assert read_map(path) == NameMap(
        values=(Named(reference="a.b", here="c", transpose=[1, 0]),), replay=("picked",)
    )
    path.write_text('[[values]]\nreference = "a"\nhere = "b"\nturn = 1\n')
    with pytest.raises(DataError, match=r"parity\.toml: .*'turn', which is not known"):
        read_map(path)


# -- verdicts -----------------------------------------------------------------------------------


def parity(sample, own, theirs, **changes):
    found = SampleParity.of(sample, compare(own, theirs), **changes)
    assert SampleParity.of_plain(json.loads(json.dumps(found.plain()))) == found
    return found


def test_verdict_on_all_samples():
    same = parity("s/0", trace(a=X, b=X), trace(a=X, b=X))
    noisy = parity("s/1", trace(a=X, b=X * np.float32(1 + 1e-6)), trace(a=X, b=X))
    early = parity("s/2", trace(a=-X, b=X + 1), trace(a=X, b=X))
    late = parity("s/3", trace(a=X, b=-X), trace(a=X, b=X), flips=["10deg 2cm"])
    assert judge_parity([same], "r").word is ParityWord.EXACT
    assert str(judge_parity([same], "r", 2)).startswith(
        "EXACT: 2 values of 1 samples are those of r; r has no trace of 2 other samples"
    )
    verdict = judge_parity([same, noisy], "r")
    assert verdict.word is ParityWord.FLOAT_NOISE
    assert f"is {noisy.noise.relative:.1e} at b, of {NOISE:.1e} allowed" in verdict.details
    verdict = judge_parity([same, noisy, late], "r")
    first, *lines = str(verdict).splitlines()
    assert first == (
        "PARTS AT b: relative L2 2.0e+00, the largest"
        f" {np.abs(2 * X).max():.2g} at {[*map(int, divmod(np.abs(X).argmax(), 30))]}, in the stage"
        " network (s/3); 1 of 3 samples part from r here"
    )
    assert "  explained by: every sign is the other one" in lines
    assert "  outcomes: of 1 samples one is correct and the other is not (10deg 2cm 1)" in lines
    verdict = judge_parity([late, early], "r")
    assert str(verdict).startswith("PARTS AT a: ")
    assert "other samples part first at: b (1)" in verdict.details


def test_nothing_in_common_is_no_parity():
    seen = Trace(values=[value(X, "observation.depth", "observation")])
    verdict = judge_parity([parity("s/0", seen, seen)], "r")
    assert verdict.word is ParityWord.NOT_COMPARED
    verdict = judge_parity([parity("s/0", trace(a=X), trace(b=X))], "r")
    assert (verdict.word, verdict.failed) == (ParityWord.NOT_COMPARED, True)
    assert judge_parity([], "r", 3).details.startswith("no sample; r has no trace of 3 other")


def test_samples_that_could_not_be_compared_are_no_match():
    same = SampleParity.of("s/0", compare(trace(a=X), trace(a=X)))
    verdict = judge_parity([same], "r", broken=2)
    assert verdict.word is ParityWord.NOT_COMPARED
    assert verdict.details.startswith("2 items could not compare their samples, and say why; of")
    assert "EXACT: 1 values of 1 samples" in verdict.details
    parts = SampleParity.of("s/0", compare(trace(a=2 * X), trace(a=X)))
    verdict = judge_parity([parts], "r", broken=1)
    assert verdict.word is ParityWord.PARTS
    assert "1 items could not compare their samples" in verdict.details
    alone = judge_parity([], "r", broken=1)
    assert alone.details == "1 items could not compare their samples, and say why"


def test_a_name_makes_no_line_of_its_own():
    name = "a\nparity of m on d: EXACT"
    found = compare(trace(**{name: 2 * X}), trace(**{name: X, "b\n": X}))
    verdict = str(judge_parity([SampleParity.of("s", found)], "r"))
    assert not any(line.startswith(("parity", "b")) for line in verdict.splitlines())


def test_what_a_map_names_in_vain_is_told():
    names = NameMap(
        values=[Named(reference="r", here="x"), Named(reference="s", here="y")],
        ignore=["n*", "q*"],
        replay=["x"],
    )
    vain = names.in_vain(trace(x=X), trace(r=X, n=X))
    assert vain == ["reference = 's'", "here = 'y'", "ignore 'q*'", "replay 'x'"]
    found = compare(trace(x=X), names.applied(trace(r=X, n=X)))
    first, second = (
        replace(SampleParity.of(name, found), in_vain=told)
        for name, told in (("s/0", vain), ("s/1", vain[:1]))
    )
    verdict = judge_parity([first, second], "r")
    assert verdict.word is ParityWord.EXACT
    assert verdict.details.splitlines()[1:] == [
        "  nothing is called as the map has it: reference = 's'"
    ]
    assert SampleParity.of_plain(first.plain()).in_vain == vain


def test_quaternions_have_four_numbers():
    turned = Named(reference="r", here="x", quaternion="scalar-first")
    with pytest.raises(DataError, match="is none of quaternions"):
        turned.of(value(X[:, :3]))


def test_noise_of_a_nearly_constant_value_is_noise_whatever_was_measured():
    flat = (1 + 0.01 * X.astype(float)) / 96
    noisy = flat * (1 + 2.5e-7 * X[::-1])
    assert word(value(noisy), value(flat, spread=1e-8)) == "FLOAT NOISE"
    assert word(value(flat * (1 + 2e-6 * X[::-1])), value(flat, spread=1e-8)) == "PARTS"
