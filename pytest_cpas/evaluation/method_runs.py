"""A method on a data set."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import cast

from pytest_cpas.datasets.perturbed import Perturbed
from pytest_cpas.evaluation.batches import Batches, check_count
from pytest_cpas.evaluation.estimates import encode_shape
from pytest_cpas.evaluation.loading import Loading, MethodError
from pytest_cpas.evaluation.meanwhile import Meanwhile, seen
from pytest_cpas.evaluation.measuring import measure
from pytest_cpas.evaluation.other_side import (
    digests_there,
    heard_there,
    is_there,
    parts_here,
    with_other_side,
)
from pytest_cpas.evaluation.program import look_again, program_of
from pytest_cpas.evaluation.rows import Answer, Row
from pytest_cpas.evaluation.runs import Run, SampleError, Selection
from pytest_cpas.evaluation.surroundings import changed_names, united
from pytest_cpas.evaluation.watchdog import ChannelError, Limit, Limited
from pytest_cpas.facts import declared_part
from pytest_cpas.protocols import Protocol, count_columns, judge_outcomes
from pytest_cpas.remote import RaisedThereError, RemoteMethod, WorkerError
from pytest_cpas.submissions import Given
from pytest_cpas.types import (
    AnswerError,
    ContractError,
    DataError,
    Dataset,
    GroundTruth,
    Method,
    MethodInfo,
    Observation,
    Prediction,
    Sample,
    SampleRef,
    as_dataset,
    message_of,
    raised_as,
)
from pytest_cpas.types.datasets import camera_of, mask_box, readers_of
from pytest_cpas.types.declarations import TOLERANCE
from pytest_cpas.types.derived import derived_note
from pytest_cpas.types.frames import standard_prediction, to_standard

__all__ = ["MethodError", "MethodRun", "check_answers"]


#: Held while a data set reads: samples may be read ahead, in a thread, and a data set, which may be
#: shared by runs, need not know of threads.
_READING = threading.RLock()


class MethodRun(Run):
    """A method on a data set. The method is loaded at its first sample, once per process."""

    def __init__(
        self,
        method: Method,
        dataset: Dataset,
        *,
        made_by: Callable[..., Method] | None = None,
        selection: Selection | None = None,
        weights: Path | None = None,
        device: str = "cpu",
        seed: int = 0,
        seeds: int = 1,
        shared: MethodRun | None = None,
        keeps_shapes: bool = False,
        protocols: Sequence[Protocol] | None = None,
        batch: int | None = None,
    ) -> None:
        """List the samples whose category the method knows; nothing is loaded yet.

        ``made_by``: what was called for the method, if that is not its class.

        Each is judged under ``seeds`` seeds, from ``seed`` on; the first gives the row. ``shared``:
        another run of the same method, which is then loaded once for both. ``keeps_shapes``: the
        rows of samples that are not correct everywhere have the estimated shape, for a picture.
        ``batch``: how many samples the method is asked about at once, None for as many as it
        declares.
        """
        self._method, self._dataset = method, (dataset := as_dataset(dataset))
        self._weights, self._device = weights, device
        self.seed, self.seeds, self.shared = seed, seeds, shared
        self.loading: Loading = shared.loading if shared else Loading(method, weights, device)
        self._keeps_shapes = keeps_shapes
        self._heard_there = 0
        #: How long a prediction may take, set by whoever can tell of one that took longer.
        self.limit: Limit | None = None
        self.batch = method.info.batch if batch is None else batch
        self.batches = Batches(
            self._read_seen, self._predicted, [seed + number for number in range(seeds)]
        )
        self.under_contract = shared is None
        self.info = method.info
        self._parts: list[Sequence[type | Callable[..., object]]]
        self._parts = [
            parts_here(method, made_by or type(method)),
            readers_of(dataset),
        ]
        method_program, data_program = (program_of(*parts) for parts in self._parts)
        programs = self._programs = [with_other_side(method_program, method), data_program]
        self._meanwhile = Meanwhile(self.loading.seen, *(program.seen for program in programs))
        self.files = united(*(program.files for program in programs))
        unusual = {} if method.info.deterministic else {"deterministic": "no"}
        if method.info.tolerance != TOLERANCE:
            unusual["tolerance"] = f"{method.info.tolerance:g}"
        self.provenance = {
            **self.provenance,
            **unusual,
            **self.loading.undeclared_weights,
            **programs[0].facts(),
            "data_code": programs[1].code,
        }
        self.quick_truth = dataset.quick_truth
        self.classes = dataset.class_names
        self.focal = dataset.camera.fx if dataset.camera else None
        self.robustness_point = dataset.point if isinstance(dataset, Perturbed) else None
        present = [s for s in dataset.samples if s.id not in dataset.absent]
        known = [s for s in present if s.category in method.info.categories]
        missing = list(dataset.missing)
        unknown = sorted({s.category for s in present} - set(method.info.categories))
        if unknown:
            missing.append(
                f"{method.info.name} does not know {', '.join(unknown)}:"
                f" {len(present) - len(known)} samples left out"
            )
        super().__init__(
            method.info.name,
            dataset.name,
            known,
            selection=selection,
            missing=missing,
            derived=derived_note(dataset.derived, [ref.id for ref in dataset.samples]),
            damaged=dataset.damaged,
            identity={
                "data": dataset.digest,
                "seed": str(seed),
                "device": device,
                **self.loading.declared_weights,
            },
            protocols=protocols,
        )

    @property
    def notes(self) -> Sequence[str]:
        """What the data set says of itself, and what went otherwise than planned."""
        return [*self._dataset.notes, *self.batches.told]

    def began(self, when: int, plugins: Iterable[Path]) -> None:
        """Take in when pytest was started, nanoseconds since 1970, and which files its plugins are
        of, for :meth:`changed_meanwhile`."""
        self._meanwhile.watch(seen({path: path.name for path in plugins}))
        self._meanwhile.since(when)

    def changed_meanwhile(self, *, thoroughly: bool = False) -> Mapping[str, bool]:
        """Of the method, the data set's code, plugins and weights, as far as files tell."""
        self._meanwhile.look()
        if thoroughly:
            for parts, before in zip(self._parts, self._programs, strict=True):
                now = look_again(before, *parts)
                if before is self._programs[0]:
                    now = with_other_side(now, self._method)
                names = [*changed_names(before.files, now.files)]
                told = (before.code, before.packages) != (now.code, now.packages)
                if told and not names:
                    names = ["what it imports"]
                self._meanwhile.add(names, told=told)
        return self._meanwhile.changed

    def newly_heard_there(self) -> Sequence[tuple[str, str]]:
        """Name and digest of each file that the method has read on its other side since this was
        last asked."""
        news = heard_there(self._method, self._heard_there)
        self._heard_there += len(news)
        return news

    def digests_of_opened(self, names: Collection[str]) -> Mapping[str, str]:
        """Of those on the other side of the method, as they are there."""
        there = [name for name in names if is_there(name)]
        here = super().digests_of_opened([name for name in names if not is_there(name)])
        return {**here, **digests_there(self._method, there)}

    @property
    def unloaded(self) -> Method:
        """The method, loaded or not."""
        return self._method

    def loaded(self) -> Method:
        """The method, ready; :class:`MethodError` if it cannot be loaded."""
        if self.loading.error is not None:
            raise MethodError(f"the method cannot be loaded: {message_of(self.loading.error)}")
        return self._method

    def fresh(self) -> Method:
        """Another instance of the method, loaded."""
        made: Method = type(self._method)()
        made.load(self._weights, self._device)
        return made

    def limited(self, method: Method) -> Method:
        """``method``, loaded or another instance, as the contract is checked: within the limit."""
        if isinstance(method, RemoteMethod):
            method = method.checked()
        return method if self.limit is None else cast(Method, Limited(method, self.limit))

    @raised_as(DataError)
    def read(self, ref: SampleRef) -> Sample:
        """One sample; :class:`DataError` if it is damaged."""
        with _READING:
            return self._dataset.load(ref)

    def unseen(self, ref: SampleRef) -> str:
        """Why nothing is seen of a sample, so that its method is not asked; "" if something is."""
        with _READING:
            return self._dataset.unseen(ref) or ""

    @raised_as(DataError)
    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about one sample; raises :class:`DataError` if it is damaged."""
        with _READING:
            return self._dataset.truth(ref)

    def judge(self, ref: SampleRef) -> Row:
        """Read, predict, validate, measure."""
        row, prediction, seen = self._judged(ref)
        if self.take_answer is not None:
            answer = self._given(ref.category, prediction, seen)
            self.take_answer(ref, self._dataset.image_of(ref), answer, ())
        return row

    def _judged(self, ref: SampleRef) -> tuple[Row, Prediction, Observation | None]:
        """The row of a sample, the answer that it is about, that under the first seed, and what the
        method has seen, None for nothing."""
        where = f"{self.method} on {self.dataset}, sample {ref.id} ({ref.category})"
        try:
            if reason := self.unseen(ref):
                return self._unseen(ref, reason), Prediction.failed(reason), None
            predicted = self.batches.of(ref)
        except DataError as error:
            raise SampleError(f"{where}: the data is bad: {error}") from None
        except MethodError as error:
            raise SampleError(f"{where}: {error}") from None
        answers, shapes, predictions = zip(
            *(self._answer(predicted.sample, answer, where) for answer in predicted.answers),
            strict=True,
        )
        row = Row(sample=ref.id, category=ref.category, answers=answers, shape=shapes[0])
        return row, predictions[0], predicted.sample.observation

    def _read_seen(self, ref: SampleRef) -> Sample | None:
        """One sample, None if nothing is seen of it; :class:`DataError` if it is damaged."""
        return None if self.unseen(ref) else self.read(ref)

    def _predicted(self, samples: Sequence[Sample], seed: int) -> Sequence[Prediction]:
        """What the method answers, whatever that is; raises what the method raises."""
        method = self.loaded()
        batch = [sample.observation.copy() for sample in samples]
        if self.limit is None:
            return method.predict(batch, seed)
        first = samples[0].ref
        more = f" and {len(samples) - 1} more" if len(samples) > 1 else ""
        what = f"{self.method} on {self.dataset}, sample {first.id} ({first.category}){more}"
        return self.limit.predict(method, batch, seed, f"{what}: predict", sample=first.id)

    def _given(self, category: str, prediction: Prediction, seen: Observation | None) -> Given:
        """An answer in the standard frames, with the 2-D box of what the method has seen."""
        standard = standard_prediction(prediction, self._method.info)
        return Given(category, standard, None if seen is None else mask_box(seen.mask))

    def _unseen(self, ref: SampleRef, reason: str) -> Row:
        """The row of a sample that there is nothing to ask about."""
        camera = camera_of(self._dataset, ref)
        [answer] = measure(
            self.facts,
            [self.truth(ref)],
            [Prediction.failed(reason)],
            self._method.info,
            None if camera is None else [camera],
        )
        return Row(sample=ref.id, category=ref.category, answers=(answer,) * self.seeds)

    def _answer(
        self, sample: Sample, answered: Prediction | Exception, where: str
    ) -> tuple[Answer, str | None, Prediction]:
        """What is known of an answer, its shape if that is to be kept for a picture, and the answer
        itself; :class:`SampleError` if there is none."""
        if isinstance(answered, Exception):
            raise _no_answer(answered, where)
        try:
            prediction = check_answer(answered, self._method.info)
            camera = sample.observation.camera
            [answer] = measure(
                self.facts, [sample.truth], [prediction], self._method.info, [camera]
            )
            if not self._keeps_shapes or not prediction.hypotheses or self._is_correct(answer):
                return answer, None, prediction
            shape = to_standard(prediction.hypotheses[0], self._method.info).shape
            return answer, None if shape is None else encode_shape(shape), prediction
        except DataError as error:
            raise SampleError(f"{where}: the data is bad: {error}") from None
        except ContractError as error:
            raise SampleError(f"{where}: the answer breaks the contract: {error}") from None

    def _is_correct(self, answer: Answer) -> bool:
        """Whether an answer is correct in every column where that can be judged."""
        [outcome] = judge_outcomes(count_columns(self.protocols), [answer.facts])
        return "0" not in outcome


def _no_answer(error: Exception, where: str) -> SampleError:
    """Why a sample has no answer, in words."""
    if isinstance(error, ChannelError):
        return SampleError(str(error))
    if isinstance(error, ContractError):
        return SampleError(f"{where}: the answer breaks the contract: {error}")
    if isinstance(error, RaisedThereError):
        return SampleError(f"{where}: the method raised {error}")
    if isinstance(error, WorkerError):
        again = f"\n{error.again}" if error.again else ""
        return SampleError(f"{where}: {error}{again}")
    told = SampleError(f"{where}: the method raised {error!r}")
    told.__cause__ = error
    return told


def check_answers(answers: Sequence[Prediction], info: MethodInfo) -> Prediction:
    """The one prediction of a batch of one, if it holds what the method declares to give."""
    return check_answer(check_count(answers, 1)[0], info)


def check_answer(prediction: Prediction, info: MethodInfo) -> Prediction:
    """A prediction, if it holds what the method declares to give; else :class:`AnswerError`."""
    if not isinstance(prediction, Prediction):
        raise AnswerError(f"predict: a {type(prediction).__name__}, expected Prediction")
    for hypothesis in prediction.hypotheses:
        for part in ("extents", "shape", "score"):
            if getattr(hypothesis, part) is not None and part not in info.gives:
                raise AnswerError(
                    f"hypothesis: {part} is given, but info.gives is {sorted(info.gives)}; declare"
                    " what is given, or it would not be judged"
                )
            if part in info.gives:
                declared_part(getattr(hypothesis, part), part)
    return prediction
