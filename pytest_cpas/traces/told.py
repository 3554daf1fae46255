"""The parity of a method and a reference as a part of a report."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pytest_cpas.documents import DifferenceDocument, ParityDocument, PartingDocument
from pytest_cpas.traces.comparing import Difference
from pytest_cpas.traces.parity import (
    Parting,
    SampleParity,
    agreed,
    difference_words,
    first_parting,
)
from pytest_cpas.types import Verdict

__all__ = ["parity_document"]


def parity_document(
    verdict: Verdict, samples: Sequence[SampleParity], reference: str
) -> ParityDocument:
    """The document of a verdict of :func:`.parity.judge_parity` on the same ``samples``."""
    found = first_parting(samples)
    word = verdict.word.value
    return {
        "word": word,  # type: ignore[typeddict-item]  # of a ParityWord
        "subject": verdict.subject,
        "details": verdict.details,
        "outcome": verdict.outcome(False),
        "reference": reference,
        "compared": sum(bool(each.count) for each in samples),
        "parting": None if found is None else _parting(found),
    }


def _parting(found: Parting) -> PartingDocument:
    worst = found.worst
    return {
        "value": found.difference.name,
        "stage": found.difference.stage,
        "sample": worst.sample,
        "samples": len(found.here),
        "explained_by": agreed([each.fits for each in found.here]),
        "known": agreed([each.near for each in found.here]),
        "around": [_difference(each) for each in worst.around],
        "degrees": found.degrees,
        "millimetres": found.millimetres,
        "changed": found.changed,
        "columns": dict(found.columns.most_common()),
    }


def _difference(found: Difference) -> DifferenceDocument:
    exact = found.word == "EXACT"
    return {
        "value": found.name,
        "word": found.word,
        "details": "" if exact else difference_words(found),
        "relative": found.relative if math.isfinite(found.relative) else None,
    }
