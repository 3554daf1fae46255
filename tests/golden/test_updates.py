"""What an update of a golden table changes: no more than it must, so that two can be merged."""

import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from tables import GOLDEN, REFS, Fixed, a_run, rows, table, with_facts

from pytest_cpas.facts import fact
from pytest_cpas.golden import GoldenError, RunTable, Word, compare, read_golden, record
from pytest_cpas.protocols import (
    Column,
    CountColumn,
    Protocol,
    RankingColumn,
    shipped_protocol,
    shipped_protocols,
)

CPAS, OMNI = shipped_protocol("cpas"), shipped_protocol("omni6dpose")


def of(*changed, category=None, provenance=None, protocols=(CPAS,)) -> RunTable:
    """The table of tests/tables.py with other rows in places, perhaps of one category alone."""
    run = Fixed("m", "d", REFS, identity={"data": "x"}, protocols=protocols)
    new = {row.sample: row for row in (*rows(), *changed)}.values()
    made = RunTable.of(run, [row for row in new if category in (None, row.category)])
    return made if provenance is None else replace(made, provenance=provenance)


def turned(sample: str, angle: float):
    (row,) = (row for row in rows() if row.sample == sample)
    return with_facts(row, rotation_deg=angle)


def lines(folder: Path) -> dict[str, list[str]]:
    return {path.name: path.read_text().splitlines() for path in sorted(folder.iterdir())}


def changed_lines(folder: Path, update: RunTable) -> dict[str, list[str]]:
    """The lines that an update writes, by file."""
    before = lines(folder)
    record(folder.parents[2], update)
    after = lines(folder)
    assert before.keys() == after.keys()
    return {
        name: [line for line in after[name] if line not in before[name]]
        for name in before
        if before[name] != after[name]
    }


@pytest.mark.parametrize(
    ("facts", "rewritten"),
    [
        ({"rotation_deg": 4.0 * (1 + 9e-4)}, False),
        ({"rotation_deg": 4.0 * (1 + 1.1e-3)}, True),
        ({"iou": 0.9 * (1 - 9e-4)}, False),
        ({"iou": 0.9 * (1 - 1.1e-3)}, True),
        ({"iou": None}, True),
        # below any tolerance, but on the other side of a limit
        ({"rotation_deg": 5 + 1e-9}, True),
        ({"fscore_1cm": 0.0}, True),
    ],
)
def test_line_is_rewritten_only_if_something_happened(tmp_path, facts, rewritten):
    limit = {"rotation_deg": 5.0} if facts.get("rotation_deg", 0) > 5 else {}
    before = [with_facts(row, **limit) if row.sample == "s/03" else row for row in rows()]
    folder = record(tmp_path, of(*before))
    after = [with_facts(row, **facts) if row.sample == "s/03" else row for row in before]
    written = changed_lines(folder, of(*after))
    assert bool(written) is rewritten
    if rewritten:
        (line,) = written["facts.csv"]
        assert line.startswith("mug,s/03,0,")
    read = read_golden(folder)
    assert read == of(*(after if rewritten else before))


def test_failure_that_is_told_otherwise_is_rewritten(tmp_path):
    def failing(reason):
        (row,) = (row for row in rows() if row.sample == "s/03")
        (answer,) = row.answers
        failed = {name: fact(name).failed for name in answer.facts}
        return replace(row, answers=(replace(answer, facts=failed, failure=reason),))

    folder = record(tmp_path, of(failing("too dark")))
    written = changed_lines(folder, of(failing("too small")))
    assert [line.rpartition(",")[2] for line in written["facts.csv"]] == ["too small"]


def test_tolerance_is_from_what_is_recorded(tmp_path):
    """Small steps do not add up unseen."""
    folder = record(tmp_path, of())
    for step in range(1, 4):
        record(tmp_path, of(turned("s/03", 4.0 * (1 + 5e-4 * step))))
    assert read_golden(folder).samples["s/03"].facts["rotation_deg"] == 4.0 * (1 + 1.5e-3)


def test_update_of_a_category_writes_its_lines_alone(tmp_path):
    folder = record(tmp_path, of(provenance={"code": "1"}))
    update = of(turned("s/03", 9.0), category="mug", provenance={"code": "2"})
    written = changed_lines(folder, update)
    assert [line[:9] for line in written["facts.csv"]] == ["mug,s/03,"]
    assert written["cpas.toml"] == [
        *('5deg_1cm = "4/5"', '5deg_1cm_f80 = "4/5"', '5deg_5cm = "4/5"')
    ]
    assert [line.split()[0] for line in written["run.toml"]] == [
        *("digest", '[categories."mug".provenance]', "code")
    ]
    read = read_golden(folder)
    assert read.provenance_of("can") == {"code": "1"}
    assert read.provenance_of("mug") == {"code": "2"}
    # all together are of one run again
    record(tmp_path, of(provenance={"code": "3"}))
    assert {read_golden(folder).provenance_of(name)["code"] for name in ("can", "mug")} == {"3"}
    assert read_golden(folder).own_provenance == {}


def test_note_tells_what_made_the_category(tmp_path):
    record(tmp_path, of(provenance={"code": "1"}))
    folder = record(tmp_path, of(category="mug", provenance={"code": "2"}))
    worse = of(turned("s/02", 9.0), turned("s/03", 9.0), provenance={"code": "3"})
    can, mug = compare(read_golden(folder), worse)
    assert "note: code was 1, now 3" in can.details
    assert "note: code was 2, now 3" in mug.details


def git(folder: Path, *args: str) -> str:
    identity = ("-c", "user.name=x", "-c", "user.email=x@example.org")
    done = subprocess.run(
        ["git", *identity, *args], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def branched(folder: Path, updates: dict[str, RunTable]) -> None:
    """A repository with a branch for each update of its golden table."""
    git(folder, "init", "-q", "-b", "main")
    record(folder / "golden", of(provenance={"revision": "0"}))
    git(folder, "add", "-A")
    git(folder, "commit", "-qm", "recorded")
    for name, update in updates.items():
        git(folder, "checkout", "-qb", name, "main")
        record(folder / "golden", update)
        git(folder, "commit", "-qam", name)
    git(folder, "checkout", "-q", "main")


def test_updates_of_different_categories_are_merged_by_git(tmp_path):
    """The last sample of one and the first of the other, of different revisions."""
    can = [turned(ref.id, 7.0) for ref in REFS if ref.category == "can"]
    mug = [turned(ref.id, 12.0) for ref in REFS if ref.category == "mug"]
    branched(
        tmp_path,
        {
            "can": of(*can, category="can", provenance={"revision": "1"}),
            "mug": of(*mug, category="mug", provenance={"revision": "2"}),
        },
    )
    git(tmp_path, "merge", "-q", "can")
    git(tmp_path, "merge", "-q", "--no-edit", "mug")
    merged = read_golden(tmp_path / "golden" / "recorded" / "m" / "d")
    assert merged.samples == of(*can, *mug).samples
    assert merged.provenance_of("can") == {"revision": "1"}
    assert merged.provenance_of("mug") == {"revision": "2"}
    assert git(tmp_path, "status", "--porcelain") == ""


def test_merge_that_mixes_two_tables_is_refused(tmp_path):
    """Git joins what was recorded together, where the lines are far enough from each other."""
    branched(
        tmp_path,
        {
            "one": of(turned("s/00", 4.5), provenance={"revision": "0"}),
            "two": of(turned("s/08", 4.5), provenance={"revision": "0"}),
        },
    )
    git(tmp_path, "merge", "-q", "one")
    git(tmp_path, "merge", "-q", "-Xours", "--no-edit", "two")
    with pytest.raises(GoldenError, match="damaged or edited by hand"):
        read_golden(tmp_path / "golden" / "recorded" / "m" / "d")


# -- protocols ----------------------------------------------------------------------------------


def words(verdicts):
    return [(verdict.category, verdict.word) for verdict in verdicts]


MATCHES = [("can", Word.MATCHES), ("mug", Word.MATCHES)]


def test_protocols_are_not_lost_by_an_update_under_fewer(tmp_path):
    both = of(protocols=(CPAS, OMNI))
    folder = record(tmp_path, both)
    before = lines(folder)
    told = "columns of omni6dpose as well: pass --cpas-protocol cpas --cpas-protocol omni6dpose"
    for fewer in (of(), of(category="mug")):
        with pytest.raises(GoldenError, match=told):
            record(tmp_path, fewer)
    assert lines(folder) == before
    assert read_golden(folder) == both


def test_protocol_is_added_with_all_categories(tmp_path):
    folder = record(tmp_path, of())
    with pytest.raises(GoldenError, match="record all categories together"):
        record(tmp_path, of(category="mug", protocols=(CPAS, OMNI)))
    record(tmp_path, of(protocols=(CPAS, OMNI)))
    assert set(lines(folder)) == {"run.toml", "facts.csv", "cpas.toml", "omni6dpose.toml"}
    record(tmp_path, of(turned("s/03", 9.0), category="mug", protocols=(CPAS, OMNI)))
    assert read_golden(folder) == of(turned("s/03", 9.0), protocols=(CPAS, OMNI))


def test_protocol_that_one_of_the_tables_lacks_is_not_checked():
    both = of(protocols=(CPAS, OMNI))
    for golden, run, told in (
        (of(), both, "the golden table has no columns of omni6dpose"),
        (both, of(), "pass --cpas-protocol cpas --cpas-protocol omni6dpose"),
    ):
        verdicts = compare(golden, run)
        assert words(verdicts) == [*MATCHES, ("completeness", Word.NOT_CHECKED)]
        assert told in verdicts[-1].details
        assert verdicts[-1].outcome(False) == "skipped"
        assert verdicts[-1].outcome(True) == "failed"


def with_limit(limit: float) -> Protocol:
    """``cpas`` with another limit of one column."""
    columns = [
        replace(column, limits={"iou": limit}) if column.id == "iou_75" else column
        for column in CPAS.columns
    ]
    return replace(CPAS, version=2, columns=columns)


def test_column_that_is_redefined_is_stale_alone():
    verdicts = compare(of(), of(protocols=(with_limit(0.7),)))
    assert words(verdicts) == [*MATCHES, ("all", Word.STALE)]
    assert verdicts[-1].details.startswith("cpas.iou_75: defined otherwise when the golden table")
    # what it was defined by, in all columns that use it, while the others are judged
    new = of(turned("s/03", 9.0))
    new = replace(new, definitions={**new.definitions, "iou": "iou:other:2"})
    verdicts = compare(of(), new)
    assert words(verdicts)[1:] == [("mug", Word.REGRESSED), ("all", Word.STALE)]
    assert verdicts[-1].details.startswith("cpas.iou_25, cpas.iou_50, cpas.iou_75: defined")


EVERYTHING = [shipped_protocol(name) for name in shipped_protocols()]


@pytest.mark.parametrize(
    ("protocol", "column"),
    [
        pytest.param(protocol, column, id=column.key)
        for protocol in EVERYTHING
        for column in protocol.columns
    ],
)
def test_column_of_any_kind_that_the_tables_do_not_share_is_told(protocol, column):
    """One of them lacks it, judges it by another statistic, or by facts of another definition."""
    whole = of(protocols=(CPAS, protocol) if protocol.name != "cpas" else (CPAS,))
    protocol = next(p for p in whole.protocols if p.name == protocol.name)

    def with_columns(columns) -> RunTable:
        changed = replace(protocol, columns=columns)
        return of(protocols=tuple(changed if p is protocol else p for p in whole.protocols))

    lacking = with_columns([each for each in protocol.columns if each is not column])
    for golden, run, who in ((whole, lacking, "the golden table"), (lacking, whole, "this run")):
        told = compare(golden, run)[-1]
        assert told.word is Word.NOT_CHECKED
        assert told.details.startswith(f"{who} alone has {column.key}; ")

    other = with_columns([turned_over(c) if c is column else c for c in protocol.columns])
    for golden, run in ((whole, other), (other, whole)):
        told = compare(golden, run)[-1]
        assert told.word is Word.STALE
        assert told.details.startswith(f"{column.key}: defined otherwise")

    name = column.facts[0].name
    redefined = replace(whole, definitions={**whole.definitions, name: "other:1"})
    told = compare(whole, redefined)[-1]
    assert (told.category, told.word) == ("all", Word.STALE)
    users = [c.key for p in whole.protocols for c in p.columns if name in {f.name for f in c.facts}]
    assert told.details.startswith(f"{', '.join(users)}: defined otherwise")


def turned_over(column: Column) -> Column:
    """The same column with another statistic of the same facts."""
    if isinstance(column, CountColumn | RankingColumn):
        return replace(column, limits={name: 0.9 * limit for name, limit in column.limits.items()})
    if column.median:
        return replace(column, median="", areas={column.median: (0.0, 0.5)})
    if column.levels:
        return replace(column, levels={name: limits[:-1] for name, limits in column.levels.items()})
    return replace(column, bins=column.bins + 1)


def test_columns_in_another_order_are_the_same_columns():
    turned_round = replace(CPAS, columns=[*CPAS.columns][::-1])
    assert words(compare(of(), of(protocols=(turned_round,)))) == MATCHES
    worse = of(turned("s/03", 9.0), protocols=(turned_round,))
    verdicts = compare(of(), worse)
    assert words(verdicts)[1] == ("mug", Word.REGRESSED)
    assert "5 deg, 1 cm, F 0.8: 5 -> 4 of 5 correct" in verdicts[1].details
    assert "IoU" not in verdicts[1].details.replace("IoU 0.9", "")


def test_every_column_of_the_default_protocol_is_guarded():
    """Each alone: the others are as they were."""
    for column in CPAS.counts:
        assert isinstance(column, CountColumn)
        broken = GOLDEN.columns.index(column)
        outcome = "1" * broken + "0" + "1" * (len(GOLDEN.columns) - broken - 1)
        new = dict(GOLDEN.samples)
        new["s/03"] = replace(new["s/03"], outcomes=(outcome,))
        (_, mug) = compare(GOLDEN, replace(GOLDEN, samples=new))
        assert mug.word is Word.REGRESSED
        assert mug.details.startswith(f"{column.label}: 5 -> 4 of 5 correct\n")
        assert mug.details.count("lost: ") == 1


def test_run_of_these_tests_is_of_the_default_protocol():
    assert a_run().protocols == (CPAS,)
    assert table() == of()
