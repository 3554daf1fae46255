"""Two runs beside each other: counts and p-values by another hand, and what is refused."""

import copy
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from harness import RUN
from report_schema import follow_schema
from tables import CPAS, REFS, Fixed, a_row, a_run, rows

from pytest_cpas.cli import main
from pytest_cpas.golden import RunTable
from pytest_cpas.report.against import against
from pytest_cpas.report.document import document, run_document
from pytest_cpas.report.markdown import markdown
from pytest_cpas.report.page import page
from pytest_cpas.report.stored import StoredReportError, read_report, read_runs

TEN, FIVE = "10 deg, 2 cm", "5 deg, 1 cm"


def a_run_document(judged=None, run=None, errors=None) -> dict:
    run = run or a_run()
    return run_document(
        run,
        RunTable.of(run, rows() if judged is None else judged),
        errors=errors or {},
    )


def compared(new: dict, old: dict) -> dict:
    """The only pair of a document that follows the schema."""
    content = document([new], 0, CPAS)
    content["against"] = against(content["runs"], [old])
    follow_schema(content)
    (pair,) = content["against"]["pairs"]
    return pair


def cell(pair: dict, category: str, threshold: str) -> dict:
    (found,) = (
        entry
        for entry in pair["precision"]
        if (entry["category"], entry["threshold"]) == (category, threshold)
    )
    return found


def mcnemar(lost: int, gained: int) -> float:
    """Two-sided exact test: a fair coin per flip, twice the smaller tail, in whole numbers."""
    flips = lost + gained
    tail = sum(math.comb(flips, k) for k in range(min(lost, gained) + 1))
    return min(1.0, 2 * tail / 2**flips)


@pytest.mark.parametrize(("lost", "gained"), [(0, 1), (1, 1), (3, 0), (2, 4), (5, 5), (7, 1)])
def test_counts_and_p(lost, gained):
    """Samples 0 to lost-1 are lost at 5 degrees, the next ones gained."""
    refs = [f"s_{index:02d}" for index in range(10)]
    old = rows(**dict.fromkeys(refs[lost : lost + gained], 7.0))
    new = rows(**dict.fromkeys(refs[:lost], 7.0))
    pair = compared(a_run_document(new), a_run_document(old))
    found = cell(pair, "all", FIVE)
    assert (found["before"], found["after"]) == (
        {"correct": 10 - gained, "total": 10},
        {"correct": 10 - lost, "total": 10},
    )
    assert (found["lost"], found["gained"]) == (lost, gained)
    assert found["p"] == pytest.approx(mcnemar(lost, gained), rel=1e-9)
    assert cell(pair, "all", TEN)["p"] is None
    mugs = cell(pair, "mug", FIVE)
    assert mugs["lost"] == lost // 2
    assert mugs["before"]["total"] == 5
    assert [flip["sample"] for flip in pair["flips"]] == [
        f"s/{i:02d}" for i in range(lost + gained)
    ]


def test_flip_has_the_errors_of_both():
    pair = compared(a_run_document(rows(s_03=30.0)), a_run_document(rows(s_03=7.0)))
    (flip,) = pair["flips"]
    assert (flip["before"], flip["after"]) == (
        "0.5 cm, 7 deg, IoU 0.9, F 0.95, NAD 0.01",
        "0.5 cm, 30 deg, IoU 0.9, F 0.95, NAD 0.01",
    )
    assert flip["lost"] == [TEN, f"{TEN}, F 0.6", "10 deg, 5 cm"]
    lost = [
        a_row(
            sample="s/00",
            category="can",
            position_m=math.inf,
            rotation_deg=math.inf,
            iou=-math.inf,
            fscore_1cm=-math.inf,
            failure="no luck",
        ),
        *rows()[1:],
    ]
    (flip,) = compared(a_run_document(lost), a_run_document())["flips"]
    assert flip["after"] == "failed: no luck"


def test_only_samples_of_both_count():
    pair = compared(a_run_document(rows()[:6], errors={"s/07": "torn"}), a_run_document(rows()[2:]))
    assert (pair["common"], pair["only_here"], pair["only_there"]) == (4, 2, 4)
    assert cell(pair, "all", TEN)["after"] == {"correct": 4, "total": 4}
    pair = compared(a_run_document(rows()[:2]), a_run_document(rows()[2:]))
    assert (pair["common"], pair["precision"], pair["flips"]) == (0, [], [])


def test_not_applicable_in_one_is_not_counted():
    bare = [
        a_row(
            sample=r.sample,
            category=r.category,
            position_m=r.facts["position_m"],
            rotation_deg=r.facts["rotation_deg"],
            iou=None,
            fscore_1cm=None,
        )
        for r in rows()
    ]
    pair = compared(a_run_document(bare), a_run_document())
    found = cell(pair, "all", f"{TEN}, F 0.6")
    assert (found["before"], found["after"], found["p"]) == (None, None, None)
    assert cell(pair, "all", TEN)["before"] == {"correct": 10, "total": 10}


def test_what_differs_is_said():
    other = a_run(weights="w2", seed="1")
    pair = compared(a_run_document(run=other), a_run_document(run=a_run(weights="w1", seed="1")))
    assert pair["differences"] == ["weights was w1, now w2"]


def named(method: str, dataset: str = "d", **identity: str) -> dict:
    run = Fixed("m", "d", REFS, identity={"data": "x", **identity})
    run.method, run.dataset = method, dataset  # a stored report can have any
    return a_run_document(run=run)


def redefined(method: str) -> dict:
    """By another definition of the IoU."""
    told = named(method)
    return {**told, "definitions": {**told["definitions"], "iou": "other"}}


def test_pairing():
    """The same method first; a method each that is left over is compared too."""
    new = [named("a"), named("b"), named("a", "e"), named("a", "f")]
    old = [named("c"), named("b"), named("a", "g"), named("a", "f")]
    found = against(new, old)
    assert [(p["method"], p["other"], p["dataset"]) for p in found["pairs"]] == [
        ("b", "b", "d"),
        ("a", "a", "f"),
        ("a", "c", "d"),
    ]
    assert found["unpaired"] == ["a on e (this run only)", "a on g (the other run only)"]


@pytest.mark.parametrize(
    ("new", "old", "words"),
    [
        ([named("a")], [named("a", "e")], "run is of a on d, the other one of a on e; expected"),
        ([named("a")], [named("b"), named("c")], "the other one of b on d, c on d"),
        ([named("a")], [], "no method on no data set"),
        ([named("a")], [named("a", data="y")], "data was y, now x"),
        ([named("a")], [redefined("b")], "iou was other, now iou:oriented"),
    ],
)
def test_what_does_not_fit_is_refused(new, old, words):
    with pytest.raises(StoredReportError, match=re.escape(words)):
        against(new, old)


HOSTILE = "</script><img src=x onerror=alert(1)>|`\"'&amp;"


def test_hostile_text_in_both():
    new = named(HOSTILE, HOSTILE, weights=HOSTILE)
    old = named(HOSTILE, HOSTILE)
    content = document([new], 0, CPAS)
    content["against"] = against([new, named(HOSTILE, "e")], [old, named("x", HOSTILE + "2")])
    tags = []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, attributes: tags.append(tag)
    parser.feed(page(content, {}))
    assert "img" not in tags
    assert tags.count("script") == 2
    outside = re.sub(r"(?ms)^(`{3,})text\n.*?^\1$", "", markdown(content))
    assert "<img" not in outside
    assert "## &lt;/script&gt;" in outside


@pytest.fixture
def stored(recorded, pytester, monkeypatch):
    """Reports and results of two methods on the same data."""
    for name in ("Perfect", "Biased"):
        recorded(name, f"--cpas-report={name}", f"--cpas-results={name}/rows")
    monkeypatch.chdir(pytester.path)
    return pytester.path


@pytest.mark.thinned(3)
@pytest.mark.parametrize("new", ["Biased/report.json", "Biased/rows/perfect-tiny.jsonl"])
@pytest.mark.parametrize("old", ["Perfect/report.json", "Perfect/rows/perfect-tiny.jsonl"])
def test_reports_and_results_files_give_the_same_comparison(stored, new, old, capsys):
    options = RUN if new.endswith("jsonl") else ()
    code = main(["report", new, "--to", "out", "--against", old, *options])
    assert code == (1 if new.endswith("jsonl") else 0)  # results are judged
    content = read_report(stored / "out" / "report.json")
    (pair,) = content["against"]["pairs"]
    found = cell(pair, "mug", FIVE)
    assert (found["lost"], found["gained"], found["p"]) == (6, 0, pytest.approx(2 / 2**6))
    assert cell(pair, "bowl", FIVE)["p"] is None
    text = (stored / "out" / "report.md").read_text()
    assert "| mug | 100.0 → 100.0 % (+0.0)<br>no flip |" in text
    assert "100.0 → 0.0 % (-100.0)<br>6 lost, 0 gained, p = 0.031" in text
    assert "6 lost since" in (stored / "out" / "report.html").read_text()


def test_report_of_a_report_is_the_same(stored):
    assert main(["report", "Biased/report.json", "--to", "out"]) == 0
    for name in ("report.json", "report.md"):
        assert (stored / "out" / name).read_bytes() == (stored / "Biased" / name).read_bytes()


def test_a_run_is_compared_while_it_is_made(recorded, pytester):
    recorded("Perfect", "--cpas-report=old")
    result = recorded("Biased", "--cpas-report=new", "--cpas-against=old/report.json", "-n2")
    assert result.ret == 1
    (pair,) = read_report(pytester.path / "new" / "report.json")["against"]["pairs"]
    assert cell(pair, "all", FIVE)["lost"] == 6


def test_what_does_not_fit_is_refused_before_the_run(recorded, pytester):
    recorded("Perfect", "--cpas-report=old")
    other = ("--cpas-report=new", "--cpas-against=old/report.json")
    result = recorded("Perfect", *other, dataset="Renewed")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*data was tiny-1, now tiny-2*"])


def spoil(content: dict, path: Path) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_damaged_reports_are_refused(tmp_path):
    good = document([a_run_document()], 0, CPAS)
    path = spoil(good, tmp_path / "report.json")
    assert read_runs([path])[0]["judged"] == 10
    with pytest.raises(StoredReportError, match="m on d is in these files more than once"):
        read_runs([path, path])
    for change, words in (
        (lambda c: c.pop("format"), "not a report"),
        (lambda c: c.update(format=99), "format 99, this version reads 2"),
        (lambda c: c["runs"][0].pop("samples"), "has no 'samples'"),
        (lambda c: c["thresholds"].reverse(), "m on d are not those that it says"),
        (lambda c: c["guards"].reverse(), "m on d are not those that it says"),
        (lambda c: c["runs"][0]["precision"][0].update(threshold="x"), "m on d are not those"),
        (lambda c: c["runs"][0]["samples"][2].update(outcome="1111"), "m on d are not those"),
        (lambda c: c["runs"][0]["samples"][2].update(golden="1111"), "m on d are not those"),
        (lambda c: c["runs"][0]["samples"][2].update(outcome="<b>"), r"\$.runs\[0\].samples\[2\]"),
    ):
        bad = copy.deepcopy(good)
        change(bad)
        with pytest.raises(StoredReportError, match=words):
            read_report(spoil(bad, tmp_path / "bad.json"))
    for text in ("", "{", "[]", "\xff", '{"format": NaN}'):
        (tmp_path / "bad.json").write_text(text, encoding="latin-1")
        with pytest.raises(StoredReportError, match=r"JSON|not a report|holds a list"):
            read_report(tmp_path / "bad.json")
    with pytest.raises(StoredReportError, match="no such file"):
        read_report(tmp_path / "absent.json")


def test_command_line_says_what_is_wrong(stored, capsys):
    assert main(["report", "Perfect/report.json", "--to", "o", "--against", "none.json"]) == 1
    assert "none.json: no such file" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["report", "Perfect/report.json", "x.jsonl", "--to", "o"])
    assert "a report.json stands alone; not understood: x.jsonl" in capsys.readouterr().err
