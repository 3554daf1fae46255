"""A method on a data set."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import cast

from pytest_cpas.datasets.perturbed import Perturbed
from pytest_cpas.evaluation.estimates import encode_shape
from pytest_cpas.evaluation.meanwhile import Meanwhile, Seen, seen
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
from pytest_cpas.evaluation.surroundings import changed_names, piecewise_digest, united
from pytest_cpas.evaluation.watchdog import ChannelError, Limit, Limited
from pytest_cpas.facts import declared_part
from pytest_cpas.protocols import Protocol, count_columns, judge_outcomes
from pytest_cpas.reading.checkpoints import LARGEST_CHECKPOINT
from pytest_cpas.reading.files import sha256
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
    ToldError,
    as_dataset,
    assets_of,
    message_of,
    raised_as,
)
from pytest_cpas.types.datasets import camera_of, mask_box, readers_of
from pytest_cpas.types.declarations import TOLERANCE
from pytest_cpas.types.derived import derived_note
from pytest_cpas.types.frames import standard_prediction, to_standard

__all__ = ["MethodError", "MethodRun", "check_answers"]


#: Of a folder of weights that are not declared: files that are looked at, and bytes up to which
#: their whole contents are.
_MOST_FILES, _LARGEST_FOLDER = 10_000, 2**30


class MethodError(ToldError):
    """A method cannot be loaded."""


class Loading:
    """The loading of a method, and what is known of its weights: when it is first needed, once for
    all runs that share it."""

    def __init__(self, method: Method, weights: Path | None, device: str) -> None:
        self._method, self._weights, self._device = method, weights, device

    @functools.cached_property
    def error(self) -> Exception | None:
        """Loads the method; what went wrong is remembered, not tried again for every sample."""
        try:
            self._method.load(self._weights, self._device)
        except Exception as error:
            return error
        return None

    @functools.cached_property
    def seen(self) -> Mapping[Path, Seen]:
        """The files of the weights, before anything is read of them."""
        folder = self._weights
        declared = assets_of(self._method, folder) if folder else ()
        paths = [folder / asset.path for asset in declared] if folder else []
        paths = paths or _files_below(folder)
        return seen({path: f"the weights {path.name}" for path in paths})

    @functools.cached_property
    def declared_weights(self) -> Mapping[str, str]:
        """Identity: a digest of the files that the method declares; nothing without any."""
        return _weights_identity(self._method, self._weights)

    @functools.cached_property
    def undeclared_weights(self) -> Mapping[str, str]:
        """Provenance: a digest of the folder of a method that declares nothing of it."""
        return _undeclared_weights(self._method, self._weights)


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
    ) -> None:
        """List the samples whose category the method knows; nothing is loaded yet.

        ``made_by``: what was called for the method, if that is not its class.

        Each is judged under ``seeds`` seeds, from ``seed`` on; the first gives the row. ``shared``:
        another run of the same method, which is then loaded once for both. ``keeps_shapes``: the
        rows of samples that are not correct everywhere have the estimated shape, for a picture.
        """
        self._method, self._dataset = method, (dataset := as_dataset(dataset))
        self._weights, self._device = weights, device
        self.seed, self.seeds, self.shared = seed, seeds, shared
        self.loading: Loading = shared.loading if shared else Loading(method, weights, device)
        self._keeps_shapes = keeps_shapes
        self._heard_there = 0
        #: How long a prediction may take, set by whoever can tell of one that took longer.
        self.limit: Limit | None = None
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
        """What the data set says of itself."""
        return self._dataset.notes

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
        return self._dataset.load(ref)

    def unseen(self, ref: SampleRef) -> str:
        """Why nothing is seen of a sample, so that its method is not asked; "" if something is."""
        return self._dataset.unseen(ref) or ""

    @raised_as(DataError)
    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about one sample; raises :class:`DataError` if it is damaged."""
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
            if reason := self._dataset.unseen(ref):
                return self._unseen(ref, reason), Prediction.failed(reason), None
            sample = self.read(ref)
        except DataError as error:
            raise SampleError(f"{where}: the data is bad: {error}") from None
        try:
            method = self.loaded()
        except MethodError as error:
            raise SampleError(f"{where}: {error}") from None
        answers, shapes, predictions = zip(
            *(self._answer(method, ref, sample, self.seed + n, where) for n in range(self.seeds)),
            strict=True,
        )
        row = Row(sample=ref.id, category=ref.category, answers=answers, shape=shapes[0])
        return row, predictions[0], sample.observation

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
        self, method: Method, ref: SampleRef, sample: Sample, seed: int, where: str
    ) -> tuple[Answer, str | None, Prediction]:
        """What is known of the answer under one seed, its shape if that is to be kept for a
        picture, and the answer itself."""
        try:
            batch = [sample.observation.copy()]
            if self.limit is None:
                predictions = method.predict(batch, seed)
            else:
                predictions = self.limit.predict(
                    method, batch, seed, f"{where}: predict", sample=ref.id
                )
        except ChannelError as error:
            raise SampleError(str(error)) from None
        except ContractError as error:
            raise SampleError(f"{where}: the answer breaks the contract: {error}") from None
        except RaisedThereError as error:
            raise SampleError(f"{where}: the method raised {error}") from None
        except WorkerError as error:
            raise SampleError(f"{where}: {error}") from None
        except Exception as error:
            raise SampleError(f"{where}: the method raised {error!r}") from error
        try:
            prediction = check_answers(predictions, self._method.info)
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


def _weights_identity(method: Method, folder: Path | None) -> dict[str, str]:
    """A digest of the files that a method loads; nothing for a method without any."""
    assets = assets_of(method, folder)
    if not assets or folder is None:
        return {}
    digest = hashlib.sha256()
    for asset in sorted(assets, key=lambda asset: asset.path):
        content = sha256(folder / asset.path, LARGEST_CHECKPOINT)
        digest.update(f"{asset.path} {content}\n".encode())
    return {"weights": digest.hexdigest()[:16]}


def _files_below(folder: Path | None) -> list[Path]:
    """The files of a folder, also where links lead to folders."""
    found: list[Path] = []
    been = set()
    for at, folders, files in os.walk(folder, followlinks=True) if folder else ():
        been.add(os.path.realpath(at))
        folders[:] = [f for f in folders if os.path.realpath(os.path.join(at, f)) not in been]
        found += [path for name in files if (path := Path(at, name)).is_file()]
    return sorted(found)[:_MOST_FILES]


def _undeclared_weights(method: Method, folder: Path | None) -> dict[str, str]:
    """A digest of the folder that a method without declared assets is given: what it reads there is
    known to nobody."""
    if folder is None or assets_of(method, folder):
        return {}
    files = _files_below(folder)
    small = sum(path.stat().st_size for path in files) <= _LARGEST_FOLDER
    digest = hashlib.sha256()
    for path in files:
        told = sha256(path) if small else piecewise_digest(path)
        digest.update(f"{path.relative_to(folder)} {told}\n".encode(errors="backslashreplace"))
    return {"weights_folder": digest.hexdigest()[:16]}


def check_answers(answers: Sequence[Prediction], info: MethodInfo) -> Prediction:
    """The one prediction of a batch of one, if it holds what the method declares to give."""
    if not isinstance(answers, Sequence) or len(answers) != 1:
        seen = f"{len(answers)} of them" if isinstance(answers, Sequence) else type(answers)
        raise AnswerError(f"predict: {seen}, expected one Prediction for a batch of one")
    prediction = answers[0]
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
