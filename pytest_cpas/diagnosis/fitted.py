"""Mistakes with a number of their own, which is estimated: lengths, offsets, boxes."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.diagnosis.evidence import Evidence
from pytest_cpas.diagnosis.mistakes import Mistake, Undo, shifted
from pytest_cpas.evaluation.estimates import Estimates
from pytest_cpas.types import Array
from pytest_cpas.types.frames import permute_extents

#: A factor nearer to 1 than this is an error of the method, not of its units.
_FACTOR = 0.1

#: Extents that were divided by a length have exactly that length 1.
_NORMALISED = 1e-3


def fitted_lengths(evidence: Evidence, answers: Estimates) -> list[Mistake]:
    """The depth scale and the principal point that bring ``answers`` nearest to the truth."""
    found = []
    true = evidence.truth.translation
    standard = answers.translation @ evidence.camera.T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ratios = np.linalg.norm(standard, axis=1) / np.linalg.norm(true, axis=1)
        shifts = standard[:, :2] / standard[:, 2:] - true[:, :2] / true[:, 2:]
    ratios, shifts = ratios[np.isfinite(ratios)], shifts[np.isfinite(shifts).all(axis=1)]
    factor = float(np.median(ratios)) if len(ratios) else 1.0
    if factor > 0 and abs(np.log(factor)) > _FACTOR:
        found.append(
            Mistake(
                "depth-scale",
                f"your translations are {factor:.4g} times the true ones (is the depth scale"
                " right?)",
                "that factor",
                "Hypothesis(rotation=rotation,"
                f" translation=translation / {factor:.4g}, ...), or rather what turns"
                " depth into metres",
                shifted(lambda t: t / factor),
                fitted=True,
            )
        )
    if len(shifts):
        found.append(_principal_point(evidence, np.median(shifts, axis=0)))
    return found


def _principal_point(evidence: Evidence, shift: Array) -> Mistake:
    """``shift`` (2,) is how far the answers lie off in x / z and y / z."""
    if evidence.focal is None:
        size = f"({shift[0]:+.4f}, {shift[1]:+.4f}) focal lengths"
    else:
        size = "({:+.1f}, {:+.1f}) pixels".format(*(shift * evidence.focal))
    camera = evidence.camera

    def moved(translation: Array) -> Array:
        standard = translation @ camera.T
        return np.asarray((standard - standard[:, 2:] * np.array([*shift, 0.0])) @ camera)

    return Mistake(
        "principal-point",
        f"your positions are shifted in the image by {size}, as if the principal point were"
        " another",
        "that shift",
        "use observation.camera.cx and .cy; in a crop, add the pixels of its corner",
        shifted(moved),
        fitted=True,
    )


def fitted_offsets(evidence: Evidence, answers: Estimates) -> list[Mistake]:
    """The origin that brings ``answers`` (of one category) nearest, fixed or growing with size.

    With a mug's handle left out of its box, for example, the origin is the axis of its body.
    """
    estimates = evidence.standard(answers)
    sizes = np.where(np.isfinite(estimates.extents), estimates.extents, evidence.truth.extents)
    gap = evidence.truth.translation - estimates.translation
    gap = np.einsum("nji,nj->ni", estimates.rotation, gap)  # in object axes
    metres, share = np.median(gap, axis=0), np.median(gap / sizes, axis=0)
    found = []
    for name, offsets in (("", np.broadcast_to(metres, gap.shape)), ("-relative", share * sizes)):
        own = evidence.axes @ (share if name else metres)
        vector = np.array2string(own, precision=4, separator=", ", suppress_small=True)
        fix = f"translation + rotation @ ({vector}{' * extents' if name else ''})"
        found.append(
            Mistake(
                f"object-origin{name}",
                "the origin of your object frame is not the centre of the box, which lies at"
                f" {np.array2string(1000 * metres, precision=0, suppress_small=True)} mm, or"
                f" {np.array2string(share, precision=2, suppress_small=True)} of the extents,"
                " along ShapeNet's x, y, z",
                "that offset",
                f"Hypothesis(rotation=rotation, translation={fix}, ...) for this category",
                _moved(evidence, offsets),
                fitted=True,
            )
        )
    return found


def _moved(evidence: Evidence, offsets: Array) -> Undo:
    def undo(answers: Estimates) -> Estimates:
        own = np.einsum("nij,nj->ni", answers.rotation @ evidence.axes, offsets)
        return replace(answers, translation=answers.translation + own)

    return undo


def part_flips(evidence: Evidence) -> list[Mistake]:
    """Half turns about the object's axes in those samples alone that they repair."""
    found = []
    for name, signs in (("y", (-1, 1, -1)), ("x", (1, -1, -1)), ("z", (-1, -1, 1))):
        turn = evidence.axes @ np.diag(np.array(signs, dtype=float))
        now, then = evidence.turned(evidence.answers, np.stack([evidence.axes, turn]))
        found.append(
            Mistake(
                f"part-flip-{name}",
                f"a part of your rotations is half a turn about the object's {name} axis off, as"
                " if it were symmetric",
                "that half turn in those samples",
                "what tells the two sides apart: symmetric losses, augmentation by mirrored or"
                " turned images, labels without a front",
                _flipped(turn @ evidence.axes.T, then & ~now),
                fitted=True,
            )
        )
    return found


def _flipped(change: Array, chosen: NDArray[np.bool_]) -> Undo:
    def undo(answers: Estimates) -> Estimates:
        turned = np.where(chosen[:, None, None], answers.rotation @ change, answers.rotation)
        return replace(answers, rotation=turned)

    return undo


# -- boxes -----------------------------------------------------------------------------------


def wrong_boxes(evidence: Evidence) -> list[Mistake]:
    """Extents with a usual factor, in another order, or divided by a length."""
    given = evidence.answers.extents
    true = permute_extents(evidence.truth.extents.T, evidence.axes).T
    lengths: dict[str, tuple[str, Callable[[Array], Array]]] = {
        "diagonal": ("the diagonal of the box", lambda e: np.linalg.norm(e, axis=1)),
        "max": ("the longest side of the box", lambda e: e.max(axis=1)),
    }
    for name, (words, measure) in lengths.items():
        if len(given) and np.median(np.abs(measure(given) - 1)) < _NORMALISED:
            return [
                Mistake(
                    f"extents-normalised-{name}",
                    f"your extents are divided by {words}, which is always 1",
                    "that length put back (here from the ground truth)",
                    "Hypothesis(rotation=rotation,"
                    " translation=translation, extents=extents * scale, ...)",
                    _sized(_times(measure(true)[:, None])),
                )
            ]
    found = [
        Mistake(
            f"extents-{name}",
            f"your extents are {words}",
            "full side lengths in metres",
            f"Hypothesis(rotation=rotation, translation=translation, extents=extents{change}, ...)",
            _sized(lambda e, factor=factor: e * factor),  # type: ignore[misc]
        )
        for name, words, change, factor in (
            ("halved", "half the side lengths", " * 2", 2),
            ("doubled", "twice the side lengths", " / 2", 0.5),
            ("mm", "in millimetres", " / 1000", 0.001),
            ("cm", "in centimetres", " / 100", 0.01),
        )
    ]
    found.append(
        Mistake(
            "extents-scaled-twice",
            "your extents are multiplied by the diagonal of the box once more, as sizes in metres"
            " are beside a pose that has a scale",
            "that length divided out",
            "Hypothesis(rotation=rotation, translation=translation, extents=extents /"
            " np.sqrt(np.linalg.norm(extents)), ...), or rather sizes relative to the scale",
            _sized(lambda e: e / np.sqrt(np.linalg.norm(e, axis=1, keepdims=True))),
        )
    )
    found += [
        Mistake(
            f"extents-order-{''.join('xyz'[i] for i in order)}",
            "your extents are in another order than the axes of your rotation",
            "that order",
            "Hypothesis(rotation=rotation,"
            f" translation=translation, extents=extents[{list(order)}], ...)",
            _sized(lambda e, order=order: e[:, order]),  # type: ignore[misc]
        )
        for order in itertools.permutations(range(3))
        if order != (0, 1, 2)
    ]
    return found


def _times(lengths: Array) -> Callable[[Array], Array]:
    return lambda extents: extents * lengths


def _sized(change: Callable[[Array], Array]) -> Undo:
    def undo(answers: Estimates) -> Estimates:
        return replace(answers, extents=change(answers.extents))

    return undo
