"""Rows, one per sample, and the table that they give."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from pytest_cpas.metrics.definitions import definition
from pytest_cpas.metrics.precision import FAILED, PAPER_THRESHOLDS, Count, Errors, JointThreshold
from pytest_cpas.metrics.surfaces import SAMPLE_COUNT
from pytest_cpas.types import SampleRef
from pytest_cpas.types.samples import ALL

__all__ = [
    "DEFINITIONS",
    "FSCORE_DISTANCE",
    "THRESHOLDS",
    "Row",
    "Table",
    "failed_row",
    "outcomes",
    "precision_table",
]


#: The distance of the paper's F-score, metres.
FSCORE_DISTANCE = 0.01

#: The thresholds of the precision table.
THRESHOLDS: tuple[JointThreshold, ...] = PAPER_THRESHOLDS

#: Under which definitions a row's errors are measured.
DEFINITIONS = {
    "translation_error": definition("translation_error", "euclidean").id(),
    "rotation_error": definition("rotation_error", "symmetry-group").id(),
    "iou": definition("iou", "oriented-symmetric").id(),
    "fscore_1cm": definition("fscore", "strict").id(
        delta_m=FSCORE_DISTANCE, frame="camera", points=SAMPLE_COUNT
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The errors of one sample.

    ``translation_error`` in metres, ``rotation_error`` in degrees. ``iou``, ``fscore_1cm``: None
    is n/a (the method gives no extents or shape, or the data set has none). A failed prediction
    has its reason in ``failure`` and the errors of :data:`pytest_cpas.metrics.precision.FAILED`.
    ``estimate``: the answer itself, as of :func:`~pytest_cpas.evaluation.encode_estimate`.
    ``repeats``: the outcomes (see :func:`outcomes`) under further seeds, separated by spaces.
    ``shape``: the estimated shape for a picture, as of
    :func:`~pytest_cpas.evaluation.encode_shape`.
    """

    sample: str
    category: str
    translation_error: float
    rotation_error: float
    iou: float | None
    fscore_1cm: float | None
    failure: str | None = None
    estimate: str | None = None
    repeats: str = ""
    shape: str | None = None


#: The field of a row for each of :data:`pytest_cpas.metrics.precision.METRICS`.
_FIELDS = {
    "rotation_deg": "rotation_error",
    "position_m": "translation_error",
    "iou": "iou",
    "fscore": "fscore_1cm",
}


def outcomes(rows: Sequence[Row]) -> list[str]:
    """Per row one character for each of :data:`THRESHOLDS`: correct 1, not 0, n/a -."""
    errors = Errors(
        {metric: [getattr(row, field) for row in rows] for metric, field in _FIELDS.items()}
    )
    columns = []
    for threshold in THRESHOLDS:
        judged = errors.judge(threshold)
        if judged is None:
            columns.append(["-"] * len(rows))
            continue
        columns.append(
            [
                "-" if not known else "1" if correct else "0"
                for correct, known in zip(*judged, strict=True)
            ]
        )
    # a few different ones only, however many rows: one object each
    return [sys.intern("".join(characters)) for characters in zip(*columns, strict=True)]


#: Counts per category (and "all") and threshold label; None where every sample is n/a.
Table = dict[str, dict[str, Count | None]]


def precision_table(judged: Iterable[tuple[str, str]]) -> Table:
    """The table of samples given as (category, outcome)."""
    groups: dict[str, list[str]] = {}
    for category, outcome in judged:
        groups.setdefault(ALL, []).append(outcome)
        groups.setdefault(category, []).append(outcome)
    table: Table = {}
    for category, members in sorted(groups.items()):
        table[category] = {}
        for index, threshold in enumerate(THRESHOLDS):
            column = [outcome[index] for outcome in members if outcome[index] != "-"]
            cell = Count(column.count("1"), len(column)) if column else None
            table[category][threshold.label] = cell
    return table


def failed_row(ref: SampleRef, reason: str | None, box: bool, shape: bool) -> Row:
    """The row of a sample without an answer: correct under no threshold."""
    return Row(
        sample=ref.id,
        category=ref.category,
        translation_error=FAILED["position_m"],
        rotation_error=FAILED["rotation_deg"],
        iou=FAILED["iou"] if box else None,
        fscore_1cm=FAILED["fscore"] if shape else None,
        failure=reason,
    )
