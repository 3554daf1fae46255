"""Rows, one per sample: what is known of the answers under all seeds, never a judgement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from pytest_cpas.facts import Facts

__all__ = ["Answer", "Answered", "Row"]


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
class Row(Answered):
    """The answers for one sample, one per seed; the first is that of the run's own seed.

    ``shape``: the first one's shape for a picture, as of
    :func:`~pytest_cpas.evaluation.encode_shape`.
    """

    sample: str
    shape: str | None = None

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Row:
        """From the plain values of :meth:`plain`."""
        answers = tuple(Answer(**answer) for answer in values["answers"])
        return cls(**{**values, "answers": answers})

    def plain(self) -> dict[str, Any]:
        """As values of JSON, but for infinite facts."""
        return asdict(self)

    @property
    def estimate(self) -> str | None:
        """The first answer itself."""
        return self.answers[0].estimate
