"""Ten made-up samples, and the tables of runs on them."""

from pytest_cpas.evaluation import Row, Run
from pytest_cpas.golden import RunTable
from pytest_cpas.types import SampleRef


class Fixed(Run):
    def judge(self, ref):
        raise NotImplementedError


REFS = [SampleRef(f"s/{i:02d}", "mug" if i % 2 else "can", "s") for i in range(10)]


def a_run(**identity: str) -> Run:
    return Fixed("m", "d", REFS, identity={"data": "x", **identity})


def rows(**rotation: float) -> list[Row]:
    """Rows with a rotation error of 4 degrees, or as given for "s_03" (sample s/03)."""
    return [
        Row(ref.id, ref.category, 0.005, rotation.get(ref.id.replace("/", "_"), 4.0), 0.9, 0.95)
        for ref in REFS
    ]


def table(identity: str = "x", **rotation: float) -> RunTable:
    """The table of :func:`rows`."""
    return RunTable.of(a_run(data=identity), rows(**rotation))


GOLDEN = table()
