"""The whole sphere of directions, drawn as a disc.

It is Lambert's equal-area projection: the middle is the image's up (-y), the rim its down; to the
right is the camera's right (+x), below the middle is what points towards the camera (-z).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from pytest_cpas.checks.dataset.orientations import REACH, lambert
from pytest_cpas.documents import DirectionsDocument
from pytest_cpas.report._html import Element, element

#: Angles to the image's up at which a ring is drawn, degrees; the stronger ones are the horizon and
#: the rim.
RINGS: Final = (30, 60, 90, 120, 150, 180)
STRONGER: Final = (90, 180)

#: Directions by name, and where they lie: to the right and down, in radii of the horizon.
DIRECTIONS: Final = (
    ("up", 0, 0),
    ("right", 1, 0),
    ("left", -1, 0),
    ("away", 0, -1),
    ("towards camera", 0, 1),
)

#: Of a disc, in units of the SVG.
_WIDTH, _HEIGHT, _RADIUS, _DOT = 220, 236, 92, 3.4


def disc(side: DirectionsDocument, title: str, *, estimate: bool) -> Element:
    """The disc of some directions as SVG; ``estimate``: they are those of estimates."""
    middle = _WIDTH / 2
    rings = [
        element(
            "circle",
            cx=middle,
            cy=middle,
            r=round(_RADIUS * math.sin(math.radians(angle) / 2), 1),
            class_="rim" if angle in STRONGER else "ring",
        )
        for angle in RINGS
    ]
    dots = []
    for right, down in middle + _RADIUS * lambert(np.array(side["directions"])):
        dots.append(f"M{right:.1f} {down:.1f}h0")
    horizon = _RADIUS / math.sqrt(2)
    names = [(name, horizon * across, 4 + horizon * down) for name, across, down in DIRECTIONS]
    names.append(("rim: down", 0, _RADIUS + 14))
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
                for name, across, down in names
            ],
            viewBox=f"0 0 {_WIDTH} {_HEIGHT}",
            role="img",
            aria_label=f"Up axes: {title}: {figures}",
        ),
        element("figcaption", title, element("small", figures)),
        class_="sphere",
    )
