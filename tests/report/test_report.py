"""The report of a run: its numbers against the rows, its schema, its renderings."""

import base64
import copy
import csv
import hashlib
import io
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import tiny
from harness import RUN
from PIL import Image
from tables import GOLDEN, REFS, Fixed, a_run, a_speed, rows

import pytest_cpas.report
from pytest_cpas.cli import main
from pytest_cpas.datasets.nocs import Real275
from pytest_cpas.evaluation import MethodRun, Row, Run, read_results
from pytest_cpas.evaluation.estimates import encode_estimate, encode_shape
from pytest_cpas.golden import RunTable, shipped_golden
from pytest_cpas.golden.comparison import Word, compare
from pytest_cpas.golden.published import published_name
from pytest_cpas.report.curves import charts, curve_lines
from pytest_cpas.report.document import document, run_document
from pytest_cpas.report.markdown import markdown
from pytest_cpas.report.page import page
from pytest_cpas.report.pictures import draw, pictures
from pytest_cpas.report.reconstruction import ESTIMATE_COLOUR, GROUND, TRUTH_COLOUR
from pytest_cpas.report.tables import groups, precision_table
from pytest_cpas.types import (
    Camera,
    GroundTruth,
    Hypothesis,
    Observation,
    Pose,
    Sample,
    SampleRef,
    Symmetry,
    Verdict,
)

SCHEMA = json.loads(Path(pytest_cpas.report.__file__).with_name("schema.json").read_text())

#: The thresholds again: degrees, metres, F-score.
LIMITS = {
    "10 deg, 2 cm": (10, 0.02, None),
    "10 deg, 2 cm, F 0.6": (10, 0.02, 0.6),
    "5 deg, 1 cm": (5, 0.01, None),
    "5 deg, 1 cm, F 0.8": (5, 0.01, 0.8),
}


def meets(row: Row, degrees: float, metres: float, fscore: float | None) -> bool:
    pose = row.rotation_error <= degrees and row.translation_error <= metres
    return pose and (fscore is None or row.fscore_1cm >= fscore)


def problems(content: dict, judged: list[Row]) -> list[str]:
    """Where the numbers of a document's only run are not those of the rows."""
    (run,) = content["runs"]
    told = []
    if run["judged"] != len(judged):
        told.append("judged")
    for cell in run["precision"]:
        group = [row for row in judged if cell["category"] in ("all", row.category)]
        correct = sum(meets(row, *LIMITS[cell["threshold"]]) for row in group)
        if cell["measured"] != {"correct": correct, "total": len(group)}:
            told.append(f"{cell['category']} {cell['threshold']}")
    if len(run["precision"]) != 4 * (1 + len({row.category for row in judged})):
        told.append("cells")
    for name, points in run["curves"].items():
        for point in points:
            limit = point["threshold"]
            correct = sum(
                {
                    "position_m": row.translation_error <= limit,
                    "rotation_deg": row.rotation_error <= limit,
                    "fscore_1cm": row.fscore_1cm >= limit,
                }[name]
                for row in judged
            )
            if (point["correct"], point["total"]) != (correct, len(judged)):
                told.append(f"{name} {limit}")
    by_name = {row.sample: row for row in judged}
    for sample in run["samples"]:
        row = by_name.pop(sample["sample"])
        outcome = "".join(str(int(meets(row, *limits))) for limits in LIMITS.values())
        if sample["outcome"] != outcome:
            told.append(sample["sample"])
    return [*told, *by_name]


@pytest.fixture
def report(recorded, pytester):
    """The report of a method, as (JSON, Markdown), and what pytest said."""

    def run(method: str, *args: str, dataset: str = "Tiny"):
        result = recorded(method, "--cpas-report=out", *args, dataset=dataset)
        folder = pytester.path / "out"
        content = json.loads((folder / "report.json").read_text())
        jsonschema.validate(content, SCHEMA)
        assert sorted(path.name for path in folder.iterdir()) == [
            "precision.csv",
            "precision.tex",
            "report.html",
            "report.json",
            "report.md",
        ]
        return content, (folder / "report.md").read_text(), result

    return run


@pytest.mark.parametrize("method", ["Perfect", "Biased", "Refuses"])
def test_numbers_are_those_of_the_rows(report, pytester, method):
    content, text, result = report(method, "--cpas-results=rows")
    (path,) = (pytester.path / "rows").iterdir()
    judged = list(read_results(path).rows.values())
    assert problems(content, judged) == []
    # what the terminal and the page print are the same numbers
    for cell in content["runs"][0]["precision"]:
        count = cell["measured"]
        told = f"{count['correct']}/{count['total']}"
        share = f"{100 * count['correct'] / count['total']:.1f} %"
        assert re.search(rf"^{cell['category']} .*{told} +{share}", result.stdout.str(), re.M)
        assert f"{told} {share}" in text
    assert (content["outcome"] == "failed") == (result.ret == 1)
    result.stdout.fnmatch_lines([f"report: {pytester.path / 'out' / 'report.html'}"])


def test_planted_wrong_numbers_are_seen(report, pytester):
    content, *_ = report("Biased", "--cpas-results=rows")
    (path,) = (pytester.path / "rows").iterdir()
    judged = list(read_results(path).rows.values())
    for index, cell in enumerate(content["runs"][0]["precision"]):
        spoiled = copy.deepcopy(content)
        spoiled["runs"][0]["precision"][index]["measured"]["correct"] -= 1
        assert problems(spoiled, judged) == [f"{cell['category']} {cell['threshold']}"]
    for name, points in content["runs"][0]["curves"].items():
        for index, point in enumerate(points):
            spoiled = copy.deepcopy(content)
            spoiled["runs"][0]["curves"][name][index]["correct"] += 1
            assert problems(spoiled, judged) == [f"{name} {point['threshold']}"]


def test_regression_names_flips_and_fails_first(report):
    content, text, result = report("Biased")
    assert result.ret == 1
    (run,) = content["runs"]
    assert content["outcome"] == run["outcome"] == "failed"
    assert [(v["word"], v["category"]) for v in run["verdicts"]] == [
        ("MATCHES", "bowl"),
        ("REGRESSED", "mug"),
    ]
    mugs = [s["sample"] for s in run["samples"] if s["category"] == "mug"]
    assert [flip["sample"] for flip in run["flips"]] == mugs
    assert all("5 deg, 1 cm" in flip["lost"] and not flip["gained"] for flip in run["flips"])
    lines = text.splitlines()
    assert lines[0] == "# pytest-cpas: FAILED"
    assert "| perfect on tiny | **FAILED** | 12 of 12 samples judged |" in lines[4]
    assert text.index("REGRESSED mug") < text.index("## tiny")
    assert all(f"| {sample.replace('_', chr(92) + '_')} |" in text for sample in mugs)


def test_several_methods_are_ranked_and_failing_ones_first(recorded, pytester):
    args = ("--cpas-method=tiny:OnlyPose", "--cpas-method=tiny:Refuses", "--cpas-report=out")
    recorded("Perfect", *args[:1], "--cpas-report=out")
    content = json.loads((pytester.path / "out" / "report.json").read_text())
    jsonschema.validate(content, SCHEMA)
    assert [run["outcome"] for run in content["runs"]] == ["skipped", "passed"]
    ((name, runs, published),) = groups(content)
    lines = precision_table(content["thresholds"], runs, published)
    assert (name, published) == ("tiny", {})
    assert [line.method for line in lines] == ["only-pose", "perfect"]
    # a tie, and a column that only one method has
    assert [[cell and cell.rank for cell in line.cells] for line in lines] == [
        [1, None, 1, None],
        [1, 0, 1, 0],
    ]


def a_told(run: Run, judged: list[Row], golden: RunTable | None = None, **more) -> dict:
    given = {
        "errors": {},
        "verdicts": compare(golden, RunTable.of(run, judged)),
        "require_golden": False,
        "contract": [],
        "findings": [],
        "golden": golden,
    }
    return run_document(run, RunTable.of(run, judged), **given | more)


def a_document(judged: list[Row], golden: RunTable | None = None, **more) -> dict:
    content = document([a_told(a_run(), judged, golden, **more)], 0)
    jsonschema.validate(content, SCHEMA)
    return content


def test_flips_are_grouped_by_kind():
    (run,) = a_document(rows(s_03=7.0, s_04=30.0), GOLDEN)["runs"]
    five, ten = ["5 deg, 1 cm", "5 deg, 1 cm, F 0.8"], ["10 deg, 2 cm", "10 deg, 2 cm, F 0.6"]
    assert [(flip["sample"], flip["lost"]) for flip in run["flips"]] == [
        ("s/03", five),
        ("s/04", ten + five),
    ]
    assert run["flips"][0]["before"] == "0.5 cm, 4 deg, F 0.95"
    assert run["flips"][0]["after"] == "0.5 cm, 7 deg, F 0.95"


def test_golden_table_of_other_conditions_is_not_compared():
    other = RunTable.of(a_run(data="y"), rows())
    (run,) = a_document(rows(s_03=7.0), other)["runs"]
    assert run["verdicts"][0]["word"] == "STALE"
    assert run["flips"] == []
    assert {cell["golden"] for cell in run["precision"]} == {None}


def test_no_answer_and_no_row():
    judged = rows()[1:]
    judged[0] = Row(
        sample="s/01",
        category="mug",
        translation_error=math.inf,
        rotation_error=math.inf,
        iou=-math.inf,
        fscore_1cm=None,
        failure="no luck",
    )
    (run,) = a_document(judged, errors={"s/00": "torn"})["runs"]
    assert (run["outcome"], run["judged"], run["listed"], run["unanswered"]) == ("failed", 9, 10, 1)
    assert run["categories"]["can"] == {"judged": 4, "listed": 5}
    torn, failed = run["samples"][:2]
    assert (torn["outcome"], torn["error"], torn["failure"]) == (None, "torn", None)
    assert (failed["outcome"], failed["error"], failed["failure"]) == ("0-0-", None, "no luck")
    assert failed["position_m"] is failed["iou"] is failed["fscore_1cm"] is None


HOSTILE = "<script>alert(1)</script>|`*_[x](y)\n```\n# h"


def test_markdown_of_hostile_text():
    judged = [
        Row(
            sample=HOSTILE,
            category="can",
            translation_error=0.5,
            rotation_error=40.0,
            iou=0.9,
            fscore_1cm=0.95,
        ),
        *rows()[1:],
    ]
    golden = RunTable.of(
        a_run(),
        [
            Row(
                sample=HOSTILE,
                category="can",
                translation_error=0.001,
                rotation_error=4.0,
                iou=0.9,
                fscore_1cm=0.95,
            ),
            *rows()[1:],
        ],
    )
    verdicts = [Verdict(Word.REGRESSED, "can", HOSTILE)]
    text = markdown(a_document(judged, golden, verdicts=verdicts))
    outside = re.sub(r"(?ms)^(`{3,})text\n.*?^\1$", "", text)
    assert "<script" not in outside
    assert "\n# h" not in outside
    (flip,) = (line for line in outside.splitlines() if "alert" in line)
    assert len(re.findall(r"(?<!\\)\|", flip)) == 5  # four columns


def strip(content: dict) -> dict:
    """Without what differs by nature: only a method that is there can be diagnosed, only a data
    set has truths, and every shard checks the contract on samples of its own."""
    for run in content["runs"]:
        for result in run["contract"]:
            result["message"] = result["status"] = ""
        run["findings"] = []
        run["up_axes"]["truth"] = None
        for verdict in run["verdicts"]:
            verdict["details"] = verdict["details"].split("\n")[0]
    return content


@pytest.mark.parametrize("method", ["Perfect", "Biased", "Refuses", "Raises"])
def test_stored_results_give_the_report_of_the_run(report, recorded, pytester, monkeypatch, method):
    whole, _, result = report(method)
    for index in (1, 2):
        recorded(method, f"--cpas-shard={index}/2", "--cpas-results=rows")
    files = sorted(map(str, (pytester.path / "rows").iterdir()))
    monkeypatch.chdir(pytester.path)
    code = main(["report", *files, "--to", "again", *RUN])
    assert code == result.ret
    merged = json.loads((pytester.path / "again" / "report.json").read_text())
    (old,), (new,) = strip(whole).pop("runs"), strip(merged).pop("runs")
    assert merged == whole
    assert {key: new[key] for key in new if new[key] != old[key]} == {}


def test_pictures_of_stored_results_with_their_data(report, recorded, pytester, monkeypatch):
    """The page of merged shards is that of the run, up to the contract, if the data is there."""
    whole, *_ = report("Biased")
    images = re.compile(r'src="(data:image/webp[^"]*)"')
    drawn = images.findall((pytester.path / "out" / "report.html").read_text())
    for index in (1, 2):
        recorded("Biased", f"--cpas-shard={index}/2", "--cpas-results=rows", "--cpas-report=part")
    files = sorted(map(str, (pytester.path / "rows").iterdir()))
    monkeypatch.chdir(pytester.path)
    data = "--cpas-dataset=tiny:Tiny"
    main(["report", *files, "--to", "again", data, *RUN])
    assert images.findall((pytester.path / "again" / "report.html").read_text()) == drawn != []
    merged = json.loads((pytester.path / "again" / "report.json").read_text())
    assert merged["runs"][0]["up_axes"] == whole["runs"][0]["up_axes"]
    assert main(["report", *files, "--to", "o", "--cpas-dataset=tiny:Renewed", *RUN]) == 4
    pytester.makepyfile(other="import tiny\nclass Other(tiny.Tiny):\n    name = 'other'\n")
    assert main(["report", *files, "--to", "o", "--cpas-dataset=other:Other", *RUN]) == 4
    assert main(["merge", *files, data, *RUN]) == 4  # pictures of nothing


def test_report_that_cannot_be_written_fails_the_run(recorded, pytester):
    (pytester.path / "out").write_text("a file")
    result = recorded("Perfect", "--cpas-report=out")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*out: the report cannot be written*"])
    result.stdout.no_fnmatch_line("report: *")


class Page(HTMLParser):
    """Elements of a page by tag, with the text that stands in them."""

    VOID = ("meta", "input", "img")

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.found: list[tuple[str, dict]] = []
        self.text: dict[str, str] = {}
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text[self.open[-1] if self.open else ""] = (
            self.text.get(self.open[-1] if self.open else "", "") + data
        )


def listed_samples(text: str) -> dict:
    """What the page's script lists."""
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    return json.loads(data)


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


def test_page_of_hostile_text():
    """Neither in the page nor in the data of its script does text become markup."""
    hostile = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&amp;"
    bad = [
        Row(
            sample=hostile,
            category="can",
            translation_error=0.5,
            rotation_error=40.0,
            iou=0.9,
            fscore_1cm=0.95,
        ),
        *rows()[1:],
    ]
    golden = RunTable.of(
        a_run(),
        [
            Row(
                sample=hostile,
                category="can",
                translation_error=0.001,
                rotation_error=4.0,
                iou=0.9,
                fscore_1cm=0.95,
            ),
            *rows()[1:],
        ],
    )
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
    content = document([a_told(run, rows(), verdicts=[])], 0)
    jsonschema.validate(content, SCHEMA)
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


def test_paper_is_named_for_stored_predictions_of_its_samples():
    """REAL275's numbers of samples per category, and one sample fewer."""
    counts = {"bottle": 2757, "bowl": 2370, "camera": 2669, "can": 2729, "laptop": 2754}
    assert published_name("stored", counts | {"mug": 2839}) == "real275"
    assert published_name("stored", counts | {"mug": 2838}) is None
    assert published_name("other", counts | {"mug": 2839}) is None
    assert published_name("real275", counts) == "real275"


def a_sample(pose: Pose, extents: list[float]) -> Sample:
    """Grey, 200 x 160, the mask in the middle."""
    camera = Camera(200, 160, 220.0, 220.0, 99.5, 79.5)
    mask = np.zeros((160, 200), bool)
    mask[70:90, 90:110] = True
    rgb = np.full((160, 200, 3), 0.5, np.float32)
    observation = Observation(
        category="mug", rgb=rgb, depth=np.ones((160, 200), np.float32), mask=mask, camera=camera
    )
    ref = SampleRef(id="s/00", category="mug", scene="s")
    return Sample(
        ref,
        observation,
        GroundTruth(pose=pose, extents=extents, symmetry=Symmetry.none(), surface=None),
    )


def panels(picture: bytes) -> tuple[np.ndarray, np.ndarray]:
    """The colour crop of a picture, without what fills its square up, and what is beside it."""
    image = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(int)
    side = image.shape[0]
    assert image.shape == (side, 2 * side, 3)
    filled = np.argwhere(abs(image[:, :side] - GROUND).max(axis=2) > 30)
    (top, left), (bottom, right) = filled.min(axis=0), filled.max(axis=0) + 1
    return image[top:bottom, left:right], image[:, side:]


def coloured(picture: bytes, colour: tuple[int, int, int]) -> np.ndarray:
    """Left, top, right and bottom of a colour, as shares of the colour crop."""
    image, _ = panels(picture)
    rows, columns = np.nonzero(abs(image - colour).max(axis=2) < 60)
    height, width = image.shape[:2]
    ends = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    return np.array(ends) / (width, height, width, height)


def test_boxes_are_drawn_where_the_corners_project():
    """Facing the camera, the nearer face of a box is its outline: by similar triangles."""
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.1, 0.2])
    moved = encode_estimate(
        Hypothesis(rotation=np.eye(3), translation=[0.03, 0.02, 1.0], extents=[0.1, 0.06, 0.1])
    )
    picture = draw(sample, moved, None)
    # 0.9 m in front: half 0.1 m and 0.05 m wide; what is shown is 35 % wider on either side
    across, up = 220 * 0.1 / 0.9, 220 * 0.05 / 0.9
    margin = 1 + 0.35 * 2 * across
    left, top = np.floor(99.5 - across - margin), np.floor(79.5 - up - margin)
    right, bottom = np.ceil(99.5 + across + margin) + 1, np.ceil(79.5 + up + margin) + 1
    size = np.array([right - left, bottom - top])

    def shares(x, y, half_width, half_height, distance):
        middle = np.array([99.5, 79.5]) + 220 * np.array([x, y]) / distance
        half = 220 * np.array([half_width, half_height]) / distance
        # the middle of a pixel is half a pixel from its edge
        return np.concatenate([middle - half, middle + half]) + 0.5

    for colour, expected in (
        (TRUTH_COLOUR, shares(0, 0, 0.1, 0.05, 0.9)),
        (ESTIMATE_COLOUR, shares(0.03, 0.02, 0.05, 0.03, 0.95)),
    ):
        told = (expected - [left, top, left, top]) / [*size, *size]
        assert coloured(picture, colour) == pytest.approx(told, abs=0.02), colour


@pytest.mark.parametrize(
    "translation", [[0, 0, -1.0], [0, 0, 1e-30], [1e30, 0, 1.0], [0, 0, 1e300], [50.0, 0, 0.2]]
)
def test_absurd_estimates_leave_the_truth(translation):
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.1, 0.2])
    extents = [0.1, 1e300 if translation[0] == 50 else 0.1, 0.1]
    estimate = encode_estimate(
        Hypothesis(rotation=np.eye(3), translation=translation, extents=extents)
    )
    for shape in (None, encode_shape(np.eye(3)), encode_shape(np.eye(3) * 1e300)):
        assert coloured(draw(sample, estimate, shape), TRUTH_COLOUR) == pytest.approx(
            coloured(draw(sample, None, None), TRUTH_COLOUR), abs=0.01
        )


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


def test_axes_tell_a_box_that_is_turned_round():
    """The lines of a box point to its right and its upper side, wherever that has gone."""
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.2, 0.2])
    for turn in (np.diag([-1.0, -1.0, 1.0]), np.diag([-1.0, 1.0, -1.0]), np.eye(3)):
        estimate = encode_estimate(
            Hypothesis(rotation=turn, translation=[0, 0, 1.0], extents=[0.2, 0.2, 0.2])
        )
        image, _ = panels(draw(sample, estimate, None))
        found = abs(image - ESTIMATE_COLOUR).max(axis=2) < 70
        # between the middle and the nearest edge of the further face
        for axis in (0, 1):
            for side in (-1, 1):
                point = np.array([0.5, 0.5])
                point[axis] += side * 0.08
                x, y = (image.shape[0] * point).astype(int)
                there = found[y - 4 : y + 5, x - 4 : x + 5].any()
                assert there == (turn[axis, axis] == side), (turn, axis, side)


def test_reconstruction_is_seen_from_the_right_and_from_above():
    """What lies beyond the truth by 6 cm appears where an orbit of the camera puts it."""
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.1, 0.2])
    ball = np.random.default_rng(0).normal(size=(400, 3))
    ball *= 0.01 / np.linalg.norm(ball, axis=1)[:, None]
    sample = replace(sample, truth=replace(sample.truth, surface=ball))
    moved = encode_estimate(
        Hypothesis(rotation=np.eye(3), translation=[0, 0, 1.06], extents=[0.1, 0.1, 0.1])
    )
    _, image = panels(draw(sample, moved, encode_shape(ball)))

    def middle(colour):
        rows, columns = np.nonzero(abs(image - 0.75 * np.array(colour)).max(axis=2) < 45)
        return np.array([columns.mean(), rows.mean()])

    # 50 degrees to the right, 25 up; a camera on that sphere sees "away" as right and as up
    right, up = math.sin(math.radians(50)), math.cos(math.radians(50)) * math.sin(math.radians(25))
    pixels = 128 / (1.15 * math.hypot(0.1, 0.05, 0.1))
    expected = 0.06 * pixels * np.array([right, -up])
    assert middle(ESTIMATE_COLOUR) - middle(TRUTH_COLOUR) == pytest.approx(expected, abs=2)
    assert middle(TRUTH_COLOUR) == pytest.approx([128, 128], abs=2)


def test_nearer_surfaces_hide_further_ones():
    """Two discs across the line of sight, the estimated one in front and then behind."""
    a, b = math.radians(50), math.radians(25)
    sight = np.array([-math.sin(a) * math.cos(b), math.sin(b), math.cos(a) * math.cos(b)])
    across = np.cross(sight, [0, 1, 0])
    across /= np.linalg.norm(across)
    spots = np.random.default_rng(0).uniform(-0.03, 0.03, (4000, 2, 1))
    plate = spots[:, 0] * across + spots[:, 1] * np.cross(sight, across)
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.1, 0.2])
    blind = replace(sample.observation, depth=np.zeros((160, 200), np.float32))
    sample = replace(
        sample, observation=blind, truth=replace(sample.truth, surface=plate.astype(float))
    )

    def orange(shift):
        moved = encode_estimate(
            Hypothesis(
                rotation=np.eye(3), translation=[0, 0, 1.0] + shift * sight, extents=[0.1] * 3
            )
        )
        _, image = panels(draw(sample, moved, encode_shape(plate)))
        return int((image[:, :, 0] > image[:, :, 2] + 60).sum())

    assert orange(-0.05) > 5 * orange(0.05)


@pytest.mark.parametrize("surface", [None, np.zeros((1, 3))])
def test_reconstruction_without_depth_or_shapes(surface):
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.1, 0.2])
    blind = replace(sample.observation, depth=np.zeros((160, 200), np.float32))
    truth = replace(sample.truth, surface=surface)
    _, image = panels(draw(replace(sample, observation=blind, truth=truth), None, None))
    lit = abs(image - GROUND).max(axis=2) > 60
    assert lit.sum() < 20
    assert lit.any() == (surface is not None)


def test_page_of_two_hundred_pictures_is_below_ten_megabytes(monkeypatch):
    """Textured images, noisy depth all over, and a shape in each."""
    rng = np.random.default_rng(0)
    sample = a_sample(Pose(np.eye(3), [0, 0, 1.0]), [0.2, 0.15, 0.2])
    points = rng.uniform(-0.1, 0.1, (2000, 3))
    rgb = rng.random((40, 50, 3), np.float32).repeat(4, axis=0).repeat(4, axis=1)
    depth = (0.95 + 0.02 * rng.random((160, 200))).astype(np.float32)
    observation = replace(sample.observation, rgb=rgb, depth=depth)
    sample = replace(sample, observation=observation, truth=replace(sample.truth, surface=points))
    estimate = encode_estimate(
        Hypothesis(rotation=np.eye(3), translation=[0.01, 0, 1.02], extents=[0.2, 0.15, 0.2])
    )
    monkeypatch.setattr(MethodRun, "read", lambda run, ref: sample)
    judged = [
        Row(
            sample=f"s/{i:03d}",
            category="mug",
            translation_error=0.5,
            rotation_error=40.0,
            iou=0.1,
            fscore_1cm=0.2,
            failure=None,
            estimate=estimate,
            repeats="",
            shape=encode_shape(points),
        )
        for i in range(30)
    ]
    data = tiny.Tiny(None)
    data.samples = [SampleRef(id=row.sample, category="mug", scene="s") for row in judged]
    runs = [MethodRun(tiny.Perfect(), data) for _ in range(12)]
    for index, run in enumerate(runs):
        run.method = f"m{index}"
    told = [a_told(run, judged) for run in runs]
    by_sample = {row.sample: row for row in judged}
    drawn = pictures(runs, dict.fromkeys(runs, by_sample), told)
    assert sum(map(len, drawn.values())) == 192  # as many of each, and 200 at most
    text = page(document(told, 0), drawn)
    assert text.count("data:image/webp") == 192
    assert len(text.encode()) < 10e6


def test_flipped_samples_are_drawn_before_the_worst(monkeypatch):
    """Lost ones first, also those that were lost since another run; gained ones too."""
    monkeypatch.setattr("pytest_cpas.report.pictures.draw", lambda *given: b"")
    run = MethodRun(tiny.Biased(), tiny.Tiny(None))
    judged = {ref.id: run.judge(ref) for ref in run.samples}
    ids = [ref.id for ref in run.samples]
    told = a_told(run, list(judged.values()))
    told["flips"] = [
        {"sample": ids[0], "lost": [], "gained": ["x"]},
        {"sample": ids[2], "lost": ["x"], "gained": []},
    ]
    since = [{"sample": ids[4], "lost": ["x"], "gained": []}]
    pair = {"method": run.method, "dataset": run.dataset, "flips": since}
    (drawn,) = pictures([run], {run: judged}, [told], {"pairs": [pair]}).values()
    mugs = [name for name in ids if judged[name].category == "mug"]
    assert list(drawn)[:3] == [ids[2], ids[4], ids[0]]
    assert sorted(list(drawn)[3:]) == mugs


def test_pictures_of_real_images_are_small_enough(test_data):
    """Two hundred like those of a frame of REAL275, in base64."""
    data = Real275(test_data / "real275")
    sizes = []
    for ref in data.samples:
        if not ref.id.startswith("scene_1/0000/"):
            continue
        sample = data.load(ref)
        true = sample.truth
        moved = true.pose.translation + np.array([0.01, 0.02, 0.03])
        estimate = encode_estimate(
            Hypothesis(rotation=true.pose.rotation, translation=moved, extents=true.extents)
        )
        shape = None if true.surface is None else encode_shape(true.surface)
        sizes.append(len(draw(sample, estimate, shape)))
    assert len(sizes) == 5
    assert 200 * np.mean(sizes) * 4 / 3 < 8e6


def test_interrupted_run_shows_what_there_is(cpas, pytester):
    names = ("--cpas-method=tiny:Interrupted", "--cpas-dataset=tiny:Tiny")
    result = pytester.runpytest_subprocess(*RUN, *names, "--cpas-report=out", "-k", "test_sample")
    assert result.ret == pytest.ExitCode.INTERRUPTED
    result.stdout.fnmatch_lines(["all *5/5 100.0 %*", "5 of 12 samples judged"])
    assert not (pytester.path / "out").exists()


def test_report_of_a_run_on_workers(report, pytester):
    """The same numbers, and the same pictures: shapes travel with the rows."""
    page = pytester.path / "out" / "report.html"
    alone, *_ = report("Biased")
    shown = page.read_text()
    spread, *_ = report("Biased", "-n2")
    assert spread == alone
    assert page.read_text() == shown
    assert "data:image/webp" in shown


def test_speed_is_told_beside_the_paper():
    speed = a_speed(0.25)
    content = a_document(rows(), speed=speed)
    assert content["outcome"] == "failed"
    text = markdown(content)
    for told in (
        "SLOWER: by 30 %",
        "250 ms (225 ms to 275 ms) per sample",
        "1.3 (1.17 to 1.43) times the revision git:HEAD\\~1",
        "network 200 us (80 %)",
        "on A CPU, 2 cores, A GPU; peak memory 1024 MiB, 1 MiB on the device",
        "the paper: 227 ms (mean) per sample of redwood75, on Old, Older",
    ):
        assert told in text
    unjudged = speed | {"verdict": {**speed["verdict"], "word": "MEASURED", "outcome": "passed"}}
    assert a_document(rows(), speed=unjudged)["outcome"] == "skipped"
