"""What a report holds, as types: ``report.json``, and each of its parts.

``report/schema.json`` is made of them by ``tools/make_schema.py``: a class is an object, the first
paragraph of its docstring describes it, and a field's type, and :class:`Allowed` and a text in its
:data:`typing.Annotated`, are what the schema says of the field.
None is null. Lengths are in metres, angles in degrees, times in seconds.
"""

from typing import Annotated, Literal, NotRequired, TypedDict

from pytest_cpas.documents._allowed import Allowed, Natural
from pytest_cpas.documents.comparison import AgainstDocument, ChangeDocument, PairDocument
from pytest_cpas.documents.counts import (
    CountDocument,
    CurveName,
    CurvesDocument,
    IntervalsDocument,
    LiteratureDocument,
    PointDocument,
    PrecisionDocument,
    PublishedCountDocument,
    PublishedCurvesDocument,
    PublishedMethodDocument,
    PublishedPrecisionDocument,
    PublishedTimeDocument,
    ScoreDocument,
)
from pytest_cpas.documents.parity import (
    DifferenceDocument,
    ParityDocument,
    PartingDocument,
)
from pytest_cpas.documents.runs import (
    CategoryDocument,
    ContractDocument,
    ContractStatus,
    DirectionsDocument,
    FindingDocument,
    FlipDocument,
    RunConditions,
    RunDocument,
    RunName,
    SampleDocument,
    UpAxesDocument,
    VerdictDocument,
)
from pytest_cpas.documents.speed import (
    Clock,
    IntervalDocument,
    MachineDocument,
    MeasuredSpeedDocument,
    MemoryDocument,
    ReferenceDocument,
    SpeedDocument,
    SpeedVerdictDocument,
    StageDocument,
)
from pytest_cpas.types import ItemOutcome

__all__ = [
    "AgainstDocument",
    "Allowed",
    "CategoryDocument",
    "ChangeDocument",
    "Clock",
    "ContractDocument",
    "ContractStatus",
    "CountDocument",
    "CurveName",
    "CurvesDocument",
    "DifferenceDocument",
    "DirectionsDocument",
    "Document",
    "FindingDocument",
    "FlipDocument",
    "IntervalDocument",
    "IntervalsDocument",
    "ItemOutcome",
    "LiteratureDocument",
    "MachineDocument",
    "MeasuredSpeedDocument",
    "MemoryDocument",
    "PairDocument",
    "ParityDocument",
    "PartingDocument",
    "PointDocument",
    "PrecisionDocument",
    "PublishedCountDocument",
    "PublishedCurvesDocument",
    "PublishedMethodDocument",
    "PublishedPrecisionDocument",
    "PublishedTimeDocument",
    "ReferenceDocument",
    "RunConditions",
    "RunDocument",
    "RunName",
    "SampleDocument",
    "ScoreDocument",
    "SpeedDocument",
    "SpeedVerdictDocument",
    "StageDocument",
    "UpAxesDocument",
    "VerdictDocument",
]


class Document(TypedDict):
    """What --cpas-report and pytest-cpas report write. Lengths in metres, angles in degrees; null
    is n/a.

    Made by :func:`pytest_cpas.report.document.document`.
    """

    format: Literal[2]
    outcome: Annotated[
        ItemOutcome,
        "failed if any test item failed; skipped: a verdict could not be given, and was not"
        " required.",
    ]
    failed_items: Annotated[Natural, "Test items of the session that failed, whatever they tested."]
    thresholds: Annotated[
        list[str],
        "Labels of the joint thresholds; a sample's outcome has one character for each.",
    ]
    guards: Annotated[
        list[str],
        "Labels of the columns that are there to be guarded; their characters come after those.",
    ]
    runs: list[RunDocument]
    published: Annotated[
        dict[str, dict[str, PublishedMethodDocument]],
        "By data set and method: the tables of the paper; empty unless a run is on one of its data"
        " sets.",
    ]
    literature: Annotated[
        NotRequired[dict[str, list[LiteratureDocument]]],
        "Only under the protocol nocs-legacy: by data set, what the literature prints of it.",
    ]
    against: Annotated[
        NotRequired[AgainstDocument],
        "Only with --cpas-against: the runs compared with those of another one.",
    ]
