"""A method in another revision, in a process of its own, as a reference."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

from pytest_cpas.reading.arrays import read_npz
from pytest_cpas.traces import traced_worker
from pytest_cpas.traces.recording import Recorder, Trace, answer_parts, observed
from pytest_cpas.traces.references import NoTraceError, Reference
from pytest_cpas.traces.values import Value
from pytest_cpas.types import Hypothesis, Mesh, MethodInfo, Observation, Prediction, SampleRef
from pytest_cpas.types.frames import standard_prediction

__all__ = ["Adapter", "RevisionReference"]


class Adapter(Protocol):
    """A class of a module in the ``tree`` of a revision; ``first``: the folders in it that Python
    looks into."""

    @property
    def module(self) -> str:
        """Its dotted name."""

    @property
    def attribute(self) -> str:
        """The class's name in it."""

    @property
    def tree(self) -> Path | None:
        """Where the revision lies."""

    @property
    def first(self) -> tuple[Path, ...]:
        """What comes first on the path."""


class RevisionReference(Reference):
    """The adapter as it was; its process starts when it is first asked."""

    def __init__(
        self, told: str, extract: Callable[[Path], Adapter], weights: Path | None, device: str
    ) -> None:
        """``extract``: puts the files of the revision below a folder."""
        self.told = told
        self._extract, self._weights, self._device = extract, weights, device
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._process: subprocess.Popen[str] | None = None

    def trace(self, ref: SampleRef, observation: Observation, seed: int) -> Trace | None:
        """Made now, there."""
        if self._folder is None:
            self._start()
        folder = Path(cast(Any, self._folder).name)
        camera = observation.camera
        size = (camera.width, camera.height)
        np.savez(
            folder / "observation.npz",
            category=np.array(observation.category),
            camera=np.array([*size, camera.fx, camera.fy, camera.cx, camera.cy]),
            **{part: getattr(observation, part) for part in ("rgb", "depth", "mask")},
        )
        told = self._ask(
            observation=f"{folder / 'observation.npz'}", seed=seed, target=f"{folder / 'trace.npz'}"
        )
        arrays = read_npz(folder / "trace.npz")
        return _trace(told, list(arrays.values()), observation)

    def close(self) -> None:
        """End the process, and remove the files."""
        if self._process is not None:
            if self._process.poll() is None:
                self._process.kill()
            self._process.wait()
            for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
                if stream is not None:
                    stream.close()
            self._process = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _start(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="cpas-parity-")
        folder = Path(self._folder.name)
        adapter = self._extract(folder)
        with (folder / "complaints").open("w") as complaints:
            self._process = subprocess.Popen(  # noqa: S603 - this Python, a file of ours
                [sys.executable, "-P", traced_worker.__file__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=complaints,
                encoding="utf-8",
            )
        self._ask(
            path=[*map(str, adapter.first), *sys.path],
            module=adapter.module,
            attribute=adapter.attribute,
            inside=str(adapter.tree),
            weights=None if self._weights is None else str(self._weights),
            device=self._device,
        )

    def _ask(self, **request: Any) -> Any:
        process = self._process
        if process is None or process.stdin is None or process.stdout is None:
            raise NoTraceError(f"{self.told}: its process has ended")
        try:
            process.stdin.write(json.dumps(request) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            complaints = Path(cast(Any, self._folder).name) / "complaints"
            said = complaints.read_text(encoding="utf-8", errors="replace").strip()[-2000:]
            raise NoTraceError(
                f"{self.told}: its process ended with exit status {process.wait()}:"
                f" {said or 'it printed nothing'}"
            )
        answer = json.loads(line)
        if "error" in answer:
            raise NoTraceError(f"{self.told}, in its process:\n{answer['error'].rstrip()}")
        return answer["answer"]


def _trace(told: Any, arrays: list[Any], observation: Observation) -> Trace:
    """The trace of what a worker has told, in the standard frames."""
    recorder = Recorder()
    observed(recorder, observation)
    calls: Counter[str] = Counter()
    values: list[Value] = list(recorder.values)
    parts: dict[int, dict[str, Any]] = {}
    for (name, kind, stage), array in zip(told["values"], arrays, strict=True):
        if kind == "answer":
            number, _, part = name.partition(".")
            parts.setdefault(int(number), {})[part] = array
            continue
        calls[name] += 1
        values.append(Value.of(name, calls[name], kind, stage, array))
    camera, axes = told["frames"]
    prediction = Prediction(
        tuple(_hypothesis(each) for _, each in sorted(parts.items())), reason=told["reason"]
    )
    info = MethodInfo(
        name="reference",
        categories=(observation.category,),
        needs=frozenset(),
        gives=frozenset(),
        licence="",
        camera_frame=camera,
        object_frame=axes,
    )
    answer = Recorder()
    for name, part in answer_parts(standard_prediction(prediction, info)):
        answer.keep(f"answer.{name}", part, "answer")
    return Trace(values=[*values, *answer.values], reason=told["reason"])


def _hypothesis(parts: dict[str, Any]) -> Hypothesis:
    score = parts.pop("score", None)
    vertices, triangles = parts.pop("vertices", None), parts.pop("triangles", None)
    mesh = None if vertices is None else Mesh(vertices, triangles)
    return Hypothesis(**parts, mesh=mesh, score=None if score is None else float(score))
