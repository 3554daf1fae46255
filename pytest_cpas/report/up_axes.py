"""Where up axes point, of truths and of estimates, as a part of a document."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_cpas.checks.dataset.orientations import up_axis_spread
from pytest_cpas.diagnosis.running import MOST_TRUTHS
from pytest_cpas.documents import DirectionsDocument, UpAxesDocument
from pytest_cpas.evaluation import Row, Run
from pytest_cpas.evaluation.estimates import decode_estimates
from pytest_cpas.types import Array, ContractError
from pytest_cpas.types.samples import evenly

#: Directions of a document, evenly spaced in the order of the samples.
SHOWN = 400


def up_axes(run: Run, rows: Sequence[Row]) -> UpAxesDocument | None:
    """The up axes of a run's answers and of the truths, camera frame; None for perturbed data.

    A side is None where nothing is known: no answer is finite, or only rows are left. Truths that
    cost an image each are read of some samples only.
    """
    if run.robustness_point:
        return None
    few = evenly(rows, len(rows) if run.quick_truth else MOST_TRUTHS)
    refs = {ref.id: ref for ref in run.samples}
    true = []
    for row in few:
        try:
            truth = run.truth(refs[row.sample])
        except ContractError:  # judged when it was not yet damaged
            continue
        if truth is not None:
            true.append(truth.pose.rotation[:, 1])
    answers = decode_estimates([row.estimate for row in rows if row.estimate is not None])
    return {
        "truth": _side(np.array(true).reshape(-1, 3)),
        "estimate": _side(answers.rotation[:, :, 1]),
    }


def _side(directions: Array) -> DirectionsDocument | None:
    directions = directions[np.isfinite(directions).all(axis=1)]
    if not len(directions):
        return None
    spread = up_axis_spread(directions)
    return {
        "count": spread.count,
        "resultant": round(spread.resultant, 6),
        "coverage": round(spread.coverage, 6),
        "directions": [
            [round(part, 3) + 0.0 for part in direction]
            for direction in evenly(directions.tolist(), SHOWN)
        ],
    }
