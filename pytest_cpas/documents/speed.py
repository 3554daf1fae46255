"""What ``--cpas-benchmark`` measured: the only part of a report that holds times, in seconds."""

from typing import Annotated, Literal, NotRequired, TypedDict

from pytest_cpas.documents._allowed import (
    AboveZero,
    Allowed,
    Natural,
    NotNegative,
    Positive,
    Share,
)
from pytest_cpas.documents.counts import PublishedTimeDocument
from pytest_cpas.types import ItemOutcome


class IntervalDocument(TypedDict):
    """A median and its interval, exact for any distribution (order statistics).

    Made of :class:`pytest_cpas.timing.intervals.Interval`.
    """

    median: AboveZero
    lower: NotNegative
    upper: AboveZero
    confidence: Annotated[float, Allowed(above=0, below=1)]


class StageDocument(TypedDict):
    """A stage of a prediction, as the adapter names it.

    From :mod:`pytest_cpas.stages`.
    """

    name: str
    seconds: Annotated[NotNegative, "Per sample: the mean."]
    share: Annotated[Share, "Of the whole prediction."]


class MemoryDocument(TypedDict):
    """Peaks of memory; null where the system does not tell."""

    host_bytes: Annotated[Natural | None, "Peak of the process's resident memory."]
    host_source: Annotated[
        Literal["predictions", "process"] | None,
        "predictions: the peak while some were made; process: the peak since the process began.",
    ]
    device_bytes: Annotated[
        Natural | None,
        "Peak of what torch had allocated on the device while some predictions were made; null on"
        " the CPU.",
    ]


Clock = Literal["wall clock", "wall clock without waiting for a core"]


class MachineDocument(TypedDict):
    """On what it was measured."""

    clock: Annotated[
        Clock, "Whether time counts in which the method was ready, and the core had other work."
    ]
    cpu: str
    cores: Annotated[Positive, "That the process may use."]
    system: str
    python: str
    device: Annotated[str, "cpu, or the name of the device."]
    threads: Annotated[dict[str, int], "By library."]
    versions: Annotated[
        dict[str, str], "Of numpy, and where there are any of torch, CUDA and the driver."
    ]


class ReferenceDocument(TypedDict):
    """What was timed in turns with the method."""

    kind: Annotated[
        Literal["calibration", "method", "revision"],
        "A fixed operation, another adapter, or the same adapter of another revision.",
    ]
    name: str
    seconds: IntervalDocument


class SpeedVerdictDocument(TypedDict):
    """The verdict on the speed.

    Made of :class:`pytest_cpas.types.Verdict`.
    """

    word: Literal[
        "SLOWER",
        "NOT SLOWER",
        "FASTER",
        "UNDECIDED",
        "NOT COMPARED",
        "RECORDED",
        "NOT RECORDED",
        "MEASURED",
    ]
    details: str
    outcome: ItemOutcome
    limit: Annotated[
        float | None,
        Allowed(above=1),
        "The slow-down that is too much; null: none was given, and nothing was judged.",
    ]


class MeasuredSpeedDocument(TypedDict):
    """What was measured of a method's speed, without the verdict on it.

    Made by :meth:`pytest_cpas.timing.running.SpeedRun.measure`.
    """

    seconds: Annotated[
        IntervalDocument,
        "Per sample: predict() with one observation, transfer to the device included, without the"
        " metrics.",
    ]
    mean_seconds: Annotated[AboveZero, "Per sample, as the paper states it."]
    rounds: Annotated[Positive, "Timed rounds."]
    predictions_per_round: Annotated[
        Positive, "Short predictions are repeated, and a round is their mean."
    ]
    samples: Annotated[Positive, "Different samples among them; as many predictions warmed up."]
    stages: Annotated[
        list[StageDocument],
        "What the adapter names, in the order in which it came; measured apart from the rounds.",
    ]
    transfer_seconds: Annotated[
        NotRequired[NotNegative],
        "Per sample: the way to a method in another interpreter and back, which is no part of its"
        " time; only of such a method.",
    ]
    memory: MemoryDocument
    machine: MachineDocument
    reference: ReferenceDocument
    ratio: Annotated[IntervalDocument, "Of the method's time to the reference's, pair by pair."]
    slowdown: Annotated[
        IntervalDocument | None,
        "The ratio over the recorded ratio or, where the reference is a method or a revision, the"
        " ratio; above 1 is slower. null: nothing to compare with.",
    ]
    published: Annotated[
        PublishedTimeDocument | None,
        "What the paper prints for this method; never judged, for it is another machine's.",
    ]


class SpeedDocument(MeasuredSpeedDocument):
    """The speed of a method on a data set."""

    verdict: SpeedVerdictDocument
