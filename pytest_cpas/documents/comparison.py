"""Runs beside others on the same data, sample by sample."""

from typing import Annotated, TypedDict

from pytest_cpas.documents._allowed import Natural, Share
from pytest_cpas.documents.counts import CountDocument
from pytest_cpas.documents.runs import FlipDocument


class ChangeDocument(TypedDict):
    """A category (all: every one) at a joint threshold, in both runs.

    ``before`` and ``after`` count the same samples; null if the metric is n/a in either run.
    """

    category: str
    threshold: str
    before: CountDocument | None
    after: CountDocument | None
    lost: Natural
    gained: Natural
    p: Annotated[
        Share | None,
        "McNemar's exact test, two-sided: the probability of flips as uneven as these if both runs"
        " were equally good. null without a flip.",
    ]


class PairDocument(TypedDict):
    """A run beside another one on the same data."""

    method: str
    dataset: str
    other: Annotated[str, "The method of the other run."]
    differences: Annotated[list[str], "Conditions that differ, in words."]
    common: Annotated[Natural, "Samples judged in both; all counts are of them."]
    only_here: Natural
    only_there: Natural
    precision: list[ChangeDocument]
    guards: Annotated[list[ChangeDocument], "The same for columns that are there to be guarded."]
    flips: Annotated[list[FlipDocument], "Samples judged otherwise than in the other run."]


class AgainstDocument(TypedDict):
    """The runs of a report compared with those of another one.

    Made by :func:`pytest_cpas.report.against.against`.
    """

    pairs: list[PairDocument]
    unpaired: Annotated[list[str], "Runs without a counterpart."]
