"""The report of a run: its numbers against the rows; whole, in parts, on workers, cut short."""

import copy
import json
import math
import re
import statistics

import pytest
from harness import RUN
from report_schema import follow_schema

from pytest_cpas.cli import main
from pytest_cpas.evaluation import Row, read_results
from pytest_cpas.report.tables import groups, precision_table

#: The thresholds again: degrees, metres, F-score.
LIMITS = {
    "10 deg, 2 cm": (10, 0.02, None),
    "10 deg, 2 cm, F 0.6": (10, 0.02, 0.6),
    "5 deg, 1 cm": (5, 0.01, None),
    "5 deg, 1 cm, F 0.8": (5, 0.01, 0.8),
}

#: What is guarded besides: facts, and what they must be at most, or at least.
GUARDS = {
    "10 deg, 5 cm": {"rotation_deg": 10, "position_m": 0.05},
    "5 deg, 5 cm": {"rotation_deg": 5, "position_m": 0.05},
    "IoU 0.25": {"iou": 0.25},
    "IoU 0.5": {"iou": 0.5},
    "IoU 0.75": {"iou": 0.75},
    "F 0.6": {"fscore_1cm": 0.6},
    "F 0.8": {"fscore_1cm": 0.8},
}


def meets(row: Row, degrees: float, metres: float, fscore: float | None) -> bool:
    pose = row.facts["rotation_deg"] <= degrees and row.facts["position_m"] <= metres
    return pose and (fscore is None or row.facts["fscore_1cm"] >= fscore)


def guarded(row: Row, limits: dict[str, float]) -> bool:
    return all(
        row.facts[name] >= limit if name in ("iou", "fscore_1cm") else row.facts[name] <= limit
        for name, limit in limits.items()
    )


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
    for cell in run["guards"]:
        group = [row for row in judged if cell["category"] in ("all", row.category)]
        correct = sum(guarded(row, GUARDS[cell["threshold"]]) for row in group)
        if cell["measured"] != {"correct": correct, "total": len(group)}:
            told.append(f"{cell['category']} {cell['threshold']}")
    for cell in run["scores"]:
        group = [row for row in judged if cell["category"] in ("all", row.category)]
        median = statistics.median(row.facts["nad"] for row in group)
        shown = None if math.isinf(median) else pytest.approx(median, rel=1e-5)
        if (cell["score"], cell["measured"]) != ("median NAD", shown):
            told.append(f"{cell['category']} {cell['score']}")
    if len(run["guards"]) != 7 * (1 + len({row.category for row in judged})):
        told.append("guards")
    if len(run["precision"]) != 4 * (1 + len({row.category for row in judged})):
        told.append("cells")
    for name, points in run["curves"].items():
        for point in points:
            limit = point["threshold"]
            correct = sum(
                {
                    "position_m": row.facts["position_m"] <= limit,
                    "rotation_deg": row.facts["rotation_deg"] <= limit,
                    "fscore_1cm": row.facts["fscore_1cm"] >= limit,
                }[name]
                for row in judged
            )
            if (point["correct"], point["total"]) != (correct, len(judged)):
                told.append(f"{name} {limit}")
    by_name = {row.sample: row for row in judged}
    for sample in run["samples"]:
        row = by_name.pop(sample["sample"])
        outcome = "".join(str(int(meets(row, *limits))) for limits in LIMITS.values())
        outcome += "".join(str(int(guarded(row, limits))) for limits in GUARDS.values())
        finite = {name: value for name, value in row.facts.items() if math.isfinite(value)}
        if sample["facts"] != finite:  # to the last bit
            told.append(f"{row.sample} facts")
        if sample["outcome"] != outcome:
            told.append(sample["sample"])
    return [*told, *by_name]


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
    spoiled = copy.deepcopy(content)
    spoiled["runs"][0]["guards"][2]["measured"]["correct"] -= 1
    spoiled["runs"][0]["scores"][0]["measured"] += 0.1
    (guard, score) = (content["runs"][0][kind][i] for kind, i in (("guards", 2), ("scores", 0)))
    assert problems(spoiled, judged) == [
        f"{guard['category']} {guard['threshold']}",
        f"{score['category']} {score['score']}",
    ]
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
    follow_schema(content)
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


@pytest.mark.thinned(3)
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


@pytest.mark.minutes
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
    (pytester.path / "out/report.html").mkdir(parents=True)
    result = recorded("Perfect", "--cpas-report=out")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*out: the report cannot be written*"])
    result.stdout.no_fnmatch_line("report: *")


def test_interrupted_run_shows_what_there_is(cpas, pytester):
    names = ("--cpas-method=tiny:Interrupted", "--cpas-dataset=tiny:Tiny")
    result = pytester.runpytest_subprocess(*RUN, *names, "--cpas-report=out", "-k", "test_sample")
    assert result.ret == pytest.ExitCode.INTERRUPTED
    result.stdout.fnmatch_lines(["all *5/5 100.0 %*", "5 of 12 samples judged"])
    assert not (pytester.path / "out").exists()


def rounded(value):
    """A document with numbers to 12 decimals: the last ones depend on what is computed together."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    return round(value, 12) if isinstance(value, float) else value


def test_report_of_a_run_on_workers(report, pytester):
    """The same numbers, and the same pictures: shapes travel with the rows."""
    page = pytester.path / "out" / "report.html"
    alone, *_ = report("Biased")
    shown = page.read_text()
    spread, *_ = report("Biased", "-n2")
    assert rounded(spread) == rounded(alone)
    assert page.read_text() == shown
    assert "data:image/webp" in shown
