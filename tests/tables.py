"""Ten made-up samples, and the tables of runs on them."""

from dataclasses import replace

from pytest_cpas.evaluation import Answer, Row, Run
from pytest_cpas.facts import fact
from pytest_cpas.golden import RunTable
from pytest_cpas.protocols import shipped_protocol
from pytest_cpas.traces.comparing import Difference
from pytest_cpas.traces.parity import SampleParity, judge_parity
from pytest_cpas.traces.told import parity_document
from pytest_cpas.types import SampleRef


class Fixed(Run):
    def judge(self, ref):
        raise NotImplementedError


REFS = [
    SampleRef(id=f"s/{i:02d}", category="mug" if i % 2 else "can", scene="s") for i in range(10)
]


def a_run(**identity: str) -> Run:
    return Fixed("m", "d", REFS, identity={"data": "x", **identity})


#: What a run is judged under unless it says otherwise.
CPAS = (shipped_protocol("cpas"),)


#: The facts of an answer that is right everywhere.
FACTS = {
    "position_m": 0.005,
    "rotation_deg": 4.0,
    "iou": 0.9,
    "fscore_1cm": 0.95,
    "nad": 0.01,
}


def a_row(sample: str, category: str, *, failure: str | None = None, **facts: float | None) -> Row:
    """A row of one seed, with :data:`FACTS` but for what is given."""
    if failure is not None:
        facts = {name: fact(name).failed for name in FACTS} | facts
    answer = Answer(facts={**FACTS, **facts}, failure=failure)
    return Row(sample=sample, category=category, answers=(answer,))


def with_facts(row: Row, **facts: float | None) -> Row:
    """The row with other facts under its first seed."""
    first, *further = row.answers
    first = replace(first, facts={**first.facts, **facts})
    return replace(row, answers=(first, *further))


def rows(**rotation: float) -> list[Row]:
    """Rows with a rotation error of 4 degrees, or as given for "s_03" (sample s/03)."""
    return [
        a_row(ref.id, ref.category, rotation_deg=rotation.get(ref.id.replace("/", "_"), 4.0))
        for ref in REFS
    ]


def table(identity: str = "x", **rotation: float) -> RunTable:
    """The table of :func:`rows`."""
    return RunTable.of(a_run(data=identity), rows(**rotation))


def interval(median: float) -> dict:
    return {"median": median, "lower": 0.9 * median, "upper": 1.1 * median, "confidence": 0.99}


def a_speed(seconds: float) -> dict:
    """What --cpas-benchmark leaves in a document, of a method that got slower."""
    return {
        "seconds": interval(seconds),
        "mean_seconds": seconds,
        "rounds": 24,
        "predictions_per_round": 1,
        "samples": 12,
        "stages": [{"name": "network", "seconds": 0.0002, "share": 0.8}],
        "memory": {"host_bytes": 2**30, "host_source": "predictions", "device_bytes": 2**20},
        "machine": {
            "clock": "wall clock",
            "cpu": "A CPU",
            "cores": 2,
            "system": "Linux",
            "python": "3.12.1",
            "device": "A GPU",
            "threads": {"openblas": 2},
            "versions": {"numpy": "2.3"},
        },
        "reference": {"kind": "revision", "name": "git:HEAD~1", "seconds": interval(0.19)},
        "ratio": interval(1.3),
        "slowdown": interval(1.3),
        "verdict": {"word": "SLOWER", "details": "by 30 %", "outcome": "failed", "limit": 1.2},
        "published": {"dataset": "redwood75", "mean_seconds": 0.227, "machine": "Old, Older"},
    }


def a_parity() -> dict:
    """What --cpas-parity leaves there, of a method that parts."""
    own = Difference(
        name="net, call 2", word="PARTS", kind="tap", stage="in", relative=0.5, largest=1.0, at=(3,)
    )
    same = Difference(name="input", word="EXACT", kind="tap", stage="")
    found = SampleParity(
        sample="s/01",
        count=2,
        exact=1,
        place=1,
        parting=own,
        around=[same, own],
        fits=["scaled by 2"],
        degrees=1.0,
        millimetres=2.0,
        flips=["5 deg, 1 cm"],
    )
    return parity_document(judge_parity([found], "the original"), [found], "the original")


GOLDEN = table()
