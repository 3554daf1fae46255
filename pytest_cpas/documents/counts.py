"""Counts of correct samples: measured, golden, and as the paper prints them."""

from typing import Annotated, Literal, TypedDict

from pytest_cpas.documents._allowed import (
    AboveZero,
    Allowed,
    Natural,
    NotNegative,
    Percent,
    Positive,
)

#: What the threshold of a curve is on.
CurveName = Literal["position_m", "rotation_deg", "fscore_1cm"]


class CountDocument(TypedDict):
    """Samples that meet a joint threshold, of those that it can be asked of.

    Made of :class:`pytest_cpas.metrics.precision.Count`.
    """

    correct: Natural
    total: Positive


class PublishedCountDocument(TypedDict):
    """Between lowest and highest of total are correct, as far as the paper tells.

    Made of :class:`pytest_cpas.golden.published.PublishedCell`; its print has four decimals.
    """

    lowest: Natural
    highest: Natural
    total: Positive


#: Low and high; null is infinite.
_Ends = Annotated[list[float | None], Allowed(length=2)]


class IntervalsDocument(TypedDict):
    """Between what a figure lies at 95 %, as [low, high]; null where that says nothing.

    Made of :class:`pytest_cpas.protocols.Intervals`; :mod:`pytest_cpas.metrics.intervals` has how.
    """

    sample: Annotated[_Ends | None, "As if samples were independent of each other."]
    scene: Annotated[_Ends | None, "By a cluster bootstrap of whole scenes."]


class PrecisionDocument(TypedDict):
    """A category (all: every one) at a joint threshold, by its label; null is n/a or not known."""

    category: str
    threshold: str
    measured: CountDocument | None
    intervals: Annotated[IntervalsDocument | None, "Of the measured share."]
    golden: CountDocument | None
    published: PublishedCountDocument | None


class ScoreDocument(TypedDict):
    """A category (all: every one) in a column that has a number per sample; null is n/a.

    Made of :class:`pytest_cpas.protocols.Score`.
    """

    category: str
    score: Annotated[str, "The label of the column."]
    guard: Annotated[bool, "Whether it is there to be guarded more than to be read."]
    measured: float | None
    intervals: Annotated[
        IntervalsDocument | None, "Of the measured number; null for average precision."
    ]
    golden: float | None
    samples: Annotated[Natural, "Of how many samples the number is known."]
    better: Literal["lower", "higher"]
    share: Annotated[bool, "Whether it is a share of 1: an area, or an average precision."]


class PublishedPrecisionDocument(TypedDict):
    """A category (all: every one) at a joint threshold, by its label."""

    category: str
    threshold: str
    published: PublishedCountDocument


class LiteratureDocument(TypedDict):
    """What is printed of a method as average precision: to look at, no verdict is made of it.

    From ``golden/published/average_precision.csv``.
    """

    method: str
    paper: Annotated[str, "Where the method is from."]
    read_in: Annotated[str, "Where the figures were read."]
    also_in: Annotated[str, "Where they stand too; empty if nowhere was found."]
    note: Annotated[str, "What differs between the places, and the like."]
    percent: Annotated[
        dict[str, Percent], "By the label of a column of scores; what is not printed is left out."
    ]


class PointDocument(TypedDict):
    """Samples that meet one threshold alone: metres, degrees or an F-score."""

    threshold: NotNegative
    correct: Natural
    total: Positive


class CurvesDocument(TypedDict):
    """Precision against one threshold at a time; null where the metric is n/a."""

    position_m: list[PointDocument] | None
    rotation_deg: list[PointDocument] | None
    fscore_1cm: list[PointDocument] | None


class PublishedCurvesDocument(TypedDict, total=False):
    """Precision against one threshold at a time, as far as the paper prints it.

    From ``golden/published/curves.csv``.
    """

    position_m: list[PointDocument]
    rotation_deg: list[PointDocument]
    fscore_1cm: list[PointDocument]


class PublishedTimeDocument(TypedDict):
    """The run time per prediction that the paper prints for a method.

    From ``golden/published/run_time.csv``.
    """

    dataset: str
    mean_seconds: AboveZero
    machine: str


class PublishedMethodDocument(TypedDict):
    """What the paper prints for a method on a data set."""

    precision: list[PublishedPrecisionDocument]
    curves: PublishedCurvesDocument
    run_time: Annotated[
        PublishedTimeDocument | None, "Per prediction, on another data set and machine perhaps."
    ]
