"""Runs of a report judged under other protocols, by the facts of their samples."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from pytest_cpas.documents import Document, RunDocument, SampleDocument
from pytest_cpas.evaluation import Answer, Row, Run
from pytest_cpas.facts import fact
from pytest_cpas.golden import RunTable
from pytest_cpas.protocols import Protocol
from pytest_cpas.report.document import document, run_document, run_outcome
from pytest_cpas.types import SampleRef

__all__ = ["rejudged", "rejudged_run"]


class _ReportedRun(Run):
    """What a report still knows of a run."""

    def __init__(self, told: RunDocument, protocols: Sequence[Protocol]) -> None:
        super().__init__(
            told["method"],
            told["dataset"],
            [
                SampleRef(id=sample["sample"], category=sample["category"], scene=sample["scene"])
                for sample in told["samples"]
            ],
            missing=told["missing"],
            identity=told["identity"],
            protocols=protocols,
        )
        self.listed = Counter({name: n["listed"] for name, n in told["categories"].items()})
        self.seeds = told["seeds"]
        self._notes = told.get("notes", ())
        self.definitions, self.provenance = told["definitions"], told["provenance"]

    @property
    def notes(self) -> Sequence[str]:
        """Those of the report."""
        return self._notes

    def judge(self, ref: SampleRef) -> Row:
        """Nothing is judged anew."""
        raise NotImplementedError


def rejudged(content: Document, protocols: Sequence[Protocol]) -> Document:
    """The report with every run judged under other protocols; nothing is run again.

    The golden table is not at hand, so that no verdict on it, and no cell of it, is left. Facts
    that the samples lack leave their columns n/a, and the run says so (``lacking``).
    """
    runs = [rejudged_run(run, protocols) for run in content["runs"]]
    return document(runs, content["failed_items"], protocols)


def rejudged_run(told: RunDocument, protocols: Sequence[Protocol]) -> RunDocument:
    """One run of :func:`rejudged`."""
    run = _ReportedRun(told, protocols)
    rows = [_row(sample, told) for sample in told["samples"] if sample["error"] is None]
    errors = {s["sample"]: s["error"] for s in told["samples"] if s["error"] is not None}
    speed, parity = told["speed"], told.get("parity")
    made = run_document(run, RunTable.of(run, rows), errors=errors, speed=speed, parity=parity)
    made["problems"] = told["problems"]  # the data set is not at hand either
    made["contract"], made["findings"] = told["contract"], told["findings"]
    made["up_axes"] = told["up_axes"]
    broken = told["problems"] or errors
    made["outcome"] = run_outcome(broken, told["contract"], speed, [], parity)
    return made


def _row(sample: SampleDocument, told: RunDocument) -> Row:
    facts = {
        name: sample["facts"].get(name, fact(name).failed)  # as a document leaves it out
        for name in told["definitions"]
    }
    answer = Answer(facts=facts, failure=sample["failure"])
    return Row(sample=sample["sample"], category=sample["category"], answers=(answer,))
