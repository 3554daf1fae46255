"""One run: a method on a data set. Lengths in metres, angles in degrees; None is n/a."""

from typing import Annotated, Literal, NotRequired, TypedDict

from pytest_cpas.documents._allowed import Allowed, Natural, NotNegative, Positive, Share
from pytest_cpas.documents.counts import CurvesDocument, PrecisionDocument, ScoreDocument
from pytest_cpas.documents.parity import ParityDocument
from pytest_cpas.documents.speed import SpeedDocument
from pytest_cpas.types import ItemOutcome

#: A character for each of the thresholds and then of the guards, in their order.
_Outcomes = Annotated[str, Allowed(pattern="^[01-]*$")]

_Direction = Annotated[
    list[Annotated[float, Allowed(minimum=-1.001, maximum=1.001)]], Allowed(length=3)
]


class RunName(TypedDict):
    """What a run is called by; every document of a run, or of two, has it."""

    method: str
    dataset: str


class RunConditions(RunName):
    """What decides whether a run can be compared with another one."""

    identity: dict[str, str]
    definitions: dict[str, str]


class CategoryDocument(TypedDict):
    """Samples of a category: with a row, and that there are."""

    judged: Natural
    listed: Natural


class VerdictDocument(TypedDict):
    """The verdict on a category, or on all of them, against the golden table or the paper.

    Made of :class:`pytest_cpas.types.Verdict`.
    """

    word: str
    category: str
    details: str
    outcome: ItemOutcome


class FindingDocument(TypedDict):
    """A mistake that explains wrong answers, in a category or in all.

    Made of :class:`pytest_cpas.diagnosis.Explanation`.
    """

    category: str
    name: str
    lines: list[str]


ContractStatus = Literal["passed", "violated", "known", "gone", "information", "n/a"]


class ContractDocument(TypedDict):
    """What a check of the contract of methods said.

    Made of :class:`pytest_cpas.checks.contract.ContractResult`.
    """

    check: str
    status: Annotated[
        ContractStatus,
        "known: a recorded violation; gone: a recorded violation that no longer happens;"
        " information: violated, but not demanded.",
    ]
    message: str


class FlipDocument(TypedDict):
    """A sample that is judged otherwise than before, with the labels of the thresholds.

    ``changed``: a metric is n/a that was not, or the other way round. ``before`` and ``after`` are
    the errors, for people.
    """

    sample: str
    category: str
    lost: list[str]
    gained: list[str]
    changed: list[str]
    before: str
    after: str


class SampleDocument(TypedDict):
    """A sample with a row or an error."""

    sample: str
    category: str
    scene: Annotated[str, "Samples of one scene have the same; empty if it is not known."]
    outcome: Annotated[
        _Outcomes | None,
        "Per threshold and guard: 1 correct, 0 not, - n/a; null: the sample could not be judged,"
        " error says why.",
    ]
    golden: Annotated[_Outcomes | None, "The same as recorded; null without a golden table."]
    position_m: NotNegative | None
    # float32 turns a half turn into a little more
    rotation_deg: Annotated[float | None, Allowed(minimum=0, maximum=180.001)]
    iou: Annotated[float | None, Allowed(minimum=0, maximum=1.000001)]
    fscore_1cm: Share | None
    facts: Annotated[
        dict[str, float | None],
        "All that was measured, by name, as exact as it was; null is n/a. What a sample without an"
        " answer failed at has no entry.",
    ]
    failure: Annotated[str | None, "Why the method gave no answer."]
    error: str | None


class DirectionsDocument(TypedDict):
    """Unit vectors in the camera frame."""

    count: Positive
    resultant: Annotated[
        float,
        Allowed(minimum=0, maximum=1.000001),
        "Mean resultant length: 1 where all agree.",
    ]
    coverage: Annotated[
        NotNegative,
        "Share of the sphere near a direction, over what as many uniform ones reach on average.",
    ]
    directions: Annotated[list[_Direction], "Some of them, evenly spaced."]


class UpAxesDocument(TypedDict):
    """Where the objects' up axes point; null where nothing is known.

    Made by :func:`pytest_cpas.report.up_axes.up_axes`.
    """

    truth: DirectionsDocument | None
    estimate: DirectionsDocument | None


class RunDocument(TypedDict):
    """A method on a data set.

    Made by :func:`pytest_cpas.report.document.run_document`.
    """

    method: str
    dataset: str
    published_as: Annotated[str | None, "The data set of the paper that the samples are of."]
    outcome: ItemOutcome
    judged: Annotated[Natural, "Samples with a row."]
    listed: Annotated[Natural, "Samples that there are, judged or not."]
    unanswered: Annotated[Natural, "Judged samples for which the method gave no answer."]
    failures: Annotated[
        NotRequired[dict[str, Positive]],
        "The most frequent reasons why, and how many samples have each.",
    ]
    scenes: Annotated[
        Natural | None, "Of the judged samples; null if it is not known of all of them."
    ]
    categories: dict[str, CategoryDocument]
    seeds: Positive
    missing: Annotated[
        list[str], "Parts of the data set that are not there, or that the method does not know."
    ]
    notes: Annotated[
        NotRequired[list[str]], "What else people should know of what was judged, such as a file."
    ]
    problems: Annotated[list[str], "What is wrong with the data set."]
    verdicts: list[VerdictDocument]
    findings: Annotated[list[FindingDocument], "Mistakes that explain wrong answers."]
    contract: list[ContractDocument]
    precision: list[PrecisionDocument]
    guards: Annotated[list[PrecisionDocument], "The same for columns that are there to be guarded."]
    scores: list[ScoreDocument]
    lacking: Annotated[
        list[str],
        "Columns in which no sample could be judged, and what for, in words; they are n/a.",
    ]
    curves: CurvesDocument
    flips: Annotated[
        list[FlipDocument],
        "Samples judged otherwise than by the golden table, with the labels of the thresholds.",
    ]
    samples: list[SampleDocument]
    speed: Annotated[
        SpeedDocument | None,
        "What --cpas-benchmark measured; null if it was not asked for. Only here does a report hold"
        " times: two runs give the same report but for them.",
    ]
    parity: Annotated[
        NotRequired[ParityDocument], "Where it parts from a reference; only with --cpas-parity."
    ]
    identity: Annotated[dict[str, str], "What must agree for two runs to be comparable."]
    definitions: Annotated[
        dict[str, str], "What each fact means; those of two runs are comparable if they agree."
    ]
    provenance: Annotated[dict[str, str], "What else is known of the run."]
    up_axes: Annotated[
        UpAxesDocument | None,
        "Where the objects' up axes point; null for perturbed data, and where nobody asked for a"
        " report. truth is null where only rows are left.",
    ]
