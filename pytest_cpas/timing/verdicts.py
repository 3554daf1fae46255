"""The verdict on a method's speed."""

from __future__ import annotations

from pytest_cpas.timing.intervals import Interval, decide
from pytest_cpas.types import Verdict, VerdictWord
from pytest_cpas.types.samples import ALL


class SpeedWord(VerdictWord):
    """How a method's time compares."""

    #: The whole interval of the slow-down lies above what is allowed.
    SLOWER = "SLOWER", "failed"
    #: The whole interval is within what is allowed.
    NOT_SLOWER = "NOT SLOWER", "passed"
    #: The same, and it is faster by more than the share that it may be slower by.
    FASTER = "FASTER", "passed"
    #: The interval still holds what is allowed when the time for measuring is spent.
    UNDECIDED = "UNDECIDED", "skipped", "failed"
    #: There is nothing to compare with, for the reason that is given.
    NOT_COMPARED = "NOT COMPARED", "skipped", "failed"
    #: Measured, and judged by nothing: there is no --cpas-benchmark-fail.
    MEASURED = "MEASURED", "passed"
    #: With --snapshot-update: the ratio was written.
    RECORDED = "RECORDED", "passed"


def judge(
    slowdown: Interval | None, reference: str, limit: float | None, quadruples: int
) -> Verdict:
    """The verdict on a slow-down relative to ``reference`` (as a message says it).

    Without a slow-down ``reference`` says why there is none. Without a limit nothing is judged.
    """
    if slowdown is None:
        word = SpeedWord.MEASURED if limit is None else SpeedWord.NOT_COMPARED
        return Verdict(word, ALL, reference, limit)
    factor = (
        f"{slowdown.median:.3g} times {reference} ({slowdown.lower:.3g} to {slowdown.upper:.3g}"
        f" with {100 * slowdown.confidence:.3g} % confidence, {quadruples} quadruples)"
    )
    if limit is None:
        return Verdict(
            SpeedWord.MEASURED, ALL, f"{factor}; not judged without --cpas-benchmark-fail"
        )
    words = {
        "slower": (SpeedWord.SLOWER, f"{factor}; allowed are {limit:.4g} times"),
        "not slower": (SpeedWord.NOT_SLOWER, f"{factor}; allowed are {limit:.4g} times"),
        "faster": (SpeedWord.FASTER, factor),
        "undecided": (
            SpeedWord.UNDECIDED,
            f"{factor}; the limit of {limit:.4g} times lies in between. Give the machine less else"
            " to do, or another limit",
        ),
    }
    word, details = words[decide(slowdown, limit)]
    return Verdict(word, ALL, details, limit)


def parse_limit(text: str) -> float:
    """The factor, above 1, of a slow-down written as ``20%`` or ``0.2``; ValueError for others."""
    number, percent = text.strip(), False
    if number.endswith("%"):
        number, percent = number[:-1].rstrip(), True
    try:
        share = float(number) / (100 if percent else 1)
    except ValueError:
        share = float("nan")
    if not 0 < share < 100:  # NaN is not
        raise ValueError(
            f"--cpas-benchmark-fail is {text!r}, expected by how much longer is too much, such as"
            " 20% or 0.2"
        )
    if share > 2 and not percent:
        raise ValueError(
            f"--cpas-benchmark-fail is {text!r}, which is {100 * share:g} %: write {share:g}%, or"
            f" {100 * share:g}% if that is meant"
        )
    return 1 + share
