"""Method times data set gives rows, one per sample; rows give the table."""

from __future__ import annotations

import functools
import hashlib
import platform
import sys
from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy

from pytest_cpas.estimates import encode_estimate, encode_shape
from pytest_cpas.frames import to_standard
from pytest_cpas.metrics.boxes import symmetric_iou
from pytest_cpas.metrics.definitions import definition
from pytest_cpas.metrics.pose import rotation_error, translation_error
from pytest_cpas.metrics.precision import (
    FAILED,
    PAPER_THRESHOLDS,
    Count,
    Errors,
    JointThreshold,
)
from pytest_cpas.metrics.surfaces import SAMPLE_COUNT, Surface, surface_errors
from pytest_cpas.types import (
    Array,
    Camera,
    ContractError,
    Dataset,
    GroundTruth,
    Hypothesis,
    Mesh,
    Method,
    MethodInfo,
    Prediction,
    Sample,
    SampleRef,
    Symmetry,
    assets_of,
)

#: The distance of the paper's F-score, metres.
FSCORE_DISTANCE = 0.01

#: The thresholds of the precision table.
THRESHOLDS: tuple[JointThreshold, ...] = PAPER_THRESHOLDS

#: Under which definitions a row's errors are measured.
DEFINITIONS = {
    "translation_error": definition("translation_error", "euclidean").id(),
    "rotation_error": definition("rotation_error", "symmetry-group").id(),
    "iou": definition("iou", "oriented-symmetric").id(),
    "fscore_1cm": definition("fscore", "strict").id(
        delta_m=FSCORE_DISTANCE, frame="camera", points=SAMPLE_COUNT
    ),
}


class SampleError(Exception):
    """A sample could not be judged: damaged data, a method that raised, a broken contract."""


class MethodError(Exception):
    """A method cannot be loaded."""


@dataclass(frozen=True, slots=True)
class Row:
    """The errors of one sample.

    ``translation_error`` in metres, ``rotation_error`` in degrees. ``iou``, ``fscore_1cm``: None
    is n/a (the method gives no extents or shape, or the data set has none). A failed prediction
    has its reason in ``failure`` and the errors of :data:`pytest_cpas.metrics.precision.FAILED`.
    ``estimate``: the answer itself, as of :func:`pytest_cpas.estimates.encode_estimate`.
    ``repeats``: the outcomes (see :func:`outcomes`) under further seeds, separated by spaces.
    ``shape``: the estimated shape for a picture, as of :func:`pytest_cpas.estimates.encode_shape`.
    """

    sample: str
    category: str
    translation_error: float
    rotation_error: float
    iou: float | None
    fscore_1cm: float | None
    failure: str | None = None
    estimate: str | None = None
    repeats: str = ""
    shape: str | None = None


#: The field of a row for each of :data:`pytest_cpas.metrics.precision.METRICS`.
_FIELDS = {
    "rotation_deg": "rotation_error",
    "position_m": "translation_error",
    "iou": "iou",
    "fscore": "fscore_1cm",
}


def outcomes(rows: Sequence[Row]) -> list[str]:
    """Per row one character for each of :data:`THRESHOLDS`: correct 1, not 0, n/a -."""
    errors = Errors(
        {metric: [getattr(row, field) for row in rows] for metric, field in _FIELDS.items()}
    )
    columns = []
    for threshold in THRESHOLDS:
        judged = errors.judge(threshold)
        if judged is None:
            columns.append(["-"] * len(rows))
            continue
        columns.append(
            [
                "-" if not known else "1" if correct else "0"
                for correct, known in zip(*judged, strict=True)
            ]
        )
    # a few different ones only, however many rows: one object each
    return [sys.intern("".join(characters)) for characters in zip(*columns, strict=True)]


#: Counts per category (and "all") and threshold label; None where every sample is n/a.
Table = dict[str, dict[str, Count | None]]


def precision_table(judged: Iterable[tuple[str, str]]) -> Table:
    """The table of samples given as (category, outcome)."""
    groups: dict[str, list[str]] = {}
    for category, outcome in judged:
        groups.setdefault("all", []).append(outcome)
        groups.setdefault(category, []).append(outcome)
    table: Table = {}
    for category, members in sorted(groups.items()):
        table[category] = {}
        for index, threshold in enumerate(THRESHOLDS):
            column = [outcome[index] for outcome in members if outcome[index] != "-"]
            cell = Count(column.count("1"), len(column)) if column else None
            table[category][threshold.label] = cell
    return table


_Value = TypeVar("_Value")


def evenly(values: Sequence[_Value], most: int) -> list[_Value]:
    """At most so many of the values, evenly spaced, in order."""
    count = min(most, len(values))
    return [values[i * len(values) // count] for i in range(count)]


@dataclass(frozen=True)
class Selection:
    """Which samples to judge: those of ``categories`` (all if empty), of them ``limit``, evenly
    spaced, and of those the ``shard``-th (from 1) of ``shards`` parts."""

    categories: Sequence[str] = ()
    limit: int | None = None
    shard: int = 1
    shards: int = 1

    def of(self, samples: Sequence[SampleRef]) -> list[SampleRef]:
        """The selected samples, in order."""
        chosen = [s for s in samples if not self.categories or s.category in self.categories]
        limited = chosen if self.limit is None else evenly(chosen, self.limit)
        return limited[self.shard - 1 :: self.shards]


class Run(ABC):
    """Something that judges samples: a method on a data set, or stored predictions.

    ``samples`` are those selected; ``listed`` counts per category what there was to select from.
    ``missing`` and ``damaged`` as for a data set. ``identity`` holds what must agree for two runs
    to be comparable, ``provenance`` what else should be known of this one. ``seeds`` is how often
    each sample is judged. ``info`` is what the method declares, None where only rows are left.
    ``quick_truth``: :meth:`truth` opens no image. ``focal``: the focal length in pixels, if known.
    ``under_contract``: it is a method's first run, which has the checks of the contract.
    """

    seeds = 1
    under_contract = False
    info: MethodInfo | None = None
    quick_truth = True
    focal: float | None = None

    provenance: Mapping[str, str] = {
        "platform": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }

    def __init__(
        self,
        method: str,
        dataset: str,
        samples: Sequence[SampleRef],
        *,
        selection: Selection | None = None,
        missing: Sequence[str] = (),
        damaged: Sequence[str] = (),
        identity: Mapping[str, str],
    ) -> None:
        """List ``samples``, and select some of them (all if ``selection`` is None)."""
        self.method, self.dataset = method, dataset
        self.listed = Counter(sample.category for sample in samples)
        self.samples = (selection or Selection()).of(samples)
        self.missing, self.damaged = missing, damaged
        self.identity: Mapping[str, str] = {**DEFINITIONS, **identity}

    @abstractmethod
    def judge(self, ref: SampleRef) -> Row:
        """The row of one sample; raises :class:`SampleError`."""

    def truth(self, ref: SampleRef) -> GroundTruth | None:
        """The truth about one sample; None where only its row is left."""
        return None


def has_quick_truth(dataset: Dataset) -> bool:
    """Whether :func:`read_truth` opens no image."""
    return bool(getattr(dataset, "quick_truth", hasattr(dataset, "truth")))


def read_truth(dataset: Dataset, ref: SampleRef) -> GroundTruth:
    """The truth about one sample of a data set; :class:`ContractError` if it is damaged."""
    read = getattr(dataset, "truth", None)
    truth: GroundTruth = dataset.load(ref).truth if read is None else read(ref)
    return truth


class MethodRun(Run):
    """A method on a data set. The method is loaded at its first sample, once per process."""

    def __init__(
        self,
        method: Method,
        dataset: Dataset,
        *,
        selection: Selection | None = None,
        weights: Path | None = None,
        device: str = "cpu",
        seed: int = 0,
        seeds: int = 1,
        shared: MethodRun | None = None,
        keeps_shapes: bool = False,
    ) -> None:
        """List the samples whose category the method knows; nothing is loaded yet.

        Each is judged under ``seeds`` seeds, from ``seed`` on; the first gives the row. ``shared``:
        another run of the same method, which is then loaded once for both. ``keeps_shapes``: the
        rows of samples that are not correct everywhere have the estimated shape, for a picture.
        """
        self._method, self._dataset = method, dataset
        self._weights, self._device = weights, device
        self.seed, self.seeds, self.shared = seed, seeds, shared
        self._keeps_shapes = keeps_shapes
        self.under_contract = shared is None
        self.info = method.info
        self.quick_truth = has_quick_truth(dataset)
        camera = getattr(dataset, "camera", None)
        self.focal = camera.fx if isinstance(camera, Camera) else None
        absent: frozenset[str] = getattr(dataset, "absent", frozenset())
        present = [s for s in dataset.samples if s.id not in absent]
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
            damaged=dataset.damaged,
            identity={
                "data": dataset.digest,
                "seed": str(seed),
                "device": device,
                **_weights_identity(method, weights),
            },
        )

    @functools.cached_property
    def _load_error(self) -> Exception | None:
        """Loads the method; what went wrong is remembered, not tried again for every sample."""
        if self.shared is not None:
            return self.shared._load_error
        try:
            self._method.load(self._weights, self._device)
        except Exception as error:
            return error
        return None

    @property
    def unloaded(self) -> Method:
        """The method, loaded or not."""
        return self._method

    def loaded(self) -> Method:
        """The method, ready; :class:`MethodError` if it cannot be loaded."""
        if self._load_error is not None:
            raise MethodError(f"the method cannot be loaded: {self._load_error}")
        return self._method

    def fresh(self) -> Method:
        """Another instance of the method, loaded."""
        made: Method = type(self._method)()
        made.load(self._weights, self._device)
        return made

    def read(self, ref: SampleRef) -> Sample:
        """One sample; :class:`ContractError` if it is damaged."""
        return self._dataset.load(ref)

    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about one sample; raises :class:`ContractError` if it is damaged."""
        return read_truth(self._dataset, ref)

    def judge(self, ref: SampleRef) -> Row:
        """Read, predict, validate, measure."""
        where = f"{self.method} on {self.dataset}, sample {ref.id} ({ref.category})"
        try:
            sample = self.read(ref)
        except ContractError as error:
            raise SampleError(f"{where}: the data is bad: {error}") from None
        try:
            method = self.loaded()
        except MethodError as error:
            raise SampleError(f"{where}: {error}") from None
        row, *repeats = [
            self._judge(method, ref, sample, self.seed + further, where)
            for further in range(self.seeds)
        ]
        return replace(row, repeats=" ".join(outcomes(repeats))) if repeats else row

    def _judge(self, method: Method, ref: SampleRef, sample: Sample, seed: int, where: str) -> Row:
        try:
            answers = method.predict([sample.observation], seed)
        except ContractError as error:
            raise SampleError(f"{where}: the answer breaks the contract: {error}") from None
        except Exception as error:
            raise SampleError(f"{where}: the method raised {error!r}") from error
        try:
            prediction = check_answers(answers, self._method.info)
            row = measure([ref], [sample.truth], [prediction], self._method.info)[0]
            if self._keeps_shapes and "0" in outcomes([row])[0] and prediction.hypotheses:
                shape = to_standard(prediction.hypotheses[0], self._method.info).shape
                row = replace(row, shape=None if shape is None else encode_shape(shape))
            return row
        except ContractError as error:
            raise SampleError(f"{where}: the answer breaks the contract: {error}") from None


def _weights_identity(method: Method, folder: Path | None) -> dict[str, str]:
    """A digest of the files that a method loads; nothing for a method without any."""
    assets = assets_of(method, folder)
    if not assets or folder is None:
        return {}
    digest = hashlib.sha256()
    for asset in sorted(assets, key=lambda asset: asset.path):
        with (folder / asset.path).open("rb") as file:
            content = hashlib.file_digest(file, "sha256").hexdigest()
        digest.update(f"{asset.path} {content}\n".encode())
    return {"weights": digest.hexdigest()[:16]}


def check_answers(answers: Sequence[Prediction], info: MethodInfo) -> Prediction:
    """The one prediction of a batch of one, if it holds what the method declares to give."""
    if not isinstance(answers, Sequence) or len(answers) != 1:
        seen = f"{len(answers)} of them" if isinstance(answers, Sequence) else type(answers)
        raise ContractError(f"predict: {seen}, expected one Prediction for a batch of one")
    prediction = answers[0]
    if not isinstance(prediction, Prediction):
        raise ContractError(f"predict: a {type(prediction).__name__}, expected Prediction")
    for hypothesis in prediction.hypotheses:
        for part in ("extents", "shape", "score"):
            if getattr(hypothesis, part) is not None and part not in info.gives:
                raise ContractError(
                    f"hypothesis: {part} is given, but info.gives is {sorted(info.gives)}; declare"
                    " what is given, or it would not be judged"
                )
            if part in info.gives:
                _declared(getattr(hypothesis, part), part)
    return prediction


def measure(
    refs: Sequence[SampleRef],
    truths: Sequence[GroundTruth],
    predictions: Sequence[Prediction],
    info: MethodInfo,
) -> list[Row]:
    """The errors of each prediction's best hypothesis; frames are converted as ``info`` declares.

    Raises :class:`ContractError` for a hypothesis without the shape that ``info`` declares.
    """
    rows: list[Row | None] = []
    groups: dict[Symmetry, list[int]] = defaultdict(list)
    best: dict[int, Hypothesis] = {}
    for index, (ref, truth, prediction) in enumerate(zip(refs, truths, predictions, strict=True)):
        rows.append(None)
        if prediction.hypotheses:
            best[index] = to_standard(prediction.hypotheses[0], info)
            groups[truth.symmetry].append(index)
        else:
            shape = "shape" in info.gives and truth.surface is not None
            rows[index] = failed_row(ref, prediction.reason, "extents" in info.gives, shape)
    for symmetry, members in groups.items():
        estimates, true = [best[i] for i in members], [truths[i] for i in members]
        rotations = np.stack([h.rotation for h in estimates])
        translations = np.stack([h.translation for h in estimates])
        true_rotations = np.stack([t.pose.rotation for t in true])
        true_translations = np.stack([t.pose.translation for t in true])
        angles = np.degrees(rotation_error(rotations, true_rotations, symmetry))
        distances = translation_error(translations, true_translations)
        ious: Sequence[float | None] = [None] * len(members)
        if "extents" in info.gives:
            extents = np.stack([_declared(h.extents, "extents") for h in estimates])
            true_extents = np.stack([t.extents for t in true])
            true_box = true_rotations, true_translations, true_extents
            ious = symmetric_iou(rotations, translations, extents, *true_box, symmetry).tolist()
        for i, distance, angle, iou in zip(members, distances, angles, ious, strict=True):
            fscore = _fscore(truths[i], best[i]) if "shape" in info.gives else None
            rows[i] = Row(
                refs[i].id,
                refs[i].category,
                float(distance),
                float(angle),
                iou,
                fscore,
                estimate=encode_estimate(best[i]),
            )
    return [row for row in rows if row is not None]


def _declared(value: Any, part: str) -> Any:
    if value is None:
        raise ContractError(
            f"hypothesis: {part} is None, but info.gives has {part!r}; give it or do not declare it"
        )
    return value


def _fscore(truth: GroundTruth, estimate: Hypothesis) -> float | None:
    if truth.surface is None:
        return None
    errors = surface_errors(
        _truth_surface(_Same(truth.surface)),
        # another seed than the truth's: two samplings of one mesh must not coincide
        Surface.of(_declared(estimate.shape, "shape"), seed=1),
        truth_pose=truth.pose,
        estimated_pose=estimate.pose,
    )
    return float(errors.fscore(FSCORE_DISTANCE))


def failed_row(ref: SampleRef, reason: str | None, box: bool, shape: bool) -> Row:
    """The row of a sample without an answer: correct under no threshold."""
    return Row(
        ref.id,
        ref.category,
        FAILED["position_m"],
        FAILED["rotation_deg"],
        FAILED["iou"] if box else None,
        FAILED["fscore"] if shape else None,
        failure=reason,
    )


@dataclass(frozen=True, eq=False)
class _Same:
    """A surface as a key of a cache: equal if it is the same object."""

    surface: Mesh | Array

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.surface is other.surface

    def __hash__(self) -> int:
        return id(self.surface)


@functools.lru_cache(maxsize=256)
def _truth_surface(same: _Same) -> Surface:
    return Surface.of(same.surface, seed=0)
