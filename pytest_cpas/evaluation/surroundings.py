"""The files around a program: what its code can reach by other ways than an import.

A method may execute a file, run it in another process, load a library by its path, read a table of
settings, or put a folder on ``sys.path`` while it runs. No import tells of that, so all files count
that it may run or read: those below the folder of the project that a module is in, those of
the distributions that are its own, and the files and folders that its text names. What is left out,
and where looking ends, is in docs/lab.md.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import os
import re
import tempfile
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from pytest_cpas.evaluation.kinds_of_files import CODE, READ, SETTINGS, TELLS, TOOLS
from pytest_cpas.reading.files import opened, sha256
from pytest_cpas.types import DataError, some_of

__all__ = [
    "WHOLE",
    "by_name",
    "changed_names",
    "changes",
    "digest_again",
    "digest_of_start",
    "digests_of",
    "files_around",
    "is_installed",
    "is_left_out",
    "leave_out",
    "left_out",
    "named",
    "piecewise_digest",
    "united",
]

_ARCHIVES = frozenset({".zip", ".egg", ".whl", ".pyz"})

#: What marks the folder of a project.
_MARKS = (".git", "pyproject.toml", "setup.py", "setup.cfg")

#: Folders that hold other people's code, or none.
_NEVER = frozenset({"__pycache__", "site-packages", "dist-packages", "node_modules", ".git"})

#: Folders that are about a method and no part of it, unless its text names them.
_ASIDE = frozenset({"tests", "test", "docs", "doc"})

#: Folders of the root that the system makes as it is asked.
_MADE = (("proc",), ("sys",), ("dev",))

#: What lies together in a folder that this plugin has written, or that is a virtual environment.
_WRITTEN = (
    frozenset({"report.html", "report.json"}),
    frozenset({"run.toml", "facts.csv"}),
    frozenset({"table.toml", "samples.csv"}),
    frozenset({"pyvenv.cfg"}),
    frozenset({"conda-meta"}),
)

#: Below one folder, nearest first: entries that are looked at, and files that count.
_MOST_ENTRIES, _MOST_FILES = 20_000, 2_000

#: Bytes of a file up to which all of it counts, and of all files together. Of a larger file its
#: size and some pieces count; beyond all of them, the size.
WHOLE, _ALL = 2**23, 2**28
_PIECES, _PIECE = 64, 2**16

#: How the digest of a file ends of which the size alone counts.
_UNREAD = " bytes"

#: Where a name that begins with ~, or is below Path.home(), begins.
_HOME = Path("~")

#: Longest text that may be a path, and what is none.
_LONGEST_PATH = 200
_NO_PATH = re.compile(r"[\0\n\t*?\"<>|{}$]|^\W*$")

#: Folders, and files, that are known by other digests, or are written by the run.
_left_out: set[Path] = set()


def leave_out(places: Iterable[Path]) -> None:
    """Do not look at these files, or into these folders: data and weights have digests of their
    own, results are written."""
    for folder in places:
        with suppress(OSError, RuntimeError):
            _left_out.add(folder.resolve())


def is_left_out(path: Path) -> bool:
    """Whether a file is one that :func:`leave_out` was told of, or in such a folder."""
    path = path.resolve()
    return not _left_out.isdisjoint((path, *path.parents))


def left_out() -> frozenset[Path]:
    """The folders of :func:`leave_out`."""
    return frozenset(_left_out)


def is_installed(path: Path) -> bool:
    """Whether a file belongs to a distribution that is installed, not to somebody's project."""
    return not {"site-packages", "dist-packages"}.isdisjoint(path.parts)


def files_around(
    own: Mapping[Path, str],
    texts: Mapping[Path, Collection[str]],
    distributions: Iterable[str],
    folder: Path,
) -> dict[Path, str]:
    """All files of a program, each with a name that does not depend on where it lies.

    ``own``: the modules that imports lead to, by name; ``texts``: what strings each of them has;
    ``distributions``: those that are installed and are the program's own; ``folder``: where
    the process was started.
    """
    look = _Look(own, texts, folder)
    for name in distributions:
        look.at_distribution(name)
    for path, module in own.items():
        if is_installed(path):
            look.found.setdefault(path, module)
            continue
        wide, base = _roots(path, module)
        look.name(path, wide)
        if module.partition(".")[0] != "pytest_cpas":  # whose imports are all there is
            look.into(wide)
            look.into(base, within=wide)
            look.at_names(path)
    return look.found


class _Look:
    """The files found so far, and what has been looked into."""

    def __init__(
        self, own: Mapping[Path, str], texts: Mapping[Path, Collection[str]], folder: Path
    ) -> None:
        self.found: dict[Path, str] = {}
        self._own, self._texts, self._folder = own, texts, folder
        self._holding = {folder for path in own for folder in path.parents}
        self._words = {
            part for parts in texts.values() for text in parts for part in re.split(r"[/\\]", text)
        }
        self._seen: set[tuple[Path, re.Pattern[str] | None]] = set()
        self._tried: set[Path] = set()

    def name(self, path: Path, root: Path) -> None:
        """Take a file in, under its name below ``root``."""
        self.found.setdefault(path, path.relative_to(root).as_posix())

    def into(
        self, root: Path, *, within: Path | None = None, only: re.Pattern[str] | None = None
    ) -> None:
        """Take in what counts below a folder, as far as that is looked at: the nearest first.

        Names are relative to ``within``, or to ``root``; ``only``: what counts by its name.
        """
        if (root, only) in self._seen:
            return
        self._seen.add((root, only))
        behind_link = only is SETTINGS
        entries = files = others = 0
        level = [root]
        while level:
            below = []
            for folder in level:
                there = _entries(folder)
                names = {entry.name for entry in there}
                if folder not in self._holding and any(some <= names for some in _WRITTEN):
                    continue
                entries += len(there)
                for entry in there:
                    path = Path(entry.path)
                    if _is_folder(entry) and not (behind_link and entry.is_symlink()):
                        below += [path] if self._is_entered(path) else []
                    elif only is None and _is_link_to_data(entry) and self._is_entered(path):
                        # where it leads to, and the settings there
                        self.name(path, within or root)
                        self.into(path, within=within or root, only=SETTINGS)
                    elif not self._counts(path) or not _is_file(entry):
                        continue
                    elif (only or READ).fullmatch(path.name):
                        self.name(path, within or root)
                        files += 1
                    elif not behind_link and others < _MOST_FILES and self._is_read(path):
                        # they take no place from code and settings
                        self.name(path, within or root)
                        others += 1
                if entries > _MOST_ENTRIES or files > _MOST_FILES:
                    return
            level = [] if root in _everybodys() else below

    def at_names(self, module: Path) -> None:
        """Take in the files and folders that the text of a module names: from the folder it is in,
        from where the process was started, or from the root of the file system."""
        for text in self._texts.get(module, ()):
            if len(text) > _LONGEST_PATH or _NO_PATH.search(text):
                continue
            for start in (module.parent, self._folder, _HOME):
                path = start / text.removeprefix("~/")
                if path in self._tried:
                    continue
                self._tried.add(path)
                with suppress(OSError, ValueError, RuntimeError):
                    self._at_name(path.expanduser(), text, start)

    def _at_name(self, path: Path, text: str, start: Path) -> None:
        if path.is_file():
            self.found.setdefault(path.resolve(), text)
        elif path.is_dir() and start != _HOME:  # where folders are everybody's
            path = path.resolve()
            if (
                self._is_entered(path)
                and path not in _everybodys()
                and path.parts[1:2] not in _MADE
            ):
                self.into(path, only=CODE)

    def at_distribution(self, name: str) -> None:
        """Take in what counts of the files that were installed with a distribution."""
        for file in importlib.metadata.files(name) or ():
            path = Path(str(file.locate()))
            counts = READ.fullmatch(path.name) or self._is_read(path)
            if counts and _NEVER.isdisjoint(file.parts) and path.is_file():
                self.found.setdefault(path.resolve(), file.as_posix())

    def _is_entered(self, folder: Path) -> bool:
        name = folder.name
        if folder in self._holding:
            return True
        if name in _NEVER or folder in _left_out or folder.resolve() in _left_out:
            return False
        return (name not in _ASIDE and not name.startswith(".")) or name in self._words

    def _is_read(self, path: Path) -> bool:
        """Whether a file that is neither code nor settings by its name may be read by code."""
        return path.name in self._words or not TELLS.fullmatch(path.name)

    def _counts(self, path: Path) -> bool:
        if path in self._own or path.name in self._words:
            return True
        return not TOOLS.fullmatch(path.name) and path not in _left_out


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return sorted(entries, key=lambda entry: entry.name)
    except OSError:
        return []


def _is_folder(entry: os.DirEntry[str]) -> bool:
    """Whether it is a folder; a link to one is if there is code in it: others lead to data."""
    if entry.is_symlink():
        linked = os.path.isdir(entry.path)
        return linked and any(seen.name.endswith(".py") for seen in _entries(Path(entry.path)))
    return entry.is_dir()


def _is_link_to_data(entry: os.DirEntry[str]) -> bool:
    if not entry.is_symlink() or not os.path.isdir(entry.path):
        return False
    # pytest's NAME-current leads to the last NAME0, NAME1, ... that a test was given
    name, current, rest = entry.name.rpartition("-current")
    return not (current and not rest and Path(os.readlink(entry.path)).name.startswith(name))


def _is_file(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_file()
    except OSError:
        return False


@functools.cache
def _everybodys() -> frozenset[Path]:
    """Folders that are nobody's project."""
    places = [Path(tempfile.gettempdir()).resolve()]
    with suppress(RuntimeError, OSError):
        places.append(Path.home().resolve().parent)
    return frozenset(folder for place in places for folder in (place, *place.parents))


def _roots(path: Path, module: str) -> tuple[Path, Path]:
    """The folder of the project that a module's file is in, and that of its outermost package, or
    of the file if it is in none."""
    levels = module.count(".") + (path.stem == "__init__")
    archive = path.suffix.lower() in _ARCHIVES
    base = path.parent if archive or not levels else path.parents[levels - 1]
    # what it is imported from, unless that is said otherwise
    start = base if base == path.parent and not levels else base.parent
    places = [start, *start.parents]
    theirs = [*_everybodys(), Path(os.path.realpath(os.path.expanduser("~")))]
    places = [place for place in places if place not in theirs]
    marked = [place for place in places if any((place / mark).exists() for mark in _MARKS)]
    repositories = [place for place in marked if (place / ".git").exists()]
    return [*repositories[-1:], *marked[:1], *places[:1], base][0], base


def digests_of(files: Mapping[Path, str]) -> dict[Path, str]:
    """A digest of each file that is there, or its size beyond what is read of all together."""
    sizes = {path: size for path in files if (size := _size(path)) is not None}
    digests = {}
    total = 0
    for path in sorted(
        sizes, key=lambda path: (not READ.fullmatch(path.name), sizes[path], files[path])
    ):
        total += min(sizes[path], WHOLE)
        digests[path] = _told_size(sizes[path]) if total > _ALL else _digest(path, sizes[path])
    return digests


def digest_again(path: Path, told: str) -> str:
    """What :func:`digests_of` says of a file now of which it said ``told``."""
    size = _size(path)
    if size is None:
        return "gone"
    return _told_size(size) if told.endswith(_UNREAD) else _digest(path, size)


def by_name(files: Mapping[Path, str], digest_of: Mapping[Path, str]) -> dict[str, str]:
    """The digest of each file by name; of those of the same name together."""
    digests = defaultdict(list)
    for path, name in files.items():
        if path in digest_of:
            digests[name].append(digest_of[path])
    return {name: " ".join(sorted(set(told))) for name, told in sorted(digests.items())}


def digest_of_start(path: Path, size: int) -> str:
    """What :func:`digests_of` would say of the first ``size`` bytes of a file, of at most
    :data:`WHOLE`."""
    try:
        with opened(path, 2**50) as file:
            return hashlib.sha256(file.read(size)).hexdigest()[:16]
    except (DataError, OSError):
        return "unreadable"


def _told_size(size: int) -> str:
    return f"{size}{_UNREAD}"


def _size(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except OSError:
        return None


def _digest(path: Path, size: int) -> str:
    try:
        if path.is_dir():  # a link: what it says
            return hashlib.sha256(os.fsencode(os.readlink(path))).hexdigest()[:16]
        return sha256(path)[:16] if size <= WHOLE else piecewise_digest(path)
    except (DataError, OSError):
        return "unreadable"


def piecewise_digest(path: Path) -> str:
    """A digest of the size of a large file, and of pieces of it; :class:`OSError`,
    :class:`DataError`."""
    size = path.stat().st_size
    digest = hashlib.sha256(str(size).encode())
    with opened(path, 2**50) as file:
        for index in range(_PIECES):
            file.seek(max(index * (size - _PIECE), 0) // (_PIECES - 1))
            digest.update(file.read(_PIECE))
    return digest.hexdigest()[:16]


def united(*parts: Mapping[str, str]) -> dict[str, str]:
    """The digests of several programs, those of the same name together."""
    told: dict[str, set[str]] = defaultdict(set)
    for part in parts:
        for name, digest in part.items():
            told[name] |= {digest}
    return {name: " ".join(sorted(digests)) for name, digests in sorted(told.items())}


def changed_names(before: Mapping[str, str], now: Mapping[str, str]) -> Iterator[str]:
    """Which files are others, are new or are gone."""
    for name in sorted({*before, *now}):
        if name not in before:
            yield f"{name} (new)"
        elif name not in now:
            yield f"{name} (gone)"
        elif before[name] != now[name]:
            yield name


def changes(before: Mapping[str, str], now: Mapping[str, str]) -> Iterator[str]:
    """Which files are others, in words: at most three of each kind are named."""
    kinds = {
        "changed": sorted(name for name in before.keys() & now.keys() if before[name] != now[name]),
        "new": sorted(now.keys() - before.keys()),
        "gone": sorted(before.keys() - now.keys()),
    }
    for kind, names in kinds.items():
        if names:
            yield f"{kind}: {named(names)}"


def named(names: Collection[str]) -> str:
    """Names of files, in words: at most three."""
    return some_of(sorted(names))
