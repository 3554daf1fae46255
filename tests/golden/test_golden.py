"""The files of golden tables: whatever happens to them."""

import multiprocessing
import os
import subprocess
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from tables import GOLDEN, a_run, rows, table

from pytest_cpas import golden
from pytest_cpas.evaluation import Row
from pytest_cpas.golden import GoldenError, RunTable, read_golden, record
from pytest_cpas.metrics.precision import FAILED


def test_what_is_written_is_read(tmp_path):
    odd = rows()
    odd[0] = a_row(
        sample="s/00",
        category="can",
        position_m=FAILED["position_m"],
        rotation_deg=FAILED["rotation_deg"],
        iou=FAILED["iou"],
        fscore_1cm=FAILED["fscore"],
        failure='commas, "quotes"\nand lines',
    )
    odd[1] = a_row(
        sample="s/01",
        category="mug",
        position_m=0.1,
        rotation_deg=0.333333,
        iou=None,
        fscore_1cm=None,
    )
    odd_table = RunTable.of(a_run(), odd)
    folder = record(tmp_path, odd_table)
    assert folder == tmp_path / "recorded" / "m" / "d"
    assert read_golden(folder) == odd_table
    assert "\\n" not in (folder / "table.toml").read_text()


def test_writing_is_reproducible_and_sorted(tmp_path):
    first = record(tmp_path / "a", GOLDEN)
    second = record(tmp_path / "b", RunTable.of(a_run(), rows()[::-1]))
    for name in ("table.toml", "samples.csv"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
    cells = (first / "table.toml").read_text().split("[cells]\n")[1].splitlines()
    assert cells == sorted(cells)
    assert cells[0] == '"all | 10 deg, 2 cm" = "10/10"'


def test_every_changed_byte_of_the_samples_is_noticed(tmp_path):
    folder = record(tmp_path, GOLDEN)
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
        ("format = 2", "format = 1"),
        ("seeds = 1", "seeds = 0"),
        ("seeds = 1", ""),
        ("[cells]", "[cells"),
        ("[cells]", "[other]"),
        ("[provenance]", "provenance = 3"),
    ],
)
def test_edited_table_is_refused(tmp_path, edit):
    folder = record(tmp_path, GOLDEN)
    path = folder / "table.toml"
    text = path.read_text()
    assert edit[0] in text
    path.write_text(text.replace(*edit))
    with pytest.raises(GoldenError, match="damaged or edited by hand"):
        read_golden(folder)


def test_half_a_pair_is_refused(tmp_path):
    """The samples were replaced, the table was not: what a crash between the two would leave."""
    folder = record(tmp_path / "a", GOLDEN)
    other = record(tmp_path / "b", table(s_03=9))
    (folder / "samples.csv").write_bytes((other / "samples.csv").read_bytes())
    with pytest.raises(GoldenError, match=r"not the file that table\.toml was made with"):
        read_golden(folder)


def test_full_disk_leaves_the_old_table(tmp_path, monkeypatch):
    folder = record(tmp_path, GOLDEN)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(GoldenError, match="No space left"):
        record(tmp_path, table(s_03=9))
    assert read_golden(folder) == GOLDEN
    assert {path.name for path in folder.iterdir()} == {"table.toml", "samples.csv"}


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
    assert merged.samples["s/03"].outcome == "1100"
    with pytest.raises(GoldenError, match="record all categories together"):
        record(tmp_path, RunTable.of(a_run(data="y"), mugs))
    assert read_golden(tmp_path / "recorded" / "m" / "d") == merged


def test_spread_is_not_lost_by_accident(tmp_path):
    jittered = [replace(row, repeats="1100 1111") for row in rows()]
    run = a_run()
    run.seeds = 3
    folder = record(tmp_path, RunTable.of(run, jittered))
    golden = read_golden(folder)
    assert golden.seeds == 3
    assert golden.samples["s/03"].repeats == ("1100", "1111")
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
    assert {s.errors[1] for s in final.samples.values() if s.category == "can"} == {7}
    assert {s.errors[1] for s in final.samples.values() if s.category == "mug"} == {13}


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
    failed = [replace(row, failure="line\nand line") for row in rows()]
    for name, expected in (("a", GOLDEN), ("b", RunTable.of(a_run(), failed))):
        folder = record(tmp_path / name, expected)
        for file in folder.iterdir():
            file.write_bytes(file.read_bytes().replace(b"\n", b"\r\n"))
        assert read_golden(folder) == expected
    (folder / "samples.csv").write_bytes((folder / "samples.csv").read_bytes()[:-9])
    with pytest.raises(GoldenError, match="Restore it from version control"):
        read_golden(folder)


def test_first_recording_keeps_line_ends_under_version_control(tmp_path):
    folder = record(tmp_path / "golden", GOLDEN)
    attributes = tmp_path / "golden" / ".gitattributes"
    subprocess.run(["git", "init", "-q", "."], cwd=tmp_path, check=True)
    shown = subprocess.run(
        ["git", "check-attr", "eol", "text", "--", folder / "samples.csv", folder / "table.toml"],
        cwd=tmp_path, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    assert shown.count("eol: lf") == shown.count("text: set") == 2
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
    new[0] = replace(new[0], failure=f"a{reason}b")
    folder = record(tmp_path, RunTable.of(a_run(), new))
    assert read_golden(folder) == RunTable.of(a_run(), new)
    text = read_golden(folder).samples["s/00"].failure
    assert text.replace("\n", "").isprintable() or "\t" in text or "\u202e" in text
    assert len(text) < 3000


def test_what_cannot_be_read_back_is_not_recorded(tmp_path, monkeypatch):
    folder = record(tmp_path, GOLDEN)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    spoilt = {
        "table_toml": lambda self, samples: "x = [",
        "samples_csv": lambda self: "sample\n",
    }
    for name, text in spoilt.items():
        with monkeypatch.context() as patch:
            patch.setattr(RunTable, name, text)
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
        "icp/synthetic-handheld",
    }
    for folder in folders:
        read_golden(folder)
