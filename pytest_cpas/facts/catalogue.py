"""The catalogue of facts: what each is called, means, needs, and how it is computed."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal, cast

import numpy as np

from pytest_cpas.facts.answers import AnswerBatch
from pytest_cpas.facts.fact import Fact, FactError, Known, Part
from pytest_cpas.facts.hypotheses import joint_margin
from pytest_cpas.facts.known_objects import KNOWN_OBJECTS
from pytest_cpas.metrics.boxes import axis_aligned_box_iou, nocs_legacy_iou, symmetric_iou
from pytest_cpas.metrics.definitions import definition
from pytest_cpas.metrics.pose import rotation_error, translation_error
from pytest_cpas.metrics.surfaces import SAMPLE_COUNT
from pytest_cpas.types import Array

__all__ = ["all_facts", "fact", "in_order"]


def fact(name: str) -> Fact:
    """The fact of a name; F-scores are called ``fscore_1cm``, ``fscore_5mm``, at any distance.

    What the best and the worst hypothesis are at joint limits is called ``best_10deg_2cm``,
    ``worst_5deg_1cm_f80``: degrees, a distance, and a percentage of F at 1 cm if it is limited.
    Raises :class:`FactError` that lists the names, or says which distances an F-score may have.
    """
    if name in _FACTS:
        return _FACTS[name]
    if match := re.fullmatch(r"fscore_([1-9]\d{0,3})(mm|cm)", name):
        if int(match[1]) * _MILLIMETRES[match[2]] > _LARGEST_DISTANCE:
            raise FactError(
                f"there is no fact {name!r}: the distance of an F-score is 1 to"
                f" {_LARGEST_DISTANCE} mm, such as fscore_1cm or fscore_5mm"
            )
        return _fscore(name, int(match[1]), match[2])
    if match := re.fullmatch(_JOINT, name):
        which = cast(Literal["best", "worst"], match[1])
        return _joint(name, which, match[2], match[3], match[4], match[5])
    raise FactError(
        f"there is no fact {name[:40]!r}; expected one of {', '.join(_FACTS)}, or one with its"
        " limits, such as fscore_1cm, fscore_5mm, best_10deg_2cm or worst_5deg_1cm_f80"
    )


_MILLIMETRES = {"mm": 1, "cm": 10}

#: Of an F-score, mm: whatever lies within half a metre of a thing to be held says nothing of it.
_LARGEST_DISTANCE = 500


def all_facts() -> list[Fact]:
    """Every fact, of the F-scores that of the paper, in the order in which they are told."""
    facts = list(_FACTS.values())
    facts.insert(3, fact("fscore_1cm"))
    return facts


def in_order(names: Iterable[str]) -> list[str]:
    """Names of facts, each once, in the order of :func:`all_facts`; those that have limits in their
    names come last."""
    known, given = [made.name for made in all_facts()], set(names)
    return [name for name in known if name in given] + sorted(given.difference(known))


@functools.cache
def _fscore(name: str, distance: int, unit: str) -> Fact:
    metres = distance * _MILLIMETRES[unit] / 1000
    # the paper's distance is its F-score: no need to name it
    told = "F" if metres == 0.01 else f"F({distance} {unit})"
    return Fact(
        name,
        definition("fscore", "strict").id(delta_m=metres, frame="camera", points=SAMPLE_COUNT),
        "",
        "higher",
        told + " {}",
        lambda batch: batch.of_surfaces(lambda errors: float(errors.fscore(metres))),
        _SHAPE,
        _TRUE_SHAPE,
    )


#: Best or worst; degrees, up to 180; a distance; a percentage, up to 100.
_JOINT = r"(best|worst)_([1-9]\d?|1[0-7]\d|180)deg_([1-9]\d{0,3})(mm|cm)(?:_f([1-9]\d?|100))?"


@functools.cache
def _joint(
    name: str,
    which: Literal["best", "worst"],
    degrees: str,
    distance: str,
    unit: str,
    f: str | None,
) -> Fact:
    conditions = [
        (fact("rotation_deg"), float(degrees)),
        (fact("position_m"), int(distance) * _MILLIMETRES[unit] / 1000),
    ]
    if f is not None:
        conditions.append((fact("fscore_1cm"), int(f) / 100))
    return joint_margin(name, which, conditions)


def _rotation(batch: AnswerBatch) -> Sequence[float]:
    errors: list[float] = np.degrees(rotation_error(*batch.rotations, batch.symmetry)).tolist()
    return errors


def _position(batch: AnswerBatch) -> Sequence[float]:
    errors: list[float] = translation_error(*batch.translations).tolist()
    return errors


def _iou(batch: AnswerBatch) -> Sequence[float]:
    estimated, true = batch.boxes
    ious: list[float] = symmetric_iou(*estimated, *true, batch.symmetry).tolist()
    return ious


def _scaled_position(batch: AnswerBatch) -> Sequence[float]:
    estimated, true = batch.boxes_of_unit_diagonal
    errors: list[float] = translation_error(estimated[1], true[1]).tolist()
    return errors


def _scaled_iou(batch: AnswerBatch) -> Sequence[float]:
    estimated, true = batch.boxes_of_unit_diagonal
    ious: list[float] = symmetric_iou(*estimated, *true, batch.symmetry).tolist()
    return ious


def _rotation_in_view(batch: AnswerBatch) -> Sequence[float]:
    angles = rotation_error(*batch.rotations, batch.symmetry_in_view)
    errors: list[float] = np.degrees(angles).tolist()
    return errors


def _iou_in_view(batch: AnswerBatch) -> Sequence[float]:
    estimated, true = batch.boxes
    ious: list[float] = symmetric_iou(*estimated, *true, batch.symmetry_in_view).tolist()
    return ious


#: Rotations about the up axis that the NOCS protocol tries for what is symmetric about it.
_SPINS = 20


def _nocs_iou(compute: Callable[..., Array]) -> Callable[[AnswerBatch], Sequence[float]]:
    def ious(batch: AnswerBatch) -> Sequence[float]:
        axis = batch.symmetry_in_view.axis
        round_up = batch.symmetry_in_view.sphere or (axis is not None and abs(axis[1]) > 1 - 1e-9)
        estimated, true = batch.boxes
        values: list[float] = compute(*estimated, *true, spins=_SPINS if round_up else 1).tolist()
        return values

    return ious


def _of_surface(name: str, variant: str) -> str:
    return definition(name, variant).id(frame="camera", points=SAMPLE_COUNT)


_BOX: frozenset[Part] = frozenset({"extents"})
_SHAPE: frozenset[Part] = frozenset({"shape"})
_TRUE_SHAPE: frozenset[Known] = frozenset({"shape"})

_FACTS: Mapping[str, Fact] = {
    made.name: made
    for made in (
        Fact(
            "position_m",
            definition("translation_error", "euclidean").id(),
            "m",
            "lower",
            "{} cm",
            _position,
            factor=100,
        ),
        Fact(
            "rotation_deg",
            definition("rotation_error", "symmetry-group").id(),
            "deg",
            "lower",
            "{} deg",
            _rotation,
        ),
        Fact(
            "iou",
            definition("iou", "oriented-symmetric").id(),
            "",
            "higher",
            "IoU {}",
            _iou,
            _BOX,
        ),
        Fact(
            "rotation_in_view_deg",
            definition("rotation_error", "symmetry-in-view").id(),
            "deg",
            "lower",
            "{} deg in view",
            _rotation_in_view,
        ),
        Fact(
            "iou_in_view",
            definition("iou", "oriented-symmetric-in-view").id(),
            "",
            "higher",
            "IoU (in view) {}",
            _iou_in_view,
            _BOX,
        ),
        Fact(
            "iou_axis_aligned",
            definition("iou", "axis-aligned-boxes").id(),
            "",
            "higher",
            "IoU (axis-aligned) {}",
            _nocs_iou(axis_aligned_box_iou),
            _BOX,
        ),
        Fact(
            "iou_legacy",
            definition("iou", "nocs-legacy").id(),
            "",
            "higher",
            "IoU (legacy) {}",
            _nocs_iou(nocs_legacy_iou),
            _BOX,
        ),
        Fact(
            "nad",
            _of_surface("nad", "own-diameters"),
            "",
            "lower",
            "NAD {}",
            lambda batch: batch.of_surfaces(lambda errors: errors.nad),
            _SHAPE,
            _TRUE_SHAPE,
        ),
        Fact(
            "cd_m",
            _of_surface("cd", "mean"),
            "m",
            "lower",
            "CD {} mm",
            lambda batch: batch.of_surfaces(lambda errors: errors.chamfer),
            _SHAPE,
            _TRUE_SHAPE,
            factor=1000,
        ),
        Fact(
            "ad_to_estimate_m",
            _of_surface("ad", "truth-to-estimate"),
            "m",
            "lower",
            "AD(S->S~) {} mm",
            lambda batch: batch.of_surfaces(lambda errors: errors.ad_truth_to_estimate),
            _SHAPE,
            _TRUE_SHAPE,
            factor=1000,
        ),
        Fact(
            "ad_to_truth_m",
            _of_surface("ad", "estimate-to-truth"),
            "m",
            "lower",
            "AD(S~->S) {} mm",
            lambda batch: batch.of_surfaces(lambda errors: errors.ad_estimate_to_truth),
            _SHAPE,
            _TRUE_SHAPE,
            factor=1000,
        ),
        Fact(
            "position_relative",
            definition("translation_error", "own-diagonals").id(),
            "",
            "lower",
            "{} %",
            _scaled_position,
            _BOX,
            factor=100,
        ),
        Fact(
            "iou_equal_diagonals",
            definition("iou", "equal-diagonals").id(),
            "",
            "higher",
            "NIoU {}",
            _scaled_iou,
            _BOX,
        ),
        *KNOWN_OBJECTS,
    )
}
