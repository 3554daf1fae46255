"""Where up axes point, of truths and of estimates: as a part of a document, and as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pytest_cpas.checks.dataset.orientations import REACH, lambert, up_axis_spread
from pytest_cpas.datasets.perturbed import perturbation_of
from pytest_cpas.diagnosis.running import MOST_TRUTHS
from pytest_cpas.evaluation import Row, Run
from pytest_cpas.evaluation.estimates import decode_estimates
from pytest_cpas.report._html import Element, element
from pytest_cpas.report.documents import DirectionsDocument, UpAxesDocument
from pytest_cpas.types import Array, ContractError
from pytest_cpas.types.samples import evenly

#: Directions of a document, evenly spaced in the order of the samples.
SHOWN = 400

#: Of a disc, in units of the SVG.
_WIDTH, _HEIGHT, _RADIUS, _DOT = 220, 236, 92, 3.4


def up_axes(run: Run, rows: Sequence[Row]) -> UpAxesDocument | None:
    """The up axes of a run's answers and of the truths, camera frame; None for perturbed data.

    A side is None where nothing is known: no answer is finite, or only rows are left. Truths that
    cost an image each are read of some samples only.
    """
    if perturbation_of(run.dataset):
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


def disc(side: DirectionsDocument, title: str, *, estimate: bool) -> Element:
    """The whole sphere in Lambert's equal-area projection, as ``--cpas-pictures`` draws it.

    The middle is the image's up (-y), the rim its down; to the right is the camera's right (+x),
    below the middle is what points towards the camera (-z). Rings are 30 degrees apart.
    """
    middle = _WIDTH / 2
    rings = [
        element(
            "circle",
            cx=middle,
            cy=middle,
            r=round(_RADIUS * math.sin(math.radians(angle) / 2), 1),
            class_="rim" if angle in (90, 180) else "ring",
        )
        for angle in range(30, 181, 30)
    ]
    dots = []
    for right, down in middle + _RADIUS * lambert(np.array(side["directions"])):
        dots.append(f"M{right:.1f} {down:.1f}h0")
    equator = _RADIUS / math.sqrt(2)
    figures = (
        f"{side['count']} directions, mean resultant length {side['resultant']:.3f}; within"
        f" {REACH:.0f} deg of {100 * side['coverage']:.0f} % of what as many uniform ones reach"
    )
    return element(
        "figure",
        element(
            "svg",
            element("title", f"Up axes: {title}"),
            element("desc", figures),
            rings,
            element(
                "path",
                d="".join(dots),
                class_="ups estimate" if estimate else "ups truth",
                stroke_width=_DOT,
                stroke_opacity=0.9 if len(dots) < 100 else 0.6,
            ),
            [
                element("text", name, x=middle + across, y=middle + down, text_anchor="middle")
                for name, across, down in (
                    ("up", 0, 4),
                    ("right", equator, 4),
                    ("left", -equator, 4),
                    ("away", 0, 4 - equator),
                    ("towards camera", 0, 4 + equator),
                    ("rim: down", 0, _RADIUS + 14),
                )
            ],
            viewBox=f"0 0 {_WIDTH} {_HEIGHT}",
            role="img",
            aria_label=f"Up axes: {title}: {figures}",
        ),
        element("figcaption", title, element("small", figures)),
        class_="sphere",
    )
