"""Flips that measured moves of other platforms explain are borderline, and no more of them than
that."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from tables import FACTS, Fixed, a_row

from pytest_cpas import cli
from pytest_cpas.facts import fact
from pytest_cpas.golden import GoldenError, Noise, RunTable, Word, compare, read_golden, record
from pytest_cpas.golden.noise import FactNoise, at_least
from pytest_cpas.session import platforms
from pytest_cpas.types import SampleRef

REFS = [SampleRef(id=f"s{i:02d}/0", category="mug", scene=f"s{i:02d}") for i in range(40)]
ROTATION = fact("rotation_deg")


def table(machine="here", noise=None, **rotation) -> RunTable:
    """Every mug is at 4 degrees, or as given, "s01" for s01/0."""
    run = Fixed("m", "d", REFS, identity={"data": "x"})
    run.provenance = {"kernels": machine, "code": "c", "data_code": "d"}
    rows = [
        a_row(r.id, r.category, **{**FACTS, "rotation_deg": rotation.get(r.scene, 4.0)})
        for r in REFS
    ]
    return replace(RunTable.of(run, rows), noise=noise or Noise())


def measured(*moves: float, compared: int = 120) -> Noise:
    """That rotations moved so far, and otherwise nothing."""
    pairs = [(4.0, 4.0 + move) for move in moves] + [(4.0, 4.0)] * (compared - len(moves))
    return Noise(("another kernel",), {"rotation_deg": FactNoise.of(ROTATION, pairs)})


def verdict(golden: RunTable, new: RunTable):
    (mug,) = [v for v in compare(golden, new) if v.category == "mug"]
    return mug


def test_shares_are_never_below_the_true_ones():
    rng = np.random.default_rng(0)
    for count in (0, 1, 2, 3, 7, 8, 60):
        sizes = rng.exponential(1, count) + 0.01
        noise = FactNoise.of(ROTATION, [(4.0, 4.0 + s) for s in sizes] + [(4.0, 4.0)] * 40)
        assert noise.compared == count + 40
        assert noise.largest == pytest.approx(sizes.max(initial=0))
        for size in (*rng.exponential(1, 20), *sizes):
            true = np.mean([*(s >= size - 1e-12 for s in sizes), *[False] * 40])
            assert true <= noise.share(size - 1e-9) <= 2 * true + 1e-12 or size < 0.01


def test_probabilities_are_those_of_all_outcomes():
    chances = [0.3, 0.0, 0.5, 0.01]
    for count in range(6):
        exact = sum(
            math.prod(c if hit else 1 - c for c, hit in zip(chances, hits, strict=True))
            for hits in itertools.product((0, 1), repeat=len(chances))
            if sum(hits) >= count
        )
        assert at_least(count, chances) == pytest.approx(exact)


def test_a_flip_that_the_noise_explains_is_borderline():
    golden = table(s01=4.9, s02=5.1, noise=measured(0.3, 0.01, -0.2))
    new = table("there", s01=5.1, s02=4.9)
    mug = verdict(golden, new)
    assert (mug.word, mug.passed) == (Word.BORDERLINE, True)
    assert "1 samples lost and 1 gained on another platform" in mug.details
    assert "no further than on 1 platforms where that was measured" in mug.details
    assert "lost: s01/0" in mug.details
    # without the measurement, where it was recorded, and further than was measured, it is none
    assert verdict(replace(golden, noise=Noise()), new).word is not Word.BORDERLINE
    assert verdict(golden, table(s01=5.1, s02=4.9)).word is Word.CHANGED
    far = verdict(golden, table("there", s01=5.3, s02=5.1))
    assert far.word is Word.REGRESSED
    # and so it is by another fact
    other = verdict(replace(golden, noise=Noise(("x",), {"iou": FactNoise(9, (0.4,))})), new)
    assert other.word is not Word.BORDERLINE


def test_more_flips_than_the_noise_explains_are_a_regression():
    """Six on the threshold's side where one of 120 moves reached it: 1 / 240 each."""
    near = {f"s{i:02d}": 4.9 for i in range(6)}
    golden = table(**near, noise=measured(0.3))
    one = table("there", **{**near, "s00": 5.1})
    assert verdict(golden, one).word is Word.BORDERLINE
    gone = dict.fromkeys(near, 5.1)
    # as many gained elsewhere: a fair coin would see nothing
    back = {f"s{i:02d}": 5.1 for i in range(10, 16)}
    both = table(**near, **back, noise=measured(0.3))
    mug = verdict(both, table("there", **gone, **dict.fromkeys(back, 4.9)))
    assert mug.word is Word.REGRESSED
    assert "measured moves explain 0.025 of them on average" in mug.details


def test_noise_is_kept_with_the_table_and_with_its_next_recording(tmp_path):
    noise = measured(0.3, 0.01, -0.2)
    folder = record(tmp_path, table(noise=noise))
    assert read_golden(folder).noise == noise
    text = (folder / "run.toml").read_text()
    record(tmp_path, table(s01=4.5))
    assert read_golden(folder).noise == noise
    for before, after in (("0.3", "0.9"), ("compared = 120", "compared = 12"), ("another", "no")):
        (folder / "run.toml").write_text(text.replace(before, after, 1))
        with pytest.raises(GoldenError):
            read_golden(folder)


def stored(cpas, monkeypatch, machine: str, method="Perfect", **how) -> str:
    """The results file of a run on a machine."""
    from pytest_cpas.evaluation import Run

    monkeypatch.setattr(Run, "provenance", {**Run.provenance, "kernels": machine})
    assert cpas(method, f"--cpas-results={machine}").ret == 0
    return f"{machine}/perfect-tiny.jsonl"


def test_other_machines_are_learned_from_their_results(cpas, monkeypatch, capsys, pytester):
    assert cpas("Perfect", "--snapshot-update").ret == 0
    file = stored(cpas, monkeypatch, "theirs")
    capsys.readouterr()
    assert cli.main(["noise", "--results", file]) == 0
    told = capsys.readouterr().out
    assert "measured on 1 platforms" in told
    assert "nothing moved beyond its tolerance" in told
    noise = read_golden(pytester.path / "golden/recorded/perfect/tiny").noise
    assert noise.platforms == (file,)
    assert noise.facts["rotation_deg"] == FactNoise(12, ())
    # no table, a part, no results
    assert cli.main(["noise", "--results", file, "--golden=elsewhere"]) == 1
    assert "record one first" in capsys.readouterr().err
    assert cpas("Perfect", "--cpas-results=part", "--cpas-limit=3").ret == 0
    assert cli.main(["noise", "--results", "part/perfect-tiny.jsonl"]) == 1
    assert "9 samples of the golden table are not there" in capsys.readouterr().err
    assert cli.main(["noise", "--results", "nowhere.jsonl"]) == 1
    assert "nowhere.jsonl" in capsys.readouterr().err


def test_another_program_is_no_platform():
    golden, new = table(), table("there")
    platforms._check_comparable(golden, new, "there")
    for changed, told in (
        (replace(new, provenance={**new.provenance, "code": "e"}), "what moves may be the program"),
        (replace(new, identity={"data": "y"}), "made under other conditions: data was x, now y"),
        (replace(new, provenance={**new.provenance, "deterministic": "no"}), "varies by itself"),
    ):
        with pytest.raises(GoldenError, match=told):
            platforms._check_comparable(golden, changed, "there")


def test_one_machine_stands_for_several(cpas, monkeypatch, capsys, pytester):
    """Each setting is another one, and what runs under it sees it."""
    assert 1 <= len(platforms.settings()) <= 3
    assert cpas("Perfect", "--snapshot-update").ret == 0
    monkeypatch.setattr(platforms, "settings", lambda: [{"OPENBLAS_CORETYPE": "Nehalem"}])
    capsys.readouterr()
    options = ["--cpas-method=tiny:Perfect", "--cpas-dataset=tiny:Tiny", "-p", "no:cacheprovider"]
    assert cli.main(["noise", *options]) == 0
    assert "ran under OPENBLAS_CORETYPE=Nehalem" in capsys.readouterr().out
    noise = read_golden(pytester.path / "golden/recorded/perfect/tiny").noise
    assert noise.platforms == ("OPENBLAS_CORETYPE=Nehalem",)
    # what is no run is told
    assert cli.main(["noise", "--cpas-method=nobody:Nothing", *options[1:]]) == 1
    assert "under OPENBLAS_CORETYPE=Nehalem gave no results" in capsys.readouterr().err
