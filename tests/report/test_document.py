"""The document of a run: flips, samples without an answer or a row, speed, the paper's name."""

import math

from made_documents import a_document
from tables import GOLDEN, a_row, a_run, a_speed, rows

from pytest_cpas.golden import RunTable
from pytest_cpas.golden.published import published_name
from pytest_cpas.report.markdown import markdown


def test_flips_are_grouped_by_kind():
    (run,) = a_document(rows(s_03=7.0, s_04=30.0), GOLDEN)["runs"]
    five, ten = ["5 deg, 1 cm", "5 deg, 1 cm, F 0.8"], ["10 deg, 2 cm", "10 deg, 2 cm, F 0.6"]
    assert [(flip["sample"], flip["lost"]) for flip in run["flips"]] == [
        ("s/03", [*five, "5 deg, 5 cm"]),
        ("s/04", [*ten, *five, "10 deg, 5 cm", "5 deg, 5 cm"]),
    ]
    assert run["flips"][0]["before"] == "0.5 cm, 4 deg, IoU 0.9, F 0.95, NAD 0.01"
    assert run["flips"][0]["after"] == "0.5 cm, 7 deg, IoU 0.9, F 0.95, NAD 0.01"


def test_golden_table_of_other_conditions_is_not_compared():
    other = RunTable.of(a_run(data="y"), rows())
    (run,) = a_document(rows(s_03=7.0), other)["runs"]
    assert run["verdicts"][0]["word"] == "STALE"
    assert run["flips"] == []
    assert {cell["golden"] for cell in run["precision"]} == {None}


def test_no_answer_and_no_row():
    judged = rows()[1:]
    judged[0] = a_row(
        sample="s/01",
        category="mug",
        position_m=math.inf,
        rotation_deg=math.inf,
        iou=-math.inf,
        fscore_1cm=None,
        failure="no luck",
    )
    (run,) = a_document(judged, errors={"s/00": "torn"})["runs"]
    assert (run["outcome"], run["judged"], run["listed"], run["unanswered"]) == ("failed", 9, 10, 1)
    assert run["categories"]["can"] == {"judged": 4, "listed": 5}
    torn, failed = run["samples"][:2]
    assert (torn["outcome"], torn["error"], torn["failure"]) == (None, "torn", None)
    assert (failed["outcome"], failed["error"], failed["failure"]) == (
        "0-0-" + "00000--",  # of what is read, and of what is guarded
        None,
        "no luck",
    )
    # what is n/a is told from what the sample failed at
    assert failed["facts"] == {"fscore_1cm": None}
    assert failed["position_m"] is failed["iou"] is failed["fscore_1cm"] is None


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


def test_paper_is_named_for_stored_predictions_of_its_samples():
    """REAL275's numbers of samples per category, and one sample fewer."""
    counts = {"bottle": 2757, "bowl": 2370, "camera": 2669, "can": 2729, "laptop": 2754}
    assert published_name("stored", counts | {"mug": 2839}) == "real275"
    assert published_name("stored", counts | {"mug": 2838}) is None
    assert published_name("other", counts | {"mug": 2839}) is None
    assert published_name("real275", counts) == "real275"
