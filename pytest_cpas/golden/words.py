"""The words of verdicts against golden tables."""

from __future__ import annotations

from pytest_cpas.types import VerdictWord

__all__ = ["Word"]


class Word(VerdictWord):
    """The verdict on one category of a run."""

    #: Every sample meets the same thresholds as when the table was recorded; of a table that was
    #: recorded under several seeds that disagree: nothing is improbable beside them.
    MATCHES = "MATCHES", "passed"
    #: There is no recorded table, and the exact binomial interval of each count holds what the
    #: paper prints for this method and data set.
    AGREES = "AGREES WITH THE PAPER", "passed"
    #: The same, and an interval lies above what the paper prints.
    ABOVE = "ABOVE THE PAPER", "passed"
    #: On another platform than that of the recording: samples flipped, but only by facts that moved
    #: by less than the tolerance, or no further than was measured on other platforms, across a
    #: threshold; about as often either way, and no more than such moves explain.
    BORDERLINE = "BORDERLINE", "passed"
    #: At some threshold more samples were lost than gained; they are named with their errors. Or
    #: facts got worse in so many samples that it is improbable without a change.
    #: Against the paper: an interval lies below what it prints.
    REGRESSED = "REGRESSED", "failed"
    #: Of a table recorded under several seeds: a loss, or facts that got worse, as less than 5 % of
    #: all runs without a change show anywhere, but not as improbable as --cpas-alarm asks of
    #: REGRESSED. Its p is told; it fails with --cpas-require-golden=strict.
    PROBABLY_WORSE = "PROBABLY WORSE", "skipped", "skipped", "failed"
    #: Of a table recorded under several seeds: nothing is improbable beside them, but not even the
    #: loss of every sample of this category would be; that of others would.
    CANNOT_TELL = "CANNOT TELL", "skipped"
    #: Samples were gained and none lost, or facts got better in so many samples that it is
    #: improbable without a change: look at it and record it.
    IMPROVED = "IMPROVED", "failed"
    #: As many lost as gained, or other samples, or fewer than there were, or a metric is n/a that
    #: was not; or facts moved on the platform of the recording although nothing flipped.
    CHANGED = "CHANGED", "failed"
    #: The table was made with other data, weights, seed, device or metric definitions: not
    #: comparable.
    STALE = "STALE", "failed"
    #: The table was edited by hand or is torn.
    DAMAGED = "DAMAGED", "failed"
    #: There is no table, or one whose seeds could show no loss at all, or only a part of the
    #: samples was judged (and agrees).
    NOT_CHECKED = "NOT CHECKED", "skipped", "failed"
    #: The table has the form of an earlier version, which knew less or kept it elsewhere: record it
    #: anew. What it knows is judged all the same.
    OUTDATED = "OUTDATED", "passed"
    #: With --snapshot-update: the table was written.
    RECORDED = "RECORDED", "passed"
    #: With --snapshot-update: it was not, for the reason that is given.
    NOT_RECORDED = "NOT RECORDED", "failed"
