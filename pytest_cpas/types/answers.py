"""What a method answers."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pytest_cpas.types._arrays import Array, checked_extents, checked_number, frozen_array
from pytest_cpas.types.errors import AnswerError, raised_as, shortened, words_of
from pytest_cpas.types.geometry import Mesh, Pose

__all__ = ["Hypothesis", "Prediction"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Hypothesis:
    """One answer of a method, in the frames that its :class:`MethodInfo` declares.

    ``rotation`` (3, 3), ``translation`` (3,) metres. ``extents`` (3,) side lengths of the box,
    metres. The shape, posed by the same rotation and translation, is given in the object frame,
    metric: ``points`` (N, 3) or ``mesh``. ``score``: larger is surer. What a method does not
    estimate stays None and is n/a in every table.
    """

    rotation: Array
    translation: Array
    extents: Array | None = None
    points: Array | None = None
    mesh: Mesh | None = None
    score: float | None = None

    @raised_as(AnswerError)
    def __post_init__(self) -> None:
        pose = Pose(self.rotation, self.translation)
        object.__setattr__(self, "rotation", pose.rotation)
        object.__setattr__(self, "translation", pose.translation)
        if self.extents is not None:
            object.__setattr__(self, "extents", checked_extents(self.extents))
        if self.points is not None:
            points = frozen_array(self.points, (None, 3), "points (metres)")
            if len(points) == 0:
                raise AnswerError("points: no points; leave it None if there is no shape")
            object.__setattr__(self, "points", points)
        if self.mesh is not None and not isinstance(self.mesh, Mesh):
            raise AnswerError(f"mesh: a {type(self.mesh).__name__}, expected pytest_cpas Mesh")
        if self.score is not None:
            limit = float(np.finfo(float).max)
            score = checked_number(self.score, "score (None where there is none)", -limit, limit)
            object.__setattr__(self, "score", score)

    @property
    def pose(self) -> Pose:
        """Rotation and translation as one."""
        return Pose(self.rotation, self.translation)

    @property
    def shape(self) -> Mesh | Array | None:
        """The mesh if there is one, else the points."""
        return self.points if self.mesh is None else self.mesh


@dataclass(frozen=True)
class Prediction:
    """A method's answer for one observation: ``hypotheses``, the best first.

    A method that finds no answer returns ``Prediction.failed("why")``: it counts as not correct,
    with its reason in the report.
    """

    hypotheses: tuple[Hypothesis, ...]
    reason: str | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        try:
            object.__setattr__(self, "hypotheses", tuple(self.hypotheses))
        except TypeError:
            seen = type(self.hypotheses).__name__
            raise AnswerError(f"prediction: a {seen}, expected a list of Hypothesis") from None
        for hypothesis in self.hypotheses:
            if not isinstance(hypothesis, Hypothesis):
                raise AnswerError(
                    f"prediction: holds a {type(hypothesis).__name__}, expected Hypothesis"
                )
        if self.reason is not None and not isinstance(self.reason, str):
            raise AnswerError(
                f"prediction: reason is a {type(self.reason).__name__}, expected text"
            )
        if self.reason:
            object.__setattr__(self, "reason", shortened(self.reason))
        if not self.hypotheses and not self.reason:
            raise AnswerError(
                "prediction: no hypothesis and no reason; say why with Prediction.failed('...')"
            )

    @classmethod
    def failed(cls, reason: str | BaseException) -> Prediction:
        """No answer, and why: in words, or the exception that was raised."""
        if isinstance(reason, BaseException):
            reason = words_of(reason)
        return cls((), reason=reason)
