"""What a file of predictions says of its images, whatever its form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.types import Array, Mesh, Symmetry

__all__ = ["Answers", "Image", "Objects", "Submission", "Truths", "relative_extents"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Objects:
    """Objects of an image.

    ``class_ids`` (n,): places, from 1, in the submission's classes; 0 of an answer that has none,
    and is about the only object of its image. ``poses`` (n, 4, 4): object to camera, OpenCV axes,
    metres; the rotation may have a scale as a factor. ``extents`` (n, 3): side lengths of the box,
    metres, None where a form has none. ``boxes`` (n, 4): y1, x1, y2, x2 in pixels, None likewise.
    """

    class_ids: NDArray[np.int64]
    poses: Array
    extents: Array | None = None
    boxes: Array | None = None

    def __len__(self) -> int:
        return len(self.class_ids)


@dataclass(frozen=True, eq=False, kw_only=True)
class Truths(Objects):
    """The objects that are in an image, as the file has it.

    ``visible_handles`` (n,): whether a mug's handle is seen; None where the file does not say.
    ``symmetries`` (n,), None likewise: they are those of the category then.
    """

    visible_handles: NDArray[np.bool_] | None = None
    symmetries: Sequence[Symmetry] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Answers(Objects):
    """The answers about an image.

    Which object one is about is said by ``samples`` (n,), the ids of the data set, empty of what is
    no sample's but was found all the same; or by ``truths``
    (n,), the row among the file's own truths, -1 for none; else by class and 2-D box, or by class
    and position where a form has no boxes. ``scores``
    (n,): larger is surer. ``shapes`` (n,): mesh or points (N, 3) in the object frame, metres, or
    None. ``reasons`` (n,): why there is no answer, None where there is one. ``ranks`` (n,): the
    place among the answers about one sample, the best is 0, where a form says so whatever their
    scores; a score of NaN is that of no answer at all.
    """

    samples: Sequence[str] | None = None
    truths: NDArray[np.int64] | None = None
    scores: Array | None = None
    shapes: Sequence[Mesh | Array | None] | None = None
    reasons: Sequence[str | None] | None = None
    ranks: NDArray[np.int64] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Image:
    """An image: its ``name`` in the file, empty where it has none, what was answered, and what is
    true as the file has it, None where it does not say."""

    name: str
    answers: Answers
    truths: Truths | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Submission:
    """A file of predictions, or a folder of them, that has been read.

    ``form``: what its form is called. ``classes``: the category of each class id. ``object_frame``:
    the axes of its poses and extents, as a method declares them. ``gives``: what its answers have
    beside the pose. ``notes``: what was noticed while it was read, for people. ``method``,
    ``dataset`` and ``provenance``: who answered what, and texts about it, empty where a form does
    not say.
    """

    path: Path
    form: str
    images: Sequence[Image]
    classes: Sequence[str]
    object_frame: Literal["shapenet", "nocs"]
    gives: frozenset[Literal["extents", "shape", "score"]]
    notes: Sequence[str] = field(default=())
    method: str = ""
    dataset: str = ""
    provenance: Mapping[str, str] = field(default_factory=dict)

    def category(self, class_id: int) -> str:
        """The category of a class id; empty of 0, which is none."""
        return self.classes[class_id - 1] if class_id else ""


def relative_extents(poses: Array, sizes: Array) -> Array:
    """Extents (n, 3), metres, of ``sizes`` (n, 3) that are relative to the scales in ``poses``
    (n, 4, 4). Of a pose without a scale they are what they are: NaN, 0 or negative."""
    with np.errstate(all="ignore"):
        extents: Array = sizes * np.cbrt(np.linalg.det(poses[:, :3, :3]))[:, None]
    return extents
