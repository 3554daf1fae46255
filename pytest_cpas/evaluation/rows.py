"""Rows, one per sample: what is known of the answers under all seeds, never a judgement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from pytest_cpas.facts import Facts, fact
from pytest_cpas.types.declarations import TOLERANCE

__all__ = ["Answer", "Answered", "Detection", "Row"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """The facts of the answer for one sample under one seed.

    ``facts`` by name, None is n/a. A failed prediction has its reason in ``failure``, and facts
    that meet no limit. ``estimate``: the answer itself, as of
    :func:`~pytest_cpas.evaluation.encode_estimate`.
    """

    facts: Facts
    failure: str | None = None
    estimate: str | None = None

    def difference(self, before: Answer, tolerance: float = TOLERANCE) -> str:
        """What differs, in words, from an answer to the same: why it is none, or a fact by more
        than it may move, which ``tolerance`` says as a method declares it; empty if nothing does.
        """
        if self.failure != before.failure:
            return f"failure was {before.failure}, now {self.failure}"
        for name, now in self.facts.items():
            then = before.facts.get(name)
            if (now is None) is not (then is None):
                return f"{name} was {then}, now {now}"
            if now is None or then is None or fact(name).is_close(then, now, tolerance):
                continue
            return f"{name} was {then:.6g}, now {now:.6g}"
        return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered:
    """A sample's category, and its answers, one per seed; the first is that of the run's own."""

    category: str
    answers: tuple[Answer, ...]

    @property
    def facts(self) -> Facts:
        """Those of the first answer."""
        return self.answers[0].facts

    @property
    def failure(self) -> str | None:
        """Why the first answer is none."""
        return self.answers[0].failure


@dataclass(frozen=True, slots=True, kw_only=True)
class Detection:
    """What a detector found and a method was asked about: what it is called among all detections,
    its image and category, how sure the detector is, and the first seed's answer, as of
    :func:`~pytest_cpas.evaluation.encode_estimate`; None where there is none."""

    name: str
    image: str
    category: str
    score: float
    estimate: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Row(Answered):
    """The answers for one sample, one per seed; the first is that of the run's own seed.

    ``shape``: the first one's shape for a picture, as of
    :func:`~pytest_cpas.evaluation.encode_shape`. ``detections``: those of its image that are ranked
    with it, where the method sees objects through the masks of a detector.
    """

    sample: str
    shape: str | None = None
    detections: tuple[Detection, ...] = ()

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Row:
        """From the plain values of :meth:`plain`."""
        answers = tuple(Answer(**answer) for answer in values["answers"])
        detections = tuple(Detection(**found) for found in values.get("detections", ()))
        return cls(**{**values, "answers": answers, "detections": detections})

    def difference(self, kept: Row, tolerance: float) -> str:
        """What differs, in words, from the row that was kept of a deterministic method, under the
        seeds that both have; empty if nothing does. ``tolerance``: the one that it declares."""
        pairs = zip(self.answers, kept.answers, strict=False)
        return next((told for now, then in pairs if (told := now.difference(then, tolerance))), "")

    def plain(self) -> dict[str, Any]:
        """As values of JSON, but for infinite facts."""
        # asdict() takes ten times as long
        answers = tuple(
            {"facts": dict(each.facts), "failure": each.failure, "estimate": each.estimate}
            for each in self.answers
        )
        values: dict[str, Any] = {
            "category": self.category,
            "answers": answers,
            "sample": self.sample,
            "shape": self.shape,
        }
        if self.detections:
            values["detections"] = tuple(map(asdict, self.detections))
        return values

    @property
    def estimate(self) -> str | None:
        """The first answer itself."""
        return self.answers[0].estimate
