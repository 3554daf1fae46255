"""The index of a tree: made once, kept in the user's cache, made again when the tree has changed.

A scan of a tree notes every folder that it lists, and every file that it reads or whose size or
presence decides something, with times and size. An index is used only while all of these are the
same. A folder's times change when an entry is added, removed or renamed, and a file's ctime
whenever it is written, so that what is not caught is an image overwritten in place, which is read
anew for every sample anyway.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from pytest_cpas._files import cache_folder, write_file
from pytest_cpas.reading.files import read_bytes
from pytest_cpas.reading.images import image_size
from pytest_cpas.reading.paths import names
from pytest_cpas.reading.structured import parse_json
from pytest_cpas.types import ContractError, Derived, SampleRef

#: The packages whose code decides what is listed of every tree.
_ROOMS = ("datasets", "reading")

#: Largest annotation or mesh, bytes.
_LARGEST = 2**30

#: Largest annotation, bytes: that of one frame, or of a scene.
_LARGEST_TEXT = 2**26

#: Seconds. A tree changed so recently may change again without its times telling.
SETTLED = 2.0

#: Per path: times and size, or None where there is nothing.
Stamps = dict[str, list[int] | None]


class Index(NamedTuple):
    """What a scan found. ``details``: per sample, in order, what its loader needs, as JSON.
    ``derived``: the fields of each :class:`Derived`, lists for sets."""

    samples: list[SampleRef]
    details: list[Any]
    missing: list[str]
    damaged: list[str]
    absent: list[str]
    derived: list[Any]
    digest: str


class Scan:
    """Looks at a tree, remembers at what, and collects what is found.

    Paths are relative to the tree's root, with ``/``.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.missing: list[str] = []
        self.damaged: list[str] = []
        self.absent: list[str] = []
        self.stamps: Stamps = {}
        self._samples: list[SampleRef] = []
        self._details: list[Any] = []
        self._lacking: dict[str, list[str]] = defaultdict(list)
        self._shapeless: Counter[str] = Counter()
        self._derived: dict[Derived, list[str]] = defaultdict(list)
        self._ids: set[str] = set()
        self._names: dict[str, set[str]] = {}
        self._digest = hashlib.sha256()

    def names(self, folder: str) -> set[str]:
        """What a folder holds; nothing if there is no such folder."""
        if folder not in self._names:
            self.see(folder)
            self._names[folder] = names(self.root / folder)
        return self._names[folder]

    def has(self, path: str) -> bool:
        """Whether a folder lists this entry."""
        folder, _, name = path.rpartition("/")
        return name in self.names(folder)

    def read(self, path: str, most: int = _LARGEST_TEXT) -> bytes:
        """A file's bytes, at most so many, which become part of the digest."""
        self.see(path)
        content = read_bytes(self.root / path, most)
        self._digest.update(content)
        return content

    def hash(self, path: str) -> None:
        """Make a file part of the digest; if it cannot be read, loading a sample will say so."""
        with suppress(ContractError):
            self.read(path, _LARGEST)

    def read_json(self, path: str) -> dict[str, Any]:
        """A JSON file that holds an object."""
        content: dict[str, Any] = parse_json(self.root / path, self.read(path))
        return content

    def weigh(self, path: str, name: str = "") -> None:
        """Add a file's path and size, which are had without reading it, to the digest; ``name``:
        its path in the published layout, where people have others."""
        stamp = self.see(path)
        self.note(f"{name or path} {stamp and stamp[-1]}\n")

    def image_size(self, path: str) -> tuple[int, int]:
        """Width and height of an image, which is not decoded."""
        self.weigh(path)
        return image_size(self.root / path)

    def note(self, text: str) -> None:
        """Add ``text`` to the digest."""
        # names of files that are no text, and texts that name no file
        self._digest.update(text.encode("utf-8", "surrogatepass"))

    def add(self, ref: SampleRef, detail: Any) -> None:
        """A sample, and what its loader needs, as JSON values; an id that is there twice is
        damage, and the first one stays."""
        if ref.id in self._ids:
            self.damaged.append(f"{self.root}: sample {ref.id!r} is listed twice")
            return
        self._ids.add(ref.id)
        self._samples.append(ref)
        self._details.append(detail)

    def lacks(self, kind: str, where: str) -> None:
        """Something of ``kind`` is not there for ``where``; each kind is told once."""
        self._lacking[kind].append(where)

    def derives(self, derived: Derived, sample: str) -> None:
        """A part of this listed sample is made by the reader."""
        self._derived[derived].append(sample)

    def lacks_shape(self, mesh: str) -> None:
        """A sample is listed, but this file, its mesh, is not there; each file is told once."""
        self._shapeless[mesh] += 1

    def index(self) -> Index:
        """What was found."""
        lacking = [
            f"{len(where)} {kind}, first {where[0]}: left out"
            for kind, where in sorted(self._lacking.items())
        ]
        lacking += [
            f"mesh {mesh}: shape metrics of {count} samples are n/a"
            for mesh, count in sorted(self._shapeless.items())
        ]
        return Index(
            self._samples,
            self._details,
            lacking + self.missing,
            self.damaged,
            self.absent,
            [
                [each.part, sorted(each.made_of), each.how, ids if self._ids - {*ids} else None]
                for each, ids in self._derived.items()
            ],
            self._digest.hexdigest(),
        )

    def see(self, path: str) -> list[int] | None:
        """Make a new index when this file or folder changes."""
        self.stamps[path] = _stamp(self.root, path)
        return self.stamps[path]


def read_index(
    name: str, root: Path, scan: Callable[[Scan], None], sources: Iterable[str]
) -> Index:
    """The index of the tree at ``root``, from the cache if nothing has changed since.

    ``sources``: the files whose code decides what ``scan`` finds, beside :data:`_ROOMS`. A
    cache that cannot be written is done without.
    """
    key = hashlib.sha256(os.fsencode(root.resolve())).hexdigest()[:24]
    file = cache_folder() / "index" / f"{name}-{key}.json"
    code = hashlib.sha256()
    package = Path(__file__).parents[1]
    ours = (path for room in _ROOMS for path in (package / room).glob("*.py"))
    for source in sorted({*map(str, ours), *sources}):
        code.update(read_bytes(Path(source)))
    recipe = code.hexdigest()
    kept = _read_kept(file, root, recipe)
    if kept is not None:
        return kept
    began = time.time()
    seen = Scan(root)
    scan(seen)
    index = seen.index()
    latest = max((max(stamp[:2]) for stamp in seen.stamps.values() if stamp), default=0)
    if latest / 1e9 < began - SETTLED:
        with suppress(OSError):
            _keep(file, index, seen.stamps, recipe)
    return index


def _stamp(root: Path, path: str) -> list[int] | None:
    try:
        status = os.stat(root / path)
    except (OSError, ValueError):  # of what is no name of a file
        return None
    return [status.st_mtime_ns, status.st_ctime_ns, status.st_size]


def _read_kept(file: Path, root: Path, recipe: str) -> Index | None:
    try:
        kept = parse_json(file, read_bytes(file, _LARGEST))
        if kept.pop("recipe") != recipe:
            return None
        stamps: Stamps = kept.pop("stamps")
        samples = [
            SampleRef(id=name, category=category, scene=scene, model=model)
            for name, category, scene, model in kept.pop("samples")
        ]
        index = Index(samples=samples, **kept)
    except (ValueError, TypeError, AttributeError, KeyError):
        return None  # never kept, or torn: it is made again
    if all(_stamp(root, path) == stamp for path, stamp in stamps.items()):
        return index
    return None


def _keep(file: Path, index: Index, stamps: Stamps, recipe: str) -> None:
    content = index._asdict()
    content["samples"] = [dataclasses.astuple(ref) for ref in index.samples]
    write_file(file, json.dumps({**content, "stamps": stamps, "recipe": recipe}))
