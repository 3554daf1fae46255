"""A method is loaded once, and what is known of its weights."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Mapping
from pathlib import Path

from pytest_cpas.evaluation.meanwhile import Seen, seen
from pytest_cpas.evaluation.surroundings import piecewise_digest
from pytest_cpas.reading.checkpoints import LARGEST_CHECKPOINT
from pytest_cpas.reading.files import sha256
from pytest_cpas.types import Method, ToldError, assets_of

__all__ = ["Loading", "MethodError"]

#: Of a folder of weights that are not declared: files that are looked at, and bytes up to which
#: their whole contents are.
_MOST_FILES, _LARGEST_FOLDER = 10_000, 2**30


class MethodError(ToldError):
    """A method cannot be loaded."""


class Loading:
    """The loading of a method, and what is known of its weights: when it is first needed, once for
    all runs that share it."""

    def __init__(self, method: Method, weights: Path | None, device: str) -> None:
        self._method, self._weights, self._device = method, weights, device

    @functools.cached_property
    def error(self) -> Exception | None:
        """Loads the method; what went wrong is remembered, not tried again for every sample."""
        try:
            self._method.load(self._weights, self._device)
        except Exception as error:
            return error
        return None

    @functools.cached_property
    def seen(self) -> Mapping[Path, Seen]:
        """The files of the weights, before anything is read of them."""
        folder = self._weights
        declared = assets_of(self._method, folder) if folder else ()
        paths = [folder / asset.path for asset in declared] if folder else []
        paths = paths or _files_below(folder)
        return seen({path: f"the weights {path.name}" for path in paths})

    @functools.cached_property
    def declared_weights(self) -> Mapping[str, str]:
        """Identity: a digest of the files that the method declares; nothing without any."""
        return _weights_identity(self._method, self._weights)

    @functools.cached_property
    def undeclared_weights(self) -> Mapping[str, str]:
        """Provenance: a digest of the folder of a method that declares nothing of it."""
        return _undeclared_weights(self._method, self._weights)


def _weights_identity(method: Method, folder: Path | None) -> dict[str, str]:
    """A digest of the files that a method loads; nothing for a method without any."""
    assets = assets_of(method, folder)
    if not assets or folder is None:
        return {}
    digest = hashlib.sha256()
    for asset in sorted(assets, key=lambda asset: asset.path):
        content = sha256(folder / asset.path, LARGEST_CHECKPOINT)
        digest.update(f"{asset.path} {content}\n".encode())
    return {"weights": digest.hexdigest()[:16]}


def _files_below(folder: Path | None) -> list[Path]:
    """The files of a folder, also where links lead to folders."""
    found: list[Path] = []
    been = set()
    for at, folders, files in os.walk(folder, followlinks=True) if folder else ():
        been.add(os.path.realpath(at))
        folders[:] = [f for f in folders if os.path.realpath(os.path.join(at, f)) not in been]
        found += [path for name in files if (path := Path(at, name)).is_file()]
    return sorted(found)[:_MOST_FILES]


def _undeclared_weights(method: Method, folder: Path | None) -> dict[str, str]:
    """A digest of the folder that a method without declared assets is given: what it reads there is
    known to nobody."""
    if folder is None or assets_of(method, folder):
        return {}
    files = _files_below(folder)
    small = sum(path.stat().st_size for path in files) <= _LARGEST_FOLDER
    digest = hashlib.sha256()
    for path in files:
        told = sha256(path) if small else piecewise_digest(path)
        digest.update(f"{path.relative_to(folder)} {told}\n".encode(errors="backslashreplace"))
    return {"weights_folder": digest.hexdigest()[:16]}
