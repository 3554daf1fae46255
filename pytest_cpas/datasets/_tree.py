"""What all data sets on disk share."""

from __future__ import annotations

import functools
import inspect
from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pytest_cpas.datasets._index import Scan, read_index
from pytest_cpas.datasets.sources import how_to_get
from pytest_cpas.reading.images import read_depth, read_ids, read_rgb
from pytest_cpas.types import Dataset, Derived, GroundTruth, SampleRef


class Tree(Dataset):
    """A data set below the folder ``root``: listed from its index, read sample by sample.

    An image is decoded once for the objects of its frame.
    """

    #: Whether an image has several objects: then an id ends with the object's place in its image.
    several = True

    #: What is derived of all samples; :meth:`Scan.derives` tells of some.
    all_derived: Sequence[Derived] = ()

    def __init__(self, name: str, root: Path) -> None:
        """List the samples."""
        self.name = name
        self.root = root
        sources = [inspect.getfile(kind) for kind in type(self).__mro__ if issubclass(kind, Tree)]
        index = read_index(name, root, self.scan, sources)
        self.samples = index.samples
        self.missing = index.missing
        self.damaged = index.damaged
        self.absent = frozenset(index.absent)
        self.derived = (
            *self.all_derived,
            *(
                Derived(
                    part=part,
                    made_of=frozenset(made_of),
                    how=how,
                    samples=None if ids is None else frozenset(ids),
                )
                for part, made_of, how, ids in index.derived
            ),
        )
        self.digest = index.digest
        self._details: dict[str, Any] = {
            ref.id: detail for ref, detail in zip(index.samples, index.details, strict=True)
        }
        self._read_rgb = functools.lru_cache(maxsize=2)(read_rgb)
        self._read_depth = functools.lru_cache(maxsize=2)(read_depth)
        self._read_ids = functools.lru_cache(maxsize=2)(read_ids)

    @abstractmethod
    def scan(self, scan: Scan) -> None:
        """List the samples of the tree to ``scan``."""

    def image_of(self, ref: SampleRef) -> str:
        """The image that a sample is in."""
        return ref.id.rpartition("/")[0] if self.several else ref.id

    @abstractmethod
    def truth(self, ref: SampleRef) -> GroundTruth:
        """The truth about a sample; :class:`DataError` names what is damaged."""


def find_root(name: str, data_dir: Path | None, mark: str, *folders: str) -> Path:
    """``data_dir``, or a folder in it called ``name`` or one of ``folders``, that holds ``mark``.

    Raises :class:`FileNotFoundError` that says how to get the data set ``name``.
    """
    return find_marked(name, data_dir, [mark], *folders)[0]


def find_marked(
    name: str, data_dir: Path | None, marks: Sequence[str], *folders: str
) -> tuple[Path, str]:
    """As :func:`find_root`, of a data set that people have in several layouts: the first of
    ``marks`` that there is tells which one, and is given back as well."""
    roots = [] if data_dir is None else [data_dir, *(data_dir / n for n in (name, *folders))]
    for root in roots:
        for mark in marks:
            if (root / mark).exists():
                return root, mark
    lack = f"no {' or '.join(marks)} in {data_dir}"
    if data_dir is None:
        lack = f"{name} needs a folder (--cpas-data)"
    raise FileNotFoundError(f"{lack}.\n{how_to_get(name)}")
