"""Golden tables in the form of version 1: read, judged as far as they go, replaced."""

import hashlib
import shutil
from dataclasses import replace

import pytest
from harness import unfolded
from older_tables import older_texts, record_older
from tables import GOLDEN, a_row, a_run, rows, table, with_facts

from pytest_cpas.golden import (
    GoldenError,
    RunTable,
    Word,
    compare,
    find_golden,
    orphans,
    read_golden,
    record,
)
from pytest_cpas.golden.older import parse_older
from pytest_cpas.golden.tables import table_samples

#: The files of version 1, and of those that take their place.
OLDER, FILES = {"table.toml", "samples.csv"}, {"run.toml", "facts.csv", "cpas.toml"}

#: As version 1 recorded them: three samples of ``icp`` on ``synthetic-handheld``.
TABLE = """\
# Recorded by pytest-cpas; --snapshot-update records it anew.
format = 2
samples_sha256 = "SHA256"
seeds = 1

[identity]
data = "5419efc0f5e2953f45b6ecc3d8644f724abd906dec92078bc15225a436542369"
device = "cpu"
fscore_1cm = "fscore:strict:1[delta_m=0.01,frame=camera,points=10000]"
iou = "iou:oriented-symmetric:1"
rotation_error = "rotation_error:symmetry-group:1"
seed = "0"
translation_error = "translation_error:euclidean:1"

[provenance]
numpy = "2.4.6"
platform = "Linux x86_64"

[cells]
"all | 10 deg, 2 cm" = "2/3"
"all | 10 deg, 2 cm, F 0.6" = "2/3"
"all | 5 deg, 1 cm" = "2/3"
"all | 5 deg, 1 cm, F 0.8" = "2/3"
"bottle | 10 deg, 2 cm" = "2/2"
"bottle | 10 deg, 2 cm, F 0.6" = "2/2"
"bottle | 5 deg, 1 cm" = "2/2"
"bottle | 5 deg, 1 cm, F 0.8" = "2/2"
"can | 10 deg, 2 cm" = "0/1"
"can | 10 deg, 2 cm, F 0.6" = "0/1"
"can | 5 deg, 1 cm" = "0/1"
"can | 5 deg, 1 cm, F 0.8" = "0/1"
"""
SAMPLES = """\
sample,category,outcome,repeats,translation_error_m,rotation_error_deg,iou,fscore_1cm,failure
scene_1/0000/1,bottle,1111,,0.00405257,0.24733,0.872509,1,
scene_1/0001/1,bottle,1111,,0.00196929,0.459864,0.732994,1,
scene_1/0002/3,can,0000,,inf,inf,-inf,-inf,too few points
"""


def test_table_of_version_1_is_read():
    sha256 = hashlib.sha256(SAMPLES.encode()).hexdigest()
    older = parse_older("icp", "synthetic-handheld", TABLE.replace("SHA256", sha256), SAMPLES)
    assert older.outdated
    assert older.seeds == 1
    assert older.identity == {
        "data": "5419efc0f5e2953f45b6ecc3d8644f724abd906dec92078bc15225a436542369",
        "device": "cpu",
        "seed": "0",
    }
    # what they mean is what it means now
    now = a_run().definitions
    assert older.definitions == {name: now[name] for name in now if name != "nad"}
    assert older.listed == {"bottle": 2, "can": 1}
    # errors decide what version 1 did not ask: the box, the shape and the pose alone
    assert [column.id for column in older.columns] == [column.id for column in GOLDEN.columns]
    assert {name: sample.outcomes for name, sample in older.samples.items()} == {
        "scene_1/0000/1": ("1" * 11,),
        "scene_1/0001/1": ("11111111011",),
        "scene_1/0002/3": ("0" * 11,),
    }
    assert older.samples["scene_1/0002/3"].failure == "too few points"


def test_table_of_version_1_that_was_edited_is_refused(tmp_path):
    folder = record_older(tmp_path, GOLDEN)
    texts = {name: (folder / name).read_text() for name in OLDER}
    edits = (
        ("table.toml", '"mug | 5 deg, 1 cm" = "5/5"', '"mug | 5 deg, 1 cm" = "4/5"'),
        ("table.toml", "format = 2", "format = 1"),
        ("table.toml", "seeds = 1", "seeds = 0"),
        ("table.toml", "[cells]", "[cells"),
        ("table.toml", "[cells]", "[other]"),
        ("samples.csv", "s/03,mug,1111", "s/03,mug,1110"),
        ("samples.csv", "sample,", "name,"),
    )
    for name, old, new in edits:
        assert old in texts[name]
        (folder / name).write_text(texts[name].replace(old, new))
        with pytest.raises(GoldenError, match="damaged or edited by hand"):
            read_golden(folder)
        (folder / name).write_text(texts[name])
    whole = texts["samples.csv"].encode()
    for position in range(0, len(whole), 11):
        changed = bytearray(whole)
        changed[position] ^= 1
        (folder / "samples.csv").write_bytes(changed)
        with pytest.raises(GoldenError, match="Restore it from version control"):
            read_golden(folder)
    for name in OLDER:
        (folder / name).unlink()
        with pytest.raises(GoldenError, match="is missing"):
            find_golden(tmp_path, "m", "d")
        (folder / name).write_text(texts[name])


@pytest.mark.parametrize("line", ["", " ", ",", "a,mug,1111,,0,0,1,1", "a,mug,1111,,0,0,1,1,,"])
def test_line_of_another_length_is_refused(line):
    for lines in ([*SAMPLES.splitlines(), line], [SAMPLES.splitlines()[0], line]):
        samples = "\n".join([*lines, ""])
        sha256 = hashlib.sha256(samples.encode()).hexdigest()
        with pytest.raises(GoldenError, match=rf"samples.csv, line {len(lines)}.*expected 9"):
            parse_older("icp", "d", TABLE.replace("SHA256", sha256), samples)


def words(verdicts):
    return {verdict.category: verdict.word for verdict in verdicts}


OUTDATED = {"completeness": Word.OUTDATED}


def test_same_run_matches_and_is_told_to_be_recorded_anew(tmp_path):
    older = read_golden(record_older(tmp_path, GOLDEN))
    verdicts = compare(older, GOLDEN)
    assert words(verdicts) == {
        "can": Word.MATCHES,
        "mug": Word.MATCHES,
        "completeness": Word.OUTDATED,
    }
    assert "record it anew with --snapshot-update" in verdicts[-1].details
    assert {verdict.outcome("strict") for verdict in verdicts} == {"passed"}


@pytest.mark.parametrize(
    ("facts", "label"),
    [
        ({"rotation_deg": 5.5}, "5 deg, 1 cm"),
        ({"position_m": 0.06}, "10 deg, 5 cm"),
        ({"iou": 0.7}, "IoU 0.75"),
        ({"iou": 0.2}, "IoU 0.25"),
        ({"fscore_1cm": 0.7}, "F 0.8"),
        ({"fscore_1cm": 0.5}, "F 0.6"),
    ],
)
def test_loss_in_any_column_is_found(tmp_path, facts, label):
    older = read_golden(record_older(tmp_path, GOLDEN))
    worse = [with_facts(row, **facts) if row.sample == "s/03" else row for row in rows()]
    verdicts = compare(older, RunTable.of(a_run(), worse))
    assert words(verdicts) == OUTDATED | {"can": Word.MATCHES, "mug": Word.REGRESSED}
    (mug,) = (verdict for verdict in verdicts if verdict.failed)
    assert f"{label}: 5 -> 4 of 5 correct" in mug.details
    assert "lost: s/03 (" in mug.details


def of_seeds(*angles: float) -> RunTable:
    run = a_run()
    run.seeds = len(angles)
    turned = [
        replace(
            row,
            answers=tuple(
                answer for angle in angles for answer in with_facts(row, rotation_deg=angle).answers
            ),
        )
        for row in rows()
    ]
    return RunTable.of(run, turned)


def test_where_seeds_disagree_it_is_judged_by_what_all_of_them_have(tmp_path):
    """The errors of one seed alone say nothing about the others."""
    older = read_golden(record_older(tmp_path / "a", of_seeds(4.0, 7.0, 4.0)))
    assert [column.id for column in older.columns] == [
        *("10deg_2cm", "10deg_2cm_f60", "5deg_1cm", "5deg_1cm_f80")
    ]
    assert older.samples["s/03"].outcomes == ("1111", "1100", "1111")
    verdicts = compare(older, table())
    assert not any(verdict.failed for verdict in verdicts)
    unknown = (
        "cpas.10deg_5cm, cpas.5deg_5cm, cpas.iou_25, cpas.iou_50, cpas.iou_75, cpas.f60, cpas."
    )
    (verdict,) = (v for v in verdicts if v.word is Word.NOT_CHECKED)
    assert verdict.details.startswith(
        f"this run alone has {unknown}f80; if these results are right"
    )
    assert verdict.outcome(True) == "failed"
    # seeds that agree have the same outcomes everywhere
    older = read_golden(record_older(tmp_path / "b", of_seeds(4.0, 4.0)))
    assert older.samples["s/03"].outcomes == ("1" * 11,) * 2
    verdicts = compare(older, table(s_03=9))
    assert words(verdicts) == OUTDATED | {"can": Word.MATCHES, "mug": Word.REGRESSED}
    with pytest.raises(GoldenError, match="pass --cpas-jitter 2"):
        record(tmp_path / "b", table())


def test_other_conditions_and_definitions_are_stale(tmp_path):
    older = read_golden(record_older(tmp_path, GOLDEN))
    (verdict,) = compare(older, table("y"))
    assert verdict.word is Word.STALE
    redefined = replace(older, definitions={**older.definitions, "iou": "iou:other:2"})
    verdicts = compare(redefined, GOLDEN)
    (stale,) = (verdict for verdict in verdicts if verdict.failed)
    assert (stale.word, len(verdicts)) == (Word.STALE, 4)
    assert "cpas.iou_25, cpas.iou_50, cpas.iou_75: defined otherwise" in stale.details


def test_update_replaces_it(tmp_path):
    folder = record_older(tmp_path, GOLDEN)
    assert {path.name for path in folder.iterdir()} == OLDER
    assert record(tmp_path, table(s_03=9)) == folder
    assert {path.name for path in folder.iterdir()} == FILES
    assert read_golden(folder) == table(s_03=9)
    assert not read_golden(folder).outdated


def test_part_of_it_is_not_recorded(tmp_path):
    """What the others' facts were is not known."""
    folder = record_older(tmp_path, GOLDEN)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    mugs = [row for row in rows(s_03=9) if row.category == "mug"]
    with pytest.raises(GoldenError, match="record all categories together"):
        record(tmp_path, RunTable.of(a_run(), mugs))
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.fixture
def recorded_older(recorded, pytester):
    """A run of pytest, and the folder of an older table in which nothing is known of some facts."""

    def made(lacking):
        folder = pytester.path / "golden" / "recorded" / "perfect" / "tiny"
        new = read_golden(folder)
        shutil.rmtree(folder)
        samples = {
            name: replace(
                sample,
                answers=tuple(
                    replace(answer, facts={**answer.facts, **dict.fromkeys(lacking)})
                    for answer in sample.answers
                ),
            )
            for name, sample in new.samples.items()
        }
        folder.mkdir(parents=True)
        for name, text in older_texts(rejudged(new, samples)).items():
            (folder / name).write_text(text)
        return recorded, folder

    return made


def rejudged(table, samples):
    """The table with the facts of other samples, and what follows from them."""
    answers = {name: (sample.category, sample.answers) for name, sample in samples.items()}
    return replace(table, samples=table_samples(table.protocols, answers))


@pytest.mark.parametrize("lacking", [(), ("iou", "fscore_1cm")])
def test_one_category_of_it_is_not_recorded_and_the_table_stays(recorded_older, lacking):
    """Also of a method that gives no box, or no shape: `--cpas-category mug --snapshot-update`."""
    cpas, folder = recorded_older(lacking)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    result = cpas("Perfect", "--cpas-category=mug", "--snapshot-update")
    assert result.ret == 1
    unfolded(result).fnmatch_lines(
        ["golden: NOT RECORDED: *earlier form*record all categories together (leave out *"]
    )
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    # the category is judged all the same, as far as the table goes; what was n/a has changed
    part = cpas("Perfect", "--cpas-category=mug", "--cpas-require-golden")
    assert part.ret == bool(lacking)
    word = "CHANGED mug: *0 of 0 -> 6 of 6 *" if lacking else "MATCHES mug: all 6 *"
    unfolded(part).fnmatch_lines([f"golden: {word}", "golden: OUTDATED *"])
    assert cpas("Perfect", "--snapshot-update").ret == 0
    assert {path.name for path in folder.iterdir()} == FILES
    assert cpas("Perfect", "--cpas-category=mug", "--snapshot-update").ret == 0


def test_it_is_found_where_the_newer_form_is(tmp_path):
    folder = record_older(tmp_path, GOLDEN)
    assert find_golden(tmp_path, "m", "d").outdated
    assert orphans(tmp_path, {"n"}) == [folder]
    assert orphans(tmp_path, {"m"}) == []


def test_failures_and_what_is_not_known_are_read(tmp_path):
    odd = rows()
    odd[0] = a_row("s/00", "can", failure='commas, "quotes"\nand lines')
    odd[1] = a_row("s/01", "mug", iou=None, fscore_1cm=None)
    new = RunTable.of(a_run(), odd)
    older = read_golden(record_older(tmp_path, new))
    matches = {"can": Word.MATCHES, "mug": Word.MATCHES}
    assert words(compare(older, new)) == OUTDATED | matches
    assert older.samples["s/00"].failure == 'commas, "quotes"\nand lines'
    assert older.samples["s/01"].outcome == "1-1-11---" "--"  # fmt: skip
