"""What the paper prints of a data set, in a document."""

from __future__ import annotations

from collections.abc import Iterable

from pytest_cpas.documents import (
    CurveName,
    PointDocument,
    PublishedCountDocument,
    PublishedCurvesDocument,
    PublishedMethodDocument,
    PublishedTimeDocument,
)
from pytest_cpas.golden.published import (
    PublishedCell,
    PublishedTime,
    published_cells,
    published_curves,
    published_methods,
    published_time,
)
from pytest_cpas.metrics.precision import Count

_CURVES: tuple[CurveName, ...] = ("position_m", "rotation_deg", "fscore_1cm")


def published_document(dataset: str) -> dict[str, PublishedMethodDocument]:
    """What it prints of a data set, by method."""
    return {
        method: {
            "precision": [
                {
                    "category": cell.category,
                    "threshold": cell.label,
                    "published": published_count(cell),
                }
                for cell in published_cells(dataset, method)
            ],
            "curves": _curves(dataset, method),
            "run_time": _run_time(published_time(method)),
        }
        for method in published_methods(dataset)
    }


def published_count(cell: PublishedCell) -> PublishedCountDocument:
    """How many samples of a cell are correct."""
    return {"lowest": cell.low, "highest": cell.high, "total": cell.total}


def points(counts: Iterable[tuple[float, Count]]) -> list[PointDocument]:
    """The points of a curve: thresholds (metres, degrees or F-score), and counts at them."""
    return [
        {"threshold": limit, "correct": count.correct, "total": count.total}
        for limit, count in counts
    ]


def _curves(dataset: str, method: str) -> PublishedCurvesDocument:
    curves: PublishedCurvesDocument = {}
    printed = published_curves(dataset, method)
    for name in _CURVES:
        if name in printed:
            curves[name] = points(printed[name])
    return curves


def _run_time(time: PublishedTime | None) -> PublishedTimeDocument | None:
    if time is None:
        return None
    return {
        "dataset": time.dataset,
        "mean_seconds": time.mean_seconds,
        "machine": time.machine,
    }
