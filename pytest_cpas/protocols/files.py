"""Protocols that ship with the plugin, and those of others, as TOML files."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from pathlib import Path

from pytest_cpas.protocols.columns import Protocol, ProtocolError
from pytest_cpas.reading.structured import read_toml
from pytest_cpas.types import DataError

__all__ = ["PAPER", "asked_for", "read_protocol", "shipped_protocol", "shipped_protocols"]

#: The protocol of the paper, which is the default.
PAPER = "cpas"

_SHIPPED = Path(__file__).parent / "shipped"


def asked_for(names: Iterable[str]) -> str:
    """The options that ask for protocols of those names, in words."""
    names = list(names)
    options = " ".join(f"--cpas-protocol {name}" for name in names)
    if own := [name for name in names if name not in shipped_protocols()]:
        return f"{options} (or the .toml file of {', '.join(own)})"
    return options


def shipped_protocols() -> list[str]:
    """The names of the protocols that ship with the plugin, the default first."""
    names = sorted(path.stem for path in _SHIPPED.glob("*.toml"))
    return sorted(names, key=lambda name: name != PAPER)


@functools.cache
def shipped_protocol(name: str) -> Protocol:
    """One of :func:`shipped_protocols`; :class:`ProtocolError` for any other name."""
    if name not in shipped_protocols():
        raise ProtocolError(
            f"there is no protocol {name!r}; those that ship are {', '.join(shipped_protocols())}"
        )
    return read_protocol(_SHIPPED / f"{name}.toml")


def read_protocol(path: Path) -> Protocol:
    """A protocol in a TOML file; :class:`ProtocolError` that names the file and what is wrong."""
    try:
        content = read_toml(path)
    except DataError as error:
        raise ProtocolError(str(error)) from error
    return Protocol.parse(content, str(path))
