"""All points of a robustness profile are in the files of one folder, and none minds the others."""

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from older_tables import record_older
from tables import REFS, Fixed, rows
from test_rankings import a_ranking
from test_revisions import git
from test_updates import lines, turned, with_limit

from pytest_cpas.golden import (
    GoldenError,
    RunTable,
    Word,
    compare,
    find_golden,
    golden_diff,
    left_over,
    orphans,
    read_golden,
    read_tables,
    record,
)
from pytest_cpas.golden.files import is_recorded
from pytest_cpas.golden.points import Points, kept_texts, parse_kept
from pytest_cpas.golden.texts import table_texts
from pytest_cpas.protocols import shipped_protocol

CPAS, OMNI, LEGACY = (shipped_protocol(name) for name in ("cpas", "omni6dpose", "nocs-legacy"))

POINTS = ("unperturbed", "depth-noise-1", "depth-noise-2", "mask-erosion-3")

FIRST = {"code": "1", "revision": "a"}


def at(point, *changed, category=None, protocols=(CPAS,), seeds=1, **told) -> RunTable:
    """The table of tests/tables.py at a point, with other rows in places, perhaps in part."""
    run = Fixed("m", f"d+{point}", REFS, identity={"data": f"x {point}"}, protocols=protocols)
    run.seeds = seeds
    if LEGACY in protocols:
        run.ranking = lambda rows: a_ranking()
    new = {row.sample: row for row in (*rows(), *changed)}.values()
    made = RunTable.of(
        run,
        [
            replace(row, answers=row.answers * seeds)
            for row in new
            if category in (None, row.category)
        ],
    )
    return replace(made, **{"provenance": FIRST, **told})


CHANGES = {
    "nothing": {},
    "a fact": {"changed": [turned("s/03", 9.0)]},
    "part": {"changed": [turned("s/03", 9.0)], "category": "mug", "provenance": {"code": "2"}},
    "data": {"identity": {"data": "y"}},
    "program": {"provenance": {"code": "2"}},
    "definition": {"definitions": {"position_m": "other:2"}},
    "seeds": {"seeds": 3},
    "protocol redefined": {"protocols": (with_limit(0.7),)},
    "protocol more": {"protocols": (CPAS, OMNI)},
    "detections": {"protocols": (CPAS, LEGACY)},
}


def recorded(golden: Path) -> Path:
    """The folder of all points; the disk is not waited for."""
    folder = golden / "recorded" / "m" / "d+robustness"
    folder.mkdir(parents=True)
    for name, text in RECORDED.items():
        (folder / name).write_text(text)
    (golden / ".gitattributes").write_text("recorded/** text eol=lf\n")
    return folder


def texts_of(changes: Sequence[str]) -> dict[str, str]:
    """The files of all points, each under other conditions."""
    kept = Points({}, {}, {})
    for point, change in zip(POINTS, changes, strict=True):
        kept = kept.joined(point, at(point, **CHANGES[change]))
    return kept_texts(kept)


RECORDED = texts_of(["nothing"] * len(POINTS))


def lines_of(folder: Path, point: str) -> dict[str, list[str]]:
    """What the files say of a point, or ("") of all."""
    told: dict[str, list[str]] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix == ".csv":
            key = {"": "perturbation", "unperturbed": ""}.get(point, point)
            told[path.name] = [
                line for line in path.read_text().splitlines() if line and line.split(",")[0] == key
            ]
        else:
            key = rf'\[+points\."{point}"' if point else "# Recorded"
            sections = re.split(r"\n\n(?=\[)", path.read_text().removesuffix("\n"))
            told[path.name] = [
                section
                for section in sections
                if re.match(key, section) or not (point or re.match(r"\[+points\.", section))
            ]
    return told


def test_points_are_in_one_folder_and_read_as_they_were(tmp_path):
    folder = tmp_path / "recorded" / "m" / "d+robustness"
    assert {record(tmp_path, at(point)) for point in POINTS} == {folder}
    assert {path.name: path.read_text() for path in folder.iterdir()} == RECORDED
    assert [path.name for path in folder.parent.iterdir()] == ["d+robustness"]
    assert set(RECORDED) == {"run.toml", "facts.csv", "cpas.toml"}
    for point in POINTS:
        assert find_golden(tmp_path, "m", f"d+{point}") == at(point)
    assert read_tables(folder) == {f"d+{point}": at(point) for point in POINTS}
    assert find_golden(tmp_path, "m", "d+light-1") is None
    assert find_golden(tmp_path, "m", "d") is None
    keys = [tuple(line[:4]) for line in csv.reader(lines(folder)["facts.csv"][1:]) if line]
    assert len(set(keys)) == len(keys) == len(POINTS) * len(REFS)
    assert Counter(key[0] for key in keys) == dict.fromkeys(("", *POINTS[1:]), len(REFS))
    assert orphans(tmp_path, {"n"}) == [folder]


def test_order_of_recording_does_not_matter(tmp_path):
    for point in POINTS[::-1]:
        folder = record(tmp_path, at(point))
    assert {path.name: path.read_text() for path in folder.iterdir()} == RECORDED


def test_the_table_of_the_whole_data_set_is_another_one(tmp_path):
    recorded(tmp_path)
    whole = replace(at("unperturbed", turned("s/03", 9.0)), dataset="d")
    assert record(tmp_path, whole).name == "d"
    assert find_golden(tmp_path, "m", "d") == whole
    assert find_golden(tmp_path, "m", "d+unperturbed") == at("unperturbed")


@pytest.mark.parametrize("point", POINTS[::2])
@pytest.mark.parametrize("change", CHANGES)
def test_a_point_is_recorded_anew_without_the_others(change, point, tmp_path):
    folder = recorded(tmp_path)
    before = {each: lines_of(folder, each) for each in ("", *POINTS)}
    told = dict(CHANGES[change])
    new = at(point, *told.pop("changed", ()), **told)
    record(tmp_path, new)
    for each in POINTS:
        expected = at(each)
        if each == point:
            whole = {**told, "category": None}
            expected = at(point, *CHANGES[change].get("changed", ()), **whole)
        assert find_golden(tmp_path, "m", f"d+{each}").samples == expected.samples
    after = {each: lines_of(folder, each) for each in ("", *POINTS)}
    same = [each for each in after if before[each] == after[each]]
    if change == "nothing":
        assert same == ["", *POINTS]
        return
    assert point not in same
    for each in ("", *POINTS):
        if each != point:
            for name in before[each]:
                if not (change == "protocol more" and name == "facts.csv"):  # it has more columns
                    assert after[each][name] == before[each][name]
    assert set(after[point]) >= set(before[point])
    for each in POINTS:
        if each != point:
            assert find_golden(tmp_path, "m", f"d+{each}") == at(each)


@pytest.mark.parametrize("change", [*CHANGES][4:])
def test_what_is_true_of_all_points_is_told_once(change, tmp_path):
    folder = recorded(tmp_path)
    for point in POINTS:
        record(tmp_path, at(point, **CHANGES[change]))
    fresh = texts_of([change] * len(POINTS))
    assert {path.name: path.read_text() for path in folder.iterdir()} == fresh


def test_points_may_have_been_recorded_under_anything(tmp_path):
    """Each under other conditions than the rest, written over each other in every order."""
    given = dict(
        zip(POINTS, ("seeds", "protocol redefined", "detections", "protocol more"), strict=True)
    )
    tables = {point: at(point, **CHANGES[change]) for point, change in given.items()}
    for order in (POINTS, POINTS[::-1], POINTS[2:] + POINTS[:2]):
        golden = tmp_path / "-".join(order)
        for point in order:
            record(golden, tables[point])
        for point in POINTS:
            assert find_golden(golden, "m", f"d+{point}") == tables[point]


# -- folders of earlier versions ------------------------------------------------------------------


def in_its_own_folder(golden: Path, table: RunTable) -> Path:
    folder = golden / "recorded" / table.method / table.dataset
    folder.mkdir(parents=True)
    for name, text in table_texts(table).items():
        (folder / name).write_text(text)
    return folder


EARLIER = {"its own folder": in_its_own_folder, "version 1": record_older}


@pytest.mark.parametrize("form", EARLIER)
def test_folder_of_a_point_is_judged_named_and_moved(form, tmp_path):
    folders = [EARLIER[form](tmp_path, at(point)) for point in POINTS]
    for point in POINTS:
        golden = find_golden(tmp_path, "m", f"d+{point}")
        assert golden.misplaced
        verdicts = compare(golden, at(point, turned("s/03", 9.0)))
        assert {v.category: v.word for v in verdicts} == {
            "can": Word.MATCHES,
            "mug": Word.REGRESSED,
            "completeness": Word.OUTDATED,
        }
        assert "an earlier form, " in verdicts[-1].details
        assert verdicts[-1].outcome("strict") == "passed"
    (folders[1] / "notes.txt").write_text("mine")
    for done, point in enumerate(POINTS, start=1):
        record(tmp_path, at(point))
        golden = find_golden(tmp_path, "m", f"d+{point}")
        assert golden == at(point)
        assert not golden.misplaced
        assert [v.word for v in compare(golden, at(point))] == [Word.MATCHES] * 2
        assert [folder.exists() for folder in folders[2:]] == [done < 3, done < 4]
    assert [*folders[1].iterdir()] == [folders[1] / "notes.txt"]
    assert not folders[0].exists()


def test_moved_lines_stay_where_nothing_happened(tmp_path):
    in_its_own_folder(tmp_path, at("light-1"))
    record(tmp_path, at("light-1", turned("s/03", 4.0 * (1 + 9e-4))))
    assert find_golden(tmp_path, "m", "d+light-1") == at("light-1")
    in_its_own_folder(tmp_path, at("light-2"))
    record(tmp_path, at("light-2", turned("s/03", 9.0), category="mug"))
    merged = find_golden(tmp_path, "m", "d+light-2")
    assert merged.samples == at("light-2", turned("s/03", 9.0)).samples


def test_damaged_folder_of_a_point_is_neither_judged_nor_replaced(tmp_path):
    recorded(tmp_path)
    folder = in_its_own_folder(tmp_path, at("light-1"))
    (folder / "cpas.toml").write_text("")
    with pytest.raises(GoldenError, match=r"d\+light-1: .*damaged or edited by hand"):
        find_golden(tmp_path, "m", "d+light-1")
    with pytest.raises(GoldenError, match="damaged or edited by hand"):
        record(tmp_path, at("light-1"))
    # beside one that has moved, it is left alone
    record(tmp_path / "b", at("light-1"))
    other = in_its_own_folder(tmp_path / "b", at("light-1"))
    (other / "cpas.toml").write_text("")
    record(tmp_path / "b", at("light-1"))
    assert set(lines(other)) == {"run.toml", "facts.csv", "cpas.toml"}
    assert find_golden(tmp_path / "b", "m", "d+light-1") == at("light-1")
    assert left_over(tmp_path / "b", "m", "d+light-1") == other


@pytest.mark.parametrize("looked_at", ["d+light-1", "d+robustness"])
def test_update_that_moves_a_point_while_it_is_looked_for(looked_at, tmp_path, monkeypatch):
    in_its_own_folder(tmp_path, at("light-1"))

    def moved_meanwhile(folder):
        if folder.name == looked_at:
            monkeypatch.undo()
            record(tmp_path, at("light-1"))
        return is_recorded(folder)

    monkeypatch.setattr("pytest_cpas.golden.files.is_recorded", moved_meanwhile)
    assert find_golden(tmp_path, "m", "d+light-1") == at("light-1")


def test_folder_that_cannot_be_removed_is_told(tmp_path, monkeypatch):
    folder = in_its_own_folder(tmp_path, at("light-1"))
    assert left_over(tmp_path, "m", "d+light-1") is None
    unlink = Path.unlink

    def refusing(path, *args, **kwargs):
        if path.parent == folder:
            raise PermissionError(13, "no")
        unlink(path, *args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refusing)
        record(tmp_path, at("light-1"))
    assert not find_golden(tmp_path, "m", "d+light-1").misplaced
    assert left_over(tmp_path, "m", "d+light-1") == folder
    record(tmp_path, at("light-1"))
    assert left_over(tmp_path, "m", "d+light-1") is None
    assert not folder.exists()


def test_what_ships_is_found_point_by_point(tmp_path, monkeypatch):
    recorded(tmp_path / "shipped")
    monkeypatch.setattr("pytest_cpas.golden.files.shipped_golden", lambda: tmp_path / "shipped")
    new = at("depth-noise-1", turned("s/03", 9.0), category="mug")
    record(tmp_path / "own", new)
    assert [*read_tables(tmp_path / "own/recorded/m/d+robustness")] == ["d+depth-noise-1"]
    found = find_golden(tmp_path / "own", "m", "d+depth-noise-1")
    assert found.samples == at("depth-noise-1", turned("s/03", 9.0)).samples
    assert find_golden(tmp_path / "own", "m", "d+depth-noise-2") == at("depth-noise-2")


# -- names ----------------------------------------------------------------------------------------


def test_data_set_that_is_named_like_the_folder_of_points(tmp_path):
    table = replace(at("unperturbed"), dataset="d+robustness")
    recorded(tmp_path / "a")
    record(tmp_path / "b", table)
    for golden, second in (("a", table), ("b", at("unperturbed"))):
        with pytest.raises(GoldenError, match=r"names of data sets that end with \+robustness"):
            record(tmp_path / golden, second)
    assert read_golden(tmp_path / "b" / "recorded" / "m" / "d+robustness") == table


@pytest.mark.parametrize("dataset", ["d+real-2", "d+light-4", "d+light-0", "d+Light-1", "d+light"])
def test_data_set_that_is_no_point_has_its_own_folder(dataset, tmp_path):
    table = replace(at("unperturbed"), dataset=dataset)
    assert record(tmp_path, table).name == dataset
    assert find_golden(tmp_path, "m", dataset) == table
    assert not find_golden(tmp_path, "m", dataset).misplaced


def test_folder_of_points_is_not_read_as_one_table(tmp_path):
    with pytest.raises(GoldenError, match=r"holds the tables of d\+unperturbed, .*read_tables"):
        read_golden(recorded(tmp_path))


# -- damage ---------------------------------------------------------------------------------------


#: Of points of which some state what others do not.
TEXTS = texts_of(["nothing", "protocol redefined", "detections", "seeds"])


def test_mixed_points_are_read():
    assert parse_kept("m", "d+robustness", TEXTS).tables.keys() == {*POINTS}


@pytest.mark.parametrize("name", TEXTS)
def test_every_line_counts(name):
    """None can be taken away, or be there twice; of every seventh."""
    whole = TEXTS[name].split("\n")
    for number in range(0, len(whole) - 1, 7):
        once, twice = whole[:], whole[:]
        del once[number]
        twice.insert(number, whole[number])
        for edited in (once, twice):
            texts = {**TEXTS, name: "\n".join(edited)}
            if texts != TEXTS:
                with pytest.raises(GoldenError):
                    parse_kept("m", "d+robustness", texts)


EDITS = {
    "point of another name": ("run.toml", '[points."unperturbed"', '[points."light-1"', "is"),
    "point that is none": ("run.toml", '[points."unperturbed"', '[points."Dark"', "points is"),
    "lines of an unknown point": ("facts.csv", "\nmask-erosion-3,", "\nmask-erosion-4,", "is"),
    "lines of another point": ("facts.csv", "\ndepth-noise-1,", "\ndepth-noise-2,", "out of order"),
    "points a number": ("run.toml", '\n[points."unperturbed"]', "\n[x]\n[points.x]", "points is"),
    "no shared facts": ("run.toml", "\nfacts = ", "\nfact = ", "facts is missing"),
    "shared facts of numbers": ("run.toml", "\nfacts = [", "\nfacts = [1, ", "expected names"),
    "unknown shared fact": ("run.toml", '\nfacts = ["', '\nfacts = ["beauty", "', "beauty is mis"),
    "no shared definitions": ("run.toml", "[definitions]", "[definition]", "definitions is miss"),
    "provenance a number": ("run.toml", "\n[provenance]", "\nprovenance = 1\n[p]", "provenance"),
    "column of no fact": ("facts.csv", "perturbation,category", "perturbed,category", "expected"),
    "short line": ("facts.csv", "\n,can,s/00,", "\n,can,", "fields, expected"),
    "no seeds": ("run.toml", "\nseeds = 3", "\nseeds = 0", "seeds is 0"),
    "own protocol of no columns": (
        "cpas.toml",
        '[[points."depth-noise-1".columns]]',
        "[[x]]",
        "a protocol has 'x'",
    ),
    "own protocol of another name": ("cpas.toml", '"]\nname = "cpas"', '"]\nname = "cpus"', "cpus"),
    "unknown section of a protocol": (
        "cpas.toml",
        '\n[points."unper',
        '\n[pints."unper',
        "'pints'",
    ),
}


@pytest.mark.parametrize("edit", EDITS)
def test_edits_are_noticed(edit):
    name, old, new, told = EDITS[edit]
    assert old in TEXTS[name]
    texts = {**TEXTS, name: TEXTS[name].replace(old, new)}
    with pytest.raises(GoldenError, match=re.escape(told)):
        parse_kept("m", "d+robustness", texts)


def test_one_damaged_point_is_told_of_all(tmp_path):
    folder = recorded(tmp_path)
    path = folder / "facts.csv"
    path.write_text(path.read_text().replace("mask-erosion-3,mug,s/03", "mask-erosion-3,mug,s/04"))
    for point in POINTS:
        with pytest.raises(GoldenError, match="Restore it from version control"):
            find_golden(tmp_path, "m", f"d+{point}")
        with pytest.raises(GoldenError, match="Restore it from version control"):
            record(tmp_path, at(point))


# -- version control ------------------------------------------------------------------------------


def branched(folder: Path, *updates: tuple[RunTable, ...]) -> None:
    """A repository into which branches, each with some updates, have been merged."""
    git(folder, "init", "-q", "-b", "main")
    recorded(folder / "golden")
    git(folder, "add", "-A")
    git(folder, "commit", "-qm", "recorded")
    for number, update in enumerate(updates):
        git(folder, "checkout", "-qb", f"b{number}", "main")
        for table in update:
            record(folder / "golden", table)
        git(folder, "commit", "-qam", "update")
    git(folder, "checkout", "-q", "main")
    for number in range(len(updates)):
        git(folder, "merge", "-q", "--no-edit", f"b{number}")


LAST, NEXT = turned("s/09", 12.0), turned("s/00", 7.0)


def test_updates_of_neighbours_are_merged_by_git(tmp_path):
    """The last sample of one point, the first of the next; and categories of a third point."""
    one, two = {"provenance": {"code": "2"}}, {"provenance": {"code": "3"}}
    branched(
        tmp_path,
        (
            at("depth-noise-1", LAST, **one),
            at("mask-erosion-3", turned("s/08", 12.0), category="can", **one),
        ),
        (
            at("depth-noise-2", NEXT, **two),
            at("mask-erosion-3", turned("s/01", 12.0), category="mug", **two),
        ),
    )
    golden = tmp_path / "golden"
    assert find_golden(golden, "m", "d+depth-noise-1") == at("depth-noise-1", LAST, **one)
    assert find_golden(golden, "m", "d+depth-noise-2") == at("depth-noise-2", NEXT, **two)
    third = find_golden(golden, "m", "d+mask-erosion-3")
    assert third.samples == at("x", turned("s/08", 12.0), turned("s/01", 12.0)).samples
    assert (third.provenance_of("can"), third.provenance_of("mug")) == (
        {"code": "2"},
        {"code": "3"},
    )


def test_updates_that_leave_nothing_shared_are_merged_by_git(tmp_path):
    """Neither knows that no point is left of what both have kept above all points."""
    new = {"provenance": {"code": "2"}}
    branched(
        tmp_path,
        tuple(at(point, **new) for point in POINTS[:2]),
        tuple(at(point, **new) for point in POINTS[2:]),
    )
    folder = tmp_path / "golden/recorded/m/d+robustness"
    assert read_tables(folder) == {f"d+{point}": at(point, **new) for point in POINTS}
    record(tmp_path / "golden", at("unperturbed", **new))
    for point in POINTS:
        fresh = record(tmp_path / "fresh", at(point, **new))
    assert lines(folder) == lines(fresh)


@pytest.mark.parametrize("form", [record, *EARLIER.values()])
def test_golden_diff_names_flips_by_point(form, tmp_path):
    git(tmp_path, "init", "-q")
    for point in POINTS:
        form(tmp_path / "golden", at(point))
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "one")
    for point in POINTS:
        record(tmp_path / "golden", at(point))
    assert list(golden_diff(tmp_path / "golden", "HEAD")) == []
    record(tmp_path / "golden", at("depth-noise-2", turned("s/03", 9.0)))
    record(tmp_path / "golden", at("light-1"))
    flip, there = golden_diff(tmp_path / "golden", "HEAD")
    assert flip.startswith("m/d+depth-noise-2: REGRESSED mug: 5 deg, 1 cm: 5 -> 4 of 5 correct")
    assert there == "m/d+light-1: there was none in HEAD"


def test_golden_diff_is_of_what_is_read(tmp_path):
    """What is left of the folder that a point had is not."""
    branched(tmp_path)
    for left in ("unperturbed", "depth-noise-1"):
        (in_its_own_folder(tmp_path / "golden", at(left)) / "facts.csv").unlink()
    assert list(golden_diff(tmp_path / "golden", "HEAD")) == []
