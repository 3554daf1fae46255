"""Whole runs with --cpas-trace and --cpas-parity."""

import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from harness import RUN, unfolded
from report_schema import follow_schema

from pytest_cpas.traces.files import read_sample, samples_in

TRACED = """
import numpy as np
from tiny import *
from pytest_cpas.adapting import draw, stage, tap

class Traced(Perfect):
    seed = scale = 0
    shift = 0.0

    def predict(self, batch, seed):
        with stage("pre-processing"):
            x = tap("input.depth", [seen.depth + self.shift for seen in batch])[0]
            chosen = draw("chosen", np.random.default_rng(seed + self.seed).permutation(48)[:20])
            tap("input.points", x.ravel()[chosen])
        with stage("network"):
            features = np.sin(np.arange(600.0)).reshape(20, 30) * (1 + chosen[:, None] / 10)
            tap("features", features.T if self.scale == "T" else features * (1 + self.scale))
        return super().predict(batch, seed)

class Noisy(Traced):
    scale = 1e-7

class Scaled(Traced):
    scale = 0.5

class Transposed(Traced):
    scale = "T"

class OtherSeed(Traced):
    seed = 1

class OtherInput(Traced):
    shift = 0.01

class Mute(Perfect):
    pass

class Failing(Traced):
    def answer(self, index):
        return Prediction.failed("no idea") if index == 3 else super().answer(index)

class Raises(Traced):
    def predict(self, batch, seed):
        raise RuntimeError("the network exploded")
"""


@pytest.fixture
def traced(cpas, pytester, monkeypatch):
    pytester.makepyfile(traced=TRACED)
    monkeypatch.delitem(sys.modules, "traced", raising=False)

    def run(method, *args):
        names = (f"--cpas-method=traced:{method}", "--cpas-dataset=tiny:Tiny")
        start = pytester.runpytest_subprocess if "-n2" in args else pytester.runpytest_inprocess
        return start(*RUN, *names, "-k", "test_parity", "--cpas-limit=4", *args)

    return run


@pytest.fixture
def recorded_trace(traced):
    assert traced("Traced", "--cpas-trace=out").ret == 0
    return traced


def verdict(result, method="perfect"):
    lines = unfolded(result).lines
    return next(line for line in lines if line.startswith(f"parity of {method} on tiny: "))


def test_trace_is_recorded_and_resumed(traced, pytester):
    result = traced("Traced", "--cpas-trace=out")
    result.assert_outcomes(passed=4, skipped=1, deselected=28)
    folder = pytester.path / "out" / "perfect" / "tiny"
    assert f"trace: 4 samples, 0.1 MiB, in {folder}" in result.outlines
    paths = samples_in(folder)
    assert list(paths) == ["scene_0/0000", "scene_0/0003", "scene_1/0006", "scene_2/0009"]
    read = read_sample(paths["scene_0/0003"])
    names = [value.name for value in read.trace.values]
    assert names == [
        *("observation.rgb", "observation.depth", "observation.mask", "observation.camera"),
        *("input.depth.0", "chosen", "input.points", "features"),
        *("answer.rotation", "answer.translation", "answer.extents", "answer.points"),
    ]
    by_name = {value.name: value for value in read.trace.values}
    assert (by_name["chosen"].kind, by_name["chosen"].stage) == ("draw", "pre-processing")
    assert by_name["features"].stage == "network"
    assert read.header.seed == 0
    assert read.header.identity["data"] == "tiny-1"
    # as after a kill: one sample lacks its lines
    paths["scene_1/0006"].unlink()
    kept = {path: path.stat().st_mtime_ns for path in paths.values() if path.exists()}
    result = traced("Traced", "--cpas-trace=out")
    assert f"trace: 1 samples, 0.0 MiB, in {folder}; 3 were there already" in result.outlines
    assert all(path.stat().st_mtime_ns == time for path, time in kept.items())
    # of another limit they are others
    result = traced("Traced", "--cpas-trace=out", "--cpas-trace-max=0.001")
    assert "trace: 4 samples" in result.stdout.str()
    thin = read_sample(paths["scene_0/0003"]).trace
    assert sum(value.kept.nbytes for value in thin.values) < 1200
    assert traced("Traced", "--cpas-parity=out").ret == 0


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        ("Traced", "EXACT: 32 values of 4 samples are those of the trace of perfect"),
        ("Noisy", "FLOAT NOISE: 32 values of 4 samples: 28 are * at features, of 1.0e-05*"),
        ("Scaled", "PARTS AT features: relative L2 5.0e-01, * in the stage network (scene_*"),
        ("Transposed", "PARTS AT features: shape (30, 20), the reference's is (20, 30), in *"),
        ("OtherInput", "PARTS AT input.depth.0: *, in the stage pre-processing (scene_*"),
        ("OtherSeed", "PARTS AT chosen: *, which is drawn at random, in the stage pre-*"),
        ("Failing", "PARTS AT answer: none (no idea), the reference has an answer (*; 1 of 4*"),
        ("Mute", "EXACT: 16 values of 4 samples are those of the trace of perfect"),
    ],
    ids=lambda value: value if value.isalpha() else "",
)  # fmt: skip
def test_verdict_names_the_first_that_parts(recorded_trace, method, expected):
    result = recorded_trace(method, "--cpas-parity=out")
    line = verdict(result)
    pytest.LineMatcher([line]).fnmatch_lines([f"parity of perfect on tiny: {expected}"])
    parts = expected.startswith("PARTS")
    assert result.ret == (pytest.ExitCode.TESTS_FAILED if parts else 0)
    result.assert_outcomes(passed=4 + (not parts), failed=int(parts), skipped=1, deselected=28)


def test_what_explains_it_and_what_it_does(recorded_trace):
    told = unfolded(recorded_trace("Scaled", "--cpas-parity=out"))
    told.fnmatch_lines(
        [
            "*explained by: scaled by 1.5",
            "*poses of the answers: up to 0 deg and 0 mm apart (4 of 4 samples that part*)",
            "*outcomes: none is another at any threshold",
            "*PARTS*features: relative L2 5.0e-01*",
        ]
    )
    told = unfolded(recorded_trace("OtherSeed", "--cpas-parity=out"))
    told.fnmatch_lines(["*with what the trace of perfect has drawn: no value parts"])
    told = unfolded(recorded_trace("Mute", "--cpas-parity=out"))
    told.fnmatch_lines(["*named by the reference alone: 4, such as input.depth.0, chosen, *"])


def test_draws_are_taken_over_by_a_map(recorded_trace, pytester):
    (pytester.path / "parity.toml").write_text('replay = ["chosen"]\n')
    result = recorded_trace("OtherSeed", "--cpas-parity=out", "--cpas-parity-map=parity.toml")
    assert verdict(result).endswith(
        "EXACT: 28 values of 4 samples are those of the trace of perfect"
    )


def test_names_and_axes_are_mapped(recorded_trace, pytester):
    (pytester.path / "parity.toml").write_text(
        '[[values]]\nreference = "features"\nhere = "features"\ntranspose = [1, 0]\n'
    )
    result = recorded_trace("Transposed", "--cpas-parity=out", "--cpas-parity-map=parity.toml")
    assert "EXACT: 32 values" in verdict(result)


def test_map_is_proposed(recorded_trace, pytester):
    path = pytester.path / "traced.py"
    path.write_text(
        path.read_text()
        + """
class Renamed(Traced):
    def predict(self, batch, seed):
        import traced
        real, traced.tap = tap, lambda name, x: real(name.replace("features", "encoder.out"), x)
        try:
            return super().predict(batch, seed)
        finally:
            traced.tap = real
"""
    )
    result = recorded_trace("Renamed", "--cpas-parity=out", "--cpas-parity-propose=map.toml")
    assert "EXACT: 28 values" in verdict(result)
    told = (pytester.path / "map.toml").read_text()
    assert told.endswith('[[values]]\nreference = "features"\nhere = "encoder.out"\n')
    result = recorded_trace("Renamed", "--cpas-parity=out", "--cpas-parity-map=map.toml")
    assert "EXACT: 32 values" in verdict(result)


def test_another_method_and_another_revision(traced, pytester):
    def git(*arguments):
        name = ("-c", "user.name=x", "-c", "user.email=x@example.org")
        subprocess.run(["git", *name, *arguments], cwd=pytester.path, check=True)

    assert "EXACT: 32 values" in verdict(traced("Traced", "--cpas-parity=traced:Traced"))
    told = verdict(traced("Scaled", "--cpas-parity=traced:Traced"))
    assert "PARTS AT features" in told
    assert "4 of 4 samples part from traced:Traced here" in told
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "first")
    path = pytester.path / "traced.py"
    path.write_text(path.read_text().replace("scale = 1e-7", "scale = 0.25"))
    told = verdict(traced("Noisy", "--cpas-parity=git:HEAD"))
    assert "PARTS AT features: relative L2 2.5e-01" in told
    assert "part from git:HEAD here" in told
    assert "EXACT: 32 values" in verdict(traced("Scaled", "--cpas-parity=git:HEAD"))
    result = traced("Scaled", "--cpas-parity=git:nothing")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["ERROR: git:nothing: no such revision of *"])


def test_workers_write_and_the_controller_judges(recorded_trace, pytester):
    result = recorded_trace("Scaled", "--cpas-trace=other", "--cpas-parity=out", "-n2")
    assert "trace: 4 samples" in result.stdout.str()
    assert "PARTS AT features" in verdict(result)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    assert len(samples_in(pytester.path / "other" / "perfect" / "tiny")) == 4


def test_reference_is_not_overwritten(cpas):
    assert cpas("Perfect", "-k", "test_parity", "--cpas-trace=kept").ret == 0
    result = cpas("Perfect", "-k", "test_parity", "--cpas-trace=kept", "--cpas-parity=kept")
    assert result.ret == 4
    result.stderr.fnmatch_lines(["*--cpas-trace * would overwrite the trace in *; record into*"])


def test_method_that_raises_is_told(recorded_trace):
    result = recorded_trace("Raises", "--cpas-parity=out", "--cpas-limit=1")
    result.assert_outcomes(failed=2, skipped=1, deselected=25)
    assert "while it was traced, RuntimeError" in result.stdout.str()
    assert "NOT COMPARED: 1 items could not compare their samples" in verdict(result)


def test_other_weights_are_told(recorded_trace, pytester):
    for path in (pytester.path / "out" / "perfect" / "tiny").glob("*.jsonl"):
        path.write_text(path.read_text().replace('"device": "cpu"', '"device": "cuda"'))
    told = unfolded(recorded_trace("Traced", "--cpas-parity=out"))
    told.fnmatch_lines(["*the trace of perfect is of other device: cuda, and here cpu"])


def test_samples_that_are_not_in_the_trace(recorded_trace):
    result = recorded_trace("Traced", "--cpas-parity=out", "--cpas-limit=12")
    assert "32 values of 4 samples are those of the trace of perfect; the trace" in verdict(result)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--cpas-trace=out", "--cpas-trace-max=x"), "--cpas-trace-max is x, expected MiB for a"),
        (("--cpas-trace=out", "--cpas-trace-max=1000"), "above 0 and at most 200"),
        (("--cpas-parity=nowhere",), "unknown method 'nowhere'"),
        (("--cpas-parity=empty",), "empty: no trace of tiny, expected one of perfect on tiny"),
        (("--cpas-parity=out", "--cpas-seed=1"), "recorded under seed 0, and this run has 1"),
        (("--cpas-parity=out", "--cpas-parity-map=none.toml"), "none.toml: no such file"),
    ],
)
def test_what_cannot_be_meant(recorded_trace, pytester, arguments, words):
    pytester.mkdir("empty")
    result = recorded_trace("Traced", *arguments)
    assert result.ret != 0
    assert words in result.stderr.str() + result.stdout.str()


def test_spread_is_measured_and_allowed(traced, pytester):
    """The depth's noise reaches the points; the features do not depend on it."""
    traced("Traced", "--cpas-trace=out", "--cpas-trace-spread")
    [path, *_] = samples_in(pytester.path / "out" / "perfect" / "tiny").values()
    read = read_sample(path)
    spread = {value.name: value.spread for value in read.trace.values}
    assert 0 < spread["input.points"] < 1e-6
    assert spread["features"] == 0
    assert spread["chosen"] is None
    told = read.header.spread_of
    assert told["batch"] == "0.0e+00"
    assert told["float64"] == "not possible: ValueError: no network is tapped by TorchTaps"
    line = json.loads(path.read_text().splitlines()[0])
    assert line["spread_of"] == dict(told)
    assert np.isclose(float(told["noise"]), max(s for s in spread.values() if s), rtol=0.1)
    assert traced("Traced", "--cpas-parity=out").ret == 0


@pytest.mark.parametrize("workers", [(), ("-n2",)])
def test_report_has_the_verdict_and_pictures(recorded_trace, pytester, workers):
    result = recorded_trace("Scaled", "--cpas-parity=out", "--cpas-report=report", *workers)
    content = json.loads((pytester.path / "report" / "report.json").read_text())
    follow_schema(content)
    [run] = content["runs"]
    told = run["parity"]
    assert (run["outcome"], told["outcome"], told["word"]) == ("failed", "failed", "PARTS AT")
    assert (told["reference"], told["compared"]) == ("the trace of perfect", 4)
    parting = told["parting"]
    assert (parting["value"], parting["stage"], parting["samples"]) == ("features", "network", 4)
    assert parting["explained_by"] == ["scaled by 1.5"]
    assert (parting["degrees"], parting["millimetres"], parting["columns"]) == (0, 0, {})
    words = {each["value"]: each["word"] for each in parting["around"]}
    assert words == {"chosen": "EXACT", "input.points": "EXACT", "features": "PARTS"} | {
        f"answer.{name}": "EXACT" for name in ("rotation", "translation")
    } | {"input.depth.0": "EXACT"}
    first = verdict(result).removeprefix("parity of perfect on tiny: ").partition("; ")[0]
    for name in ("report.md", "report.html"):
        text = (pytester.path / "report" / name).read_text()
        assert first in text
        assert "explained by: scaled by 1.5" in text
        assert "features: relative L2 5.0e-01" in text
    # of the only picture that there is of a sample: it is the one that is told
    assert text.count("data:image/webp") == 3
    assert f"features in {parting['sample']}:" in text


def test_report_of_parity_that_passes(recorded_trace, pytester):
    recorded_trace("Noisy", "--cpas-parity=out", "--cpas-report=report")
    content = json.loads((pytester.path / "report" / "report.json").read_text())
    told = content["runs"][0]["parity"]
    assert (told["word"], told["subject"], told["parting"]) == ("FLOAT NOISE", "all", None)
    assert content["runs"][0]["outcome"] == "skipped"  # there is no golden table
    text = (pytester.path / "report" / "report.html").read_text()
    assert "parity with the trace of perfect: FLOAT NOISE" in text
    assert "data:image/webp" not in text


def test_methods_in_another_interpreter(traced, pytester):
    """On both sides; one's draws are taken over by the other."""
    folder = Path(__file__).parents[1] / "remote"
    shutil.copy(folder / "tapping.py", pytester.path)
    python = shlex.quote(sys.executable)
    names = [f"exec:{python}#tapping:{name}" for name in ("Tapping", "OtherSeed")]
    arguments = ("--cpas-dataset=tiny:Tiny", "-k", "test_parity", "--cpas-limit=2")
    (pytester.path / "parity.toml").write_text('replay = ["chosen"]\n')
    for more, expected in (
        ((), "PARTS AT chosen: "),
        (("--cpas-parity-map=parity.toml",), "EXACT: 12 values of 2 samples are those of exec:"),
    ):
        result = pytester.runpytest_inprocess(
            *RUN, f"--cpas-method={names[1]}", *arguments, f"--cpas-parity={names[0]}", *more
        )
        assert expected in verdict(result, "tapping")


def test_recorded_trace_of_another_interpreter_is_replayed_here_and_one_of_here_there(
    traced, pytester
):
    for name in ("tapping.py", "tapping_here.py"):
        shutil.copy(Path(__file__).parents[1] / "remote" / name, pytester.path)
    (pytester.path / "parity.toml").write_text('replay = ["chosen"]\n')
    sides = {
        "there": f"exec:{shlex.quote(sys.executable)}#tapping:Tapping",
        "here": "tapping_here:Here",
    }
    arguments = ("--cpas-dataset=tiny:Tiny", "-k", "test_parity", "--cpas-limit=2")

    def run(side, *more):
        return pytester.runpytest_inprocess(*RUN, f"--cpas-method={sides[side]}", *arguments, *more)

    for side, other in (("there", "here"), ("here", "there")):
        assert run(side, f"--cpas-trace={side}").ret == 0
        assert "PARTS AT chosen: " in verdict(run(other, f"--cpas-parity={side}"), "tapping")
        replayed = run(other, f"--cpas-parity={side}", "--cpas-parity-map=parity.toml")
        assert "EXACT: 12 values of 2 samples are those of the trace" in verdict(
            replayed, "tapping"
        )
