"""A method in another interpreter, which answers here as any other one does."""

from __future__ import annotations

import copy
import itertools
import random
import time
import zlib
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.remote.answers import asset_of, info_of, predictions_of, told_observations
from pytest_cpas.remote.process import WorkerError
from pytest_cpas.remote.reached import Remote
from pytest_cpas.remote.spec import Spec
from pytest_cpas.stages import draw, heard_by, listener, stage, tap
from pytest_cpas.types import (
    AnswerError,
    Asset,
    DeclarationError,
    MethodInfo,
    Observation,
    Prediction,
    shown,
)

__all__ = ["RemoteMethod", "remote_method"]

_numbers = itertools.count()


class RemoteMethod:
    """A method whose class, assets and answers are those of a worker; made by
    :func:`remote_method`."""

    info: MethodInfo
    remote: Remote
    #: Whether it is of plain values, and knows no type of pytest-cpas.
    is_plain: bool

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
        replayed: list[NDArray[Any]] = []
        if (hearing := heard_by()) is not None:
            replay = {key: x for key, x in hearing.replay.items() if x.dtype.kind in "iuf"}
            request |= {"traced": True, "replay": list(replay)}
            replayed = [np.asarray(x, x.dtype.newbyteorder("<")) for x in replay.values()]
        start = time.perf_counter()
        answer, given = self.remote.ask(
            request, [*arrays, *replayed], what="predict", seconds=seconds
        )
        elapsed = time.perf_counter() - start
        self.own_seconds += _seconds(answer.get("seconds"))
        self.transfer_seconds += max(elapsed - _seconds(answer.get("wall")), 0.0)
        if clock is not None and isinstance(stages := answer.get("stages"), dict):
            for name, value in stages.items():
                clock.seconds[name] = clock.seconds.get(name, 0.0) + _seconds(value)
        _draw(answer.get("drawn"))
        _put_back(answer.get("changed"), arrays, given)
        if hearing is not None:
            _name_values(answer.get("values"), answer.get("values_from"), given)
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
    members["is_plain"] = remote.declared.get("is_plain") is True
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


def _seconds(value: object) -> float:
    return float(value) if isinstance(value, int | float) and 0 <= value < 1e9 else 0.0


def _random_state() -> int:
    """A number that is another one once anybody has drawn from a global generator."""
    _, keys, place, *_ = np.random.get_state()  # noqa: NPY002
    state = zlib.crc32(np.asarray(keys).tobytes(), int(place))
    return zlib.crc32(repr(hash(random.getstate())).encode(), state)


def _name_values(told: object, first: object, given: Sequence[NDArray[Any]]) -> None:
    """Name here what was named there; :class:`AnswerError` for what is none."""
    places = range(len(given) + 1)
    if (
        not isinstance(told, list)
        or type(first) is not int
        or not {first, first + len(told)} <= {*places}
    ):
        raise AnswerError(f"predict: values are {shown(told)}, expected names of arrays")
    for each, array in zip(told, given[first:], strict=False):
        texts = isinstance(each, list) and all(isinstance(text, str) for text in each)
        if not texts or len(each) != 3:
            raise AnswerError(f"predict: a value is {shown(each)}, expected name, kind and stage")
        name, kind, where = each
        with stage(where) if where else nullcontext():
            (draw if kind == "draw" else tap)(name, array)


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
