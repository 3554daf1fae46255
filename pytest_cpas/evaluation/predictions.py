"""Stored predictions as input: what somebody else's run of a method gave.

The truth is that of a data set, or, where none is named, what the file says itself.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pytest_cpas.evaluation.measuring import measure
from pytest_cpas.evaluation.rows import Row
from pytest_cpas.evaluation.runs import Run, SampleError, Selection
from pytest_cpas.facts import Detected, fact, pair_table
from pytest_cpas.metrics.boxes import expect_pairs
from pytest_cpas.protocols import Protocol, Ranking, facts_of, rank, ranking_columns
from pytest_cpas.reading.files import sha256
from pytest_cpas.submissions import (
    Answers,
    Given,
    OwnTruth,
    Pairing,
    audit,
    box_at,
    failures,
    hypothesis,
    in_half_precision,
    names,
    read_submission,
    score_at,
    symmetry_in_view,
    without_detections,
)
from pytest_cpas.types import (
    CATEGORIES,
    Array,
    Camera,
    ContractError,
    Dataset,
    GroundTruth,
    Hypothesis,
    MethodInfo,
    Prediction,
    SampleRef,
    as_dataset,
)
from pytest_cpas.types.datasets import camera_of
from pytest_cpas.types.derived import derived_note
from pytest_cpas.types.frames import standard_prediction, to_standard

__all__ = ["StoredRun"]

#: Samples that are measured at once.
_BATCH = 512


class StoredRun(Run):
    """Stored predictions, judged like the run of a method."""

    def __init__(
        self,
        path: Path,
        *,
        dataset: Dataset | None = None,
        selection: Selection | None = None,
        protocols: Sequence[Protocol] | None = None,
    ) -> None:
        """Read the file or folder; nothing is judged yet.

        ``dataset``: whose samples and truth are taken; without it those of the file. Raises
        :class:`pytest_cpas.types.DataError` for a file that is damaged, or that is not about the
        data set.
        """
        known = None if dataset is None else as_dataset(dataset)
        self._path = path
        self._submission = read_submission(path, known)
        self._dataset = known or OwnTruth(self._submission)
        self._pairing = Pairing(self._submission, self._dataset)
        self._half = in_half_precision(self._submission.images)
        self._truths: dict[str, GroundTruth] = {}
        super().__init__(
            re.sub(r"[^A-Za-z0-9._-]", "-", path.stem if path.is_file() else path.name),
            self._dataset.name,
            self._dataset.samples,
            selection=selection,
            missing=self._dataset.missing,
            derived=derived_note(self._dataset.derived, [ref.id for ref in self._dataset.samples]),
            damaged=self._dataset.damaged,
            identity={
                "data": self._dataset.digest,
                "truth": "the file's own" if known is None else known.name,
            },
            protocols=protocols,
        )
        #: The samples that are measured together: of one scene, since workers share those out.
        self._batches = [
            scene[start : start + _BATCH]
            for _, of in itertools.groupby(self.samples, key=lambda ref: ref.scene)
            for scene in [list(of)]
            for start in range(0, len(scene), _BATCH)
        ]
        self._places = {ref.id: n for n, batch in enumerate(self._batches) for ref in batch}
        self.quick_truth = self._dataset.quick_truth
        self.classes = self._submission.classes
        if self._submission.method:
            self.provenance = {**self.provenance, "predicted_by": self._submission.method}
        self.focal = self._dataset.camera.fx if self._dataset.camera else None
        self.info: MethodInfo = MethodInfo(
            name=self.method,
            categories=tuple(dict.fromkeys((*CATEGORIES, *self._submission.classes))),
            needs=frozenset(),
            gives=self._submission.gives,
            licence="unknown",
            object_frame=self._submission.object_frame,
        )

    @functools.cached_property
    def files(self) -> Mapping[str, str]:  # type: ignore[override]  # those of others are known
        """A digest of each file of the predictions, which are what answers; :class:`OSError`."""
        found = sorted(self._path.rglob("*")) if self._path.is_dir() else [self._path]
        return {
            path.relative_to(self._path.parent).as_posix(): sha256(path)[:16]
            for path in found
            if path.is_file()
        }

    def judge(self, ref: SampleRef) -> Row:
        """The row of one sample; raises :class:`SampleError` for a broken pose."""
        row = self._batch(self._places[ref.id])[ref.id]
        if isinstance(row, ContractError):
            raise SampleError(f"{self.method}, sample {ref.id} ({ref.category}): {row}")
        if self.take_answer is not None:
            self.take_answer(ref, self._dataset.image_of(ref), *self._given(ref))
        return row

    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about one sample; without its surface if no fact is about it."""
        if ref.id not in self._truths:
            truth = self._dataset.truth(ref)
            if "shape" in self._known:
                return self._in_view(ref, truth)
            if truth.surface is not None:
                truth = replace(truth, surface=None)
            self._truths[ref.id] = self._in_view(ref, truth)
        return self._truths[ref.id]

    def ranking(self, rows: Sequence[Row]) -> Ranking | None:
        """All detections of the images, ranked; None of a part of the samples, or without scores.

        A detection whose pose is none is never right.
        """
        columns = ranking_columns(self.protocols)
        if len(self.samples) < sum(self.listed.values()):
            return None
        detected: list[Detected] = []
        for number, image in self._pairing.images.items():
            answers = self._submission.images[number].answers
            if answers.scores is None:
                return None
            detected += self._detected(number, image, answers, answers.scores)
        try:
            truths = [(self._dataset.image_of(r), r.category, self.truth(r)) for r in self.samples]
        except ContractError:  # which the samples say themselves
            return None
        pairs = pair_table(facts_of(columns), detected, truths, self.info.gives)
        return rank(columns, pairs)

    def _detected(
        self, number: int, image: str, answers: Answers, scores: Array
    ) -> Iterator[Detected]:
        """The answers about an image, whatever their order in the file."""
        for row, name in names(self._submission, image, answers):
            yield Detected(
                name=name,
                image=image,
                category=self._submission.category(int(answers.class_ids[row])),
                score=float(scores[row]),
                hypothesis=self._ranked(number, row),
            )

    @property
    def notes(self) -> Sequence[str]:
        """What was noticed about the file, for people."""
        return self._notes

    @functools.cached_property
    def _notes(self) -> Sequence[str]:
        notes = [*self._dataset.notes, *self._submission.notes, *self._pairing.notes]
        notes += self._other_data()
        if self._half:
            notes.append(
                "poses are stored in half precision: the nearest rotations are judged, and a"
                " position 1 m away is off by up to 0.5 mm"
            )
        try:
            notes += audit(self._submission, self._pairing, self._dataset)
        except ContractError as error:
            notes.append(f"the file was not audited: {error}")
        return notes

    def _other_data(self) -> Iterator[str]:
        """Where the file says that its answers are about something else."""
        name = without_detections(self._submission.dataset)
        told, known = self._submission.provenance.get("data"), self._dataset.digest
        if name and name != self._dataset.name:
            yield f"the answers are about {name}, and are judged by {self._dataset.name}"
        elif told is not None and told != known and name == self._submission.dataset:
            yield f"the answers are about other data of {name}: {told}, judged by {known}"

    def _ranked(self, number: int, row: int) -> Hypothesis | None:
        """A detection in the standard frames; None where it is none."""
        if self._failures(number)[row] is not None:
            return None
        try:
            return to_standard(self._hypothesis(number, row, self._ranks_shapes), self.info)
        except ContractError:
            return None

    @functools.cache  # noqa: B019 - lives as long as the run
    def _failures(self, number: int) -> Sequence[str | None]:
        return failures(self._submission.images[number].answers)

    def _hypothesis(self, number: int, row: int, shaped: bool = True) -> Hypothesis:
        """An answer as it is stored; :class:`ContractError` where it is none."""
        shaped = shaped and "shape" in self.info.gives
        # shapes of a whole file may be more than memory has
        return self._read(number, row, shaped) if shaped else self._remembered(number, row)

    @functools.cache  # noqa: B019 - lives as long as the run
    def _remembered(self, number: int, row: int) -> Hypothesis:
        return self._read(number, row, shaped=False)

    def _read(self, number: int, row: int, shaped: bool) -> Hypothesis:
        image = self._submission.images[number]
        where = f"prediction {row} of {image.name or f'image {number}'}"
        return hypothesis(image.answers, row, where, half=self._half, shaped=shaped)

    @functools.cached_property
    def _ranks_shapes(self) -> bool:
        """Whether detections are ranked by their shapes."""
        names = facts_of(ranking_columns(self.protocols))
        return any("shape" in fact(name).needs for name in names)

    @functools.lru_cache(maxsize=2)  # noqa: B019 - lives as long as the run
    def _batch(self, number: int) -> Mapping[str, Row | ContractError]:
        """The rows of some samples at once: measuring in bulk is what makes large files quick."""
        rows: dict[str, Row | ContractError] = {}
        pairs: dict[SampleRef, tuple[GroundTruth, Prediction, Camera | None]] = {}
        expect_pairs(len(self.samples))
        for ref in self._batches[number]:
            try:
                pairs[ref] = self.truth(ref), self._prediction(ref), self._camera(ref)
            except ContractError as error:
                rows[ref.id] = error
        try:
            return rows | self._measured(pairs)
        except ContractError:  # of one of them, which is not known
            for ref, pair in pairs.items():
                try:
                    rows |= self._measured({ref: pair})
                except ContractError as error:
                    rows[ref.id] = error
            return rows

    def _measured(
        self, pairs: Mapping[SampleRef, tuple[GroundTruth, Prediction, Camera | None]]
    ) -> dict[str, Row]:
        """The rows of answers beside their truths."""
        truths, predictions, cameras = zip(*pairs.values(), strict=True) if pairs else ((), (), ())
        answers = measure(self.facts, truths, predictions, self.info, cameras)
        return {
            ref.id: Row(sample=ref.id, category=ref.category, answers=(answer,))
            for ref, answer in zip(pairs, answers, strict=True)
        }

    def _answers(self, ref: SampleRef) -> tuple[int, Sequence[int], str | None]:
        """The image and the rows of a sample's answers, the best first; or why there are none."""
        number = self._pairing.number(ref)
        if number is None:
            return -1, (), "whose image is not in the file"
        rows = self._pairing.found(number).answers[ref.id]
        if not rows:
            named = self._submission.images[number].answers.samples is not None
            return number, (), "not in the file" if named else "not detected"
        reasons = self._failures(number)
        if reasons[rows[0]] is not None:
            return number, (), reasons[rows[0]]
        return number, [row for row in rows if reasons[row] is None], None

    def _prediction(self, ref: SampleRef) -> Prediction:
        number, rows, reason = self._answers(ref)
        if reason is not None:
            return Prediction.failed(reason)
        return Prediction(tuple(self._hypothesis(number, row) for row in rows))

    def _given(self, ref: SampleRef) -> tuple[Given, list[Given]]:
        """What a file says of a sample in the standard frames, and what else it has found that is
        ranked with it: what is no pose, and, with the first of an image, what is no sample's."""
        number, answered, reason = self._answers(ref)
        if number < 0:
            return Given(ref.category, Prediction.failed(reason or ""), None), []
        assigned = self._pairing.found(number).answers
        told = answered or assigned[ref.id][:1]
        others = [row for row in assigned[ref.id] if row not in told]
        if ref == self._pairing.refs(number)[0]:
            taken = {row for rows in assigned.values() for row in rows}
            answers = self._submission.images[number].answers
            others += [row for row, _ in names(self._submission, "", answers) if row not in taken]
        if not told:
            answer = Given(ref.category, Prediction.failed(reason or ""), None)
        else:
            answer = self._told(ref, number, told)
        return answer, [self._told(ref, number, [row]) for row in others]

    def _told(self, ref: SampleRef, number: int, rows: Sequence[int]) -> Given:
        """The answer in some rows of an image, the best first."""
        answers, best = self._submission.images[number].answers, rows[0]
        reason = self._failures(number)[best]
        try:
            prediction = Prediction(
                tuple(self._hypothesis(number, row) for row in rows if reason is None),
                reason=reason,
            )
        except ContractError as error:
            prediction = Prediction.failed(str(error))
        return Given(
            category=self._submission.category(int(answers.class_ids[best])) or ref.category,
            prediction=standard_prediction(prediction, self.info),
            box=box_at(answers, best),
            score=score_at(answers, best) if "score" in self.info.gives else None,
        )

    @functools.cached_property
    def _known(self) -> frozenset[str]:
        """What a data set must know for the facts that are measured."""
        measured = (fact(name) for name in self.definitions)
        return frozenset().union(*(f.knows for f in measured if f.needs <= self.info.gives))

    def _camera(self, ref: SampleRef) -> Camera | None:
        """The camera of a sample's image, if a fact is about it and it is known."""
        return camera_of(self._dataset, ref) if "camera" in self._known else self._dataset.camera

    def _in_view(self, ref: SampleRef, truth: GroundTruth) -> GroundTruth:
        """A truth with the symmetry of what can be seen, where only the file knows it."""
        number = self._pairing.number(ref)
        if number is None or truth.symmetry_in_view is not None:
            return truth
        row = self._pairing.found(number).own.get(ref.id)
        truths = self._submission.images[number].truths
        if row is None or truths is None:
            return truth
        symmetry = symmetry_in_view(truths, row, ref.category)
        return truth if symmetry is None else replace(truth, symmetry_in_view=symmetry)
