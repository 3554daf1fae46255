"""A sample that was answered and fails now is lost under every protocol; losses stand first."""

from dataclasses import replace

import pytest
from tables import REFS, Fixed

from pytest_cpas.evaluation import Answer, Row
from pytest_cpas.facts import fact
from pytest_cpas.golden import RunTable, Word, compare, read_golden, record
from pytest_cpas.protocols import RankedDetection, Ranking, shipped_protocol, shipped_protocols

MUGS = [ref.id for ref in REFS if ref.category == "mug"]
SHIPPED = list(shipped_protocols())


def table(protocol: str, failed=(), seeds=((),), **facts: float) -> RunTable:
    """Right answers but for those of samples that ``failed``; ``seeds``: who failed, per seed."""
    run = Fixed("m", "d", REFS, identity={"data": "x"}, protocols=[shipped_protocol(protocol)])
    run.seeds = len(seeds)
    if run.seeds > 1:
        run.provenance = {"deterministic": "no"}
    right = {name: 0.001 if fact(name).better == "lower" else 0.999 for name in run.facts} | facts
    wrong = {name: fact(name).failed for name in run.facts}
    return RunTable.of(
        run,
        [
            Row(
                sample=ref.id,
                category=ref.category,
                answers=tuple(
                    Answer(facts=wrong, failure="not detected")
                    if ref.id in {*failed, *others}
                    else Answer(facts=right)
                    for others in seeds
                ),
            )
            for ref in REFS
        ],
    )


@pytest.mark.parametrize("protocol", SHIPPED)
@pytest.mark.parametrize("number", [1, 3, 5])
def test_who_fails_now_is_lost_under_every_protocol(protocol, number):
    golden, new = table(protocol), table(protocol, MUGS[:number])
    can, mug = compare(golden, new)
    assert (can.word, mug.word, mug.failed) == (Word.MATCHES, Word.REGRESSED, True)
    assert f"answered: 5 -> {5 - number} of 5" in mug.details
    assert "lost: " in mug.details
    assert all(name in mug.details for name in MUGS[:number])
    can, mug = compare(new, golden)
    assert (can.word, mug.word) == (Word.MATCHES, Word.IMPROVED)
    assert compare(new, new)[1].word is Word.MATCHES


def test_who_fails_beside_several_seeds_that_answered():
    golden = table("omni6dpose", seeds=[()] * 5)
    assert compare(golden, golden)[1].word is Word.MATCHES
    assert compare(golden, table("omni6dpose", MUGS[:1]))[1].word is Word.REGRESSED
    two_seeds = table("omni6dpose", seeds=[(), MUGS[:1]])
    assert compare(golden, two_seeds)[1].word is Word.REGRESSED
    # whose failures come and go loses nothing by one more
    at_times = table("omni6dpose", seeds=[(), MUGS[:1], MUGS[1:2], ()])
    assert compare(at_times, table("omni6dpose", MUGS[2:3]))[1].word is Word.MATCHES


def test_who_fails_where_outcomes_vary_by_seed():
    golden = table("cpas", seeds=[()] * 5)
    can = golden.samples[REFS[0].id]
    varies = replace(can, outcomes=(*can.outcomes[1:], "0" * len(can.outcome)))
    golden = replace(golden, samples={**golden.samples, REFS[0].id: varies})
    assert {v.word for v in compare(golden, table("cpas"))} <= {Word.MATCHES, Word.CANNOT_TELL}
    told = {v.category: v for v in compare(golden, table("cpas", MUGS[:1]))}
    assert (told["mug"].word, told["all"].word) == (Word.REGRESSED, Word.REGRESSED)
    assert f"answered: 5 -> 4 of 5\n      lost: {MUGS[0]}" in told["mug"].details
    assert told["can"].word is not Word.REGRESSED


@pytest.mark.parametrize("protocol", SHIPPED)
@pytest.mark.parametrize("name", ["iou", "fscore_1cm"])
def test_box_and_shape_are_guarded_under_every_protocol(protocol, name):
    golden, moved = table(protocol), table(protocol, **{name: 0.99})
    can, mug = compare(golden, moved)
    assert (can.word, mug.word) == (Word.CHANGED, Word.CHANGED)
    assert f"{name} moved in 5 of 5 samples" in mug.details


@pytest.mark.parametrize("protocol", SHIPPED)
def test_a_table_that_lacks_box_and_shape_is_compared_without(protocol, tmp_path):
    golden = table(protocol)
    needed = {made.name for each in golden.protocols for c in each.columns for made in c.facts}
    extra = {"iou", "fscore_1cm"} - needed
    golden = replace(
        golden,
        definitions={k: v for k, v in golden.definitions.items() if k not in extra},
        samples={
            name: replace(
                sample,
                answers=tuple(
                    replace(a, facts={k: v for k, v in a.facts.items() if k not in extra})
                    for a in sample.answers
                ),
            )
            for name, sample in golden.samples.items()
        },
    )
    golden = read_golden(record(tmp_path, golden))
    moved = table(protocol, **dict.fromkeys(extra, 0.99))
    assert {verdict.word for verdict in compare(golden, moved)} == {Word.MATCHES}


def test_losses_stand_before_gains():
    """One column of the ranking rises, and another falls."""

    def ranked(outcome: str) -> RunTable:
        run = Fixed("m", "d", REFS, identity={"data": "x"}, protocols=[legacy])
        counted = {"can": (5,) * width, "mug": (5,) * width}
        detections = {"mug-0": RankedDetection("mug", 0.9, outcome.ljust(width, "1"))}
        run.ranking = lambda rows: Ranking(detections, counted)
        return RunTable.of(run, [])

    legacy = shipped_protocol("nocs-legacy")
    width = len(legacy.rankings)
    _, mug = compare(ranked("0101"), ranked("1100"))
    labels = [column.label for column in legacy.rankings]
    assert mug.word is Word.REGRESSED
    assert mug.details.startswith(f"{labels[3]}: 20 % -> 0 %")
    assert f"{labels[0]}: 0 % -> 20 %" in mug.details
