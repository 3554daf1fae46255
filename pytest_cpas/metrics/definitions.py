"""Definition ids: which number a number is.

Two codes print different numbers under one name (docs/metrics.md says where). Every number that
leaves this package carries the id of its definition, such as
``fscore:strict:1[delta_m=0.01,frame=camera,points=10000]``: name, variant, version, and the values
of everything else that it depends on. Numbers are comparable if their ids are equal. The version
is raised whenever a change of the code changes a printed number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from pytest_cpas.types import ContractError

__all__ = ["DEFINITIONS", "Definition", "definition", "require_same_definition"]

PAPER = "Bruns & Jensfelt 2023"
NOCS = "Wang et al. 2019 (NOCS), published evaluation code"
OMNI6DPOSE = "Zhang et al. 2024 (Omni6DPose)"
HINTERSTOISSER = "Hinterstoisser et al. 2012"
LAPOSE = "Zhang et al. 2024 (LaPose), published evaluation code"
BOP = "Hodan et al. 2020 (BOP Challenge), bop_toolkit"


@dataclass(frozen=True)
class Definition:
    """What a metric's number means.

    ``unit`` is empty for a share. ``better``: which direction is the better one. ``parameters``:
    what must be given for the number to be defined.
    """

    name: str
    variant: str
    version: int
    unit: Literal["deg", "m", "px", ""]
    better: Literal["lower", "higher", "neither"]
    source: str
    parameters: tuple[str, ...] = ()

    def id(self, **parameters: str | float | int) -> str:
        """The id with the values of exactly ``parameters``; raises :class:`ContractError`."""
        if set(parameters) != set(self.parameters):
            raise ContractError(
                f"definition {self.name}:{self.variant}: parameters {sorted(parameters)}, expected"
                f" {sorted(self.parameters)}"
            )
        for key, value in parameters.items():
            if isinstance(value, float) and not math.isfinite(value):
                raise ContractError(
                    f"definition {self.name}:{self.variant}: {key} is {value}, expected a finite"
                    " number"
                )
        values = ",".join(f"{key}={parameters[key]}" for key in sorted(parameters))
        return f"{self.name}:{self.variant}:{self.version}" + (f"[{values}]" if values else "")


_SHAPE = ("frame", "points")

#: All definitions by (name, variant).
DEFINITIONS: Mapping[tuple[str, str], Definition] = MappingProxyType(
    {
        (entry.name, entry.variant): entry
        for entry in (
            Definition("rotation_error", "symmetry-group", 1, "deg", "lower", PAPER),
            Definition("rotation_error", "symmetry-in-view", 1, "deg", "lower", NOCS),
            Definition("translation_error", "euclidean", 1, "m", "lower", PAPER),
            Definition("translation_error", "own-diagonals", 1, "", "lower", LAPOSE),
            Definition("iou", "oriented", 1, "", "higher", PAPER),
            Definition("iou", "oriented-symmetric", 1, "", "higher", PAPER),
            Definition(
                "iou", "oriented-symmetric-in-view", 1, "", "higher", PAPER + ", symmetry of NOCS"
            ),
            Definition(
                "iou", "equal-diagonals", 1, "", "higher", LAPOSE + ", IoU of the oriented boxes"
            ),
            Definition("iou", "axis-aligned-boxes", 1, "", "higher", NOCS + ", repaired"),
            Definition("iou", "nocs-legacy", 1, "", "higher", NOCS),
            Definition("iou_plus", "axis-aligned-surfaces", 1, "", "higher", PAPER),
            Definition("ad", "truth-to-estimate", 1, "m", "lower", PAPER, _SHAPE),
            Definition("ad", "estimate-to-truth", 1, "m", "lower", PAPER, _SHAPE),
            Definition("cd", "mean", 1, "m", "lower", PAPER, _SHAPE),
            Definition("nad", "own-diameters", 1, "", "lower", PAPER, _SHAPE),
            Definition("diameter", "exact", 1, "m", "neither", PAPER, ("points",)),
            Definition("surface_recall", "strict", 1, "", "higher", PAPER, ("delta_m", *_SHAPE)),
            Definition("surface_precision", "strict", 1, "", "higher", PAPER, ("delta_m", *_SHAPE)),
            Definition("fscore", "strict", 1, "", "higher", PAPER, ("delta_m", *_SHAPE)),
            Definition("add", "same-points", 1, "m", "lower", HINTERSTOISSER),
            Definition("add", "nearest-points", 1, "m", "lower", HINTERSTOISSER),
            Definition("add", "by-symmetry", 1, "m", "lower", HINTERSTOISSER),
            Definition("add_relative", "same-points", 1, "", "lower", HINTERSTOISSER),
            Definition("add_relative", "nearest-points", 1, "", "lower", HINTERSTOISSER),
            Definition("add_relative", "by-symmetry", 1, "", "lower", HINTERSTOISSER),
            Definition("mssd", "relative-to-diameter", 1, "", "lower", BOP, ("spins",)),
            Definition("mspd", "of-width-640", 1, "px", "lower", BOP, ("spins",)),
            Definition("precision", "joint", 1, "", "higher", PAPER, ("limits",)),
            Definition("precision", "best-hypothesis", 1, "", "higher", PAPER, ("limits",)),
            Definition("precision", "worst-hypothesis", 1, "", "higher", PAPER, ("limits",)),
            Definition("joint_margin", "best-hypothesis", 1, "", "lower", PAPER, ("limits",)),
            Definition("joint_margin", "worst-hypothesis", 1, "", "lower", PAPER, ("limits",)),
            Definition("iou_auc", "integral", 1, "", "higher", OMNI6DPOSE, ("iou", "lower")),
            Definition(
                "iou_auc", "midpoints", 1, "", "higher", OMNI6DPOSE, ("bins", "iou", "lower")
            ),
            Definition("pose_vus", "integral", 1, "", "higher", OMNI6DPOSE, ("max",)),
            Definition("pose_vus", "midpoints", 1, "", "higher", OMNI6DPOSE, ("bins", "max")),
            Definition("ap", "nocs-iou", 1, "", "higher", NOCS, ("iou", "limit")),
            Definition("ap", "nocs-pose", 1, "", "higher", NOCS, ("limits",)),
            Definition("ap", "nocs-pose-on-matches", 1, "", "higher", NOCS, ("iou", "limits")),
        )
    }
)


def definition(name: str, variant: str) -> Definition:
    """Look a definition up; raises :class:`ContractError` that lists what there is."""
    try:
        return DEFINITIONS[name, variant]
    except (KeyError, TypeError):
        known = sorted(f"{known_name}:{known_variant}" for known_name, known_variant in DEFINITIONS)
        raise ContractError(
            f"definition {name}:{variant} does not exist; there are {', '.join(known)}"
        ) from None


def require_same_definition(ours: str, theirs: str) -> None:
    """Raise :class:`ContractError` unless two numbers' definition ids are equal."""
    if not isinstance(ours, str) or not isinstance(theirs, str):
        raise ContractError(
            f"definition ids are texts, and not {type(ours).__name__} and {type(theirs).__name__}"
        )
    if ours != theirs:
        raise ContractError(
            f"numbers under different definitions cannot be compared: {ours} and {theirs}"
        )
