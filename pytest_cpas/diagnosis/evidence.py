"""What the diagnosis looks at: answers and truths of the same samples, and which are correct."""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.evaluation.estimates import Estimates
from pytest_cpas.metrics.boxes import symmetric_iou
from pytest_cpas.types import Array, GroundTruth, MethodInfo, Symmetry
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET, OPENCV_FROM_OPENGL, permute_extents

Bools = NDArray[np.bool_]

#: A sample is correct at the coarser threshold of the paper.
ANGLE_DEG, DISTANCE_M = 10.0, 0.02

#: What counts for boxes, in both senses of IoU below.
BOX_IOU = 0.5
_SIZE_IOU = 0.7


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """Answers of n samples as the method gave them, and the truths in the standard frames.

    ``answers`` are in the frames that the method declared, which ``camera`` (3, 3) turns into
    OpenCV's and ``axes`` (3, 3), from ShapeNet's, lead to: a standard rotation is
    ``camera @ rotation @ axes``. ``unanswered``: per category, how many samples more have no
    usable answer. ``focal``: the focal length in pixels, if it is known. ``scene``: where each
    sample is from; without it, all are taken as independent of each other.
    """

    category: NDArray[np.str_]
    answers: Estimates
    truth: Estimates
    symmetry: Sequence[Symmetry]
    camera: Array
    axes: Array
    unanswered: Mapping[str, int] = field(default_factory=dict)
    focal: float | None = None
    scene: NDArray[np.str_] | None = None

    @classmethod
    def of(
        cls,
        categories: Sequence[str],
        standard: Estimates,
        truths: Sequence[GroundTruth],
        info: MethodInfo,
        *,
        unanswered: Mapping[str, int] | None = None,
        focal: float | None = None,
        scenes: Sequence[str] | None = None,
    ) -> Evidence:
        """From answers in the standard frames, which ``info`` declares how to turn back."""
        camera = OPENCV_FROM_OPENGL if info.camera_frame == "opengl" else np.eye(3)
        axes = NOCS_FROM_SHAPENET if info.object_frame == "nocs" else np.eye(3)
        names = np.array(categories, dtype=np.str_)
        usable = finite(standard.rotation.reshape(-1, 9)) & finite(standard.translation)
        standard, used = select(standard, usable), itertools.compress(truths, usable)
        true = [(t.pose.rotation, t.pose.translation, t.extents, t.symmetry) for t in used]
        rotations, translations, extents, symmetries = (
            zip(*true, strict=True) if true else ((),) * 4
        )
        return cls(
            category=names[usable],
            answers=Estimates(
                camera.T @ standard.rotation @ axes.T,
                standard.translation @ camera,
                permute_extents(standard.extents.T, axes).T,
            ),
            truth=Estimates(
                np.array(rotations).reshape(-1, 3, 3),
                np.array(translations).reshape(-1, 3),
                np.array(extents).reshape(-1, 3),
            ),
            symmetry=_shared(symmetries),
            camera=camera,
            axes=axes,
            unanswered=Counter(unanswered or {}) + Counter(names[~usable].tolist()),
            focal=focal,
            scene=None if scenes is None else np.array(scenes, dtype=np.str_)[usable],
        )

    def __len__(self) -> int:
        return len(self.category)

    @property
    def total(self) -> int:
        """The samples, with those that have no answer."""
        return len(self) + sum(self.unanswered.values())

    def part(self, chosen: Bools) -> Evidence:
        """The chosen samples (n,), and all that have no answer."""
        return replace(
            self,
            category=self.category[chosen],
            answers=select(self.answers, chosen),
            truth=select(self.truth, chosen),
            symmetry=[s for s, keep in zip(self.symmetry, chosen, strict=True) if keep],
            scene=None if self.scene is None else self.scene[chosen],
        )

    def of_category(self, category: str) -> Evidence:
        """The samples of one category."""
        unanswered = {category: self.unanswered.get(category, 0)}
        return replace(self.part(self.category == category), unanswered=unanswered)

    def standard(self, answers: Estimates | None = None) -> Estimates:
        """Answers (by default its own) in the standard frames."""
        answers = answers or self.answers
        return Estimates(
            self.camera @ answers.rotation @ self.axes,
            answers.translation @ self.camera.T,
            permute_extents(answers.extents.T, self.axes.T).T,
        )

    # -- what is correct ---------------------------------------------------------------------

    def near(self, answers: Estimates, order: NDArray[np.int64] | None = None) -> Bools:
        """Which positions are within ``DISTANCE_M``, (n,).

        With an ``order`` (n,) the answers are compared with other samples' truths.
        """
        true = self.truth.translation if order is None else self.truth.translation[order]
        with np.errstate(over="ignore"):
            distances = np.linalg.norm(answers.translation @ self.camera.T - true, axis=1)
        return np.asarray(distances <= DISTANCE_M)

    def turned(
        self, answers: Estimates, turns: Array, order: NDArray[np.int64] | None = None
    ) -> Bools:
        """Which rotations are within ``ANGLE_DEG``, (k, n), if ``turns`` (k, 3, 3) were ``axes``.

        The cosine of an angle is linear in the relative rotation M = R^-1 camera R~, so that all
        turns are one matrix product.
        """
        true = self.truth.rotation if order is None else self.truth.rotation[order]
        relative = np.swapaxes(true, 1, 2) @ self.camera @ answers.rotation
        correct = np.ones((len(turns), len(self)), dtype=bool)
        groups: dict[Symmetry, list[int]] = defaultdict(list)
        for index, symmetry in enumerate(self.symmetry):
            groups[symmetry].append(index)
        cosine = np.cos(np.radians(ANGLE_DEG))
        for symmetry, members in groups.items():
            if symmetry.sphere:
                continue
            after = turns[:, None] @ np.swapaxes(symmetry.rotations, 1, 2)  # (k, group, 3, 3)
            if symmetry.axis is None:
                weights, bound = np.swapaxes(after, 2, 3), 1 + 2 * cosine
            else:
                images = after @ symmetry.axis  # (k, group, 3)
                weights, bound = symmetry.axis[:, None] * images[..., None, :], cosine
            values = relative[members].reshape(-1, 9) @ weights.reshape(-1, 9).T
            best = values.reshape(len(members), len(turns), -1).max(axis=2)
            correct[:, members] = np.greater_equal(best.T, bound)
        return correct

    def sized(self, extents: Array) -> Bools:
        """Which extents (n, 3), in the method's axes, are those of the object: (n,).

        Two boxes with one centre and the same axes must overlap, so the pose does not matter.
        """
        found = permute_extents(extents.T, self.axes.T).T
        shared = np.minimum(found, self.truth.extents).prod(axis=1)
        union = found.prod(axis=1) + self.truth.extents.prod(axis=1) - shared
        return np.asarray(shared >= _SIZE_IOU * union)  # false for NaN

    def boxes(self, answers: Estimates) -> Bools:
        """Which oriented boxes have at least ``BOX_IOU``, (n,)."""
        correct = np.zeros(len(self), dtype=bool)
        groups: dict[Symmetry, list[int]] = defaultdict(list)
        for index, symmetry in enumerate(self.symmetry):
            groups[symmetry].append(index)
        found = self.standard(answers)
        usable = finite(found.extents)
        for symmetry, indices in groups.items():
            members = np.array(indices)[usable[indices]]
            ious = symmetric_iou(*_box(found, members), *_box(self.truth, members), symmetry)
            correct[members] = ious >= BOX_IOU
        return correct


def _shared(symmetries: Sequence[Symmetry]) -> list[Symmetry]:
    """The symmetries, equal ones as one object."""
    known: dict[tuple[bytes, bytes, bool], Symmetry] = {}
    return [
        known.setdefault(
            (s.rotations.tobytes(), b"" if s.axis is None else s.axis.tobytes(), s.sphere), s
        )
        for s in symmetries
    ]


def finite(values: Array) -> Bools:
    """Which rows of (n, m) are finite, (n,)."""
    return np.asarray(np.isfinite(values).all(axis=1))


def select(estimates: Estimates, chosen: Bools | NDArray[np.int64]) -> Estimates:
    """Some of the estimates."""
    return Estimates(
        estimates.rotation[chosen], estimates.translation[chosen], estimates.extents[chosen]
    )


def _box(estimates: Estimates, members: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    chosen = select(estimates, members)
    return chosen.rotation, chosen.translation, chosen.extents
