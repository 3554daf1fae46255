"""A method on what a detector has found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

from pytest_cpas.evaluation.estimates import decode_hypothesis
from pytest_cpas.evaluation.method_runs import MethodError, MethodRun
from pytest_cpas.evaluation.rows import Detection, Row
from pytest_cpas.evaluation.runs import SampleError
from pytest_cpas.facts import Detected, pair_table
from pytest_cpas.protocols import Ranking, facts_of, rank, ranking_columns
from pytest_cpas.submissions import DetectedDataset, Found, Given
from pytest_cpas.types import DataError, Method, Observation, Prediction, Sample, SampleRef

__all__ = ["DetectedRun"]


class DetectedRun(MethodRun):
    """A method that sees objects through the masks of a detector, as the literature runs it.

    It is asked about every detection of the images, so that those can be ranked.
    """

    def __init__(self, method: Method, dataset: DetectedDataset, **options: Any) -> None:
        """As :class:`MethodRun`."""
        super().__init__(method, dataset, **options)
        self._detected = dataset

    @property
    def notes(self) -> Sequence[str]:
        """What is noticed about the detections, and what went otherwise than planned."""
        return [*self._detected.notes, *self.batches.told]

    @property
    def answers_give(self) -> frozenset[Literal["extents", "shape", "score"]]:
        """What the method gives, and the score of the detector, which ranks."""
        return self._method.info.gives | {"score"}

    def judge(self, ref: SampleRef) -> Row:
        """The row of a sample, with the detections that are ranked with it."""
        row, prediction, observed = self._judged(ref)
        keeps = self.take_answer is not None
        answer = self._given(ref.category, prediction, observed) if keeps else None
        seen = self._detected.unseen(ref) is None
        where = f"{self.method} on {self.dataset}, sample {ref.id} ({ref.category})"
        detections, others = [], []
        for index, found in enumerate(self._detected.ranked_with(ref)):
            if found.category not in self._method.info.categories:
                continue
            if seen and index == 0:
                estimate = row.estimate
                answer = answer and _ranked(answer, found)
            else:
                estimate, prediction, observed = self._further(ref, found, where)
                if keeps:
                    given = self._given(found.category, prediction, observed)
                    others.append(_ranked(given, found, most=1))
            detections.append(
                Detection(
                    name=found.name,
                    image=found.image,
                    category=found.category,
                    score=found.score,
                    estimate=estimate,
                )
            )
        if self.take_answer is not None and answer is not None:
            self.take_answer(ref, self._dataset.image_of(ref), answer, others)
        return replace(row, detections=tuple(detections))

    def _further(
        self, ref: SampleRef, found: Found, where: str
    ) -> tuple[str | None, Prediction, Observation | None]:
        """The estimate and the answer about a further detection, and what the method has seen of
        it; none where its mask has no pixel."""
        where = f"{where}, detection {found.name}"
        try:
            observation = self._detected.observe(ref, found)
            if observation is None:
                return None, Prediction.failed("its mask is empty"), None
            sample = Sample(ref, observation, self.truth(ref))
            [answered] = self.batches.asked([sample], self.seed)
            answer, _, prediction = self._answer(sample, answered, where)
            return answer.estimate, prediction, observation
        except DataError as error:
            raise SampleError(f"{where}: the data is bad: {error}") from None
        except MethodError as error:
            raise SampleError(f"{where}: {error}") from None

    def ranking(self, rows: Sequence[Row]) -> Ranking | None:
        """The detections of all images, ranked; None of a part of the samples.

        The estimates are in single precision, and have no shapes.
        """
        if not len(rows) == len(self.samples) == sum(self.listed.values()):
            return None
        columns = ranking_columns(self.protocols)
        detected = [
            Detected(
                name=found.name,
                image=found.image,
                category=found.category,
                score=found.score,
                hypothesis=None if found.estimate is None else decode_hypothesis(found.estimate),
            )
            for row in rows
            for found in row.detections
        ]
        image = self._detected.image_of
        truths = [(image(ref), ref.category, self.truth(ref)) for ref in self.samples]
        gives = self._method.info.gives - {"shape"}
        return rank(columns, pair_table(facts_of(columns), detected, truths, gives))


def _ranked(answer: Given, found: Found, most: int | None = None) -> Given:
    """An answer with box and score of its detection, and at most so many hypotheses, of which the
    first is ranked."""
    hypotheses = tuple(
        replace(hypothesis, score=None if number else found.score)
        for number, hypothesis in enumerate(answer.prediction.hypotheses[:most])
    )
    prediction = Prediction(hypotheses, reason=answer.prediction.reason)
    return Given(found.category, prediction, found.box, found.score)
