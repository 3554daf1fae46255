"""The truth that a file of predictions brings itself, as a data set without images."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np

from pytest_cpas.datasets.nocs import symmetry_of
from pytest_cpas.submissions.answers import rigid
from pytest_cpas.submissions.frames import Submission, Truths
from pytest_cpas.types import (
    Array,
    ContractError,
    DataError,
    Dataset,
    GroundTruth,
    Pose,
    Sample,
    SampleRef,
    Symmetry,
)
from pytest_cpas.types.datasets import STORED
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET, permute_extents

__all__ = ["OwnTruth", "truth_of"]


def truth_of(submission: Submission, truths: Truths, index: int) -> GroundTruth:
    """One object of a file in the standard frames; :class:`DataError` for what is none."""
    category = submission.category(int(truths.class_ids[index]))
    try:
        rotation, translation = rigid(truths, index)
        if truths.extents is None:
            raise DataError("it has no size")
        extents = truths.extents[index]
        if submission.object_frame == "nocs":
            rotation = rotation @ NOCS_FROM_SHAPENET
            extents = permute_extents(extents, NOCS_FROM_SHAPENET.T)
        return GroundTruth(
            pose=Pose(rotation, translation),
            extents=extents,
            symmetry=truths.symmetries[index] if truths.symmetries else symmetry_of(category),
            symmetry_in_view=symmetry_in_view(truths, index, category),
        )
    except ContractError as error:
        raise DataError(f"ground truth: {error}") from None


def symmetry_in_view(truths: Truths, index: int, category: str) -> Symmetry | None:
    """That of a mug whose handle is hidden, which the NOCS protocol takes for round."""
    visible = truths.visible_handles
    hidden = category == "mug" and visible is not None and not visible[index]
    return Symmetry.about((0, 1, 0)) if hidden else None


def _digest(truths: Mapping[str, Truths | None]) -> str:
    """That of the truth about all images, whatever their order in the file."""
    digest = hashlib.sha256()
    for _, objects in sorted(truths.items()):
        if objects is not None:
            for values in (objects.class_ids, objects.boxes, objects.poses, objects.extents):
                if values is not None:
                    digest.update(np.ascontiguousarray(values).tobytes())
            for symmetry in objects.symmetries or ():
                axis = b"" if symmetry.axis is None else symmetry.axis.tobytes()
                digest.update(symmetry.rotations.tobytes() + axis + bytes([symmetry.sphere]))
    return digest.hexdigest()


class OwnTruth(Dataset):
    """What a file itself says is true. Nobody vouches for it but the file."""

    name = STORED
    quick_truth = True
    missing: Sequence[str] = ()
    damaged: Sequence[str] = ()

    def __init__(self, submission: Submission) -> None:
        """List the objects; :class:`DataError` for a file without any truth."""
        self._submission = submission
        self._places: dict[str, tuple[str, Truths, int]] = {}
        self.samples: list[SampleRef] = []
        self.class_names = submission.classes
        #: The number of each image in the submission.
        self.numbers: dict[str, int] = {}
        named = any(image.name for image in submission.images)
        names: dict[str, str] = {}
        path = submission.path
        if not any(image.truths is not None for image in submission.images):
            raise DataError(
                f"{path}: the file has no ground truth of its own; name the data set that it"
                " answers: --cpas-dataset=NAME --cpas-data=DIR"
            )
        for number, image in enumerate(submission.images):
            name = image.name if named else f"{number:04d}"
            if not name:
                raise DataError(f"{path}: image {number} has no name, others have")
            if name in self.numbers:
                raise DataError(f"{path}: frame {name} occurs twice")
            if image.truths is None:
                raise DataError(f"{path}: frame {name} has no ground truth, others have")
            scene, _, place = name.rpartition("/" if "/" in name else "_")
            at = f"{scene}/{place}" if scene else place
            if at in names:
                raise DataError(f"{path}: frames {names[at]} and {name} give one id, {at}")
            self.numbers[name] = number
            names[at] = name
            truths = image.truths
            for index, class_id in enumerate(truths.class_ids.tolist()):
                try:
                    ref = SampleRef(
                        id=f"{at}/gt{index}",
                        category=submission.category(class_id),
                        scene=scene or place,
                    )
                except ContractError as error:
                    raise DataError(f"{path}, frame {name!r}: {error}") from None
                self._places[ref.id] = name, truths, index
                self.samples.append(ref)
        self.absent = frozenset(self._places)
        self.digest = _digest(
            {name: submission.images[number].truths for name, number in self.numbers.items()}
        )

    def load(self, ref: SampleRef) -> Sample:
        """There are no images; raises :class:`DataError`."""
        raise DataError(f"{self._submission.path}: it has no images, so none of {ref.id}")

    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about a sample as the file has it; :class:`DataError` for what is none."""
        _, truths, index = self._places[ref.id]
        return truth_of(self._submission, truths, index)

    def image_of(self, ref: SampleRef) -> str:
        """The name of the image in the file."""
        return self._places[ref.id][0]

    def box_of(self, ref: SampleRef) -> Array | None:
        """The object's 2-D box (4,), y1, x1, y2, x2 in pixels, as the file has it."""
        _, truths, index = self._places[ref.id]
        return None if truths.boxes is None else truths.boxes[index]
