"""The comparison with a golden table, a pure function."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from tables import FACTS, GOLDEN, REFS, Fixed, a_row, a_run, rows, table, with_facts

from pytest_cpas.golden import RunTable, Word, compare, detectable_flips
from pytest_cpas.metrics.precision import Count
from pytest_cpas.protocols import (
    PAPER,
    count_columns,
    count_table,
    judge_outcomes,
    shipped_protocol,
)
from pytest_cpas.types import SampleRef


def words(verdicts):
    return {verdict.category: verdict.word for verdict in verdicts}


def test_outcomes_follow_the_columns_of_the_paper():
    cases = [
        a_row("a", "mug", position_m=0.01, rotation_deg=5.0, iou=1, fscore_1cm=0.8),
        a_row("b", "mug", position_m=0.01, rotation_deg=5.0001, iou=0.75, fscore_1cm=0.8),
        a_row("c", "mug", position_m=0.0101, rotation_deg=5.0, iou=0.7499, fscore_1cm=0.5),
        a_row("d", "mug", position_m=0.03, rotation_deg=5.0, iou=0.25, fscore_1cm=None),
        a_row("e", "mug", iou=None, failure="no"),
    ]
    columns = count_columns([shipped_protocol(PAPER)])
    assert [column.id for column in columns] == [
        *("10deg_2cm", "10deg_2cm_f60", "5deg_1cm", "5deg_1cm_f80"),
        *("10deg_5cm", "5deg_5cm", "iou_25", "iou_50", "iou_75", "f60", "f80"),
    ]
    outcomes = judge_outcomes(columns, [row.facts for row in cases])
    assert outcomes == [
        "1111" "11" "111" "11",
        "1100" "10" "111" "11",
        "1000" "11" "110" "00",
        "0-0-" "11" "100" "--",
        "0000" "00" "---" "00",
    ]  # fmt: skip
    table = count_table(columns, [("mug", outcome) for outcome in outcomes])
    assert [*table["mug"].values()] == [
        *(Count(3, 5), Count(2, 4), Count(1, 5), Count(1, 4)),
        *(Count(4, 5), Count(3, 5), Count(4, 4), Count(3, 4), Count(2, 4)),
        *(Count(2, 4), Count(2, 4)),
    ]
    assert list(table["mug"]) == [f"cpas.{column.id}" for column in columns]
    assert table["all"] == table["mug"]
    (alone,) = judge_outcomes(columns, [a_row("a", "mug", iou=None, fscore_1cm=None).facts])
    assert alone == "1-1-" "11" "---" "--"  # fmt: skip


def test_same_rows_match():
    assert words(compare(GOLDEN, table())) == {
        "can": Word.MATCHES,
        "mug": Word.MATCHES,
    }


def test_one_flip_in_any_sample_is_found():
    for ref in REFS:
        verdicts = compare(GOLDEN, table(**{ref.id.replace("/", "_"): 5.5}))
        other = "can" if ref.category == "mug" else "mug"
        assert words(verdicts) == {ref.category: Word.REGRESSED, other: Word.MATCHES}
        (verdict,) = (v for v in verdicts if v.failed)
        rest = "IoU 0.9, F 0.95, NAD 0.01"
        assert f"lost: {ref.id} (0.5 cm, 4 deg, {rest} -> 0.5 cm, 5.5 deg, {rest})" in str(verdict)
        assert "5 deg, 1 cm: 5 -> 4 of 5 correct" in str(verdict)


@pytest.mark.parametrize(
    ("before", "after", "word"),
    [
        ({"s_01": 7}, {}, Word.IMPROVED),
        ({"s_01": 7}, {"s_03": 7}, Word.CHANGED),
        ({"s_01": 7}, {"s_03": 7, "s_05": 7}, Word.REGRESSED),
        # better at 5 degrees, worse at 10: no improvement hides a loss
        ({"s_01": 7, "s_03": 7}, {"s_05": 12}, Word.REGRESSED),
    ],
)
def test_words(before, after, word):
    old = table(**before)
    verdicts = compare(old, table(**after))
    assert words(verdicts) == {"can": Word.MATCHES, "mug": word}
    assert all(v.failed for v in verdicts if v.category == "mug")


def test_subset_is_compared_and_not_checked():
    part = [row for row in rows() if row.sample != "s/03"]
    assert words(compare(GOLDEN, RunTable.of(a_run(), part))) == {
        "can": Word.MATCHES,
        "mug": Word.NOT_CHECKED,
    }
    part = [row for row in rows(s_05=9) if row.sample != "s/03"]
    assert words(compare(GOLDEN, RunTable.of(a_run(), part)))["mug"] is Word.REGRESSED
    assert set(words(compare(GOLDEN, RunTable.of(a_run(), []))).values()) == {Word.NOT_CHECKED}


def test_samples_that_the_table_lacks_are_a_change():
    fewer = replace(
        GOLDEN, samples=dict(list(GOLDEN.samples.items())[:9]), listed={"can": 5, "mug": 4}
    )
    verdicts = compare(fewer, table())
    assert words(verdicts) == {"can": Word.MATCHES, "mug": Word.CHANGED}


def test_shape_that_becomes_na_is_a_change():
    without = [with_facts(row, fscore_1cm=None) for row in rows()]
    assert set(words(compare(GOLDEN, RunTable.of(a_run(), without))).values()) == {Word.CHANGED}


def test_flips_count_what_the_cells_count():
    """What is n/a is not among the samples of which some are correct."""
    shapeless = {"s/01", "s/03"}

    def of(more, **rotation):
        lacking = shapeless | more
        return RunTable.of(
            a_run(),
            [
                with_facts(r, fscore_1cm=None) if r.sample in lacking else r
                for r in rows(**rotation)
            ],
        )

    old, new = of(set()), of(set(), s_05=7)
    (_, mug) = compare(old, new)
    assert "5 deg, 1 cm: 5 -> 4 of 5 correct" in mug.details
    assert "5 deg, 1 cm, F 0.8: 3 -> 2 of 3 correct" in mug.details
    assert new.table["mug"]["cpas.5deg_1cm_f80"] == Count(2, 3)
    (_, mug) = compare(old, of({"s/05"}))
    assert "5 deg, 1 cm, F 0.8: 3 of 3 -> 2 of 2 correct" in mug.details


def test_other_conditions_are_stale():
    (verdict,) = compare(GOLDEN, table("y"))
    assert (verdict.word, verdict.failed) == (Word.STALE, True)
    assert "data was x, now y" in verdict.details


def test_no_table_is_not_checked():
    (verdict,) = compare(None, table())
    assert (verdict.word, verdict.failed) == (Word.NOT_CHECKED, False)


def test_run_that_shrank_is_red():
    """Not by a selection: the data set itself, or the method, has lost a category or a sample."""
    fewer = [row for row in rows() if row.sample != "s/03"]
    shrunk = replace(RunTable.of(a_run(), fewer), listed={"can": 5, "mug": 4})
    verdicts = compare(GOLDEN, shrunk)
    assert words(verdicts) == {"can": Word.MATCHES, "mug": Word.CHANGED}
    assert "have 4 samples in common, the golden table has 5" in str(verdicts[1])
    cans = [row for row in rows() if row.category == "can"]
    gone = replace(RunTable.of(a_run(), cans), listed={"can": 5})
    assert words(compare(GOLDEN, gone)) == {"can": Word.MATCHES, "mug": Word.CHANGED}


def test_errors_that_move_without_a_flip_are_told():
    (can, mug) = compare(GOLDEN, table(s_01=4.2, s_03=4.9, s_05=4.001))
    assert (can.word, mug.word) == (Word.MATCHES, Word.CHANGED)
    assert "moved" not in can.details
    told = "rotation_deg moved in 2 of 5 samples, median move +0.55 deg, most in s/03: 4 deg -> 4.9"
    assert told in mug.details


@pytest.mark.parametrize(("judged", "total"), [(1, 4), (3, 7), (5, 9), (9, 9), (2, 9)])
def test_detectable_flips_are_those_that_show(judged, total):
    """Against all ways to choose the part."""
    parts = list(itertools.combinations(range(total), judged))

    def shown(flips):
        return sum(min(part) < flips for part in parts) / len(parts)

    flips = detectable_flips(judged, total)
    assert shown(flips) >= 0.95
    assert flips == 1 or shown(flips - 1) < 0.95


def test_detectable_flips_of_a_large_table():
    flips = detectable_flips(300, 16118)
    assert flips == pytest.approx(math.log(0.05) / math.log(1 - 300 / 16118), rel=0.02)


REAL275_SIZE = 16118


@pytest.fixture(scope="module")
def large():
    """A recorded table of REAL275's size, and its run."""
    refs = [SampleRef(id=f"s/{i:05d}", category="mug", scene="s") for i in range(REAL275_SIZE)]
    run = Fixed("m", "d", refs, identity={})
    angles = np.random.default_rng(0).uniform(0, 20, REAL275_SIZE)
    rows = [
        a_row(ref.id, "mug", rotation_deg=float(angle))
        for ref, angle in zip(refs, angles, strict=True)
    ]
    return run, rows, RunTable.of(run, rows)


def test_one_flip_in_16118_is_caught(large):
    run, rows, golden = large
    index = next(i for i in range(11000, REAL275_SIZE) if rows[i].facts["rotation_deg"] < 5)
    changed = [*rows]
    changed[index] = with_facts(rows[index], rotation_deg=5.01)
    (verdict,) = compare(golden, RunTable.of(run, changed))
    assert verdict.word is Word.REGRESSED
    assert f"lost: s/{index:05d} (" in verdict.details
    assert verdict.details.count("s/") == 1  # in three columns, no other sample


def test_part_shows_a_change_of_the_size_that_it_states(large):
    """In the stated share of random parts, and less often when the change is smaller."""
    _, _, golden = large
    rng = np.random.default_rng(1)
    part = rng.choice(REAL275_SIZE, 300, replace=False)
    names = list(golden.samples)
    some = replace(golden, samples={names[i]: golden.samples[names[i]] for i in part})
    (verdict,) = compare(golden, some)
    assert verdict.word is Word.NOT_CHECKED
    stated = int(verdict.details.split("A change of ")[1].split()[0])
    for flips, bounds in ((stated, (0.94, 0.96)), (stated // 3, (0.5, 0.8))):
        shown = [
            bool(set(rng.choice(REAL275_SIZE, flips, replace=False)) & set(part))
            for _ in range(2000)
        ]
        assert bounds[0] < np.mean(shown) < bounds[1]
    broken = dict(some.samples)
    name = names[part[17]]
    broken[name] = replace(broken[name], outcomes=("0" * 11,))
    before = golden.samples[name].outcome
    (verdict,) = compare(golden, replace(some, samples=broken))
    assert verdict.word is (Word.REGRESSED if "1" in before else Word.NOT_CHECKED)
    assert (name in verdict.details) == ("1" in before)


def test_lines_on_samples_are_bounded_however_many_facts_there_are():
    """A column's own facts are told first; a reason is cut."""
    protocols = [shipped_protocol(name) for name in (PAPER, "bop", "omni6dpose", "scale-agnostic")]
    run = Fixed("m", "d", REFS, identity={"data": "x"}, protocols=protocols)
    more = [name for name in run.facts if name not in FACTS]

    def table_of(niou):
        made = [with_facts(row, **dict.fromkeys(more, 0.1)) for row in rows()]
        return [with_facts(row, iou_equal_diagonals=niou) for row in made]

    golden, new = (RunTable.of(run, table_of(niou)) for niou in (0.9, 0.1))
    details = "".join(verdict.details for verdict in compare(golden, new))
    assert "s/00 (0.5 cm, 4 deg, IoU 0.9, F 0.95, NAD 0.01, NIoU 0.9 -> " in details
    assert max(map(len, details.splitlines())) < 1500
    failed = [a_row(r.id, r.category, failure="no luck " * 250) for r in REFS]
    lost = compare(GOLDEN, RunTable.of(a_run(), failed))
    assert all(len(line) < 3000 for v in lost for line in v.details.splitlines())
