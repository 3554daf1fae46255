"""Facts that move without a flip are judged: exactly on the platform of the recording, elsewhere by
the signs of the moves, scene by scene."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from tables import FACTS, Fixed, a_row

from pytest_cpas.golden import ELSEWHERE, RunTable, Word, compare
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
    assert first.endswith(f"tolerance: rotation_deg in {len(MUGS)} of {len(MUGS)} samples")
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


# -- seeds, declarations and platforms ------------------------------------------------------


def seeded(machine="here", seeds=3, declared=None, **moves) -> RunTable:
    """The table under several seeds; ``moves``: by seed, the moves of that seed's facts."""
    tables = [table(machine, **moves.get(f"seed{n}", {})) for n in range(seeds)]
    samples = {
        name: replace(
            sample,
            answers=tuple(each.samples[name].answers[0] for each in tables),
            outcomes=tuple(each.samples[name].outcomes[0] for each in tables),
        )
        for name, sample in tables[0].samples.items()
    }
    own = {} if declared is None else declared
    return replace(tables[0], samples=samples, seeds=seeds, provenance={**GOLDEN.provenance, **own})


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("wavers", [False, True])
def test_every_recorded_seed_of_a_deterministic_method_is_guarded(seed, wavers):
    """Whether or not the seeds disagree in some sample."""
    lost = {"seed1": {"rotation_deg": {MUGS[0]: 90.0}}} if wavers else {}
    golden = seeded(**lost)
    assert any(sample.wavers for sample in golden.samples.values()) is wavers
    assert set(words(compare(golden, golden)).values()) == {Word.MATCHES}
    move = {"rotation_deg": turned(0.03, MUGS[1:2])}
    key = f"seed{seed}"
    new = seeded(**{**lost, key: _joined(lost.get(key, {}), move)})
    can, mug = compare(golden, new)
    assert (can.word, mug.word) == (Word.MATCHES, Word.CHANGED)
    assert mug.details.startswith(f"under seed {seed}: ")
    assert MUGS[1] in mug.details
    # elsewhere the seeds may differ by chance
    there = replace(new, provenance={"kernels": "there"})
    assert Word.CHANGED not in words(compare(golden, there)).values()


def _joined(one, other):
    return {key: {**one.get(key, {}), **other.get(key, {})} for key in {*one, *other}}


@pytest.mark.parametrize(("seed", "told"), [("7", 7), ("x", 0), ("", 0), ("1e400", 0)])
def test_a_seed_of_a_file_may_be_any_text(seed, told):
    golden, new = seeded(), seeded(seed0={"rotation_deg": turned(0.03)})
    tables = [replace(table, identity={"data": "x", "seed": seed}) for table in (golden, new)]
    assert compare(*tables)[1].details.startswith(f"under seed {told}: ")


def test_a_run_of_fewer_seeds_is_compared_with_those():
    golden = seeded()
    assert set(words(compare(golden, table())).values()) == {Word.MATCHES}
    moved = table(rotation_deg=turned(0.03))
    assert words(compare(golden, moved))["mug"] is Word.CHANGED


def test_a_declaration_that_changed_loosens_nothing():
    new = table(rotation_deg=turned(0.03))
    new = replace(new, provenance={**new.provenance, "deterministic": "no"})
    mug = compare(GOLDEN, new)[1]
    assert mug.word is Word.CHANGED
    assert "note: deterministic was not recorded, now no" in mug.details


@pytest.mark.parametrize(
    ("then", "now", "same"),
    [
        ("python 3.11.7, PyYAML 6.0.4", "python 3.11.8, PyYAML 6.0.5", True),
        ("python 3.11.7, numpy 2.4.6", "python 3.12.1, numpy 2.4.6", False),
        ("python 3.11.7, numpy 2.4.6", "python 3.11.7, numpy 2.5.0", False),
        ("python 3.11.7, own-ops 1", "python 3.11.7, own-ops 2", False),
        ("python 3.11.7, typing_extensions 4.1", "python 3.11.7", True),
    ],
)
def test_only_what_computes_makes_another_platform(then, now, same):
    golden = replace(GOLDEN, provenance={"packages": then})
    moved = table(rotation_deg=turned(0.03, MUGS[:2]))
    new = replace(moved, provenance={"packages": now})
    can, mug = compare(golden, new)[:2]
    assert mug.word is (Word.CHANGED if same else Word.MATCHES)
    assert (ELSEWHERE in can.details) is not same
    few = {name: sample for name, sample in golden.samples.items() if name < "s04"}
    listed = {"can": 4, "mug": 4}
    small = compare(
        replace(golden, samples=few, listed=listed),
        replace(new, samples={name: moved.samples[name] for name in few}, listed=listed),
    )
    if not same:
        assert "2 scenes are too few to tell one from chance" in small[0].details


def test_what_got_worse_is_not_called_improved():
    """A sample is won, and all others turned a little further."""
    golden = table(rotation_deg={MUGS[0]: 90.0})
    new = table(rotation_deg=turned(0.03, MUGS[1:]))
    for there in ("here", "there"):
        moved = replace(new, provenance={"kernels": there, "code": there})
        mug = compare(golden, moved)[1]
        assert mug.word is (Word.REGRESSED if there == "there" else mug.word)
        assert mug.word in (Word.CHANGED, Word.REGRESSED)
        assert mug.details.startswith("facts got worse in more samples than better: rotation_deg")
    assert compare(golden, table())[1].word is Word.IMPROVED


@pytest.mark.parametrize(("tolerance", "word"), [(None, Word.CHANGED), ("0.001", Word.MATCHES)])
def test_the_tolerance_that_was_declared_is_kept(tolerance, word):
    declared = {} if tolerance is None else {"tolerance": tolerance}
    golden = replace(GOLDEN, provenance={**GOLDEN.provenance, **declared})
    moved = table(position_m=dict.fromkeys(MUGS, 5e-4))
    assert words(compare(golden, moved))["mug"] is word
    hair = table(position_m=dict.fromkeys(MUGS, 5e-6))
    assert words(compare(GOLDEN, hair))["mug"] is Word.MATCHES


def on(device: str, made: RunTable) -> RunTable:
    return replace(made, identity={**made.identity, "device": device})


def test_another_device_is_another_platform():
    golden = on("cpu", GOLDEN)
    moved = turned(0.03)
    alternating = {name: step * (-1) ** i for i, (name, step) in enumerate(moved.items())}
    same, elsewhere = (
        compare(golden, on(device, table(rotation_deg=alternating))) for device in ("cpu", "cuda")
    )
    assert words(same) == {"can": Word.MATCHES, "mug": Word.CHANGED}
    assert words(elsewhere) == {"can": Word.MATCHES, "mug": Word.MATCHES}
    assert f"{ELSEWHERE} (device was cpu, now cuda)" in elsewhere[1].details


def test_what_is_worse_on_another_device_is_worse():
    verdicts = compare(on("cpu", GOLDEN), on("cuda", table(rotation_deg=turned(0.03))))
    assert words(verdicts)["mug"] is Word.REGRESSED


def test_whose_device_is_not_known_is_not_comparable():
    [verdict] = compare(on("cpu", GOLDEN), table())
    assert verdict.word is Word.STALE
    assert "device was cpu, now not given" in verdict.details


def test_other_conditions_are_other_ones_on_any_device():
    new = replace(GOLDEN, identity={"data": "y", "device": "cuda"})
    [verdict] = compare(on("cpu", GOLDEN), new)
    assert verdict.word is Word.STALE
    assert "data was x, now y" in verdict.details
    assert "device" not in verdict.details
