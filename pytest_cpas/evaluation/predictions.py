"""Stored predictions as input: what somebody else's run of a method gave.

Three forms are read, all with the field's keys (``gt_class_ids``, ``gt_bboxes``, ``gt_RTs``,
``gt_scales``, ``pred_class_ids``, ``pred_bboxes``, ``pred_scores``, ``pred_RTs``, ``pred_scales``;
poses are 4 x 4, rotation times scale, in NOCS object axes):

* a pickle ``results_*_scene_S_NNNN.pkl`` of one frame, or a folder of them;
* an ``.npz`` with the rows of all frames one after the other, ``frame`` (their names) and
  ``gt_offset`` / ``pred_offset`` (where each frame's rows begin).

The detections of a frame are assigned to its ground truth per class, one to one, by descending
2-D box IoU, at least 0.5. A ground truth without a detection counts as not correct.
"""

from __future__ import annotations

import functools
import hashlib
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.datasets.nocs import symmetry_of
from pytest_cpas.evaluation.frames import (
    REQUIRED,
    Frame,
    assign_detections,
    detection_order,
    read_frames,
)
from pytest_cpas.evaluation.measuring import measure
from pytest_cpas.evaluation.rows import Row
from pytest_cpas.evaluation.runs import Run, SampleError, Selection
from pytest_cpas.facts import Detected, pair_table
from pytest_cpas.protocols import Protocol, Ranking, facts_of, rank, ranking_columns
from pytest_cpas.types import (
    CATEGORIES,
    AnswerError,
    Array,
    ContractError,
    DataError,
    GroundTruth,
    Hypothesis,
    MethodInfo,
    Pose,
    Prediction,
    SampleRef,
    Symmetry,
)
from pytest_cpas.types._arrays import frozen_array
from pytest_cpas.types.datasets import STORED
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET, permute_extents, to_standard


def _posed_box(scaled: NDArray[Any], relative: NDArray[Any]) -> tuple[Array, Array, Array]:
    """Rotation (3, 3), translation (3,) and extents (3,), metres, of a (4, 4) similarity and a box
    relative to its scale."""
    scaled = frozen_array(scaled, (4, 4), "the pose")
    if not np.allclose(scaled[3], (0, 0, 0, 1), rtol=0, atol=1e-6):
        raise DataError(
            f"the pose's last row is {scaled[3].tolist()}, expected 0, 0, 0, 1; is it transposed?"
        )
    determinant = float(np.linalg.det(scaled[:3, :3]))
    if not determinant > 0:
        raise DataError(
            f"the pose has determinant {determinant:g}, expected the cube of a positive scale"
        )
    scale = np.cbrt(determinant)
    extents = frozen_array(relative, (3,), "the scales") * scale
    return scaled[:3, :3] / scale, scaled[:3, 3], extents


def _digest_of_truths(frames: Mapping[str, Frame]) -> str:
    """That of the ground truth of all frames, whatever their order in the file."""
    digest = hashlib.sha256()
    for name in sorted(frames):
        for key in REQUIRED:
            if key.startswith("gt"):
                digest.update(np.ascontiguousarray(frames[name][key]).tobytes())
    return digest.hexdigest()


class StoredRun(Run):
    """Stored predictions, judged like the run of a method."""

    def __init__(
        self,
        path: Path,
        *,
        selection: Selection | None = None,
        protocols: Sequence[Protocol] | None = None,
    ) -> None:
        """Read the file or folder; nothing is judged yet."""
        self._frames: dict[str, Frame] = {}
        self._places: dict[str, tuple[str, int]] = {}
        #: The truths of samples that were judged, which are not made twice.
        self._truths: dict[str, GroundTruth] = {}
        samples = []
        for name, frame in read_frames(path):
            if not name:
                raise DataError(f"{path}: a frame has no name")
            scene, _, number = name.rpartition("_")
            if name in self._frames:
                raise DataError(f"{path}: frame {name} occurs twice")
            self._frames[name] = frame
            for index, class_id in enumerate(frame["gt_class_ids"].tolist()):
                ref_id = f"{scene}/{number}/gt{index}" if scene else f"{number}/gt{index}"
                try:
                    category = CATEGORIES[class_id - 1]
                    ref = SampleRef(id=ref_id, category=category, scene=scene or number)
                except ContractError as error:
                    raise DataError(f"{path}, frame {name!r}: {error}") from None
                if ref_id in self._places:
                    other = self._places[ref_id][0]
                    raise DataError(f"{path}: frames {other} and {name} give one id, {ref_id}")
                self._places[ref_id] = name, index
                samples.append(ref)
        super().__init__(
            re.sub(r"[^A-Za-z0-9._-]", "-", path.stem if path.is_file() else path.name),
            STORED,
            samples,
            selection=selection,
            identity={"data": _digest_of_truths(self._frames)},
            protocols=protocols,
        )
        self.info: MethodInfo = MethodInfo(
            name=self.method,
            categories=CATEGORIES,
            needs=frozenset(),
            gives=frozenset({"extents"}),
            licence="unknown",
            object_frame="nocs",
        )

    def judge(self, ref: SampleRef) -> Row:
        """The row of one ground truth; raises :class:`SampleError` for a broken pose."""
        row = self._rows[ref.id]
        if isinstance(row, ContractError):
            raise SampleError(f"{self.method}, sample {ref.id} ({ref.category}): {row}")
        return row

    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about one sample."""
        known = self._truths.get(ref.id)
        return self._pair(ref)[0] if known is None else known

    def ranking(self) -> Ranking | None:
        """All detections of the frames, ranked; None of a part of the samples, or without scores.

        A detection whose pose is none is never right.
        """
        columns = ranking_columns(self.protocols)
        if len(self.samples) < sum(self.listed.values()) or any(
            "pred_scores" not in frame for frame in self._frames.values()
        ):
            return None
        detected = [each for name in self._frames for each in self._detected(name)]
        truths = [(self._places[ref.id][0], ref.category, self.truth(ref)) for ref in self.samples]
        pairs = pair_table(facts_of(columns), detected, truths, self.info.gives)
        return rank(columns, pairs)

    def _detected(self, name: str) -> Iterator[Detected]:
        """The detections of a frame, whatever their order in the file: each is called by its frame,
        its category and its 2-D box in whole pixels, those that share all three are numbered."""
        frame = self._frames[name]
        called: Counter[str] = Counter()
        for index in detection_order(frame).tolist():
            category = CATEGORIES[int(frame["pred_class_ids"][index]) - 1]
            box = "_".join(f"{pixel:.0f}" for pixel in frame["pred_bboxes"][index].tolist())
            own = f"{name}/{category}/{box}"
            called[own] += 1
            yield Detected(
                name=own if called[own] == 1 else f"{own}+{called[own]}",
                image=name,
                category=category,
                score=float(frame["pred_scores"][index]),
                hypothesis=self._hypothesis(name, index),
            )

    def _hypothesis(self, name: str, index: int) -> Hypothesis | None:
        """A detection of a frame in the standard frames; None where its pose is none."""
        try:
            return to_standard(self._estimate(name, index), self.info)
        except ContractError:
            return None

    @functools.cache  # noqa: B019 - lives as long as the run
    def _estimate(self, name: str, index: int) -> Hypothesis:
        """A stored detection as it is; :class:`ContractError` where its pose is none."""
        frame = self._frames[name]
        rotation, translation, extents = _posed_box(
            frame["pred_RTs"][index], frame["pred_scales"][index]
        )
        return Hypothesis(rotation=rotation, translation=translation, extents=extents)

    @functools.cached_property
    def _rows(self) -> dict[str, Row | ContractError]:
        """All at once: measuring in bulk is what makes large files quick."""
        rows: dict[str, Row | ContractError] = {}
        pairs: dict[SampleRef, tuple[GroundTruth, Prediction]] = {}
        for ref in self.samples:
            try:
                pairs[ref] = self._pair(ref)
            except ContractError as error:
                rows[ref.id] = error
        truths = [truth for truth, _ in pairs.values()]
        self._truths = dict(zip((ref.id for ref in pairs), truths, strict=True))
        predictions = [prediction for _, prediction in pairs.values()]
        answers = measure(self.facts, truths, predictions, self.info)
        for ref, answer in zip(pairs, answers, strict=True):
            rows[ref.id] = Row(sample=ref.id, category=ref.category, answers=(answer,))
        return rows

    def _pair(self, ref: SampleRef) -> tuple[GroundTruth, Prediction]:
        name, index = self._places[ref.id]
        frame = self._frames[name]
        try:
            rotation, translation, extents = _posed_box(
                frame["gt_RTs"][index], frame["gt_scales"][index]
            )
            truth = GroundTruth(
                pose=Pose(rotation @ NOCS_FROM_SHAPENET, translation),
                extents=permute_extents(extents, NOCS_FROM_SHAPENET.T),
                symmetry=symmetry_of(ref.category),
                symmetry_in_view=self._symmetry_in_view(frame, index, ref.category),
            )
        except ContractError as error:
            raise DataError(f"ground truth: {error}") from None
        detection = int(self._assigned(name)[index])
        if detection < 0:
            return truth, Prediction.failed("not detected")
        try:
            return truth, Prediction((self._estimate(name, detection),))
        except ContractError as error:
            raise AnswerError(f"prediction {detection} of {name}: {error}") from None

    def _symmetry_in_view(self, frame: Frame, index: int, category: str) -> Symmetry | None:
        """That of a mug whose handle is hidden, which the NOCS protocol takes for round."""
        visible = frame.get("gt_handle_visibility")
        hidden = category == "mug" and visible is not None and not visible[index]
        return Symmetry.about((0, 1, 0)) if hidden else None

    @functools.cache  # noqa: B019 - lives as long as the run
    def _assigned(self, name: str) -> NDArray[np.int64]:
        return assign_detections(self._frames[name])
