"""The worker of a method through a run: started, asked, and started again when it has ended."""

from __future__ import annotations

import hashlib
import itertools
import json
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from pytest_cpas.remote.process import WorkerError, WorkerProcess, indented
from pytest_cpas.remote.spec import Spec
from pytest_cpas.types import AnswerError, ToldError, shown

__all__ = ["OtherSide", "RaisedThereError", "Remote"]

#: How often a worker is started again in a run, after it died or was ended.
MOST_RESTARTS = 3

#: Files that are read there, and remembered.
_MOST_HEARD = 2000

#: Digest of sources that nobody can tell of.
_UNKNOWN = "unknown"


class RaisedThereError(ToldError):
    """The method raised, on the other side; the message ends with its traceback."""


@dataclass(frozen=True)
class OtherSide:
    """The program on the other side: a digest of it or "unknown", its interpreter and packages in
    words, and a digest of each file and version by name; ``unknown``: why its code is."""

    code: str
    packages: str
    files: Mapping[str, str]
    unknown: str = ""


class Remote:
    """The worker of a method, started again when it has ended, within reason."""

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self.life = 0
        self._process: WorkerProcess | None = None
        self._ended = 0
        self._last = ""
        self.declared: Mapping[str, Any] = {}
        #: Path and digest of files that were read there, and are not below its folders, in order.
        self._heard: dict[tuple[str, str], None] = {}
        self.hello: Mapping[str, Any] = {}
        #: Folders that were left out when it was asked for its sources; None before that.
        self._left_out: list[str] | None = None

    def started(self) -> WorkerProcess:
        """The worker, with the class loaded; :class:`WorkerError`, :class:`RaisedThereError`."""
        if self._process is not None and not self._process.ended:
            return self._process
        if self._process is not None:
            self._note_end("it ended between two requests")
            self._process.close()
            self._process = None
        if self._ended > MOST_RESTARTS:
            raise WorkerError(
                f"the worker of {self.spec.told} has ended {self._ended} times and is not started"
                f" again; the last time: {self._last}"
            )
        spec = self.spec
        for other, here in spec.paths.items():
            if not here.exists():
                raise WorkerError(f"paths: there is no {here} here, which is {other} there")
        try:
            process = WorkerProcess(
                spec.command,
                shell=spec.shell,
                copy=spec.worker,
                environment=spec.env,
                seconds=spec.seconds_to_start,
            )
        except WorkerError as error:
            self._note_end(str(error))
            command = " ".join(spec.command)
            raise WorkerError(f"the worker of {spec.told} ({command}): {error}") from None
        self._process, self.hello = process, process.hello
        self.life += 1
        request = {"call": "open", "class": spec.cls, "path": spec.path, "env": dict(spec.env)}
        request["places"] = list(spec.paths)
        what = f"loading the class {spec.cls}"
        try:
            answer = self.ask(request, what=what, seconds=spec.seconds_to_load)[0]
        except (RaisedThereError, AnswerError) as error:
            self.close()
            raise RaisedThereError(
                f"the class {spec.cls} cannot be loaded there: {error}"
            ) from None
        declared = answer.get("value")
        if not isinstance(declared, Mapping):
            raise WorkerError(f"{what}: the answer is {shown(declared)}")
        self.declared = declared
        if self._left_out is not None:  # it tells what it reads once that is known
            self._ask_sources()
        return process

    def ask(
        self,
        request: Mapping[str, Any],
        arrays: Sequence[NDArray[Any]] = (),
        *,
        what: str,
        seconds: float | None,
    ) -> tuple[dict[str, Any], list[NDArray[Any]]]:
        """The worker's answer; :class:`WorkerError`, and :class:`RaisedThereError` or
        :class:`AnswerError` for what was raised there."""
        process = self._process
        if process is None:
            raise RuntimeError("a worker that was not started is asked")
        try:
            answer, given = process.ask(request, arrays, seconds=seconds, what=what)
        except WorkerError as error:
            self._process = None
            self._note_end(str(error))
            error.again = (
                f"it is started again for what comes next ({self._ended} of {MOST_RESTARTS} times)"
                if self._ended <= MOST_RESTARTS
                else f"it has ended {self._ended} times and is not started again"
            )
            raise
        except BaseException:
            self._process = None
            raise
        self._hear(answer.get("read"))
        if "raised" in answer:
            kind, message = str(answer["raised"]), str(answer.get("message", ""))
            if answer.get("contract") is True:
                raise AnswerError(message)
            told = f"{kind}: {message}" if message else kind
            who = self.interpreter
            if kind in ("ImportError", "ModuleNotFoundError"):
                who += f", {self.hello.get('executable')!s:.200}"
            raise RaisedThereError(f"{told} ({who})\n{indented(str(answer.get('traceback', '')))}")
        return answer, given

    def _hear(self, told: object) -> None:
        for each in told if isinstance(told, list) else ():
            if isinstance(each, list) and len(each) == 2 and len(self._heard) < _MOST_HEARD:
                self._heard[str(each[0])[:4096], str(each[1])[:100]] = None

    def heard(self, since: int) -> list[tuple[str, str]]:
        """What was heard of, in its order, behind the first ``since``."""
        return list(itertools.islice(self._heard, since, None))

    def digests(self, files: Sequence[str]) -> dict[str, str]:
        """A digest of each of some files there, as they are now."""
        self.started()
        request = {"call": "digests", "files": list(files)}
        told = self.ask(request, what="looking at what it has read", seconds=600)[0].get("value")
        return {str(k): str(v) for k, v in told.items()} if isinstance(told, dict) else {}

    def _note_end(self, why: str) -> None:
        self._ended += 1
        self._last = why

    @property
    def interpreter(self) -> str:
        """What answers, in words."""
        told = (str(self.hello.get(part, "?"))[:40] for part in ("implementation", "python"))
        return " ".join(told)

    @property
    def is_here(self) -> bool:
        """Whether it runs on this machine, as far as both sides can tell."""
        return self.hello.get("machine") == machine()

    def _ask_sources(self) -> Any:
        request = {"call": "sources", "path": self.spec.path, "leave_out": self._left_out}
        try:
            return self.ask(request, what="looking at its sources", seconds=600)[0].get("value")
        except AnswerError as error:  # too much
            return {"files": {}, "distributions": [], "unknown": str(error)}

    def close(self) -> None:
        """End the worker; what asks for more starts another one."""
        if self._process is not None:
            self._process.close()
            self._process = None

    def other_side(self, leave_out: Iterable[Path] = ()) -> OtherSide:
        """Its program as it is now; ``leave_out``: folders of data, weights and results."""
        self.started()
        self._left_out = sorted({self.spec.there(folder) for folder in leave_out})
        answer = self._ask_sources()
        told: Mapping[str, Any] = answer if isinstance(answer, Mapping) else {}
        files, installed = told.get("files"), told.get("distributions")
        if not isinstance(files, dict) or not isinstance(installed, list):
            raise WorkerError(f"looking at its sources: the answer is {shown(answer)}")
        named = {f"{name} (other side)": str(digest) for name, digest in files.items()}
        versions = [str(each) for each in installed]
        spec = self.spec
        known: list[Any] = [
            self.interpreter,
            spec.cls,
            spec.command,
            dict(spec.env),
            spec.image,
            named,
        ]
        digest = hashlib.sha256(json.dumps([*known, versions], sort_keys=True).encode())
        unknown = str(told.get("unknown", ""))[:300] or ("" if named else "no file is seen")
        code = _UNKNOWN if unknown else digest.hexdigest()[:16]
        first = [each for each in versions if each.partition(" ")[0] in ("numpy", "torch")]
        packages = ", ".join([self.interpreter, *first, *([spec.image] if spec.image else [])])
        named |= {f"{each} (other side)": "installed" for each in versions}
        return OtherSide(code, packages, named, unknown)


def machine() -> str:
    """What tells a machine from others, also seen from a container on it."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return platform.node()
