"""Methods in processes of their own: two of them, or two revisions, compete on equal terms."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pytest_cpas.timing import contestant
from pytest_cpas.types import ToldError


class TimingError(ToldError):
    """Something cannot be timed: a worker died, a method raised, a revision is not there."""


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


class Worker:
    """A :class:`pytest_cpas.timing.contestant.Contestant` in another process."""

    def __init__(
        self,
        name: str,
        adapter: Adapter,
        observations: Path,
        *,
        weights: Path | None,
        seed: int,
        device: str,
    ) -> None:
        """Start it and load the method; raises :class:`TimingError`.

        ``name`` is for people. ``observations``: a file of
        :func:`pytest_cpas.timing.contestant.write_observations`.
        """
        self.name = name
        self._complaints = tempfile.TemporaryFile()  # noqa: SIM115 - see close
        self._process = subprocess.Popen(  # noqa: S603 - this Python, a file of ours
            [sys.executable, "-P", contestant.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complaints,
            encoding="utf-8",
        )
        try:
            self._ask(
                path=[*map(str, adapter.first), *sys.path],
                module=adapter.module,
                attribute=adapter.attribute,
                inside=None if adapter.tree is None else str(adapter.tree),
                weights=None if weights is None else str(weights),
                device=device,
                seed=seed,
                observations=str(observations),
            )
        except BaseException:
            self.close()
            raise

    def run(self, index: int) -> float:
        """Seconds of one prediction, taken in the worker."""
        return float(self._ask(call="run", arguments=[index]))

    def settle(self, repetitions: int) -> None:
        """As :meth:`Contestant.settle`."""
        self._ask(call="settle", arguments=[repetitions])

    def examine(self) -> contestant.Examined:
        """As :meth:`Contestant.examine`."""
        examined: contestant.Examined = self._ask(call="examine", arguments=[])
        return examined

    def facts(self) -> contestant.ProcessFacts:
        """As :meth:`Contestant.facts`."""
        facts: contestant.ProcessFacts = self._ask(call="facts", arguments=[])
        return facts

    def close(self) -> None:
        """End the process."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._complaints):
            if stream is not None:
                stream.close()

    def _ask(self, **request: Any) -> Any:
        requests, answers = self._process.stdin, self._process.stdout
        if requests is None or answers is None:
            raise RuntimeError("the worker was started without pipes")
        try:
            requests.write(json.dumps(request) + "\n")
            requests.flush()
            line = answers.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            raise TimingError(
                f"the worker of {self.name} ended with exit status {self._process.wait()}:"
                f" {self._last_words() or 'it printed nothing'}"
            )
        answer = json.loads(line)
        if "error" in answer:
            raise TimingError(f"{self.name} in its worker:\n{answer['error'].rstrip()}")
        return answer["answer"]

    def _last_words(self) -> str:
        self._complaints.seek(0)
        return self._complaints.read().decode(errors="replace").strip()[-2000:]


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
        """Raises :class:`TimingError` for a revision that is not there, or that does not have the
        adapter, and for an adapter that is in no repository."""
        adapter = Adapter.of(method)
        package = adapter.module.partition(".")[0]
        spec = importlib.util.find_spec(package)
        if spec is None or spec.origin is None:
            raise TimingError(f"git:{revision}: {package} has no file, so it has no revisions")
        origin = Path(spec.origin).resolve()
        # the folder that is on sys.path
        root = origin.parents[1 if spec.submodule_search_locations else 0]
        try:
            top = Path(_git(root, "rev-parse", "--show-toplevel")).resolve()
            file = origin.relative_to(top)
            wanted = f"{revision}^{{commit}}"
            commit = _git(top, "rev-parse", "--verify", "--end-of-options", wanted)
            _git(top, "cat-file", "-e", f"{commit}:{file.as_posix()}")
        except TimingError as error:
            raise TimingError(
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
        raise TimingError("git is not installed; a revision of an adapter needs it") from error
    if done.returncode:
        complaint = done.stderr.strip() or f"exit status {done.returncode}"
        raise TimingError(f"git -C {folder} {' '.join(arguments)}: {complaint}")
    return done.stdout.strip()
