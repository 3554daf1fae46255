"""The comparison with a golden table as a pure function, and its files."""

import os
from pathlib import Path

import pytest

from pytest_cpas import golden
from pytest_cpas.evaluation import Row, Run, outcomes, precision_table
from pytest_cpas.golden import GoldenError, GoldenTable, Word, compare, read_golden
from pytest_cpas.metrics.precision import FAILED, Count
from pytest_cpas.types import SampleRef


class Fixed(Run):
    def judge(self, ref):
        raise NotImplementedError


REFS = [SampleRef(f"s/{i:02d}", "mug" if i % 2 else "can", "s") for i in range(10)]


def a_run(**identity: str) -> Run:
    return Fixed("m", "d", REFS, identity={"data": "x", **identity})


def rows(**rotation: float) -> list[Row]:
    """Rows with a rotation error of 4 degrees, or as given for "s_03" (sample s/03)."""
    return [
        Row(ref.id, ref.category, 0.005, rotation.get(ref.id.replace("/", "_"), 4.0), 0.9, 0.95)
        for ref in REFS
    ]


def words(verdicts):
    return {verdict.category: verdict.word for verdict in verdicts}


GOLDEN = GoldenTable.of(a_run(), rows())


def test_outcomes_follow_the_four_thresholds():
    cases = [
        Row("a", "mug", 0.01, 5.0, 1, 0.8),
        Row("b", "mug", 0.01, 5.0001, 1, 0.8),
        Row("c", "mug", 0.0101, 5.0, 1, 0.5),
        Row("d", "mug", 0.03, 5.0, 1, None),
        Row("e", "mug", FAILED["position_m"], FAILED["rotation_deg"], None, FAILED["fscore"], "no"),
    ]
    assert outcomes(cases) == ["1111", "1100", "1000", "0-0-", "0000"]
    table = precision_table(
        [(row.category, o) for row, o in zip(cases, outcomes(cases), strict=True)]
    )
    assert [*table["mug"].values()] == [Count(3, 5), Count(2, 4), Count(1, 5), Count(1, 4)]
    assert table["all"] == table["mug"]
    assert outcomes([Row("a", "mug", 0.01, 5.0, None, None)]) == ["1-1-"]


def test_same_rows_match():
    assert words(compare(GOLDEN, rows(), a_run())) == {"can": Word.MATCHES, "mug": Word.MATCHES}


def test_one_flip_in_any_sample_is_found():
    for ref in REFS:
        verdicts = compare(GOLDEN, rows(**{ref.id.replace("/", "_"): 5.5}), a_run())
        other = "can" if ref.category == "mug" else "mug"
        assert words(verdicts) == {ref.category: Word.REGRESSED, other: Word.MATCHES}
        (verdict,) = (v for v in verdicts if v.failed)
        assert f"lost: {ref.id} (0.5 cm, 4 deg, F 0.95 -> 0.5 cm, 5.5 deg, F 0.95)" in str(verdict)
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
    table = GoldenTable.of(a_run(), rows(**before))
    verdicts = compare(table, rows(**after), a_run())
    assert words(verdicts) == {"can": Word.MATCHES, "mug": word}
    assert all(v.failed for v in verdicts if v.category == "mug")


def test_subset_is_compared_and_not_checked():
    part = [row for row in rows() if row.sample != "s/03"]
    assert words(compare(GOLDEN, part, a_run())) == {"can": Word.MATCHES, "mug": Word.NOT_CHECKED}
    part = [row for row in rows(s_05=9) if row.sample != "s/03"]
    assert words(compare(GOLDEN, part, a_run()))["mug"] is Word.REGRESSED
    assert set(words(compare(GOLDEN, [], a_run())).values()) == {Word.NOT_CHECKED}


def test_samples_that_the_table_lacks_are_a_change():
    table = GoldenTable.of(a_run(), rows())
    fewer = GoldenTable("m", "d", table.identity, {}, dict(list(table.samples.items())[:9]))
    verdicts = compare(fewer, rows(), a_run())
    assert words(verdicts) == {"can": Word.MATCHES, "mug": Word.CHANGED}


def test_shape_that_becomes_na_is_a_change():
    without = [Row(r.sample, r.category, 0.005, 4.0, 0.9, None) for r in rows()]
    assert set(words(compare(GOLDEN, without, a_run())).values()) == {Word.CHANGED}


def test_other_conditions_are_stale():
    (verdict,) = compare(GOLDEN, rows(), a_run(data="y"))
    assert (verdict.word, verdict.failed) == (Word.STALE, True)
    assert "data was x, now y" in verdict.details


def test_no_table_is_not_checked():
    (verdict,) = compare(None, rows(), a_run())
    assert (verdict.word, verdict.failed) == (Word.NOT_CHECKED, False)


# -- files ------------------------------------------------------------------------------------


def test_what_is_written_is_read(tmp_path):
    odd = rows()
    odd[0] = Row("s/00", "can", FAILED["position_m"], FAILED["rotation_deg"], FAILED["iou"],
                 FAILED["fscore"], 'commas, "quotes"\nand lines')  # fmt: skip
    odd[1] = Row("s/01", "mug", 0.1, 1 / 3, None, None)
    table = GoldenTable.of(a_run(), odd)
    folder = table.write(tmp_path)
    assert folder == tmp_path / "recorded" / "m" / "d"
    assert read_golden(folder) == table
    assert words(compare(read_golden(folder), odd, a_run())) == {
        "can": Word.MATCHES,
        "mug": Word.MATCHES,
    }
    assert "\\n" not in (folder / "table.toml").read_text()


def test_writing_is_reproducible_and_sorted(tmp_path):
    first = GOLDEN.write(tmp_path / "a")
    second = GoldenTable.of(a_run(), rows()[::-1]).write(tmp_path / "b")
    for name in ("table.toml", "samples.csv"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
    cells = (first / "table.toml").read_text().split("[cells]\n")[1].splitlines()
    assert cells == sorted(cells)
    assert cells[0] == '"all | 10 deg, 2 cm" = "10/10"'


def test_every_changed_byte_of_the_samples_is_noticed(tmp_path):
    folder = GOLDEN.write(tmp_path)
    path = folder / "samples.csv"
    whole = path.read_bytes()
    for position in range(0, len(whole), 7):
        changed = bytearray(whole)
        changed[position] ^= 1
        path.write_bytes(changed)
        with pytest.raises(GoldenError, match="Restore it from version control"):
            read_golden(folder)
    for length in range(0, len(whole), 29):
        path.write_bytes(whole[:length])
        with pytest.raises(GoldenError):
            read_golden(folder)


@pytest.mark.parametrize(
    "edit",
    [
        ('"mug | 5 deg, 1 cm" = "5/5"', '"mug | 5 deg, 1 cm" = "4/5"'),
        ('"mug | 5 deg, 1 cm" = "5/5"\n', ""),
        ('"mug | 5 deg, 1 cm" = "5/5"', '"mug | 5 deg, 1 cm" = 5'),
        ("format = 1", "format = 2"),
        ("[cells]", "[cells"),
        ("[cells]", "[other]"),
        ("[provenance]", "provenance = 3"),
    ],
)
def test_edited_table_is_refused(tmp_path, edit):
    folder = GOLDEN.write(tmp_path)
    path = folder / "table.toml"
    text = path.read_text()
    assert edit[0] in text
    path.write_text(text.replace(*edit))
    with pytest.raises(GoldenError, match="damaged or edited by hand"):
        read_golden(folder)


def test_half_a_pair_is_refused(tmp_path):
    """The samples were replaced, the table was not: what a crash between the two would leave."""
    folder = GOLDEN.write(tmp_path / "a")
    other = GoldenTable.of(a_run(), rows(s_03=9)).write(tmp_path / "b")
    (folder / "samples.csv").write_bytes((other / "samples.csv").read_bytes())
    with pytest.raises(GoldenError, match=r"not the file that table\.toml was made with"):
        read_golden(folder)


def test_full_disk_leaves_the_old_table(tmp_path, monkeypatch):
    folder = GOLDEN.write(tmp_path)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(GoldenError, match="No space left"):
        GoldenTable.of(a_run(), rows(s_03=9)).write(tmp_path)
    assert read_golden(folder) == GOLDEN
    assert {path.name for path in folder.iterdir()} == {"table.toml", "samples.csv"}


def test_only_complete_categories_are_recorded():
    with pytest.raises(GoldenError, match="mug 4 of 5"):
        GoldenTable.of(a_run(), rows()[:9])
    with pytest.raises(GoldenError, match="none was"):
        GoldenTable.of(a_run(), [])
    mugs = [row for row in rows(s_03=9) if row.category == "mug"]
    merged = GoldenTable.of(a_run(), mugs, GOLDEN)
    assert len(merged.samples) == 10
    assert merged.samples["s/00"] is GOLDEN.samples["s/00"]
    assert merged.samples["s/03"].outcome == "1100"
    with pytest.raises(GoldenError, match="record all categories together"):
        GoldenTable.of(a_run(data="y"), mugs, GOLDEN)


def test_own_table_goes_before_the_shipped_one(tmp_path, monkeypatch):
    monkeypatch.setattr(golden, "shipped_golden", lambda: tmp_path / "shipped")
    assert golden.find_golden(tmp_path / "own", "m", "d") is None
    GOLDEN.write(tmp_path / "shipped")
    assert golden.find_golden(tmp_path / "own", "m", "d") == GOLDEN
    own = GoldenTable.of(a_run(), rows(s_03=9))
    own.write(tmp_path / "own")
    assert golden.find_golden(tmp_path / "own", "m", "d") == own


def test_shipped_tables_are_sound():
    folders = list(Path(golden.shipped_golden(), "recorded").glob("*/*"))
    assert {f"{f.parent.name}/{f.name}" for f in folders} >= {
        "icp/synthetic-tabletop",
        "icp/synthetic-handheld",
    }
    for folder in folders:
        read_golden(folder)
