"""Runs under several protocols: every renderer shows each, and a stored run is judged anew."""

import csv
import io
import json
import re
import sys

import pytest
from harness import RUN
from pages import Page
from report_schema import follow_schema
from tables import CPAS, a_row, a_run, rows
from test_report_export import tables

from pytest_cpas.cli import main
from pytest_cpas.golden import RunTable
from pytest_cpas.protocols import Protocol, shipped_protocol
from pytest_cpas.report.against import against
from pytest_cpas.report.document import document, run_document
from pytest_cpas.report.export import precision_csv, precision_tex, scores_csv
from pytest_cpas.report.markdown import markdown
from pytest_cpas.report.page import page
from pytest_cpas.report.rejudged import rejudged

HOSTILE = "<b>|100 %_$x$ : y`"

OWN = Protocol.parse(
    {
        "name": "own",
        "columns": [
            {"id": "loose", "label": HOSTILE, "at": {"rotation_deg": 20, "position_m": 0.05}},
            {"id": "strict", "guard": True, "at": {"rotation_deg": 5}},
            {"id": "shape", "label": "mean F", "area": {"fscore_1cm": [0, 1]}},
        ],
    },
    "here",
)
SEVERAL = (*CPAS, shipped_protocol("omni6dpose"), OWN)


def under(protocols, judged=None) -> dict:
    """A document of the run of :func:`rows`, golden as :func:`rows` without changes."""
    run = a_run()
    run.protocols = protocols
    golden = RunTable.of(run, rows())
    new = RunTable.of(run, rows(s_03=7.0, s_04=30.0) if judged is None else judged)
    content = document([run_document(run, new, golden=golden)], 0, protocols)
    follow_schema(content)
    return content


def markdown_tables(text: str) -> dict[str, list[list[str]]]:
    """By what stands in the first cell of the head: all lines, as cells."""
    found = {}
    for block in re.findall(r"(?m)(?:^\|.*\n)+", text):
        lines = [re.split(r"(?<!\\)\|", line.strip("|\n"))[0:] for line in block.splitlines()]
        cells = [[cell.strip() for cell in line] for line in lines]
        assert {len(line) for line in cells[2:]} <= {len(cells[0])}, block
        name = cells[0][0] + " again" * (cells[0][0] in found)
        found[name] = [cells[0], *cells[2:]]
    return found


def test_markdown_has_tables_of_every_protocol():
    text = markdown(under(SEVERAL))
    found = markdown_tables(text)
    assert found["own: correct"][1:] == [["m", "9/10 90.0 %"]]
    (head, *lines) = found["own: correct again"]  # of the run, per category
    assert len(head) == 2
    assert lines[-1] == ["all", "9/10 90.0 %<br>55.5 to 99.7 % per sample<br>golden 100.0 %"]
    guards = {line[0]: line for line in found["guards"]}
    assert guards["guards"][1:3] == ["10 deg, 5 cm", "5 deg, 5 cm"]
    assert guards["all"][1:4] == [
        "**90.0 %**<br>55.5 to 99.7 % per sample<br>golden 100.0 %",
        "**80.0 %**<br>44.4 to 97.5 % per sample<br>golden 100.0 %",
        "100.0 %<br>69.2 to 100.0 % per sample",
    ]
    assert found["own: guards"][0] == ["own: guards", "5 deg"]
    assert found["scores"][-1] == ["all", "0.01<br>0.01 to 0.01 per sample"]
    assert found["own: scores"] == [
        ["own: scores", "mean F"],
        *[[name, "95.0 %"] for name in ("can", "mug", "all")],
    ]
    assert found["omni6dpose: scores"][0][4] == "VUS 5 deg 2 cm"
    (_, *lines) = found["omni6dpose: scores"]
    assert lines[-1][4].startswith("**")  # lost against golden
    assert "<b>" not in text


def test_page_has_tables_of_every_protocol():
    content = under(SEVERAL)
    text = page(content, {})
    parsed = Page(text)
    assert HOSTILE in parsed.text["th"]
    assert "b" not in {tag for tag, _ in parsed.found}
    for title in ("own: correct at", "own: guards", "guards", "omni6dpose: scores", "own: scores"):
        assert title in parsed.text["th"], title
    (run,) = content["runs"]
    for entry in run["guards"]:
        count = entry["measured"]
        assert f"{100 * count['correct'] / count['total']:.1f} %" in parsed.text["span"]
    summaries = parsed.text["summary"]
    assert "Guards" in summaries
    assert "Scores" in summaries
    beside = "<small>44.4 to 97.5 % per sample</small><small>golden 100.0 %</small>"
    assert f'<span class="unmet">80.0 %</span>{beside}' in text


def test_tables_of_a_paper_have_every_protocol():
    text = precision_tex(under(SEVERAL))
    found = tables(text)
    # the paper's four, ours, guards of both, scores of all three, intervals of what varies
    assert [len(table[0]) - 1 for table in found] == [4, 1, 7, 1, 1, 7, 1, 4, 1, 4]
    assert r"\textless{}b\textgreater{}\textbar{}100 \%\_\$x\$ : y`" in text
    assert found[2][0][1:3] == ["0.9000", "0.8000"]
    assert found[6] == [["m", "0.9500"]]
    assert found[8] == [["m, per sample", r"55.5 to 99.7 \%"]]
    for name in ("own", "omni6dpose"):
        assert f"Scores of {name} on d." in text


def test_csv_names_the_protocol_of_every_column():
    content = under(SEVERAL)
    lines = list(csv.DictReader(io.StringIO(precision_csv(content))))
    overall = {
        (line["protocol"], line["column"]): int(line["correct_low"])
        for line in lines
        if line["category"] == "all"
    }
    assert len(overall) == 4 + 7 + 2
    assert overall["own", HOSTILE] == 9
    assert overall["own", "5 deg"] == overall["cpas", "5 deg, 5 cm"] == 8
    scores = list(csv.DictReader(io.StringIO(scores_csv(content))))
    told = {(x["protocol"], x["column"]): x["value"] for x in scores if x["category"] == "all"}
    assert len(told) == 1 + 7 + 1
    assert told["own", "mean F"] == "0.95"
    assert told["cpas", "median NAD"] == "0.01"


def test_comparison_of_runs_under_different_protocols_has_the_shared_columns():
    content, other = under(SEVERAL), under(CPAS, rows())
    content["against"] = against(content["runs"], other["runs"])
    follow_schema(content)
    found = markdown_tables(markdown(content))
    assert found["before → now"][0][1:] == content["thresholds"][:4]
    assert found["before → now again"][0][1:] == content["guards"][:7]
    assert "own: before → now" not in found
    assert "own: before → now" not in Page(page(content, {})).text["th"]


def test_a_score_without_a_number_is_not_called_na():
    failed = [a_row(row.sample, row.category, failure="no luck") for row in rows()]
    found = markdown_tables(markdown(under(CPAS, failed)))
    assert found["scores"][-1] == ["all", "**infinite**<br>golden 0.01"]


def test_rejudged_is_as_if_it_had_been_judged_so():
    """With samples that failed, and facts that are n/a for some."""
    judged = [
        a_row(row.sample, row.category, failure="no luck") if index % 3 == 0 else row
        for index, row in enumerate(rows(s_04=30.0))
    ]
    judged[2] = a_row(judged[2].sample, "can", fscore_1cm=None, nad=None)
    judged[3] = a_row(judged[3].sample, "mug", failure="no luck", fscore_1cm=None, nad=None)
    run = a_run()
    before = document([run_document(run, RunTable.of(run, judged))], 0, CPAS)
    run.protocols = SEVERAL
    expected = document([run_document(run, RunTable.of(run, judged))], 0, SEVERAL)
    stored = json.loads(json.dumps(before, allow_nan=False))
    assert rejudged(stored, SEVERAL) == expected
    assert rejudged(json.loads(json.dumps(expected)), CPAS) == before


#: A protocol in a project, of facts that the paper's rows have, and one that they have not.
PROJECT = """
[tool.pytest-cpas.protocols.mine]
columns = [
    { id = "wide", at = { rotation_deg = 10, position_m = 0.10 } },
    { id = "box", guard = true, at = { iou = 0.5 } },
]
[tool.pytest-cpas.protocols.fine]
columns = [{ id = "f", at = { fscore_5mm = 0.5 } }]
"""


@pytest.fixture
def project(recorded, pytester, monkeypatch):
    (pytester.path / "pyproject.toml").write_text(PROJECT)
    recorded("Biased", "--cpas-report=old", "--cpas-results=rows", "--cpas-protocol=cpas")
    monkeypatch.chdir(pytester.path)
    return pytester.path


@pytest.mark.parametrize("name", ["old/report.json", "rows/perfect-tiny.jsonl"])
def test_a_stored_run_is_judged_under_another_protocol(project, name, capsys, recorded):
    options = () if name.endswith(".json") else RUN
    main(["report", name, "--to", "new", "--protocol", "mine", *options])
    content = json.loads((project / "new" / "report.json").read_text())
    follow_schema(content)
    assert content["thresholds"] == ["mine: 10 deg, 10 cm"]
    assert content["guards"] == ["mine: IoU 0.5"]
    recorded("Biased", "--cpas-report=fresh", "--cpas-protocol=mine")
    fresh = json.loads((project / "fresh" / "report.json").read_text())
    for key in ("precision", "guards", "scores"):
        cells = [{**cell, "golden": None} for cell in fresh["runs"][0][key]]
        assert [{**cell, "golden": None} for cell in content["runs"][0][key]] == cells
    outcomes = [sample["outcome"] for sample in fresh["runs"][0]["samples"]]
    assert [sample["outcome"] for sample in content["runs"][0]["samples"]] == outcomes


def test_what_stored_rows_do_not_have_is_said_once(project, capsys):
    told = (
        "n/a: fine.f needs the fact fscore_5mm, which these rows do not have: run again with"
        " --cpas-protocol fine (or the .toml file of fine)"
    )
    assert main(["report", "old/report.json", "--to", "new", "--protocol", "fine"]) == 0
    assert capsys.readouterr().out.splitlines().count(told) == 1
    (run,) = json.loads((project / "new" / "report.json").read_text())["runs"]
    assert {cell["measured"] for cell in run["precision"]} == {None}
    assert told.removeprefix("n/a: ").replace("_", r"\_") in (project / "new/report.md").read_text()
    assert main(["report", "old/report.json", "--to", "new", "--protocol", "fien"]) == 1
    assert "Did you mean 'fine'?" in capsys.readouterr().err
    main(["merge", "rows/perfect-tiny.jsonl", "--cpas-protocol", "fine", *RUN])
    shown = " ".join(capsys.readouterr().out.split())
    assert shown.count(told) == 1


def test_merge_judges_under_another_protocol(project, capsys):
    main(["merge", "rows/perfect-tiny.jsonl", "--cpas-protocol", "mine", *RUN])
    out = capsys.readouterr().out
    assert re.search(r"^mine: correct +10 deg, 10 cm$", out, re.M)
    assert re.search(r"^mine: guards +IoU 0.5$", out, re.M)
    assert "5 deg, 1 cm" not in re.split(r"golden: ", out)[0].split("mine: correct")[1]


def test_both_sides_of_a_comparison_are_judged_anew(project):
    others = ("--against", "old/report.json")
    code = main(["report", "old/report.json", "--to", "new", *others, "--protocol", "mine"])
    assert code == 0
    (pair,) = json.loads((project / "new/report.json").read_text())["against"]["pairs"]
    assert {cell["threshold"] for cell in pair["precision"]} == {"mine: 10 deg, 10 cm"}
    assert {cell["threshold"] for cell in pair["guards"]} == {"mine: IoU 0.5"}


def test_six_protocols_of_fourteen_columns_fit_the_terminal(recorded, pytester):
    names = [f"a-rather-long-name-of-a-protocol-{index}" for index in range(6)]
    columns = "".join(
        f'    {{ id = "c{i}", at = {{ rotation_deg = {i + 1}, position_m = 0.0{i % 9 + 1} }} }},\n'
        for i in range(14)
    )
    text = "".join(
        f"[tool.pytest-cpas.protocols.{name}]\ncolumns = [\n{columns}]\n" for name in names
    )
    (pytester.path / "pyproject.toml").write_text(text)
    result = recorded("Perfect", *(f"--cpas-protocol={name}" for name in names))
    lines = result.stdout.str().splitlines()
    tables = [line for line in lines if re.match(r"(a-rather\S*:|bowl|mug|all) ", line)]
    assert max(map(len, tables)) <= 100
    heads = [line for line in tables if line.startswith("a-rather")]
    shown = " ".join(heads)
    for name in names:
        own = " ".join(line for line in heads if line.startswith(f"{name}: correct"))
        for i in range(14):
            assert f"  {i + 1} deg, {i % 9 + 1} cm" in own, (name, i)
    assert shown.count("cpas") == 0


def test_list_shows_protocols_with_their_columns(pytester, monkeypatch):
    monkeypatch.delitem(sys.modules, "tiny", raising=False)
    (pytester.path / "pyproject.toml").write_text(PROJECT)
    result = pytester.runpytest_inprocess(*RUN, "--cpas-list")
    assert result.ret == 0
    lines = result.stdout.str().partition("protocols:")[2].splitlines()
    told = {line.split()[0]: line for line in lines if line.strip()}
    for name in ("cpas", "omni6dpose", "mine", "fine"):
        assert told[name].startswith(f"  {name} ")
    assert told["iou_50"].endswith("IoU 0.5  (guard)")
    assert told["wide"].endswith("10 deg, 10 cm")
    (pytester.path / "pyproject.toml").write_text(PROJECT.replace("iou =", "iuo ="))
    result = pytester.runpytest_inprocess(*RUN, "--cpas-list")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*there is no fact 'iuo'*"])
