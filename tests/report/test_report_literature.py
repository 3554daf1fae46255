"""A run under nocs-legacy stands beside what the literature prints, and is not judged by it."""

import csv
import io

import pytest
from pages import Page
from report_schema import follow_schema
from tables import CPAS, REFS, Fixed, rows
from test_report_export import tables
from test_report_protocols import markdown_tables
from told_lines import told

from pytest_cpas.golden import RunTable
from pytest_cpas.golden.literature import literature
from pytest_cpas.protocols import RankedDetection, Ranking, shipped_protocol
from pytest_cpas.report.document import document, run_document
from pytest_cpas.report.export import precision_tex, scores_csv
from pytest_cpas.report.literature import REMARK, literature_table, nearest, printed_rows
from pytest_cpas.report.markdown import markdown
from pytest_cpas.report.page import page

BOTH = (*CPAS, shipped_protocol("nocs-legacy"))
COLUMNS = len(BOTH[1].columns)
HEAD = [
    *("nocs-legacy: AP in %", "IoU 25", "IoU 50", "IoU 75"),
    *("5 deg 2 cm", "5 deg 5 cm", "10 deg 2 cm", "10 deg 5 cm"),
]


def half_right(rows=()) -> Ranking:
    """AP 50 % in every column: one of two cans is found, and one of two mugs."""
    detections = {f"{name}-0": RankedDetection(name, 0.9, "1" * COLUMNS) for name in ("can", "mug")}
    return Ranking(detections, dict.fromkeys(("can", "mug"), (2,) * COLUMNS))


def a_document(dataset="real275", protocols=BOTH, ranking=half_right) -> dict:
    run = Fixed("m", dataset, REFS, identity={"data": "x"}, protocols=protocols)
    run.ranking = ranking
    content = document([run_document(run, RunTable.of(run, rows()))], 0, protocols)
    follow_schema(content)
    return content


def test_document_has_the_printed_lines_of_the_data_set():
    content = a_document()
    assert list(content["literature"]) == ["real275"]
    printed = {row["method"]: row for row in content["literature"]["real275"]}
    assert list(printed) == [row.method for row in literature("real275")]
    assert printed["dualposenet"]["percent"] == {
        "nocs-legacy: AP IoU 50": 79.8,
        "nocs-legacy: AP IoU 75": 62.2,
        "nocs-legacy: AP 5 deg 2 cm": 29.3,
        "nocs-legacy: AP 5 deg 5 cm": 35.9,
        "nocs-legacy: AP 10 deg 2 cm": 50.0,
        "nocs-legacy: AP 10 deg 5 cm": 66.8,
    }
    # by the labels by which a program finds the run's own figures
    own = {score["score"] for score in content["runs"][0]["scores"]}
    assert all(set(row["percent"]) <= own for row in printed.values())


@pytest.mark.parametrize(("dataset", "count"), [("real275", 26), ("camera25", 17)])
def test_every_renderer_shows_all_lines(dataset, count):
    content = a_document(dataset)
    table = markdown_tables(markdown(content))["nocs-legacy: AP in %"]
    assert table[0] == [*HEAD, "paper"]
    assert table[1] == ["this run", *["**50.0**"] * 7, ""]
    assert len(table) == 2 + count
    lines = {line[0]: line[1:] for line in table[2:]}
    assert lines["crnet"][-1] == "Wang et al., IROS 2021 (CR-Net)"
    assert (
        lines["crnet"][1:3] == {"real275": ["79.3", "55.9"], "camera25": ["93.8", "88.0"]}[dataset]
    )
    assert lines["genpose"][:3] == ["", "", ""]  # printed nowhere, and not 0
    parsed = Page(page(content, {}))
    assert parsed.text["summary"].count("Beside the literature") == 1
    assert [title for title in HEAD if title not in parsed.text["th"]] == []
    assert "README of JeremyWANGJZ/Category-6D-Pose" in parsed.text["small"]
    for text in (markdown(content), page(content, {})):
        assert REMARK in text
    found = list(csv.DictReader(io.StringIO(scores_csv(content))))
    printed = [line for line in found if line["source"] == "literature"]
    assert {line["dataset"] for line in printed} == {dataset}
    assert len({line["method"] for line in printed}) == count
    (line,) = (
        line for line in printed if (line["method"], line["column"]) == ("crnet", "AP IoU 50")
    )
    assert line["value"] == {"real275": "0.793", "camera25": "0.938"}[dataset]
    assert (line["category"], line["protocol"], line["samples"]) == ("all", "nocs-legacy", "")
    measured = {line["source"] for line in found if line["method"] == "m"}
    assert measured == {"measured"}


@pytest.mark.parametrize(("dataset", "count"), [("real275", 26), ("camera25", 17)])
def test_tables_of_a_paper_have_all_lines(dataset, count):
    text = precision_tex(a_document(dataset))
    own, *lines = tables(text)[-1]
    assert own == ["m", *["50.0"] * 7, ""]
    assert len(lines) == count
    by_name = {line[0]: line[1:] for line in lines}
    assert by_name["crnet (paper)"][-1] == "Wang et al., IROS 2021 (CR-Net)"
    assert by_name["genpose (paper)"][:3] == ["", "", ""]
    assert text.count(REMARK) == 1
    assert REMARK not in precision_tex(a_document(dataset, CPAS))


def test_terminal_shows_the_nearest_in_100_columns():
    shown = told(a_document())
    start = next(i for i, line in enumerate(shown) if line.startswith(HEAD[0]))
    table = shown[start : start + 7]
    assert [line for line in table if len(line) > 100] == []
    assert table[1].split() == ["this", "run", *["50.0"] * 7]
    assert shown[start + 7] == ""
    assert " ".join(shown[start + 8 : start + 10]).startswith(
        "literature: the nearest 5 of 26 printed lines. Printed figures are rounded"
    )
    assert max(len(line) for line in shown) <= 100


def test_nearest_by_the_mean_difference_of_what_both_have():
    (run,) = a_document()["runs"]

    def line(name: str, **percent: float) -> dict:
        labels = {"a": "nocs-legacy: AP IoU 50", "b": "nocs-legacy: AP IoU 75"}
        return {"method": name, "percent": {labels[k]: value for k, value in percent.items()}}

    far, near, nothing = line("far", a=50, b=10), line("near", b=60), line("nothing")
    assert [row["method"] for row in nearest(run, [nothing, far, near], 5)] == ["near", "far"]
    assert nearest(run, [far, near], 1) == [near]


def test_nothing_stands_beside_other_data_or_another_protocol():
    for content in (a_document("tiny"), a_document("redwood75"), a_document(protocols=CPAS)):
        assert "literature" not in content
        assert printed_rows(content["runs"][0], content) == []
        shown = "\n".join([markdown(content), page(content, {}), *told(content)])
        assert REMARK not in " ".join(shown.split())
        assert "beside the literature" not in shown.lower()


def test_a_run_that_ranks_nothing_has_no_nearest_line():
    content = a_document(ranking=lambda rows: None)
    assert markdown_tables(markdown(content))["nocs-legacy: AP in %"][1][1] == "**n/a**"
    assert not [line for line in told(content) if line.startswith(("this run", "literature"))]


def test_no_verdict_is_made_of_it():
    """A run that finds nothing is as far below every printed line as can be."""
    nothing = Ranking({}, dict.fromkeys(("can", "mug"), (2,) * COLUMNS))
    (run,) = a_document("camera25", ranking=lambda rows: nothing)["runs"]
    (better,) = a_document("camera25")["runs"]
    assert run["verdicts"] == better["verdicts"] == []
    assert run["outcome"] == better["outcome"]
    table = literature_table(run, printed_rows(run, a_document("camera25")))
    assert table is not None
    assert set(table.own) == {"0.0"}
