"""Intervals stand beside every figure, and the terminal shows guards in full where they differ."""

import csv
import io
from dataclasses import astuple

import numpy as np
import pytest
from report_schema import follow_schema
from tables import CPAS, Fixed, a_row
from told_lines import told

from pytest_cpas.golden import RunTable, compare_published
from pytest_cpas.golden.published import PublishedCell
from pytest_cpas.metrics import mean_interval, scene_mean_intervals, scene_median_interval
from pytest_cpas.protocols import shipped_protocol
from pytest_cpas.report.document import document, run_document
from pytest_cpas.report.export import precision_csv, precision_tex, scores_csv
from pytest_cpas.report.intervals import interval_note, interval_table
from pytest_cpas.report.markdown import markdown
from pytest_cpas.report.page import page
from pytest_cpas.report.rejudged import rejudged
from pytest_cpas.types import SampleRef

SEVERAL = (*CPAS, shipped_protocol("omni6dpose"))


def refs(scenes: int) -> list[SampleRef]:
    """Sixty samples, of as many scenes; of a scene -1 the name is not known."""
    return [
        SampleRef(
            id=f"{i:02d}", category="can" if i % 2 else "mug", scene=f"s{i % scenes}" * (scenes > 0)
        )
        for i in range(60)
    ]


def a_table(scenes: int = 6, wrong: int = 20) -> tuple[Fixed, RunTable]:
    """Wrong are the first samples of some scenes, and NAD differs everywhere."""
    samples = refs(scenes)
    run = Fixed("m", "d", samples, identity={"data": "x"}, protocols=SEVERAL)
    order = sorted(samples, key=lambda ref: (ref.scene, ref.id))
    bad = {ref.id for ref in order[:wrong]}
    judged = [
        a_row(
            *(ref.id, ref.category),
            rotation_deg=30.0 if ref.id in bad else 1.0 + int(ref.id) / 60,
            nad=0.01 + int(ref.id) / 1000,
        )
        for ref in samples
    ]
    return run, RunTable.of(run, judged)


def a_document(scenes: int = 6, golden: RunTable | None = None, wrong: int = 20) -> dict:
    run, table = a_table(scenes, wrong)
    content = document([run_document(run, table, golden=golden)], 0, SEVERAL)
    follow_schema(content)
    return content


def words_of(entry: dict) -> list[str]:
    """The intervals of an entry as people read them."""
    share = entry.get("share", True)
    pattern = "{:.1f} to {:.1f} %" if share else "{:.4g} to {:.4g}"
    ends = (entry["intervals"]["sample"], entry["intervals"]["scene"])
    return [pattern.format(*(end * (100 if share else 1) for end in each)) for each in ends if each]


def test_both_intervals_stand_in_every_renderer():
    content = a_document()
    (run,) = content["runs"]
    assert run["scenes"] == 6
    read = [e for e in run["precision"] if e["category"] == "all"]
    read += [s for s in run["scores"] if s["category"] == "all" and not s["guard"]]
    (guarded,) = (s for s in run["scores"] if s["category"] == "all" and s["guard"])
    terminal, md, html, tex = (
        "\n".join(told(content)),
        *(markdown(content), page(content, {}), precision_tex(content)),
    )
    assert read[0]["intervals"]["scene"][0] < read[0]["intervals"]["sample"][0]
    for entry in read:
        for words in words_of(entry):
            assert words in terminal
            assert words in md
            assert words in html
            assert words.replace("%", r"\%") in tex
    for words in words_of(guarded):
        assert words in md
        assert words in html
    for text in (md, html, " ".join(terminal.replace("\n ", "").split())):
        assert interval_note(run) in text
    lines = [*csv.DictReader(io.StringIO(precision_csv(content)))]
    lines += csv.DictReader(io.StringIO(scores_csv(content)))
    for entry in (*run["precision"], *run["guards"], *run["scores"]):
        (protocol, _, label) = (entry.get("threshold") or entry["score"]).rpartition(": ")
        (line,) = (
            line
            for line in lines
            if (line["category"], line["column"]) == (entry["category"], label)
            and line["protocol"] == (protocol or "cpas")
        )
        ends = (entry["intervals"]["sample"] or ["", ""], entry["intervals"]["scene"] or ["", ""])
        found = [line[name] for name in ("sample_low", "sample_high", "scene_low", "scene_high")]
        assert found == [f"{end:.6g}" if end != "" else "" for pair in ends for end in pair]


@pytest.mark.parametrize(
    ("scenes", "count", "note"),
    [
        (6, 6, "by scene, wherever the 6 scenes differ, and with so few the truth lies outside"),
        (12, 12, "by scene, wherever the 12 scenes differ"),
        (3, 3, "none by scene, as 3 scenes are too few"),
        (1, 1, "none by scene, as all samples are of one"),
        (60, 60, "none by scene, as no two samples are of one"),
        (-1, None, "none by scene, as the samples do not say which they are of"),
    ],
)
def test_what_there_is_by_scene_is_said_once(scenes, count, note):
    content = a_document(scenes)
    (run,) = content["runs"]
    assert run["scenes"] == count
    assert note in interval_note(run)
    assert interval_note({**run, "precision": [], "scores": []}) == ""  # as of AP alone
    by_scene = [entry["intervals"]["scene"] for entry in run["precision"]]
    assert any(by_scene) is ("none by scene" not in note)
    shown = told(content)
    assert " ".join(" ".join(shown).split()).count("intervals at 95 %") == 1
    assert any(line.startswith("  by scene") for line in shown) is any(by_scene)
    assert max(map(len, shown)) <= 100


@pytest.mark.parametrize("category", ["can", "mug", "all"])
def test_cells_are_of_the_samples_of_their_category(category):
    _, table = a_table(12, wrong=25)
    names = [k for k, s in table.samples.items() if category in (s.category, "all")]
    scenes = [table.scenes[name] for name in names]
    facts = [table.samples[name].facts for name in names]
    made = interval_table(table)[category]
    right = np.array([[f["rotation_deg"] <= 10 and f["position_m"] <= 0.02] for f in facts])
    assert [made["cpas.10deg_2cm"].scene] == scene_mean_intervals(right, scenes)
    nad = [f["nad"] for f in facts]
    assert made["cpas.nad_median"].scene == scene_median_interval(nad, scenes)
    share = [max(0, 1 - f["rotation_deg"] / 5) * (1 - f["position_m"] / 0.05) for f in facts]
    mean = made["omni6dpose.vus_5deg_5cm"]
    assert (mean.sample.low, mean.sample.high) == pytest.approx(astuple(mean_interval(share)))
    (by_scene,) = scene_mean_intervals(np.array(share)[:, None], scenes)
    assert (mean.scene.low, mean.scene.high) == pytest.approx(astuple(by_scene))


def test_rejudged_rows_know_their_scenes():
    content = a_document()
    anew = rejudged(content, SEVERAL)
    for key in ("precision", "guards", "scores", "scenes"):
        assert anew["runs"][0][key] == content["runs"][0][key]


def test_verdict_against_the_paper_has_both():
    _, table = a_table()
    cell = PublishedCell(
        category="all", column="cpas.10deg_2cm", label="10 deg, 2 cm", low=40, high=40, total=60
    )
    (verdict,) = compare_published([cell], table.table, interval_table(table))
    scene = interval_table(table)["all"]["cpas.10deg_2cm"].scene
    words = f"; by scene, at 95 %, {100 * scene.low:.1f} to {100 * scene.high:.1f} %)"
    assert "interval per sample, at 98 %, " in verdict.details
    assert words in verdict.details
    assert "by scene" not in compare_published([cell], table.table)[0].details


def test_guards_are_one_line_a_category_where_they_are_as_recorded():
    _, golden = a_table()
    shown = told(a_document(golden=golden))
    start = shown.index("guards  as recorded")
    assert shown[start + 1 : start + 5] == [
        "can          8 of 8",
        "mug          8 of 8",
        "all          8 of 8",
        "",
    ]
    assert not any(line.startswith("guards  10 deg") for line in shown)


def test_guards_are_in_full_where_they_differ():
    _, golden = a_table(wrong=20)
    shown = told(a_document(golden=golden, wrong=21))  # the first of scene s2, a mug
    start = shown.index("guards  as recorded")
    assert shown[start + 1 : start + 3] == ["can          8 of 8", ""]
    head, mug, before, every, _, end = shown[start + 3 : start + 9]
    assert head.split("  ")[0] == "guards"
    assert (mug.split()[:3], before.split()[0]) == (["mug", "63.3", "%"], "recorded")
    assert before.split() == ["recorded", "66.7", "%", "66.7", "%"]
    assert (every.split()[0], end) == ("all", "")


def test_guards_whose_counts_agree_by_two_flips_are_in_full():
    run, golden = a_table()
    samples = refs(6)
    judged = [a_row(ref.id, ref.category, nad=0.01 + int(ref.id) / 1000) for ref in samples]
    swapped = {"00": 30.0, "01": 30.0}

    def table(bad):
        rows = [
            a_row(r.sample, r.category, nad=r.facts["nad"], rotation_deg=bad.get(r.sample, 1.0))
            for r in judged
        ]
        return RunTable.of(run, rows)

    new = table(swapped)
    old = table({"02": 30.0, "03": 30.0})
    content = document([run_document(run, new, golden=old)], 0, SEVERAL)
    assert old.table == new.table
    assert "guards  as recorded" not in told(content)
    assert golden.table != new.table


def test_guards_without_a_golden_table_are_in_full():
    shown = told(a_document())
    assert any(line.startswith("guards") and "median NAD" in line for line in shown)
    assert not any("as recorded" in line or "  recorded" in line for line in shown)
