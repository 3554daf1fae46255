"""Facts that move without a flip are judged: exactly on the platform of the recording, elsewhere by
the signs of the moves, scene by scene."""

import itertools

import numpy as np
import pytest
from tables import FACTS, Fixed, a_row

from pytest_cpas.golden import RunTable, Word, compare
from pytest_cpas.golden.drift import Drift
from pytest_cpas.types import SampleRef

SCENES, EACH = 60, 2
REFS = [
    SampleRef(id=f"s{i:02d}/{j}", category="mug" if i % 2 else "can", scene=f"s{i:02d}")
    for i in range(SCENES)
    for j in range(EACH)
]
MUGS = [ref.id for ref in REFS if ref.category == "mug"]


def table(machine="here", deterministic=True, **moves) -> RunTable:
    """``moves``: by fact, what is added to it, by sample; every sample starts from other facts."""
    run = Fixed("m", "d", REFS, identity={"data": "x"})
    run.provenance = {"kernels": machine, "code": machine}
    if not deterministic:
        run.provenance = {**run.provenance, "deterministic": "no"}
    rng = np.random.default_rng(0)
    rows = []
    for ref in REFS:
        facts = {name: value * rng.uniform(0.91, 0.99) for name, value in FACTS.items()}
        for name, added in moves.items():
            facts[name] += added.get(ref.id, 0.0)
        rows.append(a_row(ref.id, ref.category, **facts))
    return RunTable.of(run, rows)


GOLDEN = table()


def words(verdicts) -> dict[str, Word]:
    return {verdict.category: verdict.word for verdict in verdicts}


def turned(share: float, among=MUGS) -> dict[str, float]:
    old = GOLDEN.samples
    return {name: share * old[name].facts["rotation_deg"] for name in among}


def test_a_deterministic_method_that_moved_where_it_was_recorded_is_changed():
    new = table(rotation_deg=turned(0.03))
    assert GOLDEN.table == new.table
    can, mug = compare(GOLDEN, new)
    assert (can.word, mug.word, mug.failed) == (Word.MATCHES, Word.CHANGED, True)
    assert f"rotation_deg moved in {len(MUGS)} of {len(MUGS)} samples" in mug.details
    assert "median move +0.1" in mug.details
    # which is said in one line as well, and in which columns it is judged
    first = mug.details.splitlines()[0]
    assert first.endswith(f"themselves: rotation_deg in {len(MUGS)} of {len(MUGS)} samples")
    assert "; judged in 10 deg, 2 cm; 10 deg, 2 cm, F 0.6; " in mug.details
    # in a single sample as well, and for the better
    assert words(compare(GOLDEN, table(rotation_deg=turned(-0.03, MUGS[:1])))) == {
        "can": Word.MATCHES,
        "mug": Word.CHANGED,
    }


@pytest.mark.parametrize("fact", list(FACTS))
def test_every_fact_is_guarded(fact):
    sign = 1 if fact in ("position_m", "rotation_deg", "nad") else -1
    moves = {name: sign * 0.01 * GOLDEN.samples[name].facts[fact] for name in MUGS}
    moved = table(**{fact: moves})
    assert GOLDEN.table == moved.table
    assert words(compare(GOLDEN, moved))["mug"] is Word.CHANGED
    (mug,) = [v for v in compare(GOLDEN, table("there", **{fact: moves})) if v.category == "mug"]
    assert mug.word is Word.REGRESSED
    assert mug.details.splitlines()[0].endswith(f"than another platform moves: {fact} worse")
    assert f"{fact} moved in {len(MUGS)} of {len(MUGS)} samples" in mug.details


def test_what_is_within_the_tolerance_is_a_tie():
    new = table(rotation_deg=turned(0.0005))
    assert set(words(compare(GOLDEN, new)).values()) == {Word.MATCHES}
    elsewhere = table("there", rotation_deg=turned(0.0005))
    assert set(words(compare(GOLDEN, elsewhere)).values()) == {Word.MATCHES}


def test_moves_of_another_platform_go_both_ways():
    rng = np.random.default_rng(1)
    moves = {name: rng.normal(0, 0.02) for name in MUGS}
    both_ways = table("there", rotation_deg=moves)
    (mug,) = [v for v in compare(GOLDEN, both_ways) if v.category == "mug"]
    assert mug.word is Word.MATCHES
    assert "note: rotation_deg moved in" in mug.details
    # another machine, and all of them worse
    worse = table("there", rotation_deg={name: abs(move) for name, move in moves.items()})
    (mug,) = [v for v in compare(GOLDEN, worse) if v.category == "mug"]
    assert mug.word is Word.REGRESSED
    better = table("there", rotation_deg={name: -abs(move) for name, move in moves.items()})
    (mug,) = [v for v in compare(GOLDEN, better) if v.category == "mug"]
    assert mug.word is Word.IMPROVED


def test_samples_of_one_scene_are_one_witness():
    """All worse, but in three scenes only: as probable as three coins."""
    few = [name for name in MUGS if name.startswith(("s01", "s03", "s05"))]
    assert set(words(compare(GOLDEN, table("there", rotation_deg=turned(0.03, few)))).values()) == {
        Word.MATCHES
    }


def test_all_categories_together_have_more_scenes_than_each():
    """Worse in eight scenes of either: eight coins say too little, sixteen enough; level 5 %."""
    among = [r.id for r in REFS if int(r.scene[1:]) < 16]
    moved = table("there", rotation_deg=turned(0.03, among))
    assert words(compare(GOLDEN, moved, alarm=0.05)) == {
        "can": Word.MATCHES,
        "mug": Word.MATCHES,
        "all": Word.REGRESSED,
    }


def test_a_method_that_varies_by_declaration_is_judged_by_signs():
    moves = turned(0.03, MUGS[:3])
    varies = table(deterministic=False, rotation_deg=moves)
    golden = table(deterministic=False)
    assert set(words(compare(golden, varies)).values()) == {Word.MATCHES}
    assert "note: rotation_deg moved in 3" in "".join(v.details for v in compare(golden, varies))
    all_worse = table(deterministic=False, rotation_deg=turned(0.03))
    assert words(compare(golden, all_worse))["mug"] is Word.REGRESSED


def test_a_flip_stays_what_it_is_and_names_the_drift():
    new = table(rotation_deg={**turned(0.03), MUGS[0]: 20.0})
    (mug,) = [v for v in compare(GOLDEN, new) if v.category == "mug"]
    assert mug.word is Word.REGRESSED
    assert "note: rotation_deg moved in" in mug.details


def on_a_threshold(machine, **added) -> RunTable:
    """Every mug has 5 degrees but for what is added, in units of 1e-4 degrees."""
    exact = {name: 5.0 - GOLDEN.samples[name].facts["rotation_deg"] for name in MUGS}
    moves = {name: exact[name] + 1e-4 * added.get(name.replace("/", "_"), 0) for name in MUGS}
    return table(machine, rotation_deg=moves)


def test_flips_of_what_lies_on_a_threshold_are_borderline_elsewhere():
    signs = {name.replace("/", "_"): (-1) ** i for i, name in enumerate(MUGS)}
    golden = on_a_threshold("here", **signs)
    new = on_a_threshold("there", **{name: -sign for name, sign in signs.items()})
    (mug,) = [v for v in compare(golden, new) if v.category == "mug"]
    assert (mug.word, mug.passed) == (Word.BORDERLINE, True)
    assert "30 samples lost and 30 gained on another platform" in mug.details
    assert mug.details.splitlines()[0].endswith(
        "across a threshold of 5 deg, 1 cm; 5 deg, 1 cm, F 0.8; 5 deg, 5 cm"
    )
    # where it was recorded, a flip is a flip
    again = on_a_threshold("here", **{name: -sign for name, sign in signs.items()})
    assert words(compare(golden, again))["mug"] is Word.CHANGED


def test_more_of_them_worse_than_chance_is_a_regression():
    golden = on_a_threshold("here", **dict.fromkeys([n.replace("/", "_") for n in MUGS], -1))
    new = on_a_threshold("there", **dict.fromkeys([n.replace("/", "_") for n in MUGS], 1))
    (mug,) = [v for v in compare(golden, new) if v.category == "mug"]
    assert mug.word is Word.REGRESSED
    assert "improbable on either platform" in mug.details


def test_a_real_flip_is_none_of_the_borderline():
    new = table("there", rotation_deg={MUGS[0]: 2.0})
    assert words(compare(GOLDEN, new))["mug"] is Word.REGRESSED


def test_tails_are_those_of_all_signs():
    rng = np.random.default_rng(2)
    for _ in range(50):
        nets = rng.integers(-4, 5, rng.integers(1, 9)).tolist()
        sums = [
            sum(s * abs(n) for s, n in zip(signs, nets, strict=True))
            for signs in itertools.product((1, -1), repeat=len(nets))
        ]
        at_least = np.mean([total >= sum(nets) for total in sums])
        at_most = np.mean([total <= sum(nets) for total in sums])
        drift = Drift("nad", [], 0, nets)
        assert (drift.worse, drift.better) == pytest.approx((at_least, at_most))


def test_unchanged_runs_on_another_platform_keep_the_level():
    """Moves whose signs are drawn scene by scene: alarms at most as often as asked for."""
    rng = np.random.default_rng(3)
    alarm, runs, alarms = 0.05, 300, 0
    for _ in range(runs):
        moves = {}
        for fact, size in (("rotation_deg", 0.05), ("position_m", 1e-4), ("iou", 1e-2)):
            signs = {f"s{i:02d}": rng.choice((-1, 1)) for i in range(SCENES)}
            moves[fact] = {r.id: signs[r.scene] * rng.uniform(0, size) for r in REFS}
        verdicts = compare(GOLDEN, table("there", **moves), alarm=alarm)
        alarms += any(verdict.failed for verdict in verdicts)
    # 1 in 10000 that as many come of the level itself
    assert alarms <= 31, alarms
