"""What a program reaches by the words of its text alone: environment variables and modules.

``os.environ``, ``__import__``, ``pkgutil.resolve_name`` and tables of names are no imports that a
search could follow, but what they are given stands in the text.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import itertools
import json
import os
import re
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from pytest_cpas.reading.structured import parse_json
from pytest_cpas.types import ContractError

__all__ = ["Start", "installed_from_elsewhere", "module_names", "providers", "values", "variables"]

_VARIABLE = re.compile(r"[A-Z][A-Z0-9_]{2,}")

#: Variables that tell of a machine, a user or a job: each has its own, and answers the same.
_OF_MACHINES = re.compile(
    r"HOME|PATH|USER|LOGNAME|SHELL|PWD|OLDPWD|TMP|TEMP|TMPDIR|LANG|TERM|DISPLAY|HOSTNAME|PYTHONPATH"
    r"|VIRTUAL_ENV|RANK|LOCAL_RANK|WORLD_SIZE|CUDA_VISIBLE_DEVICES|CI"
    r"|(CPAS|PYTEST|SLURM|GITHUB|MASTER|XDG|CONDA)_.*"
)

#: A path below a folder, or up from it; and how many folders up from a module one is looked for.
_BELOW = re.compile(r"(?=.{1,199}\Z)/?[\w.-]+(/[\w.-]+)*")
_ABOVE = 4

_MODULE = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")


@dataclass(frozen=True)
class Start:
    """What tells a process where modules and files are, and what the code that it runs may change.

    ``path``: as ``sys.path``; ``folder``: the current one; ``environment``: as ``os.environ``.
    """

    path: Sequence[str]
    folder: Path
    environment: Mapping[str, str]

    @classmethod
    def now(cls) -> Start:
        """That of this process."""
        return cls([os.path.abspath(place) for place in sys.path], Path.cwd(), {**os.environ})

    @contextmanager
    def imports(self) -> Iterator[None]:
        """Modules are looked for where they were then."""
        path, sys.path[:] = [*sys.path], self.path
        try:
            importlib.invalidate_caches()
            yield
        finally:
            sys.path[:] = path


def _named(texts: Iterable[str], environment: Mapping[str, str]) -> list[str]:
    found = {text for text in texts if _VARIABLE.fullmatch(text) and text in environment}
    return sorted(name for name in found if not _OF_MACHINES.fullmatch(name))


def variables(texts: Collection[str], environment: Mapping[str, str]) -> dict[str, str]:
    """A digest of each variable of an environment that a text names, by ``$NAME``."""
    return {f"${name}": _digest(environment[name]) for name in _named(texts, environment)}


def values(texts: Collection[str], environment: Mapping[str, str]) -> set[str]:
    """What those variables hold, which may be paths."""
    return {environment[name] for name in _named(texts, environment)}


def module_names(texts: Iterable[str]) -> list[str]:
    """What may be the name of a module, or of something in one (``package.module:Class``)."""
    names = {text.partition(":")[0] for text in texts}
    return sorted(name for name in names if len(name) < 100 and _MODULE.fullmatch(name))


def providers(texts: Mapping[Path, Collection[str]], modules: Collection[str]) -> list[Path]:
    """Folders with one of ``modules`` that the text of a module names, from the one it is in or
    from those above it: ``os.path.join(os.path.dirname(__file__), "..", "third_party")``."""
    found = set()
    for path, some in texts.items() if modules else ():
        names = {text.lstrip("/") for text in some if _BELOW.fullmatch(text)}
        for start, name in itertools.product(path.parents[:_ABOVE], names):
            folder = os.path.join(start, name)
            # most texts are the name of no folder, which one look tells
            if os.path.isdir(folder) and any(_has_module(folder, module) for module in modules):
                found.add(Path(folder).resolve())
    return sorted(found)


def _has_module(folder: str, name: str) -> bool:
    files = (os.path.join(folder, f"{name}.py"), os.path.join(folder, name, "__init__.py"))
    return any(map(os.path.isfile, files))


def installed_from_elsewhere(distributions: Iterable[str]) -> dict[str, str]:
    """A digest of each distribution that was not installed from an index, but from a folder, an
    archive or a repository, where other code may have the same version."""
    digests = {}
    for name in distributions:
        distribution = importlib.metadata.distribution(name)
        if url := distribution.read_text("direct_url.json"):
            try:
                told = parse_json(Path(f"direct_url.json of {name}"), url.encode())
                came_from = [told.get("vcs_info"), told.get("archive_info")]
            except ContractError:  # of another installer: whatever it says
                came_from = [url]
            lines = (distribution.read_text("RECORD") or "").splitlines()
            # neither scripts, which name the environment, nor what tells of the installation
            files = [line for line in lines if not re.match(r"\.\.|[^/]*\.dist-info/", line)]
            digests[f"{name} as installed"] = _digest(json.dumps([came_from, sorted(files)]))
    return digests


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:16]
