"""Facts of methods that jitter are judged by their ranks among the recorded seeds."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from tables import FACTS, Fixed

from pytest_cpas.evaluation import Answer, Row
from pytest_cpas.facts import all_facts, fact
from pytest_cpas.golden import RunTable, Word, compare
from pytest_cpas.golden.ranks import SHIFTS, Moves, bounds
from pytest_cpas.golden.spread import DOUBT, Answers, Spread
from pytest_cpas.metrics.precision import Count
from pytest_cpas.types import SampleRef

INDEPENDENT = np.eye(1 + len(SHIFTS.sizes))[0]
ROTATION = fact("rotation_deg")


def moves_of(values, drawn, made=ROTATION) -> Moves:
    return Moves(made, values[:, :-drawn], values[:, -drawn:])


@pytest.mark.parametrize(
    ("seeds", "drawn", "samples"), [(3, 1, 4), (2, 2, 3), (5, 1, 3), (3, 2, 3), (1, 1, 6)]
)
def test_bounds_are_never_below_the_probability_over_all_exchanges(seeds, drawn, samples):
    """Any of the values of a sample could have been the run's: count them all."""
    rng = np.random.default_rng(1)
    total = seeds + drawn
    picks = [list(pick) for pick in itertools.combinations(range(total), drawn)]
    every = np.ones(samples, bool)
    for ties in (0, 1, 1, 9):
        values = np.round(rng.lognormal(1, 1, (samples, total)), ties)
        values[0, :2] = np.inf
        moves = moves_of(values, drawn)
        scores = moves.ranks - moves.ranks.mean(axis=1, keepdims=True)
        scores = scores / np.maximum(scores.std(axis=1, keepdims=True), 1e-12)
        sums = np.array(
            [
                sum(scores[i, pick].sum() for i, pick in enumerate(way))
                for way in itertools.product(picks, repeat=samples)
            ]
        )
        seen = scores[:, seeds:].sum()
        worse, better = bounds(moves, every, INDEPENDENT)
        assert np.mean(sums >= seen - 1e-9) <= worse.p * (1 + 1e-9)
        assert np.mean(sums <= seen + 1e-9) <= better.p * (1 + 1e-9)
        # where the run has the worst of every sample, it is exact
        values = np.sort(values[1:], axis=1) + 10 * np.arange(total)
        worst, _ = bounds(moves_of(values, drawn), every[1:], INDEPENDENT)
        assert worst.p == pytest.approx(float(len(picks)) ** (1 - samples), rel=0.02)


@pytest.mark.parametrize("made", all_facts(), ids=lambda made: made.name)
def test_ranks_of_every_fact(made):
    """The worst last, who failed behind all, ties within the tolerance, n/a left out."""
    sign = 1 if made.better == "lower" else -1
    close = 0.5 + sign * 0.4 * max(0.5e-3, made.finest)
    values = np.array(
        [
            [0.5, 0.5 + sign * 0.2, 0.5 - sign * 0.2, made.failed],
            [0.5, close, 0.5 + sign * 0.2, 0.5 - sign * 0.2],
            [made.failed, made.failed, 0.5, 0.4],
            [0.5, np.nan, 0.5, 0.5],
        ]
    )
    if made.finest >= 1e-3:
        values *= 100
    moves = moves_of(values, 1, made)
    first, last = (0, 2) if sign < 0 else (2, 0)
    assert moves.ranks[:2].tolist() == [[2, 4, 0, 6], [3, 3, 6, 0]]
    assert moves.ranks[2].tolist() == [5, 5, first, last]
    assert moves.known.tolist() == [True, True, True, False]
    assert bounds(moves, np.array([False, False, False, True]), INDEPENDENT) is None


def test_values_far_apart_are_no_ties_though_each_is_close_to_the_next():
    steps = (1 + 0.9e-3) ** np.arange(12)
    moves = moves_of(4.0 * steps[None], 1)
    assert len(set(moves.ranks[0])) > 4
    assert moves.ranks[0].tolist() == sorted(moves.ranks[0])


def answers_of(values, drawn, spread=2) -> Answers:
    """Of samples whose counts never change; ``values`` (n, K + J) of one fact."""
    samples, total = values.shape
    correct = np.ones((samples, total, 1), bool)
    return Answers(
        np.where(np.arange(samples) % spread, "mug", "can"),
        correct[:, drawn:],
        correct[:, :drawn],
        np.ones((samples, 1), bool),
        {"rotation_deg": moves_of(values, drawn)},
    )


@pytest.mark.parametrize("drawn", [1, 3])
def test_p_of_facts_holds_for_a_run_without_a_change(drawn):
    rng = np.random.default_rng(2)
    level = rng.lognormal(1, 1, (40, 1))
    below = 0
    for _ in range(300):
        values = level * rng.lognormal(0, 0.3, (40, 5 + drawn))
        spread = Spread(answers_of(values, drawn))
        p = [spread.p(s, "rotation_deg", better=b) for s in ("can", "mug", "all") for b in (0, 1)]
        below += min(p) < DOUBT
    assert Count(below, 300).interval(0.98)[0] < DOUBT


def test_a_small_growth_in_most_samples_is_seen_and_the_more_seeds_the_sooner():
    rng = np.random.default_rng(3)
    level = rng.lognormal(1, 1, (126, 1))
    found = []
    for seeds, drawn in ((5, 1), (20, 1), (20, 5)):
        values = level * rng.lognormal(0, 0.3, (126, seeds + drawn))
        values[:, -drawn:] *= 1.2
        found.append(Spread(answers_of(values, drawn)).p("all", "rotation_deg"))
    assert found == sorted(found, reverse=True)
    assert found[-1] < 1e-9


def test_seeds_that_move_all_samples_together_are_believed():
    rng = np.random.default_rng(4)
    luck = np.array([1.0, 1.3, 0.8, 1.2, 0.7, 1.3])
    values = rng.lognormal(1, 1, (200, 1)) * rng.lognormal(0, 0.3, (200, 6)) * luck
    together = Spread(answers_of(values, 1)).p("all", "rotation_deg")
    # what these seeds would mean if each had its luck in every sample anew
    values[:, :-1] = np.array([rng.permutation(row) for row in values[:, :-1]])
    assert together > DOUBT
    assert Spread(answers_of(values, 1)).p("all", "rotation_deg") < 1e-4


def test_facts_that_put_seeds_in_the_same_order_are_asked_about_once():
    rng = np.random.default_rng(5)
    values = rng.lognormal(1, 1, (40, 6))
    values[:, -1] *= 4
    alone = answers_of(values, 1)
    twice = replace(alone, facts={**alone.facts, "add_m": moves_of(values / 7, 1, fact("add_m"))})
    assert Spread(twice).p("all", "add_m") == Spread(alone).p("all", "rotation_deg")
    other = moves_of(rng.lognormal(1, 1, (40, 6)), 1, fact("add_m"))
    more = replace(alone, facts={**alone.facts, "add_m": other})
    assert Spread(more).p("all", "rotation_deg") > Spread(alone).p("all", "rotation_deg")


def test_facts_take_nothing_from_losses():
    """However many facts a protocol needs, their share of the level is the same."""
    rng = np.random.default_rng(6)
    correct = rng.random((60, 6, 1)) < 0.9
    correct[:8, :5], correct[:8, 5:] = True, False
    none = Answers(np.repeat("can", 60), correct[:, :5], correct[:, 5:], np.ones((60, 1), bool))
    facts = {
        name: moves_of(rng.lognormal(1, 1, (60, 6)), 1, fact(name))
        for name in ("rotation_deg", "position_m", "nad", "iou", "add_m")
    }
    for count in (1, 5):
        some = replace(none, facts=dict(itertools.islice(facts.items(), count)))
        assert Spread(some).p("all", 0) == pytest.approx(Spread(none).p("all", 0), rel=1e-3)


# -- verdicts -----------------------------------------------------------------------------------

REFS = [
    SampleRef(id=f"s{i:02d}", category="mug" if i % 2 else "can", scene=f"s{i:02d}")
    for i in range(60)
]
MUGS = {ref.id for ref in REFS if ref.category == "mug"}


def table(seeds, chance, *, wavers=True, **factors) -> RunTable:
    """Facts that vary a little with the seed, in mugs times ``factors``; can s00 comes and goes."""
    run = Fixed("m", "d", REFS, identity={"data": "x"})
    run.provenance, run.seeds = {"deterministic": "no"}, seeds
    rng = np.random.default_rng(chance)
    rows = []
    for ref in REFS:
        answers = []
        for seed in range(seeds):
            facts = {name: value * rng.uniform(0.94, 0.96) for name, value in FACTS.items()}
            for name in factors if ref.id in MUGS else ():
                facts[name] *= factors[name]
            if wavers and ref.id == "s00" and seed % 2:
                facts["rotation_deg"] = 40.0
            answers.append(Answer(facts=facts))
        rows.append(Row(sample=ref.id, category=ref.category, answers=tuple(answers)))
    return RunTable.of(run, rows)


@pytest.mark.parametrize("wavers", [True, False], ids=["spread", "seeds agree"])
@pytest.mark.parametrize("seeds", [1, 3])
@pytest.mark.parametrize("name", list(FACTS))
def test_every_fact_is_guarded_under_jitter(name, seeds, wavers):
    golden = table(10, 1, wavers=wavers)
    worse = 1.008 if fact(name).better == "lower" else 0.992

    def verdict(**factors):
        new = table(seeds, 2, wavers=wavers, **factors)
        assert golden.table == new.table
        return next(v for v in compare(golden, new) if v.category == "mug")

    assert verdict().word is Word.MATCHES
    moved = verdict(**{name: worse})
    assert (moved.word, moved.failed) == (Word.REGRESSED, True)
    assert f"{name} moved in 30 of 30 samples, median move " in moved.details
    assert " (10 recorded seeds; p = " in moved.details
    assert verdict(**{name: worse**-2}).word is Word.IMPROVED


def test_what_is_improbable_but_not_enough_is_probably_worse():
    golden = table(10, 1)
    for growth in np.linspace(1.0, 1.01, 21):
        mug = next(
            v for v in compare(golden, table(1, 2, rotation_deg=growth)) if v.category == "mug"
        )
        if mug.word is not Word.MATCHES:
            break
    assert mug.word is Word.PROBABLY_WORSE
    assert "rotation_deg moved in" in mug.details
    assert "to be sure, judge it under more seeds than 1" in mug.details


def test_other_definitions_are_not_compared():
    golden, new = table(10, 1), table(1, 2, rotation_deg=1.01)
    new = replace(new, definitions={**new.definitions, "rotation_deg": "other:1"})
    verdicts = compare(golden, new)
    assert not any("rotation_deg moved" in verdict.details for verdict in verdicts)
    assert [v.word for v in verdicts if v.failed] == [Word.STALE]
