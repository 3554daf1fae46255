"""Average precision is guarded by its exact value, and the detections that changed sides."""

from dataclasses import replace

import pytest
from tables import REFS, Fixed, rows

from pytest_cpas.golden import GoldenError, RunTable, Word, compare, read_golden, record
from pytest_cpas.protocols import RankedDetection, Ranking, shipped_protocol

PROTOCOLS = [shipped_protocol("cpas"), shipped_protocol("nocs-legacy")]
COLUMNS = len(PROTOCOLS[1].columns)


def a_ranking(wrong=(), scores=None, extra=0) -> Ranking:
    """Three detections of five objects of each category; those in ``wrong`` are so everywhere."""
    detections = {}
    for category in ("can", "mug"):
        for index in range(3 + extra):
            name = f"{category}-{index}"
            letter = "0" if name in wrong or index >= 3 else "1"
            score = (scores or {}).get(name, 0.9 - 0.1 * index)
            detections[name] = RankedDetection(category, score, letter * COLUMNS)
    return Ranking(detections, dict.fromkeys(("can", "mug"), (5,) * COLUMNS))


def table(ranking: Ranking | None) -> RunTable:
    run = Fixed("m", "d", REFS, identity={"data": "x"}, protocols=PROTOCOLS)
    run.ranking = lambda rows: ranking
    return RunTable.of(run, rows())


GOLDEN = table(a_ranking())


def words(new: RunTable) -> dict[str, Word]:
    return {verdict.category: verdict.word for verdict in compare(GOLDEN, new)}


def test_average_precision_is_that_of_the_curve():
    """Right, wrong, right of five objects: 1/5 + 1/5 * 2/3."""
    scores = table(a_ranking(wrong=["mug-1"])).scores
    assert scores["mug"]["nocs-legacy.ap_iou_50"].value == pytest.approx(1 / 5 + 2 / 15)
    assert scores["can"]["nocs-legacy.ap_iou_50"].value == pytest.approx(3 / 5)
    assert scores["all"]["nocs-legacy.ap_iou_50"].value == pytest.approx((1 / 3 + 3 / 5) / 2)


def test_a_detection_that_is_wrong_now_is_a_regression():
    assert words(table(a_ranking())) == {"can": Word.MATCHES, "mug": Word.MATCHES}
    new = table(a_ranking(wrong=["mug-1"]))
    (mug,) = [v for v in compare(GOLDEN, new) if v.category == "mug"]
    assert (mug.word, mug.failed) == (Word.REGRESSED, True)
    assert "AP IoU 50: 60 % -> 33.33 % of 5 objects" in mug.details
    assert "lost: mug-1" in mug.details
    assert words(new)["can"] is Word.MATCHES


def test_better_ones_other_scores_and_false_detections():
    worse = table(a_ranking(wrong=["mug-2"]))
    (mug,) = [v for v in compare(worse, GOLDEN) if v.category == "mug"]
    assert mug.word is Word.IMPROVED
    # a wrong one, surer than all right ones
    assert words(table(a_ranking(scores={"mug-3": 0.99}, extra=1))) == {
        "can": Word.MATCHES,  # a wrong one after all right ones takes nothing
        "mug": Word.REGRESSED,
    }


def test_what_ranks_nothing_any_more_is_told():
    new = table(None)
    verdicts = compare(GOLDEN, new)
    assert [v.category for v in verdicts if not v.passed] == ["completeness"]
    assert "rank" in verdicts[-1].details


def test_files_keep_the_detections_and_notice_every_change(tmp_path):
    folder = record(tmp_path, GOLDEN)
    assert read_golden(folder).ranking == GOLDEN.ranking
    assert read_golden(folder).scores == GOLDEN.scores
    path = folder / "detections.csv"
    whole = path.read_bytes()
    for position in range(0, len(whole), 5):
        changed = bytearray(whole)
        changed[position] ^= 1
        path.write_bytes(changed)
        with pytest.raises(GoldenError, match="Restore it from version control"):
            read_golden(folder)
    path.unlink()
    with pytest.raises(GoldenError, match=r"detections\.csv is missing"):
        read_golden(folder)


def test_a_part_keeps_the_detections_of_the_other_categories(tmp_path):
    record(tmp_path, GOLDEN)
    mugs = [row for row in rows() if row.category == "mug"]
    ranking = a_ranking(wrong=["mug-1", "can-1"]).without(["can"])
    part = table(ranking)
    part = replace(part, samples={row.sample: part.samples[row.sample] for row in mugs})
    merged = read_golden(record(tmp_path, part))
    assert merged.ranking.detections["can-1"].outcome == "1" * COLUMNS
    assert merged.ranking.detections["mug-1"].outcome == "0" * COLUMNS
    assert set(merged.ranking.counted) == {"can", "mug"}
