"""Options and settings that a project's own conftest.py adds: it may hand them to a method."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import pytest

__all__ = ["note_others", "own_settings"]

_OTHERS = pytest.StashKey[frozenset[str]]()


def note_others(config: pytest.Config) -> None:
    """What has been added up to now is pytest's, or of plugins that are installed."""
    config.stash[_OTHERS] = frozenset(_added(config))


def own_settings(config: pytest.Config) -> Mapping[str, str]:
    """A digest of the value of each option and setting that was added since, by its name."""
    others = config.stash.get(_OTHERS, None)
    if others is None:
        return {}
    added = _added(config)
    return {
        name: hashlib.sha256(repr(_value(config, *added[name])).encode()).hexdigest()[:16]
        for name in sorted(added.keys() - others)
    }


def _added(config: pytest.Config) -> dict[str, tuple[str, str]]:
    """Every option and setting, as it is typed; of which kind it is, and what it is kept under."""
    parser: Any = config._parser
    options = [o for group in (parser._anonymous, *parser._groups) for o in group.options]
    settings = {f"{name} in the configuration": ("setting", name) for name in parser._inidict}
    return {o.names()[-1]: ("option", o.dest) for o in options} | settings


def _value(config: pytest.Config, kind: str, name: str) -> Any:
    return getattr(config.option, name, None) if kind == "option" else config.getini(name)
