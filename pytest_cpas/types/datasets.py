"""What a data set is: samples in a stable order, each read when it is asked for."""

from __future__ import annotations

import functools
import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas._deprecation import deprecated
from pytest_cpas.types._arrays import Array
from pytest_cpas.types.derived import Derived
from pytest_cpas.types.errors import DataError, shown
from pytest_cpas.types.geometry import Camera
from pytest_cpas.types.samples import CATEGORIES, GroundTruth, Sample, SampleRef

__all__ = ["STORED", "Dataset", "WrappedDataset", "as_dataset"]

#: What the data set of stored predictions is called, which do not say what they were made on. No
#: other data set is called so.
STORED = "stored"


class Dataset(ABC):
    """A data set. Its class is called with the folder of ``--cpas-data``: a Path, or None.

    A subclass has :meth:`load` and sets, on the class or when it is made:

    * ``name``, str: what tables, results and golden files call it.
    * ``samples``, a sequence of :class:`SampleRef`: all of them, in an order that is the same in
      every process, made without opening an image, or from an index that is made once.
    * ``digest``, str: identifies the content that the samples are judged by, such as a hash of
      poses and meshes. Runs with other digests are not compared.
    * ``missing``, a sequence of str: what a partial copy lacks, one line each; ``()`` for nothing.
    * ``damaged``, a sequence of str: what could not even be listed, one line each; ``()`` for
      nothing. The run fails over it.

    The rest has a default:

    * ``absent``, a collection of ids: samples that are listed but whose images are not there, so
      that only their truth is known. No method is judged on them.
    * ``camera``, a :class:`Camera`: the one that took all images; None if there are several.
    * ``class_names``, a sequence of str: the categories of the class ids 1, 2, ... that files of
      predictions number them by.
    * ``published_axes``, an array (3, 3), and ``published_centres``, of arrays (3,) by category:
      object coordinates, metres, of the poses that the data set publishes, in which files of
      predictions are too, are ``published_axes`` times ours, plus the category's centre. None and
      ``{}`` where they are ours.
    * ``derived``, a sequence of :class:`Derived`: what is not published, but made of the rest by
      whoever reads the data set, such as masks that are rendered. It is named once, and no check
      holds it against what it is made of. ``()`` for nothing.
    * ``notes``, a sequence of str: what people should know of it beside that, one line each.
    * ``quick_truth``, bool: :meth:`truth` opens no image. True where a subclass has a ``truth`` of
      its own, unless it says otherwise.
    """

    name: str
    samples: Sequence[SampleRef]
    digest: str
    missing: Sequence[str]
    damaged: Sequence[str]
    absent: Collection[str] = frozenset()
    camera: Camera | None = None
    class_names: Sequence[str] = CATEGORIES
    derived: Sequence[Derived] = ()
    published_axes: Array | None = None
    published_centres: Mapping[str, Array] = MappingProxyType({})

    @property
    def notes(self) -> Sequence[str]:
        """What people should know of the data set, one line each; here nothing."""
        return ()

    @functools.cached_property
    def quick_truth(self) -> bool:
        """Whether :meth:`truth` opens no image."""
        return type(self).truth is not Dataset.truth

    @abstractmethod
    def load(self, ref: SampleRef) -> Sample:
        """Read one sample. Raises :class:`DataError` naming the file that is damaged."""

    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about one sample, of ``absent`` ones too; here that of the loaded sample.

        Raises :class:`DataError` naming the file that is damaged.
        """
        return self.load(ref).truth

    def image_of(self, ref: SampleRef) -> str:
        """The image that a sample is in, as files of predictions name it, such as
        ``scene_1/0000``; here that of a data set with one object an image: the sample's id."""
        return ref.id

    def fit_error(self, ref: SampleRef) -> float | None:
        """How well a fitted pose fits, metres: how far what it is fitted to is from where the posed
        model has it, of a few points the largest distance, of many the median. None, as here, where
        poses are published. Raises :class:`DataError` naming the file that is damaged."""
        return None

    def unseen(self, ref: SampleRef) -> str | None:
        """Why there is nothing that a method could be asked about a sample, which then counts as
        one without an answer, such as "not detected"; None, as here, where there is something."""
        return None

    def box_of(self, ref: SampleRef) -> Array | None:
        """The 2-D box (4,) of what is seen of an object: y1, x1, y2, x2 in pixels, the last row and
        column not part of it. None where only the truth is there. Here that of its mask.

        Raises :class:`DataError` naming the file that is damaged.
        """
        return None if ref.id in self.absent else mask_box(self.load(ref).observation.mask)


def mask_box(mask: NDArray[np.bool_]) -> Array:
    """The box (4,) of a mask (H, W): y1, x1, y2, x2 in pixels, the last ones not part of it."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return np.array([rows[0], columns[0], rows[-1] + 1, columns[-1] + 1], dtype=float)


class WrappedDataset(Dataset):
    """A data set that is another one, but for what a subclass makes different."""

    def __init__(self, dataset: Dataset) -> None:
        """Be like ``dataset`` in everything."""
        self._dataset = dataset
        self.name = dataset.name
        self.samples = dataset.samples
        self.digest = dataset.digest
        self.missing = dataset.missing
        self.damaged = dataset.damaged
        self.absent = dataset.absent
        self.camera = dataset.camera
        self.class_names = dataset.class_names
        self.derived = dataset.derived
        self.published_axes = dataset.published_axes
        self.published_centres = dataset.published_centres
        self.quick_truth = dataset.quick_truth

    @property
    def wrapped(self) -> Dataset:
        """The data set that this one is made of."""
        return self._dataset

    @property
    def notes(self) -> Sequence[str]:
        """What people should know of the data set."""
        return self._dataset.notes

    def load(self, ref: SampleRef) -> Sample:
        """Read one sample."""
        return self._dataset.load(ref)

    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about one sample."""
        return self._dataset.truth(ref)

    def image_of(self, ref: SampleRef) -> str:
        """The image that a sample is in."""
        return self._dataset.image_of(ref)

    def fit_error(self, ref: SampleRef) -> float | None:
        """How well a fitted pose fits, metres."""
        return self._dataset.fit_error(ref)

    def unseen(self, ref: SampleRef) -> str | None:
        """Why a method is not asked about a sample."""
        return self._dataset.unseen(ref)

    def box_of(self, ref: SampleRef) -> Array | None:
        """The 2-D box of what is seen of an object."""
        return self._dataset.box_of(ref)


def remember_maker(dataset: Dataset, make: Callable[..., Any]) -> None:
    """Remember the callable that has made a data set: its code counts, see :func:`readers_of`."""
    vars(dataset)["_made_by"] = inspect.unwrap(make)


def readers_of(dataset: Dataset) -> list[Callable[..., Any]]:
    """All whose code decides what the samples are: what made the data set, its class, and the same
    of those that it is made of."""
    readers = [vars(dataset).get("_made_by", type(dataset)), type(dataset)]
    if isinstance(dataset, WrappedDataset):
        wrapped: Any = dataset.wrapped
        readers += readers_of(wrapped) if isinstance(wrapped, Dataset) else [type(wrapped)]
    return [*dict.fromkeys(readers)]


def camera_of(dataset: Dataset, ref: SampleRef) -> Camera | None:
    """The camera of a sample's image, which is opened if there are several cameras; None where only
    the truth is there."""
    if dataset.camera is not None or ref.id in dataset.absent:
        return dataset.camera
    if dataset.unseen(ref) is None:
        return dataset.load(ref).observation.camera
    return camera_of(dataset.wrapped, ref) if isinstance(dataset, WrappedDataset) else None


#: What has no default.
_REQUIRED = ("name", "samples", "digest", "missing", "damaged", "load")


def as_dataset(made: Any, called: str = "") -> Dataset:
    """``made`` if it is a :class:`Dataset`; what only looks like one is wrapped, with a warning.

    ``called``: how it was asked for. Raises :class:`DataError` that says what it lacks, or that its
    name is taken.
    """
    kind = made if isinstance(made, type) else type(made)
    lacks = [part for part in _REQUIRED if not hasattr(made, part)]
    if lacks:
        seen = "the class itself" if made is kind else "made as"
        raise DataError(
            f"data set {called or kind.__name__!r}: {seen} {kind.__module__}.{kind.__qualname__},"
            f" which has no {', '.join(lacks)}; a data set is made by a class that inherits from"
            f" pytest_cpas.Dataset and has {', '.join(_REQUIRED)}"
        )
    if made.name == STORED:
        raise DataError(
            f"data set {called or kind.__name__!r} has the name {STORED!r}, which stands for the"
            " data set of stored predictions; give it another name"
        )
    _check_parts(made, called or kind.__name__)
    if isinstance(made, Dataset):
        return made
    deprecated(
        f"{kind.__module__}.{kind.__qualname__}, a data set that does not inherit from"
        " pytest_cpas.Dataset,",
        f"class {kind.__name__}(pytest_cpas.Dataset)",
        "0.3",
        stacklevel=2,
    )
    # of the module of its class, beside which the list of its known faults is
    adapted = type(kind.__name__, (_Adapted,), {"__module__": kind.__module__})
    dataset: Dataset = adapted(made)
    return dataset


def _check_parts(made: Any, called: str) -> None:
    """Raise :class:`DataError` for a part of a data set that is not of its kind."""
    for part in ("name", "digest"):
        if not isinstance(seen := getattr(made, part), str):
            raise DataError(f"data set {called!r}: {part} is {shown(seen)}, expected a text")
    kinds = {
        "samples": (SampleRef, "SampleRef"),
        "missing": (str, "texts"),
        "damaged": (str, "texts"),
    }
    for part, (kind, expected) in kinds.items():
        seen = getattr(made, part)
        if isinstance(seen, str) or not isinstance(seen, Sequence):
            raise DataError(
                f"data set {called!r}: {part} is {shown(seen)}, expected a sequence of {expected}"
            )
        for each in seen:
            if not isinstance(each, kind):
                raise DataError(
                    f"data set {called!r}: {part} has {shown(each)}, expected {expected}"
                )


class _Adapted(WrappedDataset):
    """What has the parts of a data set but does not inherit from it."""

    def __init__(self, made: Any) -> None:
        for part in _REQUIRED[:-1]:
            setattr(self, part, getattr(made, part))
        self._dataset = made
        self.absent = getattr(made, "absent", Dataset.absent)
        self.camera = getattr(made, "camera", None)
        self.derived = getattr(made, "derived", ())
        self.published_axes = getattr(made, "published_axes", None)
        self.published_centres = getattr(made, "published_centres", {})
        self._has_truth = hasattr(made, "truth")
        self.quick_truth = bool(getattr(made, "quick_truth", self._has_truth))

    notes = Dataset.notes
    image_of = Dataset.image_of
    fit_error = Dataset.fit_error
    unseen = Dataset.unseen
    box_of = Dataset.box_of

    def truth(self, ref: SampleRef) -> GroundTruth:
        return super().truth(ref) if self._has_truth else self.load(ref).truth
