"""Which program answers: the sources of a method, what it runs on, and its revision.

Rows that one program computed say nothing of another one. :func:`program_of` follows the imports of
a method's module, without running any, through everything that is its own: its distribution, the
folders that it shares with others outside of ``site-packages``, extension modules, and the data
files beside a module that its text names. Other distributions are known by their versions. What
code reaches without an import is looked for in :mod:`pytest_cpas.evaluation.surroundings`.

What cannot be seen either way: files and modules elsewhere whose path or name is made while it
runs, the machine's libraries.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib
import importlib.machinery
import importlib.metadata
import inspect
import platform
import re
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any

from pytest_cpas.evaluation.elsewhere import (
    Start,
    installed_from_elsewhere,
    module_names,
    providers,
    values,
    variables,
)
from pytest_cpas.evaluation.kinds_of_files import may_grow
from pytest_cpas.evaluation.meanwhile import Seen, seen
from pytest_cpas.evaluation.surroundings import (
    WHOLE,
    by_name,
    digests_of,
    files_around,
    is_installed,
)
from pytest_cpas.reading.files import read_bytes, sha256

__all__ = ["UNKNOWN", "Program", "found_programs", "look_again", "program_of", "take_programs"]

#: Finders of Python itself, and modules of such that find what others do.
_OF_PYTHON = (
    importlib.machinery.BuiltinImporter,
    importlib.machinery.FrozenImporter,
    importlib.machinery.PathFinder,
)
_NO_OTHERS = ("_pytest.assertion.rewrite",)

#: The digest of a program whose sources are not on a disk.
UNKNOWN = "unknown"

#: Neither writes: describe --dirty has git's index refreshed, under a lock that a killed run would
#: leave behind.
_DESCRIBE = ("describe", "--always")
_STATUS = ("status", "--porcelain", "--untracked-files=no")

#: Seconds that git may take to tell the revision.
_PATIENCE = 10.0


@dataclass(frozen=True)
class Program:
    """A program that answers.

    ``code``: a digest of its sources, or :data:`UNKNOWN`; ``packages``: name and version of the
    distributions that they import; ``revision``: that of the git repository they are in, with
    ``+`` if it has changes, or ""; ``files``: a digest of each source, and of each file around them
    that may be run or read, by name; ``seen``: all of them as they were before they were read;
    ``start``: what the process knew when it looked for them.
    """

    code: str
    packages: str
    revision: str
    files: Mapping[str, str] = field(default_factory=dict)
    seen: Mapping[Path, Seen] = field(default_factory=dict, compare=False, repr=False)
    start: Start | None = field(default=None, compare=False, repr=False)

    def facts(self) -> Mapping[str, str]:
        """As provenance has it."""
        facts = {"code": self.code, "packages": self.packages, "revision": self.revision}
        return {name: fact for name, fact in facts.items() if fact}


#: By the names of what they are of: those that this process looked for, and those it was handed.
_found: dict[str, Program] = {}
_handed: dict[str, Program] = {}


@functools.cache
def program_of(*parts: type | Callable[..., object]) -> Program:
    """The program of classes and functions: their modules, those of bases, and what they import.

    Its code is unknown if that of a part is.
    """
    names = " ".join(_name_of(part) for part in parts)
    if names not in _handed:
        _found[names] = _look_for(names, parts, Start.now())
    return _handed.get(names) or _found[names]


def found_programs() -> dict[str, dict[str, Any]]:
    """The programs that were looked for, as plain values for :func:`take_programs`; whether they
    change is seen by this process alone."""
    return {name: asdict(replace(program, seen={}, start=None)) for name, program in _found.items()}


def look_again(before: Program, *parts: type | Callable[..., object]) -> Program:
    """As :func:`program_of` was ``before``, but of what the files are now.

    What the process was started with counts: a method may change its folder, put one of its own on
    ``sys.path``, or set variables, and is the same program.
    """
    start = before.start or Start.now()
    with start.imports():
        _distributions.cache_clear()
        return _look_for(" ".join(map(_name_of, parts)), parts, start)


def take_programs(known: Mapping[str, Mapping[str, Any]]) -> None:
    """Take over what another process of the same run has looked for."""
    _handed.update({name: Program(**program) for name, program in known.items()})


def _is_of_python(part: type | Callable[..., object]) -> bool:
    """Whether it is a class that Python's version tells."""
    return isinstance(part, type) and part.__module__ in sys.stdlib_module_names


def _name_of(part: type | Callable[..., object]) -> str:
    return f"{part.__module__}:{getattr(part, '__qualname__', repr(part))}"


def _look_for(names: str, parts: Sequence[type | Callable[..., object]], start: Start) -> Program:
    kinds = [kind for part in parts for kind in getattr(part, "__mro__", (part,))]
    modules = {kind.__module__ for kind in kinds if kind.__module__ != "builtins"}
    search = _Search()
    for module in sorted(modules):
        search.follow(module)
    search.follow_provided()
    sources = [_source_of(part) for part in parts if not _is_of_python(part)]
    known = [source for source in sources if source in search.files]
    if not known or len(known) < len(sources):
        return Program(UNKNOWN, search.packages(), "")
    # those of the harness name what it reads itself
    own = (texts for path, texts in search.texts.items() if not _is_harness(search.files[path]))
    words = set().union(*own)
    texts = {path: some | values(some, start.environment) for path, some in search.texts.items()}
    around = files_around(search.files, texts, search.distributions(), start.folder)
    named_modules = search.beside()
    for module in module_names(words):
        named_modules.follow(module, own=False)
    around = {**named_modules.files, **around}
    watched = seen({**search.data, **search.files, **around})
    digests = digests_of({**search.data, **around})
    named = {PurePath(text).name for texts in search.texts.values() for text in texts}
    for path, file in watched.items():
        if path not in search.files:
            # a method may write what it has read; of a large file the digest is that of pieces
            size = file.stamp[2] if file.stamp else 0
            digest = digests.get(path) if size <= WHOLE else None
            grows = size if path.name not in named and may_grow(path) else None
            watched[path] = replace(file, digest=digest, told=path in search.data, grows=grows)
    files = {
        **by_name(around, digests),
        **installed_from_elsewhere(search.foreign()),
        **variables(words, start.environment),
    }
    revision = _revision(known[0])
    return Program(search.digest(names), search.packages(), revision, files, watched, start)


def _is_harness(module: str) -> bool:
    return module.partition(".")[0] == "pytest_cpas"


def _source_of(part: type | Callable[..., object]) -> Path | None:
    """The file of a class or function, or the archive that it is in."""
    try:
        return _place(Path(inspect.getfile(part)))
    except (TypeError, OSError):
        return None


class _Search:
    """The modules that are reached from some, and the distributions at whose border it ends."""

    def __init__(self) -> None:
        #: Path and name of every module that is the program's own.
        self.files: dict[Path, str] = {}
        #: The same of the data files beside them.
        self.data: dict[Path, str] = {}
        #: The strings that each of the modules has.
        self.texts: dict[Path, set[str]] = {}
        self._seen: set[str] = set()
        self._foreign: set[str] = set()
        self._installed = [
            Path(sysconfig.get_path(name)).resolve() for name in ("purelib", "platlib")
        ]
        self._distributions: set[str] = set()
        self._unknown: set[str] = set()

    def beside(self) -> _Search:
        """Another one, to which the same distributions are the program's own."""
        other = _Search()
        other._distributions = set(self._distributions)
        return other

    def follow(self, module: str, *, own: bool = True) -> None:
        """Take in a module, the packages it is in, and whatever they import.

        ``own``: its distribution is the program's.
        """
        waiting = [module]
        if own:
            self._distributions |= set(_distributions().get(module.partition(".")[0], ()))
        while waiting:
            name = waiting.pop()
            if name in self._seen:
                continue
            self._seen.add(name)
            top = name.partition(".")[0]
            if top in sys.stdlib_module_names or top == "__main__":
                continue
            path = _file_of(name)
            if path is None:
                # an attribute of a module, something optional, or a distribution without a file
                if "." not in name:
                    (self._foreign if top in _distributions() else self._unknown).add(top)
                continue
            if not self._is_own(top, path):
                self._foreign.add(top)
                continue
            self.files[path] = name
            # all of them: those between may be folders without __init__.py
            waiting += [name[: match.start()] for match in re.finditer(r"\.", name)]
            if path.suffix == ".py":
                imports, texts = _told(read_bytes(path), name, path.stem == "__init__")
                waiting += imports
                self.texts[path] = texts
                self.data |= {file: f"{name}/{file.name}" for file in _named_files(texts, path)}

    def follow_provided(self) -> None:
        """Take in what is imported and was not found, and is in a folder that a text names: it may
        be put on the path before."""
        own = {path: t for path, t in self.texts.items() if not _is_harness(self.files[path])}
        for folder in providers(own, self._unknown):
            start = Start.now()
            with replace(start, path=[*start.path, str(folder)]).imports():
                unknown, self._unknown = self._unknown, set()
                self._seen -= unknown
                for name in sorted(unknown):
                    self.follow(name, own=False)

    def _is_own(self, top: str, path: Path) -> bool:
        """Whether a file is the program's: of the same distribution, of none, whose version would
        be told, or not installed at all."""
        if is_installed(path) or any(path.is_relative_to(folder) for folder in self._installed):
            owners = _distributions().get(top, ())
            return not owners or not self._distributions.isdisjoint(owners)
        return True

    def distributions(self) -> set[str]:
        """Those that are the program's own and are not in a project's folder."""
        return self._distributions if any(map(is_installed, self.files)) else set()

    def digest(self, name: str) -> str:
        """Of what is run, by name, and of the names and contents of all files."""
        total = hashlib.sha256(name.encode(errors="backslashreplace"))
        files = {**self.files, **self.data}
        for name, path in sorted((name, path) for path, name in files.items()):
            content = sha256(path)
            total.update(f"{name} {content}\n".encode(errors="backslashreplace"))
        return total.hexdigest()[:16]

    def foreign(self) -> list[str]:
        """The distributions that are imported and are not the program's own."""
        return sorted({name for top in self._foreign for name in _distributions().get(top, ())})

    def packages(self) -> str:
        """Python, and the distributions that are imported, with their versions."""
        versions = [f"{name} {importlib.metadata.version(name)}" for name in self.foreign()]
        return ", ".join([f"python {platform.python_version()}", *versions])


@functools.cache
def _distributions() -> Mapping[str, Sequence[str]]:
    """The distributions of each importable top-level name."""
    return importlib.metadata.packages_distributions()


def _file_of(name: str) -> Path | None:
    """The file of a module, found without importing anything; None if there is none."""
    path: Sequence[str] | None = None
    parts = name.split(".")
    for index in range(len(parts)):
        part = ".".join(parts[: index + 1])
        spec = _spec_of(part, path)
        if spec is None:
            return None
        locations = spec.submodule_search_locations
        # of a folder without __init__.py they know how to look again, in modules that are loaded
        path = list(getattr(locations, "_path", None) or locations or ())
    if spec is None or not spec.has_location or spec.origin is None:
        return None
    return _place(Path(spec.origin))


def _spec_of(name: str, path: Sequence[str] | None) -> importlib.machinery.ModuleSpec | None:
    """Where a module is, below the folders of the package that it is in; None if nobody knows."""
    # a folder without __init__.py asks for the modules above it, which nobody may have loaded
    spec = None
    for asked in (name, name.rpartition(".")[2]):
        with suppress(Exception):
            spec = importlib.machinery.PathFinder.find_spec(asked, path)
            break
    if spec is not None or path is not None:
        return spec
    # a package that is installed as editable may be found by a finder of its own alone
    for finder in sys.meta_path:
        if type(finder).__module__ not in _NO_OTHERS and finder not in _OF_PYTHON:
            with suppress(Exception):
                if (spec := finder.find_spec(name, None)) is not None:
                    return spec
    return None


def _place(file: Path) -> Path | None:
    """The file of a module; a module in an archive is as the archive is."""
    file = file.resolve()
    return next((place for place in (file, *file.parents) if place.is_file()), None)


@functools.lru_cache(maxsize=4096)
def _told(text: bytes, module: str, is_package: bool) -> tuple[list[str], set[str]]:
    """What a module may import, and every string that it has; nothing if it is no Python."""
    try:
        tree = ast.parse(text)
    except SyntaxError:
        return [], set()
    constants = (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant))
    return (
        list(_imports(tree, module, is_package)),
        {value for value in constants if isinstance(value, str)},
    )


def _imports(tree: ast.Module, module: str, is_package: bool) -> Iterator[str]:
    """Every name that a module may import, wherever in it: modules, and what may be one."""
    package = module if is_package else module.rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = package.split(".")
                kept = parts[: len(parts) + 1 - node.level]
                base = ".".join([*kept, *([node.module] if node.module else [])])
            if base:
                yield base
                yield from (f"{base}.{alias.name}" for alias in node.names if alias.name != "*")
        elif isinstance(node, ast.Call) and _called(node).endswith("import_module"):
            yield from (
                argument.value
                for argument in node.args[:1]
                if isinstance(argument, ast.Constant) and isinstance(argument.value, str)
                if argument.value.replace(".", "").isidentifier()
                and not argument.value.startswith(".")
            )


def _called(node: ast.Call) -> str:
    """The last word of the name of what is called."""
    return str(getattr(node.func, "attr", getattr(node.func, "id", "")))


def _named_files(texts: Collection[str], path: Path) -> Iterator[Path]:
    """The files beside a module, or in folders there, that its text names: a table of priors."""
    for name in texts:
        if 2 < len(name) < 100 and "." in name and not set(name) & set('\\\0\n:*?"<>|'):
            file = path.parent / name
            beside = ".." not in file.parts and not Path(name).is_absolute()
            if beside and file.is_file() and file.suffix != ".py":
                yield file.resolve()


def _revision(source: Path) -> str:
    """The commit that a file is of; "" where there is no repository, or no git."""
    commit, changed = (_git(source.parent, *command) for command in (_DESCRIBE, _STATUS))
    return f"{commit}+" if commit and changed else commit


def _git(folder: Path, *command: str) -> str:
    """What git prints; "" if it cannot."""
    try:
        told = subprocess.run(  # noqa: S603 - a fixed command
            ["git", "--no-optional-locks", "-C", folder, *command],  # noqa: S607
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return told.stdout.strip() if told.returncode == 0 else ""
