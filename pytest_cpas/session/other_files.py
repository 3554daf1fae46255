"""Files of a run beside those of methods and data: its plugins, and what pytest writes."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from pathlib import Path

import pytest

from pytest_cpas.evaluation import is_installed
from pytest_cpas.reading.files import sha256

__all__ = ["digests", "outputs", "plugin_files"]


def plugin_files(config: pytest.Config) -> dict[str, set[Path]]:
    """The conftest.py files of a run, and other plugins that are not installed: they can change
    what a method answers."""
    found: dict[str, set[Path]] = {"conftest": set(), "plugins": set()}
    for plugin in config.pluginmanager.get_plugins():
        file = getattr(plugin, "__file__", None)
        own = str(getattr(plugin, "__name__", "")).partition(".")[0] == "pytest_cpas"
        if not file or own:
            continue
        if Path(file).name == "conftest.py":
            found["conftest"].add(Path(file))
        elif not is_installed(Path(file)):
            found["plugins"].add(Path(file))
    return found


def outputs(config: pytest.Config) -> list[Path]:
    """The files that pytest itself writes."""
    names = (getattr(config.option, name, None) for name in ("xmlpath", "log_file"))
    return [config.invocation_params.dir / name for name in names if name]


def digests(plugins: Mapping[str, Collection[Path]]) -> dict[str, str]:
    """Provenance: what :func:`plugin_files` has found, and holds."""
    digests = {}
    for kind, files in plugins.items():
        if files:
            contents = "".join(sha256(file) for file in sorted(files) if file.is_file())
            digests[kind] = hashlib.sha256(contents.encode()).hexdigest()[:16]
    return digests
