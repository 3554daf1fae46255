"""The schema of the report: made of the types, and what it refuses."""

import copy

import make_schema
import pytest
import tiny
from report_schema import VALIDATOR, follow_schema
from tables import CPAS, Fixed, a_parity, a_run, a_speed, rows, table

from pytest_cpas.evaluation import MethodRun
from pytest_cpas.golden import RunTable
from pytest_cpas.golden.comparison import compare
from pytest_cpas.report.against import against
from pytest_cpas.report.document import FORMAT, document, run_document
from pytest_cpas.report.up_axes import up_axes
from pytest_cpas.timing.verdicts import SpeedWord


def test_the_schema_is_that_of_the_types():
    made = make_schema.schema_text()
    assert make_schema.PATH.read_text(encoding="utf-8") == made, "run tools/make_schema.py"
    assert VALIDATOR.schema["properties"]["format"] == {"const": FORMAT}


def test_every_word_on_speed_is_in_the_schema():
    verdict = VALIDATOR.schema["$defs"]["speed_verdict"]["properties"]
    assert {word.value for word in SpeedWord} <= {*verdict["word"]["enum"]}


def full_document() -> dict:
    """A document with something in every part."""
    golden, run = table(s_02=7.0), a_run()
    judged = rows(s_03=7.0, s_04=30.0)
    new = RunTable.of(run, judged)
    told = run_document(
        run, new, verdicts=compare(golden, new), golden=golden, errors={"s/00": "torn"}
    )
    method = MethodRun(tiny.Perfect(), tiny.Tiny(None))
    told["up_axes"] = up_axes(method, [method.judge(ref) for ref in method.samples])
    told["speed"] = a_speed(0.25)
    told["findings"] = [{"category": "mug", "name": "a mistake", "lines": ["it is this one"]}]
    told["parity"] = a_parity()
    told["contract"] = [{"check": "repeatable", "status": "violated", "message": "twice"}]
    paper = Fixed("spd", "real275", run.samples, identity={})
    runs = [told, run_document(paper, RunTable.of(paper, judged))]
    old = run_document(run, table(s_03=30.0))
    return {**document(runs, 1, CPAS), "against": against(runs[:1], [old])}


FULL = full_document()

#: What stands for a key that is not there.
GONE = object()

SPOILED = [
    ("format", 1),
    ("format", GONE),
    ("outcome", "good"),
    ("outcome", None),
    ("failed_items", -1),
    ("thresholds", None),
    ("guards", GONE),
    ("guards/0", None),
    ("runs/0/guards", GONE),
    ("runs/0/guards/0/measured/total", 0),
    ("runs/0/scores/0/measured", "low"),
    ("runs/0/scores/0/samples", -1),
    ("runs/0/scores/0/better", "bigger"),
    ("runs/0/lacking", "nothing"),
    ("runs/0/definitions", GONE),
    ("runs/0/samples/1/facts/nad", "0.1"),
    ("against/pairs/0/guards", GONE),
    ("thresholds/0", 1),
    ("runs", GONE),
    ("runs", None),
    ("more", 1),
    ("published/real275/spd/run_time/mean_seconds", 0),
    ("published/real275/spd/run_time", GONE),
    ("published/real275/spd/curves/iou", []),
    ("published/real275/spd/curves/rotation_deg", None),
    ("published/real275/spd/precision/0/published", None),
    ("published/real275/spd/precision/0/published/lowest", -1),
    ("against", None),
    ("against/unpaired", GONE),
    ("against/pairs/0/common", 0.5),
    ("against/pairs/0/precision/0/p", 1.01),
    ("against/pairs/0/precision/0/before/correct", GONE),
    ("against/pairs/0/flips/0/lost", "all"),
    ("runs/0/listed", GONE),
    ("runs/0/judged", -1),
    ("runs/0/seeds", 0),
    ("runs/0/published_as", 275),
    ("runs/0/more", "x"),
    ("runs/0/categories/can/judged", None),
    ("runs/0/categories/can/wrong", 1),
    ("runs/0/verdicts/0/outcome", "MATCHES"),
    ("runs/0/verdicts/0/details", None),
    ("runs/0/findings/0/lines", "one"),
    ("runs/0/contract/0/status", "unknown"),
    ("runs/0/contract/0/message", GONE),
    ("runs/0/precision/0/measured/total", 0),
    ("runs/0/precision/0/measured/correct", 1.5),
    ("runs/0/precision/0/golden", GONE),
    ("runs/0/curves/position_m", GONE),
    ("runs/0/curves/position_m/0/threshold", -0.01),
    ("runs/0/flips/0/gained/0", None),
    ("runs/0/flips/0/after", GONE),
    ("runs/0/samples/1/outcome", "12"),
    ("runs/0/samples/1/outcome", "11112"),
    ("runs/0/samples/1/golden", 1),
    ("runs/0/samples/1/position_m", -1e-9),
    ("runs/0/samples/1/position_m", "0.1"),
    ("runs/0/samples/1/rotation_deg", 180.1),
    ("runs/0/samples/1/iou", 1.5),
    ("runs/0/samples/1/fscore_1cm", 1.001),
    ("runs/0/samples/1/failure", False),
    ("runs/0/speed/seconds/median", 0),
    ("runs/0/speed/seconds/confidence", 1),
    ("runs/0/speed/rounds", 0),
    ("runs/0/speed/stages/0/share", 1.2),
    ("runs/0/speed/memory/host_source", "thread"),
    ("runs/0/speed/memory/device_bytes", -1),
    ("runs/0/speed/machine/clock", "sundial"),
    ("runs/0/speed/machine/threads/openblas", "2"),
    ("runs/0/speed/reference/kind", "rival"),
    ("runs/0/speed/slowdown", 1.3),
    ("runs/0/speed/verdict", GONE),
    ("runs/0/speed/verdict/word", "SLOW"),
    ("runs/0/speed/verdict/limit", 1),
    ("runs/0/parity", None),
    ("runs/0/parity/word", "PARTS"),
    ("runs/0/parity/compared", -1),
    ("runs/0/parity/parting", GONE),
    ("runs/0/parity/parting/samples", 0),
    ("runs/0/parity/parting/around/0/word", "SAME"),
    ("runs/0/parity/parting/around/0/relative", -1),
    ("runs/0/parity/parting/columns/5 deg, 1 cm", 0),
    ("runs/0/identity/data", 1),
    ("runs/0/provenance", None),
    ("runs/0/up_axes/truth/count", 0),
    ("runs/0/up_axes/truth/resultant", 1.1),
    ("runs/0/up_axes/truth/directions/0", [0, 1]),
    ("runs/0/up_axes/truth/directions/0/0", 2),
    ("runs/0/up_axes/estimate", GONE),
]


def test_the_full_document_is_admitted():
    follow_schema(FULL)


def spoiled(path: str, value: object) -> dict:
    """The full document with another value at a path; one that is not there, unless it is new."""
    content = copy.deepcopy(FULL)
    *folders, last = [int(key) if key.isdecimal() else key for key in path.split("/")]
    part = content
    for key in folders:
        part = part[key]
    if value is GONE:
        del part[last]
    else:
        part[last] = value
    return content


@pytest.mark.parametrize(("path", "value"), SPOILED)
def test_the_schema_refuses_a_spoiled_document(path, value):
    assert not VALIDATOR.is_valid(spoiled(path, value))


@pytest.mark.parametrize(
    "path",
    [
        "runs/0/published_as",
        "runs/0/speed",
        "runs/0/parity/parting",
        "runs/0/parity/parting/degrees",
        "runs/0/parity/parting/around/1/relative",
        "runs/0/up_axes",
        "runs/0/up_axes/truth",
        "runs/0/precision/0/measured",
        "runs/0/precision/0/golden",
        "runs/0/precision/0/published",
        "runs/0/guards/0/golden",
        "runs/0/scores/0/measured",
        "runs/0/scores/0/golden",
        "runs/0/samples/1/facts/nad",
        "runs/0/curves/fscore_1cm",
        "runs/0/samples/1/outcome",
        "runs/0/samples/1/position_m",
        "runs/0/samples/1/error",
        "runs/0/speed/memory/host_bytes",
        "runs/0/speed/memory/host_source",
        "runs/0/speed/slowdown",
        "runs/0/speed/verdict/limit",
        "runs/0/speed/published",
        "published/real275/spd/run_time",
        "against/pairs/0/precision/0/before",
        "against/pairs/0/precision/0/p",
    ],
)
def test_what_may_be_unknown_is_null(path):
    follow_schema(spoiled(path, None))


def test_a_type_that_is_no_json_is_refused():
    for kind in (set[str], bytes, str | int, dict[int, str]):
        with pytest.raises(TypeError, match="expected a TypedDict"):
            make_schema.value_schema(kind, {})
