"""The adapter of a method as it was in another revision of its repository."""

from __future__ import annotations

import importlib.util
import subprocess
import tarfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pytest_cpas.types import ToldError

__all__ = ["Adapter", "Revision", "RevisionError"]


class RevisionError(ToldError):
    """A revision, or the adapter in it, is not there."""


@dataclass(frozen=True)
class Adapter:
    """A class of a module; ``tree``, if it is to be imported from another revision, is where that
    lies, and ``first`` the folders in it that Python looks into."""

    module: str
    attribute: str
    tree: Path | None = None
    first: tuple[Path, ...] = ()

    @classmethod
    def of(cls, method: type) -> Adapter:
        """Of a class that is imported already."""
        return cls(method.__module__, method.__qualname__)


@dataclass(frozen=True)
class Revision:
    """An adapter as it was in a ``commit`` of the git repository ``top``; ``file`` is its package
    or module, relative to it."""

    adapter: Adapter
    top: Path
    commit: str
    root: Path
    file: Path

    @classmethod
    def find(cls, method: type, revision: str) -> Revision:
        """Raises :class:`RevisionError` for a revision that is not there, or that does not have the
        adapter, and for an adapter that is in no repository."""
        adapter = Adapter.of(method)
        package = adapter.module.partition(".")[0]
        spec = importlib.util.find_spec(package)
        if spec is None or spec.origin is None:
            raise RevisionError(f"git:{revision}: {package} has no file, so it has no revisions")
        origin = Path(spec.origin).resolve()
        # the folder that is on sys.path
        root = origin.parents[1 if spec.submodule_search_locations else 0]
        try:
            top = Path(_git(root, "rev-parse", "--show-toplevel")).resolve()
            file = origin.relative_to(top)
            wanted = f"{revision}^{{commit}}"
            commit = _git(top, "rev-parse", "--verify", "--end-of-options", wanted)
            _git(top, "cat-file", "-e", f"{commit}:{file.as_posix()}")
        except RevisionError as error:
            raise RevisionError(
                f"git:{revision}: no such revision of {origin}, where {adapter.module} is imported"
                f" from ({error})"
            ) from error
        return cls(adapter, top, commit, root.relative_to(top), file)

    def extract(self, folder: Path) -> Adapter:
        """All files of the commit below ``folder``, and the adapter as it is there.

        It is imported from there with whatever of its packages that revision holds; what is
        installed besides stays as it is.
        """
        tree, archive = (folder / "revision").resolve(), folder / "revision.tar"
        _git(self.top, "archive", f"--output={archive}", self.commit)
        # 3.11.4 brought the filter; what git has packed of a repository of one's own needs none
        safely: dict[str, Any] = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
        with tarfile.open(archive) as file:
            file.extractall(tree, **safely)  # noqa: S202
        archive.unlink()
        return replace(self.adapter, tree=tree, first=(tree / self.root,))


def _git(folder: Path, *arguments: str) -> str:
    command: Sequence[str] = ["git", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    except FileNotFoundError as error:
        raise RevisionError("git is not installed; a revision of an adapter needs it") from error
    if done.returncode:
        complaint = done.stderr.strip() or f"exit status {done.returncode}"
        raise RevisionError(f"git -C {folder} {' '.join(arguments)}: {complaint}")
    return done.stdout.strip()
