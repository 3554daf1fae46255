"""Protocols by name: those that ship, those of other packages, and your own."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pytest_cpas import registry
from pytest_cpas.protocols import (
    PAPER,
    Protocol,
    ProtocolError,
    read_protocol,
    shipped_protocol,
    shipped_protocols,
)
from pytest_cpas.reading.structured import read_toml
from pytest_cpas.types import DataError

__all__ = ["known_protocols", "resolve_protocols"]


def resolve_protocols(names: Sequence[str], here: Path, root: Path) -> tuple[Protocol, ...]:
    """The protocols of some names, in order; the paper's if there is none.

    A name ending in ``.toml`` is a file, looked for in ``here``. Others are declared in
    ``[tool.pytest-cpas.protocols.NAME]`` of ``pyproject.toml`` in ``root``, ship with the plugin,
    or are an entry point of the group ``pytest_cpas.protocols``. Raises :class:`ProtocolError`.
    """
    protocols = [_resolve(name, here, root) for name in dict.fromkeys(names or [PAPER])]
    seen = [protocol.name for protocol in protocols]
    for name in seen:
        if seen.count(name) > 1:
            raise ProtocolError(f"--cpas-protocol: two protocols are called {name}")
    return tuple(protocols)


def known_protocols(root: Path) -> list[Protocol]:
    """Every protocol that has a name, the default first."""
    names = [*shipped_protocols(), *_declared(root), *_registered()]
    return [_resolve(name, root, root) for name in dict.fromkeys(names)]


def _resolve(name: str, here: Path, root: Path) -> Protocol:
    if name.endswith(".toml"):
        protocol = read_protocol(here / name)
        if protocol.name in shipped_protocols():
            raise ProtocolError(f"{here / name}: {protocol.name} is the name of one that ships")
        return protocol
    own = _declared(root)
    if name in own:
        where = f"{root / 'pyproject.toml'}, [tool.pytest-cpas.protocols.{name}]"
        if name in shipped_protocols():
            raise ProtocolError(f"{where}: it is the name of one that ships; choose another")
        return _named(name, Protocol.parse({"name": name, **own[name]}, where), where)
    if name in shipped_protocols():
        return shipped_protocol(name)
    if name in _registered():
        made = registry.resolve("protocol", name)
        if not isinstance(made, Protocol):
            raise ProtocolError(f"protocol {name!r}: {made!r} is no pytest_cpas.protocols.Protocol")
        where = f"protocol {name!r}"
        return _named(name, Protocol.parse(made.declared(), where), where)
    known = [*shipped_protocols(), *own, *_registered()]
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    raise ProtocolError(
        f"unknown protocol {name!r}.{hint} There are {', '.join(known)} (pytest --cpas-list); your"
        " own is a .toml file, or [tool.pytest-cpas.protocols.NAME] in pyproject.toml"
    )


def _named(name: str, protocol: Protocol, where: str) -> Protocol:
    """A protocol, if it is called as it is asked for."""
    if protocol.name != name:
        raise ProtocolError(f"{where}: name is {protocol.name!r}, expected {name!r}")
    return protocol


def _registered() -> list[str]:
    return [entry.name for entry in registry.registered("protocol")]


def _declared(root: Path) -> Mapping[str, Mapping[str, Any]]:
    """The content of ``[tool.pytest-cpas.protocols]``, by name."""
    path = root / "pyproject.toml"
    if not path.is_file():
        return {}
    try:
        content = read_toml(path)
    except DataError as error:
        raise ProtocolError(str(error)) from error
    declared: dict[str, Any] = content
    for key in ("tool", "pytest-cpas", "protocols"):
        declared = declared.get(key, {})
        if not isinstance(declared, dict):
            raise ProtocolError(f"{path}: {key} must be a table")
    if not all(isinstance(content, dict) for content in declared.values()):
        raise ProtocolError(f"{path}: [tool.pytest-cpas.protocols] must hold tables")
    return declared
