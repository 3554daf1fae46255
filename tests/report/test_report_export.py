"""The precision tables as CSV and LaTeX: read back, and held against the paper's print."""

import csv
import io
import re

import pytest
from tables import Fixed
from test_report_methods import judged_run, report

from pytest_cpas.golden import RunTable, shipped_golden
from pytest_cpas.report.document import run_document
from pytest_cpas.report.export import precision_csv, precision_tex


def read(text: str) -> list[dict]:
    return list(csv.DictReader(io.StringIO(text, newline="")))


def published() -> list[dict]:
    with (shipped_golden() / "published" / "precision.csv").open(newline="") as file:
        return list(csv.DictReader(file))


LIMITS = ("rotation_deg", "position_m", "fscore_1cm")


ENDS = ("sample_low", "sample_high", "scene_low", "scene_high")


def label_of(line: dict) -> str:
    """The label of the column that a line of the published table is of."""
    parts = [f"{line['rotation_deg']} deg", f"{100 * float(line['position_m']):g} cm"]
    return ", ".join([*parts, *([f"F {line['fscore_1cm']}"] if line["fscore_1cm"] else [])])


def test_csv_has_the_exact_counts():
    content = report(judged_run("mine", "redwood75", 60), judged_run("mine, too", "x\n2", 33))
    lines = read(precision_csv(content))
    paper = [
        {k: v for k, v in line.items() if k not in ("source", "protocol", "precision", *ENDS)}
        for line in lines
        if line["source"] == "paper"
    ]
    expected = []
    for line in published():
        label = label_of(line)
        rest = {k: v for k, v in line.items() if k not in LIMITS}
        expected.append({**rest, "column": label})

    def key(line):
        return sorted(line.items())

    assert sorted(paper, key=key) == sorted(expected, key=key)
    measured = [line for line in lines if line["source"] == "measured"]
    assert len(measured) == 2 * (4 + 7) * 3  # runs, columns; mug, bowl and all
    for run in content["runs"]:
        for entry in (*run["precision"], *run["guards"]):
            (line,) = (
                line
                for line in measured
                if (line["dataset"], line["method"]) == (run["dataset"], run["method"])
                and (line["category"], line["protocol"]) == (entry["category"], "cpas")
                and line["column"] == entry["threshold"]
            )
            counts = (entry["measured"]["correct"],) * 2 + (entry["measured"]["total"],)
            found = tuple(int(line[k]) for k in ("correct_low", "correct_high", "total"))
            assert found == counts
            assert line["precision"] == f"{counts[0] / counts[2]:.4f}"


def tables(text: str) -> list[list[list[str]]]:
    """The lines of every table as cells; every one has as many as its tabular has columns."""
    found = []
    for columns, body in re.findall(
        r"\\begin\{tabular\}\{(lr*)\}(.*?)\\end\{tabular\}", text, re.S
    ):
        assert body.count(r"\toprule") == body.count(r"\bottomrule") == 1
        lines = body.split(r"\midrule")[1].split(r"\bottomrule")[0].strip().split("\\\\\n")
        cells = [
            [cell.strip() for cell in re.split(r"(?<!\\)&", line.removesuffix(r"\\"))]
            for line in lines
        ]
        assert {len(line) for line in cells} == {len(columns)}
        found.append(cells)
    assert text.count(r"\begin{table*}") == text.count(r"\end{table*}") == len(found)
    return found


def test_tex_has_the_papers_figures_and_marks():
    content = report(judged_run("mine", "real275", 60), judged_run("mine", "redwood75", 60))
    # guards, scores and intervals are last
    overall, *categories, _, _, _, _, _, _ = tables(precision_tex(content))
    assert [line[0] for line in overall][:2] == ["mine", "asmnet (paper)"]
    assert len(overall) == 10
    order = [(name, label) for name in ("real275", "redwood75") for label in content["thresholds"]]
    for column, (dataset, limit) in enumerate(order, 1):
        expected = {
            f"{line['method']} (paper)": int(line["correct_low"]) / int(line["total"])
            for line in published()
            if (line["dataset"], line["category"]) == (dataset, "all") and label_of(line) == limit
        }
        shown = {line[0]: line[column] for line in overall[1:]}
        if dataset == "redwood75":  # where mine has 100 samples: the paper's are not ranked
            assert shown == {name: f"{value:.4f}" for name, value in expected.items()}
            continue
        values = sorted(expected.values(), reverse=True)
        marks = [r"\textbf{%.4f}", r"\underline{%.4f}", r"\textit{%.4f}"] + ["%.4f"] * 6
        for name, value in expected.items():
            assert shown[name] == marks[values.index(value)] % value
    assert [len(table) for table in categories] == [10, 10]


HOSTILE = '\\input{/etc/passwd}%&$#_{}~^<>|"[x]*--\n\n\x00é'


def test_tex_of_hostile_text():
    content = report(judged_run(HOSTILE, "a_b", 3), judged_run("[x]", "a_b", 5))
    text = precision_tex(content)
    (table, *_) = tables(text)
    assert table[0][0] == (
        r"\textbackslash{}input\{/etc/passwd\}\%\&\$\#\_\{\}\textasciitilde{}\textasciicircum{}"
        r"\textless{}\textgreater{}\textbar{}{\char34}{[}x]{*}-{}- ?é"
    )
    assert table[1][0] == "{[}x]"
    assert r"\input" not in text.partition("\n")[2]
    assert "a\\_b" in text
    assert "\n\n" not in text.partition(r"\begin{table*}")[2].partition(r"\end{table*}")[0]


def test_a_method_alone_is_not_marked_and_what_is_not_given_is_na():
    run = Fixed("m", "d", [], identity={})
    empty = run_document(
        run,
        RunTable.of(run, []),
    )
    ((line,),) = tables(precision_tex(report(empty)))
    assert line == ["m", *["n/a"] * 4]
    assert "Best three" not in precision_tex(report(judged_run("m", "d", 3)))
    assert read(precision_csv(report(empty))) == []


@pytest.mark.parametrize("count", [1, 2, 3])
def test_two_data_sets_stand_beside_each_other(count):
    content = report(*(judged_run("m", f"d{index}", 3) for index in range(count)))
    widths = [len(table[0]) - 1 for table in tables(precision_tex(content))]
    beside = [7, 1, 4] * count  # of each: seven guards, one score, intervals
    assert widths == {1: [4], 2: [8], 3: [8, 4]}[count] + beside
