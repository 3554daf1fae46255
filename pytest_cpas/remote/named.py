"""Methods that a command leads to: named on the command line, or in a file of the project."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pytest_cpas.reading.structured import read_toml
from pytest_cpas.remote.spec import Spec
from pytest_cpas.types import DeclarationError, raised_as, shown
from pytest_cpas.types.names import checked_name

__all__ = ["FILE", "named_methods", "project_folder", "spec_of"]

#: Where methods are named beside pyproject.toml, or without one.
FILE = "cpas-methods.toml"

#: How a command on the command line begins.
_EXEC = "exec:"

_CLASS = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")

#: Commands that hand what follows to a shell of another host.
_SHELLS = ("ssh",)

_TEXTS = ("class", "image", "worker")
_LISTS = ("command", "path")
_TABLES = ("env", "paths")
_SECONDS = ("seconds_to_start", "seconds_to_load")
_KEYS = (*_LISTS, *_TEXTS, *_TABLES, "shell", *_SECONDS)


def project_folder(root: Path, here: Path) -> Path:
    """Where methods are named: in the folder that pytest takes for the project's, or where it was
    started, if a cpas-methods.toml is there."""
    return here if (here / FILE).is_file() else root


def spec_of(name: str, root: Path) -> Spec | None:
    """How the method that is called ``name`` is reached; None if it is neither a command nor named
    in a file of the project in ``root``. Raises :class:`DeclarationError`."""
    if name.startswith(_EXEC):
        return _of_command(name, root)
    return named_methods(root).get(name)


def _of_command(name: str, root: Path) -> Spec:
    command, _, cls = name.removeprefix(_EXEC).rpartition("#")
    try:
        words = tuple(shlex.split(command))
    except ValueError as error:
        raise DeclarationError(f"method {name!r}: {error}") from None
    if not words or not _CLASS.fullmatch(cls):
        raise DeclarationError(
            f"method {name!r}: expected exec:COMMAND#module:Class, where COMMAND ends with an"
            " interpreter, such as 'exec:python3.8#my_method:MyMethod'"
        )
    return Spec(command=words, cls=cls, shell=Path(words[0]).name in _SHELLS, folder=root)


def named_methods(root: Path) -> dict[str, Spec]:
    """The methods that pyproject.toml (``[tool.pytest-cpas.methods.NAME]``) and cpas-methods.toml
    (``[NAME]``) in ``root`` name. Raises :class:`DeclarationError` for what is no such table, and
    :class:`pytest_cpas.types.DataError` for a file that is damaged."""
    found: dict[str, Spec] = {}
    for file, tables in _tables(root):
        if not isinstance(tables, Mapping):
            raise DeclarationError(f"{file}: methods is {shown(tables)}, expected tables")
        for name, table in tables.items():
            where = f"{file}, method {shown(name)}"
            with raised_as(DeclarationError):
                checked_name("method", name)
            if name in found:
                raise DeclarationError(f"{where}: it is named in pyproject.toml as well")
            found[name] = _spec(where, name, table, root)
    return found


def _tables(root: Path) -> list[tuple[Path, Any]]:
    found: list[tuple[Path, Any]] = []
    project = root / "pyproject.toml"
    if project.is_file():
        tool = read_toml(project).get("tool", {})
        ours = tool.get("pytest-cpas", {}) if isinstance(tool, Mapping) else {}
        found.append((project, ours.get("methods", {}) if isinstance(ours, Mapping) else ours))
    beside = root / FILE
    if beside.is_file():
        found.append((beside, read_toml(beside)))
    return found


def _spec(where: str, name: str, table: Any, root: Path) -> Spec:
    _check(where, table)
    command, cls = tuple(table["command"]), table["class"]
    here = {other: (root / folder).resolve() for other, folder in table.get("paths", {}).items()}
    spec = Spec(
        command=command,
        cls=cls,
        name=name,
        env=dict(table.get("env", {})),
        paths=here,
        image=table.get("image", ""),
        worker=table.get("worker"),
        shell=table.get("shell", Path(command[0]).name in _SHELLS),
        seconds_to_start=float(table.get("seconds_to_start", Spec.seconds_to_start)),
        seconds_to_load=float(table.get("seconds_to_load", Spec.seconds_to_load)),
        folder=root,
    )
    # an absolute one is the other side's already
    path = [p if Path(p).is_absolute() else spec.there(root / p) for p in table.get("path", [])]
    object.__setattr__(spec, "path", tuple(path))
    return spec


def _check(where: str, table: Any) -> None:
    """Raise :class:`DeclarationError` for what is no table of a method."""
    if not isinstance(table, Mapping):
        raise DeclarationError(f"{where}: {shown(table)}, expected a table")
    if unknown := sorted(table.keys() - {*_KEYS}):
        raise DeclarationError(f"{where}: has {unknown}, expected some of {', '.join(_KEYS)}")
    for key, value in table.items():
        if key in _LISTS:
            right = isinstance(value, list) and all(isinstance(each, str) for each in value)
            expected = "a list of words"
        elif key in _TEXTS:
            right, expected = isinstance(value, str), "a text"
        elif key in _TABLES:
            right = isinstance(value, Mapping) and all(isinstance(v, str) for v in value.values())
            expected = "a table of texts"
        elif key == "shell":
            right, expected = isinstance(value, bool), "true or false"
        else:
            right = type(value) in (int, float) and 0 < value < 1e6
            expected = "seconds above 0"
        if not right:
            raise DeclarationError(f"{where}: {key} is {shown(value)}, expected {expected}")
    if not table.get("command"):
        raise DeclarationError(
            f"{where}: no command; expected words that end with an interpreter, such as"
            ' command = ["python3.8"]'
        )
    if not _CLASS.fullmatch(table.get("class", "")):
        raise DeclarationError(f"{where}: class is {shown(table.get('class'))}, expected"
                               " module:Class")  # fmt: skip
