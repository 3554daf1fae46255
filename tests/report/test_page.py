"""The renderings of a document: the numbers in them, and text that would be markup."""

import base64
import csv
import hashlib
import io
import re

import pytest
from made_documents import a_document, a_run_document
from pages import Page, listed_samples
from PIL import Image
from report_schema import follow_schema
from tables import CPAS, GOLDEN, REFS, Fixed, a_row, a_run, rows

from pytest_cpas.evaluation import Row
from pytest_cpas.golden import RunTable, shipped_golden
from pytest_cpas.golden.words import Word
from pytest_cpas.report.curves import charts, curve_lines
from pytest_cpas.report.document import document
from pytest_cpas.report.markdown import markdown
from pytest_cpas.report.page import page
from pytest_cpas.report.tables import groups
from pytest_cpas.types import Verdict


def test_page_holds_the_numbers_of_the_document():
    content = a_document(rows(s_03=7.0, s_04=30.0), GOLDEN)
    text = page(content, {})
    told = Page(text).text
    for cell in content["runs"][0]["precision"]:
        count = cell["measured"]
        share = f"{100 * count['correct'] / count['total']:.1f} %"
        assert f"{count['correct']}/{count['total']} {share}" in told["td"]
    (run,) = listed_samples(text)["runs"]
    samples = content["runs"][0]["samples"]
    assert [line[0] for line in run["samples"]] == [s["sample"] for s in samples]
    assert [run["categories"][line[1]] for line in run["samples"]] == [
        s["category"] for s in samples
    ]
    assert [line[2:8] for line in run["samples"]] == [
        [s[key] for key in ("outcome", "golden", "position_m", "rotation_deg", "iou", "fscore_1cm")]
        for s in samples
    ]


def first_row(**values) -> list[Row]:
    """Rows of which the first is another one."""
    return [a_row(category="can", iou=0.9, fscore_1cm=0.95, **values), *rows()[1:]]


HOSTILE = "<script>alert(1)</script>|`*_[x](y)\n```\n# h"


def test_markdown_of_hostile_text():
    judged = first_row(sample=HOSTILE, position_m=0.5, rotation_deg=40.0)
    golden = RunTable.of(a_run(), first_row(sample=HOSTILE, position_m=0.001, rotation_deg=4.0))
    verdicts = [Verdict(Word.REGRESSED, "can", HOSTILE)]
    text = markdown(a_document(judged, golden, verdicts=verdicts))
    outside = re.sub(r"(?ms)^(`{3,})text\n.*?^\1$", "", text)
    assert "<script" not in outside
    assert "\n# h" not in outside
    (flip,) = (line for line in outside.splitlines() if "alert" in line)
    assert len(re.findall(r"(?<!\\)\|", flip)) == 5  # four columns


def test_page_of_hostile_text():
    """Neither in the page nor in the data of its script does text become markup."""
    hostile = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&amp;"
    bad = first_row(sample=hostile, position_m=0.5, rotation_deg=40.0)
    golden = RunTable.of(a_run(), first_row(sample=hostile, position_m=0.001, rotation_deg=4.0))
    content = a_document(
        bad, golden, verdicts=[Verdict(Word.REGRESSED, "can", hostile)], errors={"s/00": hostile}
    )
    content["runs"][0]["method"] = hostile
    content["runs"][0]["samples"][1]["category"] = hostile
    text = page(content, {})
    parsed = Page(text)
    tags = [tag for tag, _ in parsed.found]
    assert tags.count("script") == 2
    assert "img" not in tags
    assert not [name for _, attributes in parsed.found for name in attributes if name[:2] == "on"]
    for tag in ("td", "pre", "a", "summary"):
        assert hostile in parsed.text[tag], tag
    (run,) = listed_samples(text)["runs"]
    assert run["name"] == f"{hostile} on d"
    assert hostile in {line[0] for line in run["samples"]}


def test_page_loads_nothing_and_admits_its_script_only():
    text = page(a_document(rows(), GOLDEN), {})
    parsed = Page(text)
    assert not re.search(r"https?://|url\(|@import", text)
    for tag, attributes in parsed.found:
        assert tag not in ("link", "iframe", "img", "object")
        assert "src" not in attributes
        assert attributes.get("href", "#").startswith("#")
    (script,) = re.findall(r"<script>(.*?)</script>", text, re.S)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    assert f"default-src 'none'; {policy}" in text


def test_published_curves_stand_beside_the_measured_ones():
    """Every point of the chart is where the published count says."""
    run = Fixed("spd", "real275", REFS, identity={})
    content = document([a_run_document(run, rows(), verdicts=[])], 0, CPAS)
    follow_schema(content)
    ((_, runs, published),) = groups(content)
    lines = curve_lines(published, runs)
    assert [line.paper for line in lines] == [True] * 9 + [False]
    assert lines[-1].colour == next(x.colour for x in lines if x.method == "spd" and x.paper)
    figure = list(charts(lines))[1]
    drawn = {
        polyline.findtext("title"): [
            tuple(map(float, point.split(","))) for point in polyline.get("points").split()
        ]
        for polyline in figure.iter("polyline")
    }
    with (shipped_golden() / "published" / "curves.csv").open() as file:
        points = [
            (int(x["threshold"]), int(x["correct"]) / int(x["total"]))
            for x in csv.DictReader(file)
            if (x["dataset"], x["method"], x["threshold_on"]) == ("real275", "spd", "rotation_deg")
        ]
    ys = sorted({float(line.get("y1")) for line in figure.iter("line") if line.get("x1") == "44"})
    top, bottom = ys[0], ys[-1]  # 100 % and 0 %
    left, right = drawn["spd (paper)"][0][0], drawn["spd (paper)"][-1][0]
    assert len(points) == len(drawn["spd (paper)"]) == 21
    for (limit, share), (x, y) in zip(points, drawn["spd (paper)"], strict=True):
        assert x == pytest.approx(left + (right - left) * limit / 20, abs=0.06)
        assert y == pytest.approx(bottom + (top - bottom) * share, abs=0.06)
    # all ten samples are 4 degrees off
    assert [y for _, y in drawn["spd"]] == [bottom] * 4 + [top] * 17


def test_page_shows_lost_and_worst_samples(report, pytester):
    content, *_ = report("Biased")
    text = (pytester.path / "out" / "report.html").read_text()
    images = [attributes for tag, attributes in Page(text).found if tag == "img"]
    lost = [flip["sample"] for flip in content["runs"][0]["flips"]]
    assert [image["alt"] for image in images] == [f"boxes and surfaces in {name}" for name in lost]
    for image in images:
        kind, _, data = image["src"].partition(",")
        assert kind == "data:image/webp;base64"
        assert Image.open(io.BytesIO(base64.b64decode(data))).format == "WEBP"
