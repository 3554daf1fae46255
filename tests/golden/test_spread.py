"""Whether a run differs by more than seeds do: exact truths, and simulations."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from tables import a_run

from pytest_cpas.evaluation import Row
from pytest_cpas.golden import RunTable
from pytest_cpas.golden.comparison import Word, compare
from pytest_cpas.golden.spread import detectable_loss, fewer, more
from pytest_cpas.types import SampleRef


@pytest.mark.parametrize(("lost", "gained", "same"), [(5, 0, 3), (7, 2, 0), (1, 4, 9), (0, 0, 4)])
def test_one_recorded_run_is_mcnemar(lost, gained, same):
    recorded = np.array([[True]] * lost + [[False]] * gained + [[True]] * same)
    new = np.array([False] * lost + [True] * gained + [True] * same)
    if lost + gained:
        less = stats.binomtest(gained, lost + gained, 0.5, alternative="less").pvalue
        greater = stats.binomtest(gained, lost + gained, 0.5, alternative="greater").pvalue
    else:
        less = greater = 1.0
    assert fewer(recorded, new) == pytest.approx(less, rel=1e-12)
    assert more(recorded, new) == pytest.approx(greater, rel=1e-12)


def test_several_recorded_runs_against_all_exchanges():
    """Every one of the K + 1 runs of a sample could have been the new one: count them all."""
    rng = np.random.default_rng(1)
    for _ in range(5):
        answers = rng.random((4, 4)) < 0.6  # 3 recorded seeds and the new run
        recorded, new = answers[:, :3], answers[:, 3]
        totals = [
            sum(answers[i, pick] for i, pick in enumerate(picks))
            for picks in itertools.product(range(4), repeat=4)
        ]
        expected = np.mean([total <= new.sum() for total in totals])
        assert fewer(recorded, new) == pytest.approx(expected, rel=1e-12)
        expected = np.mean([total >= new.sum() for total in totals])
        assert more(recorded, new) == pytest.approx(expected, rel=1e-12)


def test_samples_that_all_agree_on_say_nothing():
    recorded = np.array([[True, False, True], [False, True, True]])
    new = np.array([False, True])
    alone = fewer(recorded, new)
    beside = np.vstack([recorded, np.ones((50, 3), bool), np.zeros((50, 3), bool)])
    added = np.concatenate([new, np.ones(50, bool), np.zeros(50, bool)])
    assert fewer(beside, added) == pytest.approx(alone, rel=1e-12)


def chances(rng, count):
    """Probabilities to be correct: most samples are easy or hopeless, some are in between."""
    middle = rng.random(count)
    return np.where(rng.random(count) < 0.2, middle, (rng.random(count) < 0.7).astype(float))


@pytest.mark.parametrize("seeds", [2, 5])
def test_no_alarm_in_2000_runs_without_a_change(seeds):
    rng = np.random.default_rng(seeds)
    chance = chances(rng, 400)
    recorded = rng.random((400, seeds)) < chance[:, None]
    p = [fewer(recorded, rng.random(400) < chance) for _ in range(2000)]
    assert min(p) > 1e-5
    # and the test is not merely blind
    assert np.mean(np.array(p) < 0.1) > 0.01


def test_detectable_loss_is_called_and_one_less_is_not():
    rng = np.random.default_rng(3)
    recorded = rng.random((400, 5)) < chances(rng, 400)[:, None]
    loss = detectable_loss(recorded, 1e-7)
    assert 5 <= loss <= 30
    easy = np.flatnonzero(recorded.all(axis=1))
    for lost, called in ((loss, True), (loss - 1, False)):
        new = recorded[:, 0].copy()
        new[easy[:lost]] = False
        assert (fewer(recorded, new) < 1e-7) == called
    assert detectable_loss(recorded[:3], 1e-7) is None


def test_seeds_that_move_all_samples_together_raise_no_alarm():
    """Each seed has good or bad luck in everything: the samples are not independent."""
    rng = np.random.default_rng(4)
    luck = np.array([0.5, 0.6, 0.7, 0.8, 0.55])
    recorded = rng.random((500, 5)) < luck
    unlucky = rng.random(500) < 0.48
    assert fewer(recorded, unlucky) > 1e-3
    # what these seeds would mean if samples were taken for independent
    shuffled = np.array([rng.permutation(row) for row in recorded])
    assert fewer(shuffled, unlucky) < 1e-6


def tables(answers, run=None):
    """A run's table, and of further seeds its repeats: from correct or not (n, K)."""
    refs = [
        SampleRef(id=f"s/{i:05d}", category="mug" if i % 2 else "can", scene="s")
        for i in range(len(answers))
    ]
    run = run or a_run()
    run.seeds = answers.shape[1]
    run.listed = {"can": (len(refs) + 1) // 2, "mug": len(refs) // 2}
    rows = [
        Row(
            sample=ref.id,
            category=ref.category,
            translation_error=0.005,
            rotation_error=4.0 if own[0] else 40.0,
            iou=None,
            fscore_1cm=None,
            repeats=" ".join("1-1-" if answer else "0-0-" for answer in own[1:]),
        )
        for ref, own in zip(refs, answers, strict=True)
    ]  # fmt: skip
    return RunTable.of(run, rows)


def test_verdicts_within_and_beyond_the_spread():
    rng = np.random.default_rng(5)
    chance = chances(rng, 600)
    golden = tables(rng.random((600, 5)) < chance[:, None])
    same = compare(golden, tables(rng.random((600, 1)) < chance[:, None]))
    assert [(v.category, v.word) for v in same] == [
        ("can", Word.MATCHES),
        ("mug", Word.MATCHES),
        ("all", Word.MATCHES),
    ]
    assert "within the spread of the 5 recorded seeds; a loss of " in same[0].details
    worse, better = chance.copy(), chance.copy()
    worse[1:200:2] = 0
    better[1:200:2] = 1
    verdicts = compare(golden, tables(rng.random((600, 1)) < worse[:, None]))
    assert [v.word for v in verdicts] == [Word.MATCHES, Word.REGRESSED, Word.REGRESSED]
    assert "lost: s/00001 (0.5 cm, 4 deg -> 0.5 cm, 40 deg)" in verdicts[1].details
    assert "5 recorded seeds: " in verdicts[1].details
    verdicts = compare(golden, tables(rng.random((600, 1)) < better[:, None]))
    assert [v.word for v in verdicts] == [Word.MATCHES, Word.IMPROVED, Word.IMPROVED]


def test_too_few_samples_or_seeds_are_not_checked():
    golden = tables(np.array([[True, True], [True, False], [True, True], [True, True]]))
    verdicts = compare(golden, tables(np.zeros((4, 1), bool)))
    assert {v.word for v in verdicts} == {Word.NOT_CHECKED}
    assert "2 seeds of so few samples cannot show a loss at 10 deg, 2 cm" in verdicts[0].details


def test_part_of_a_spread_is_compared_and_not_checked():
    rng = np.random.default_rng(6)
    chance = chances(rng, 600)
    golden = tables(rng.random((600, 5)) < chance[:, None])
    new = tables(rng.random((600, 1)) < chance[:, None])
    part = replace(new, samples=dict(list(new.samples.items())[:500]))
    assert {v.word for v in compare(golden, part)} == {Word.NOT_CHECKED}


def test_seeds_that_all_agree_allow_no_flip():
    answers = np.arange(40)[:, None] % 3 > 0
    golden = tables(np.repeat(answers, 4, axis=1))
    assert golden.seeds == 4
    new = answers.copy()
    new[4] ^= True
    assert [v.word for v in compare(golden, tables(new))] == [Word.REGRESSED, Word.MATCHES]
