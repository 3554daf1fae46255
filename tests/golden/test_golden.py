"""The files of golden tables: whatever happens to them."""

import csv
import multiprocessing
import os
import re
import struct
import subprocess
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tables import GOLDEN, a_row, a_run, rows, table, with_facts

from pytest_cpas import golden
from pytest_cpas.evaluation import Answer
from pytest_cpas.golden import GoldenError, RunTable, find_golden, read_golden, read_tables, record
from pytest_cpas.golden.parsing import parse_table
from pytest_cpas.golden.texts import table_texts

#: The files of a table in tests/tables.py.
FILES = {"run.toml", "facts.csv", "cpas.toml"}


def test_what_is_written_is_read(tmp_path):
    odd = rows()
    odd[0] = a_row("s/00", "can", failure='commas, "quotes"\nand lines')
    odd[1] = a_row("s/01", "mug", position_m=0.1, rotation_deg=0.333333, iou=None, fscore_1cm=None)
    odd_table = RunTable.of(a_run(), odd)
    folder = record(tmp_path, odd_table)
    assert folder == tmp_path / "recorded" / "m" / "d"
    assert {path.name for path in folder.iterdir()} == FILES
    assert read_golden(folder) == odd_table
    assert "\\n" not in (folder / "run.toml").read_text()


#: Numbers whose last bit is easily lost.
HARD = (0.1 + 0.2, 1 / 3, 5e-324, 2.2250738585072014e-308, 1 - 2**-53, 1e-17, 0.12345679012345678)


def test_facts_are_read_to_the_last_bit(tmp_path):
    run = a_run()
    run.seeds = 3
    rng = np.random.default_rng(0)
    given = []
    for row in rows():
        answers = []
        for _ in range(3):
            drawn = rng.choice([*HARD, *rng.random(7), None], len(row.facts))
            answers.append(Answer(facts=dict(zip(row.facts, drawn, strict=True))))
        given.append(replace(row, answers=tuple(answers)))
    given[7] = a_row(given[7].sample, given[7].category, failure="no", iou=None)
    given[7] = replace(given[7], answers=(*given[7].answers, *given[6].answers[:2]))
    expected = RunTable.of(run, given)
    again = read_golden(record(tmp_path, expected))
    assert again == expected

    def bits(table):
        return [
            None if value is None else struct.pack("d", value)
            for _, sample in sorted(table.samples.items())
            for answer in sample.answers
            for value in answer.facts.values()
        ]

    assert len(bits(again)) == 10 * 3 * 5
    assert bits(again) == bits(expected)


def test_writing_is_reproducible_and_sorted(tmp_path):
    first = record(tmp_path / "a", GOLDEN)
    second = record(tmp_path / "b", RunTable.of(a_run(), rows()[::-1]))
    for name in FILES:
        assert (first / name).read_bytes() == (second / name).read_bytes()
    cells = (first / "cpas.toml").read_text().partition('[cells."can"]')[2].splitlines()
    assert cells[1:4] == ['10deg_2cm = "5/5"', '10deg_2cm_f60 = "5/5"', '5deg_1cm = "5/5"']
    assert cells[12:16] == ['nad_median = "0.01 over 5"', "", '[cells."mug"]', '10deg_2cm = "5/5"']
    lines = [*csv.reader((first / "facts.csv").read_text().splitlines())]
    assert lines[0] == [
        *("category", "sample", "seed", "position_m", "rotation_deg", "iou", "fscore_1cm", "nad"),
        "failure",
    ]
    facts = [line for line in lines[1:] if line]
    assert facts == sorted(facts)
    assert facts[0] == ["can", "s/00", "0", "0.005", "4.0", "0.9", "0.95", "0.01", ""]


def test_every_changed_byte_is_noticed(tmp_path):
    texts = table_texts(GOLDEN)
    assert parse_table("m", "d", texts) == GOLDEN
    for name, text in texts.items():
        for position, character in enumerate(text):
            other = chr(ord(character) ^ 1)
            changed = {**texts, name: text[:position] + other + text[position + 1 :]}
            with pytest.raises(GoldenError):
                parse_table("m", "d", changed)
    folder = record(tmp_path, GOLDEN)
    for name in FILES:
        path = folder / name
        whole = path.read_bytes()
        for position in range(0, len(whole), 97):
            path.write_bytes(whole[:position] + b"\xff" + whole[position + 1 :])
            with pytest.raises(GoldenError, match="Restore it from version control"):
                read_golden(folder)
        for length in range(0, len(whole), 97):
            path.write_bytes(whole[:length])
            with pytest.raises(GoldenError):
                read_golden(folder)
        path.write_bytes(whole)
    assert read_golden(folder) == GOLDEN


def test_table_without_one_of_its_files_is_refused(tmp_path):
    for name in FILES:
        folder = record(tmp_path / name, GOLDEN)
        (folder / name).unlink()
        with pytest.raises(GoldenError, match=rf"{re.escape(name)} is missing; it was damaged"):
            read_golden(folder)


@pytest.mark.parametrize("left", sorted(FILES))
def test_what_is_left_of_a_table_is_no_lack_of_one(tmp_path, left):
    """Neither is it passed over for a shipped table, or recorded over."""
    folder = record(tmp_path, GOLDEN)
    for name in FILES:
        if name != left:
            (folder / name).unlink()
    with pytest.raises(GoldenError, match="is missing; it was damaged or edited"):
        find_golden(tmp_path, "m", "d")
    with pytest.raises(GoldenError, match="is missing; it was damaged or edited"):
        record(tmp_path, GOLDEN)
    assert [path.name for path in folder.iterdir()] == [left]


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("cpas.toml", '5deg_1cm = "5/5"', '5deg_1cm = "4/5"'),
        ("cpas.toml", '5deg_1cm = "5/5"\n', ""),
        ("cpas.toml", '5deg_1cm = "5/5"', "5deg_1cm = 5"),
        ("cpas.toml", '[cells."mug"]', '[cells."bowl"]'),
        ("cpas.toml", '[cells."mug"]', '[cells."mug"'),
        ("cpas.toml", "position_m = 0.02 }", "position_m = 0.03 }"),
        ("cpas.toml", 'id = "iou_75"', 'id = "iou_76"'),
        ("cpas.toml", "guard = true\n", ""),
        ("cpas.toml", 'name = "cpas"', 'name = "other"'),
        ("cpas.toml", "version = 1", "version = 2"),
        ("run.toml", "format = 3", "format = 2"),
        ("run.toml", "seeds = 1", "seeds = 0"),
        ("run.toml", "seeds = 1", "seeds = true"),
        ("run.toml", "seeds = 1", "seeds = 2"),
        ("run.toml", "seeds = 1", ""),
        ("run.toml", 'protocols = ["cpas"]', 'protocols = ["cpas", "omni6dpose"]'),
        ("run.toml", 'protocols = ["cpas"]', 'protocols = ["../cpas"]'),
        ("run.toml", 'protocols = ["cpas"]', "protocols = []"),
        ("run.toml", "samples = 5", "samples = 4"),
        ("run.toml", "[identity]", "[identity"),
        ("run.toml", "[identity]", "[other]"),
        ("run.toml", "[provenance]", "provenance = 3"),
        ("run.toml", "\niou = ", "\niou_2 = "),
        ("facts.csv", "can,s/02", "can,s/20"),
    ],
)
def test_edited_table_is_refused(tmp_path, file, old, new):
    folder = record(tmp_path, GOLDEN)
    path = folder / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(GoldenError, match="damaged or edited by hand"):
        read_golden(folder)


def test_half_a_table_is_refused(tmp_path):
    """The facts were replaced, the others were not: what a crash between them would leave."""
    folder = record(tmp_path / "a", GOLDEN)
    other = record(tmp_path / "b", table(s_03=9))
    before = {name: (folder / name).read_bytes() for name in FILES}
    for name in FILES:
        (folder / name).write_bytes((other / name).read_bytes())
        with pytest.raises(
            GoldenError, match=r"\.(toml|csv) is not what follows from the other files"
        ):
            read_golden(folder)
        (folder / name).write_bytes(before[name])
    assert read_golden(folder) == GOLDEN


def test_full_disk_leaves_the_old_table(tmp_path, monkeypatch):
    folder = record(tmp_path, GOLDEN)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(GoldenError, match="No space left"):
        record(tmp_path, table(s_03=9))
    assert read_golden(folder) == GOLDEN
    assert {path.name for path in folder.iterdir()} == FILES


def test_only_complete_categories_are_recorded(tmp_path):
    with pytest.raises(GoldenError, match="mug 4 of 5"):
        record(tmp_path, RunTable.of(a_run(), rows()[:9]))
    with pytest.raises(GoldenError, match="none was"):
        record(tmp_path, RunTable.of(a_run(), []))
    assert not list(tmp_path.rglob("*.*"))
    record(tmp_path, GOLDEN)
    mugs = [row for row in rows(s_03=9) if row.category == "mug"]
    merged = read_golden(record(tmp_path, RunTable.of(a_run(), mugs)))
    assert len(merged.samples) == 10
    assert merged.samples["s/00"] == GOLDEN.samples["s/00"]
    assert merged.samples["s/03"].outcome == "11001011111"
    with pytest.raises(GoldenError, match="record all categories together"):
        record(tmp_path, RunTable.of(a_run(data="y"), mugs))
    assert read_golden(tmp_path / "recorded" / "m" / "d") == merged


def jittered() -> RunTable:
    """Of three seeds, the second of which is wrong at the finer columns."""
    turned = [
        replace(
            row, answers=(*row.answers, *with_facts(row, rotation_deg=7.0).answers, *row.answers)
        )
        for row in rows()
    ]
    run = a_run()
    run.seeds = 3
    return RunTable.of(run, turned)


def test_spread_is_not_lost_by_accident(tmp_path):
    folder = record(tmp_path, jittered())
    golden = read_golden(folder)
    assert golden.seeds == 3
    assert golden.samples["s/03"].outcomes == ("1" * 11, "11001011111", "1" * 11)
    assert [a.facts["rotation_deg"] for a in golden.samples["s/03"].answers] == [4.0, 7.0, 4.0]
    with pytest.raises(GoldenError, match="pass --cpas-jitter 3, or remove the table"):
        record(tmp_path, table())
    assert read_golden(folder) == golden


def _record_often(path: Path, category: str, error: float) -> None:
    for turn in range(20):
        new = rows(**{f"s_{i:02d}": error * (turn % 2) + 1 for i in range(10)})
        record(path, RunTable.of(a_run(), [row for row in new if row.category == category]))


def test_two_updates_at_once_lose_nothing(tmp_path):
    """Each records one category, over and over; whoever reads meanwhile finds a whole table."""
    folder = record(tmp_path, GOLDEN)
    context = multiprocessing.get_context("spawn")
    writers = [
        context.Process(target=_record_often, args=(tmp_path, category, error))
        for category, error in (("can", 6), ("mug", 12))
    ]
    for writer in writers:
        writer.start()
    read = 0
    while any(writer.is_alive() for writer in writers):
        assert len(read_golden(folder).samples) == 10
        read += 1
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert read > 0
    final = read_golden(folder)
    assert {s.facts["rotation_deg"] for s in final.samples.values() if s.category == "can"} == {7}
    assert {s.facts["rotation_deg"] for s in final.samples.values() if s.category == "mug"} == {13}


def test_part_of_a_shipped_table_keeps_its_other_categories(tmp_path, monkeypatch):
    monkeypatch.setattr(golden.files, "shipped_golden", lambda: tmp_path / "shipped")
    record(tmp_path / "shipped", GOLDEN)
    mugs = [row for row in rows(s_03=9) if row.category == "mug"]
    own = read_golden(record(tmp_path / "own", RunTable.of(a_run(), mugs)))
    assert Counter(sample.category for sample in own.samples.values()) == {"can": 5, "mug": 5}
    with pytest.raises(GoldenError, match="record all categories together"):
        record(tmp_path / "other", RunTable.of(a_run(data="y"), mugs))
    assert not (tmp_path / "other").exists()


def test_checkout_with_other_line_ends_is_read(tmp_path):
    failed = [a_row(row.sample, row.category, failure="line\nand line") for row in rows()]
    for name, expected in (("a", GOLDEN), ("b", RunTable.of(a_run(), failed))):
        folder = record(tmp_path / name, expected)
        for file in folder.iterdir():
            file.write_bytes(file.read_bytes().replace(b"\n", b"\r\n"))
        assert read_golden(folder) == expected
    (folder / "facts.csv").write_bytes((folder / "facts.csv").read_bytes()[:-9])
    with pytest.raises(GoldenError, match="Restore it from version control"):
        read_golden(folder)


def test_first_recording_keeps_line_ends_under_version_control(tmp_path):
    folder = record(tmp_path / "golden", GOLDEN)
    attributes = tmp_path / "golden" / ".gitattributes"
    subprocess.run(["git", "init", "-q", "."], cwd=tmp_path, check=True)
    shown = subprocess.run(
        ["git", "check-attr", "eol", "text", "--", *(folder / name for name in FILES)],
        cwd=tmp_path, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    assert shown.count("eol: lf") == shown.count("text: set") == 3
    attributes.write_text("mine\n")
    record(tmp_path / "golden", table(s_03=9))
    assert attributes.read_text() == "mine\n"


@pytest.mark.parametrize(
    "reason",
    [
        *(
            chr(code)
            for code in (*range(1, 32), 127, 128, 133, 159, 0x2028, 0x2029, 0xD800, 0xDFFF)
        ),
        "\0",
        "a\r\nb\rc",
        "x" * 200_000,
        "\ud83d",
        'ends with a quote"',
        ',\n",',
        "\N{PILE OF POO} \u202e",
    ],
)
def test_every_reason_is_recorded_and_read(tmp_path, reason):
    new = rows()
    new[0] = a_row("s/00", "can", failure=f"a{reason}b")
    folder = record(tmp_path, RunTable.of(a_run(), new))
    assert read_golden(folder) == RunTable.of(a_run(), new)
    text = read_golden(folder).samples["s/00"].failure
    assert text.replace("\n", "").isprintable() or "\t" in text or "\u202e" in text
    assert len(text) < 3000


def test_what_cannot_be_read_back_is_not_recorded(tmp_path, monkeypatch):
    folder = record(tmp_path, GOLDEN)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for name, text in (("run.toml", "x = ["), ("facts.csv", "sample\n"), ("cpas.toml", "")):

        def spoilt(table, name=name, text=text):
            return {**table_texts(table), name: text}

        with monkeypatch.context() as patch:
            patch.setattr(golden.files, "kept_texts", spoilt)
            with pytest.raises(GoldenError, match="cannot be read back"):
                record(tmp_path, table(s_03=9))
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize(
    "name", ["../x", "/tmp/x", "..", "a/b", "a\\b", "", "x" * 300, "a\n", "é", ".x"]
)
def test_names_never_lead_out_of_the_folder(tmp_path, name):
    for method, dataset in ((name, "d"), ("m", name)):
        with pytest.raises(GoldenError, match=r"expected letters|at most"):
            record(tmp_path / "golden", replace(GOLDEN, method=method, dataset=dataset))
        with pytest.raises(GoldenError, match=r"expected letters|at most"):
            golden.find_golden(tmp_path / "golden", method, dataset)
    assert not list(tmp_path.iterdir())


def test_orphans_are_tables_of_methods_that_are_gone(tmp_path):
    folder = record(tmp_path, GOLDEN)
    assert golden.orphans(tmp_path, {"n"}) == [folder]
    assert golden.orphans(tmp_path, {"m", "n"}) == []


def test_own_table_goes_before_the_shipped_one(tmp_path, monkeypatch):
    monkeypatch.setattr(golden.files, "shipped_golden", lambda: tmp_path / "shipped")
    assert golden.find_golden(tmp_path / "own", "m", "d") is None
    record(tmp_path / "shipped", GOLDEN)
    assert golden.find_golden(tmp_path / "own", "m", "d") == GOLDEN
    own = table(s_03=9)
    record(tmp_path / "own", own)
    assert golden.find_golden(tmp_path / "own", "m", "d") == own


def test_shipped_tables_are_sound():
    folders = list(Path(golden.shipped_golden(), "recorded").glob("*/*"))
    assert {f"{f.parent.name}/{f.name}" for f in folders} >= {
        "icp/synthetic-tabletop",
        "icp/synthetic-tabletop-2",
        "icp/synthetic-handheld",
        "icp/synthetic-handheld-2",
        "icp/synthetic-handheld+robustness",
    }
    for folder in folders:
        assert not any(table.outdated for table in read_tables(folder).values())


@pytest.mark.parametrize("name", ["s/1\x1b[31m", "s\n::error::x", "x" * 501])
def test_names_that_no_sample_can_have_are_refused(tmp_path, name):
    """Whatever the digests say: they would reach a terminal."""
    odd = replace(GOLDEN, samples={**GOLDEN.samples, name: GOLDEN.samples["s/00"]})
    with pytest.raises(GoldenError, match="expected at most 500 printable characters"):
        parse_table("m", "d", table_texts(odd))
