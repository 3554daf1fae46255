"""A method beside a reference, value by value: what ``--cpas-parity`` found."""

from typing import Annotated, Literal, TypedDict

from pytest_cpas.documents._allowed import Natural, NotNegative, Positive
from pytest_cpas.types import ItemOutcome


class DifferenceDocument(TypedDict):
    """How a value differs from the reference's.

    Made of :class:`pytest_cpas.traces.comparing.Difference`.
    """

    value: Annotated[str, "Its name and, from the second on, its call."]
    word: Literal["EXACT", "FLOAT NOISE", "PARTS"]
    details: Annotated[str, "How far it is off, in words; empty if it is the same."]
    relative: Annotated[
        NotNegative | None,
        "L2 norm of the difference over that of the reference; null: infinite, other shapes.",
    ]


class PartingDocument(TypedDict):
    """The first value at which a method parts from the reference."""

    value: Annotated[str, "Its name and, from the second on, its call, in that sample."]
    stage: Annotated[str, "In which it is named; empty if in none."]
    sample: Annotated[str, "Of those that part there, the one that is furthest off."]
    samples: Annotated[Positive, "How many part there, at whichever call."]
    explained_by: Annotated[list[str], "Usual mistakes, each of which explains it alone."]
    known: Annotated[list[str], "What is known of it, where nothing explains it."]
    around: Annotated[list[DifferenceDocument], "The values around it in that sample, in order."]
    degrees: Annotated[
        NotNegative | None,
        "How far the two answers are apart at most, over all samples that part, and",
    ]
    millimetres: Annotated[NotNegative | None, "... their positions; null: none has two answers."]
    changed: Annotated[
        Natural, "Samples of which one answer is correct and the other is not, in some column."
    ]
    columns: Annotated[dict[str, Positive], "In each column how many."]


class ParityDocument(TypedDict):
    """The verdict on a method beside a reference.

    Made by :func:`pytest_cpas.traces.told.parity_document`.
    """

    word: Literal["EXACT", "FLOAT NOISE", "PARTS AT", "NOT COMPARED"]
    subject: Annotated[str, "The value at which the two part; all if at none."]
    details: str
    outcome: ItemOutcome
    reference: Annotated[str, "What it is compared with, in words."]
    compared: Annotated[Natural, "Samples in which both name some value."]
    parting: PartingDocument | None
