"""Protocols that ship with the plugin, and those of others, as TOML files."""

from __future__ import annotations

import functools
import tomllib
from pathlib import Path

from pytest_cpas.protocols.columns import Protocol, ProtocolError

__all__ = ["PAPER", "read_protocol", "shipped_protocol", "shipped_protocols"]

#: The protocol of the paper, which is the default.
PAPER = "cpas"

_SHIPPED = Path(__file__).parent / "shipped"

#: Of the largest file that is read, bytes.
_LARGEST = 1_000_000


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
        if not path.is_file():
            raise ProtocolError(f"{path}: there is no such file")
        if path.stat().st_size > _LARGEST:
            raise ProtocolError(f"{path}: larger than {_LARGEST} bytes")
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, ProtocolError):
            raise
        raise ProtocolError(f"{path}: cannot be read as TOML ({error})") from error
    return Protocol.parse(content, str(path))
