"""A method in another interpreter, which answers here as any other one does."""

from __future__ import annotations

import copy
import hashlib
import itertools
import json
import os
import platform
import random
import time
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.remote.answers import asset_of, info_of, predictions_of, told_observations
from pytest_cpas.remote.process import WorkerError, WorkerProcess, indented
from pytest_cpas.stages import listener
from pytest_cpas.types import (
    AnswerError,
    Asset,
    DeclarationError,
    MethodInfo,
    Observation,
    Prediction,
    ToldError,
    shown,
)

__all__ = ["OtherSide", "RaisedThereError", "RemoteMethod", "Spec", "remote_method"]

#: How often a worker is started again in a run, after it died or was ended.
MOST_RESTARTS = 3

#: Digest of sources that nobody can tell of.
_UNKNOWN = "unknown"

_numbers = itertools.count()


@dataclass(frozen=True, kw_only=True)
class Spec:
    """How a method is reached.

    ``command`` ends with an interpreter; ``cls`` is ``module:Class`` there; ``path``: folders there
    where modules are looked for first; ``env``: variables set there; ``paths``: folders there, by
    which folder here each is. ``image``: what else tells of the other side, such as the digest of
    an image; ``worker``: where the worker lies there, None to send it; ``shell``: whether the
    command hands its words to a shell, as ssh does. ``name``: what the method is called here, if
    not as it declares; ``folder``: where it is told what is known of it. Seconds are for the worker
    to start, and for the class to be loaded.
    """

    command: tuple[str, ...]
    cls: str
    name: str = ""
    path: tuple[str, ...] = ()
    env: Mapping[str, str] = field(default_factory=dict)
    paths: Mapping[str, Path] = field(default_factory=dict)
    image: str = ""
    worker: str | None = None
    shell: bool = False
    seconds_to_start: float = 120.0
    seconds_to_load: float = 600.0
    folder: Path = Path()

    @property
    def told(self) -> str:
        """What it is called in messages."""
        return self.name or self.cls

    def there(self, path: Path) -> str:
        """What a path of this side is called on the other one."""
        path = Path(os.path.abspath(path))
        for other, here in self.paths.items():
            if path.is_relative_to(here):
                return str(Path(other, path.relative_to(here)))
        return str(path)


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
        self.hello: Mapping[str, Any] = {}

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
        what = f"loading the class {spec.cls}"
        try:
            answer = self.ask(request, what=what, seconds=spec.seconds_to_load)[0]
        except RaisedThereError as error:
            self.close()
            raise RaisedThereError(
                f"the class {spec.cls} cannot be loaded there: {error}"
            ) from None
        declared = answer.get("value")
        if not isinstance(declared, Mapping):
            raise WorkerError(f"{what}: the answer is {shown(declared)}")
        self.declared = declared
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
            again = (
                f"it is started again for what comes next ({self._ended} of {MOST_RESTARTS} times)"
                if self._ended <= MOST_RESTARTS
                else f"it has ended {self._ended} times and is not started again"
            )
            raise WorkerError(f"{error}\n{again}") from None
        except BaseException:
            self._process = None
            raise
        if "raised" in answer:
            kind, message = str(answer["raised"]), str(answer.get("message", ""))
            if answer.get("contract") is True:
                raise AnswerError(message)
            told = f"{kind}: {message}" if message else kind
            raise RaisedThereError(
                f"{told} ({self.interpreter})\n{indented(str(answer.get('traceback', '')))}"
            )
        return answer, given

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

    def close(self) -> None:
        """End the worker; what asks for more starts another one."""
        if self._process is not None:
            self._process.close()
            self._process = None

    def other_side(self, leave_out: Iterable[Path] = ()) -> OtherSide:
        """Its program as it is now; ``leave_out``: folders of data, weights and results."""
        self.started()
        left_out = sorted({self.spec.there(folder) for folder in leave_out})
        request = {"call": "sources", "path": self.spec.path, "leave_out": left_out}
        answer = self.ask(request, what="looking at its sources", seconds=600)[0].get("value")
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


class RemoteMethod:
    """A method whose class, assets and answers are those of a worker; made by
    :func:`remote_method`."""

    info: MethodInfo
    remote: Remote

    def __init__(self) -> None:
        self._number = next(_numbers)
        self._loaded_in = 0
        self._order: Mapping[str, Any] = {}
        self._checked = False
        #: Seconds that predictions took there, and that the way there and back took beside.
        self.own_seconds = self.transfer_seconds = 0.0

    def load(self, assets: Path | None, device: str) -> None:
        """Load an instance there; :class:`WorkerError`, :class:`RaisedThereError`."""
        folder = None if assets is None else self.remote.spec.there(assets)
        self._order = {"instance": self._number, "assets": folder, "device": device}
        self._loaded_in = 0
        self._ready()

    def _ready(self) -> None:
        """Have this instance in a worker, also after another one has ended."""
        self.remote.started()
        if self._loaded_in != self.remote.life:
            seconds = self.remote.spec.seconds_to_load
            self.remote.ask({"call": "load", **self._order}, what="load", seconds=seconds)
            self._loaded_in = self.remote.life

    def checked(self) -> RemoteMethod:
        """The same instance, which also tells what it changes of the arrays that it is given."""
        other = copy.copy(self)
        other._checked = True
        return other

    def predict(self, batch: Sequence[Observation], seed: int) -> list[Prediction]:
        """As :meth:`predict_within`, without a limit."""
        return self.predict_within(batch, seed, None)

    def predict_within(
        self, batch: Sequence[Observation], seed: int, seconds: float | None
    ) -> list[Prediction]:
        """The answers of the other side; :class:`WorkerError` if there are none in ``seconds``.

        Raises :class:`RaisedThereError` for what is raised there, and :class:`AnswerError`.
        """
        self._ready()
        clock = listener()
        told, arrays = told_observations(batch)
        request = {
            "call": "predict",
            "instance": self._number,
            "seed": seed,
            "batch": told,
            "random": _random_state(),
            "checked": self._checked,
            "timed": clock is not None,
        }
        start = time.perf_counter()
        answer, given = self.remote.ask(request, arrays, what="predict", seconds=seconds)
        elapsed = time.perf_counter() - start
        self.own_seconds += _seconds(answer.get("seconds"))
        self.transfer_seconds += max(elapsed - _seconds(answer.get("wall")), 0.0)
        if clock is not None and isinstance(stages := answer.get("stages"), dict):
            for name, value in stages.items():
                clock.seconds[name] = clock.seconds.get(name, 0.0) + _seconds(value)
        _draw(answer.get("drawn"))
        _put_back(answer.get("changed"), arrays, given)
        return predictions_of(answer.get("answers"), given)

    def process_facts(self) -> dict[str, Any]:
        """Clock, device, threads and versions of the worker; :class:`WorkerError`."""
        told = self._told("facts")
        texts = all(isinstance(told.get(part), str) for part in ("clock", "device"))
        threads, versions = told.get("threads"), told.get("versions")
        if not texts or not isinstance(threads, dict) or not isinstance(versions, dict):
            raise WorkerError(f"facts: the answer is {shown(told)}")
        return {
            "clock": str(told["clock"]),
            "device": str(told["device"])[:200],
            "threads": {str(name): int(count) for name, count in threads.items()},
            "versions": {
                "interpreter": self.remote.interpreter,
                **{str(name): str(version)[:100] for name, version in versions.items()},
            },
        }

    def memory(self) -> RemoteMemory:
        """The peak of memory there, from here on."""
        return RemoteMemory(self)

    def _told(self, call: str, **request: Any) -> Mapping[str, Any]:
        self._ready()
        told = self.remote.ask({"call": call, **request}, what=call, seconds=60)[0].get("value")
        return told if isinstance(told, Mapping) else {}


class RemoteMemory:
    """The peak of what a worker holds from here on."""

    def __init__(self, method: RemoteMethod) -> None:
        self._told = method._told
        self._told("memory", anew=True)

    def peak(self) -> dict[str, Any]:
        """As a report has it."""
        told = self._told("memory", anew=False)
        host, on_device = (
            value if type(value) is int and value >= 0 else None
            for value in (told.get("host_bytes"), told.get("device_bytes"))
        )
        source = None if host is None else "predictions" if told.get("anew") else "process"
        return {"host_bytes": host, "host_source": source, "device_bytes": on_device}


def remote_method(spec: Spec) -> type[RemoteMethod]:
    """Start a worker and make a class of what it declares.

    Raises :class:`WorkerError`, :class:`RaisedThereError` and :class:`DeclarationError`.
    """
    remote = Remote(spec)
    remote.started()
    try:
        info = info_of(remote.declared.get("info"), spec.told, spec.name)
    except DeclarationError:
        remote.close()
        raise
    members: dict[str, Any] = {"info": info, "remote": remote, "__doc__": "A method elsewhere."}
    if remote.declared.get("has_assets_in") is True:
        members["assets_in"] = classmethod(_assets_in)
    members["__module__"] = __name__
    return type(f"RemoteMethod[{spec.told}]", (RemoteMethod,), members)


def _assets_in(cls: type[RemoteMethod], folder: Path) -> list[Asset]:
    """As :func:`pytest_cpas.types.assets_of` asks for."""
    cls.remote.started()
    request = {"call": "assets_in", "folder": cls.remote.spec.there(folder)}
    told = cls.remote.ask(request, what="assets_in", seconds=60)[0].get("value")
    if not isinstance(told, list):
        raise DeclarationError(f"method {cls.info.name!r}: assets_in gave {shown(told)}")
    return [asset_of(each, cls.info.name) for each in told]


def machine() -> str:
    """What tells a machine from others, also seen from a container on it."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return platform.node()


def _seconds(value: object) -> float:
    return float(value) if isinstance(value, int | float) and 0 <= value < 1e9 else 0.0


def _random_state() -> int:
    """A number that is another one once anybody has drawn from a global generator."""
    _, keys, place, *_ = np.random.get_state()  # noqa: NPY002
    state = zlib.crc32(np.asarray(keys).tobytes(), int(place))
    return zlib.crc32(repr(hash(random.getstate())).encode(), state)


def _draw(names: object) -> None:
    """Draw from the global generators that the method has drawn from: who looks after them here
    sees it."""
    if isinstance(names, list) and "random" in names:
        random.random()  # noqa: S311
    if isinstance(names, list) and "numpy.random" in names:
        np.random.random()  # noqa: NPY002


def _put_back(changed: object, arrays: Sequence[NDArray[Any]], given: list[NDArray[Any]]) -> None:
    """Change arrays as the method has changed its own; takes what is for that off ``given``."""
    if not isinstance(changed, list) or not changed:
        return
    for place, array in zip(changed, given[len(given) - len(changed) :], strict=True):
        if type(place) is int and 0 <= place < len(arrays) and array.size == arrays[place].size:
            arrays[place][...] = array.reshape(arrays[place].shape)
    del given[len(given) - len(changed) :]
