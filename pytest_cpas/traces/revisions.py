"""A method in another revision, in a process of its own, as a reference."""

from __future__ import annotations

import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

from pytest_cpas.evaluation import MethodProcess, Revision, write_observations
from pytest_cpas.reading.arrays import read_npz
from pytest_cpas.traces import traced_worker
from pytest_cpas.traces.recording import Recorder, Trace, answer_parts, observed
from pytest_cpas.traces.references import NoTraceError, Reference
from pytest_cpas.traces.values import Value
from pytest_cpas.types import Hypothesis, Mesh, MethodInfo, Observation, Prediction, SampleRef
from pytest_cpas.types.frames import standard_prediction

__all__ = ["RevisionReference"]


class RevisionReference(Reference):
    """The adapter as it was; its process starts when it is first asked."""

    def __init__(self, told: str, revision: Revision, weights: Path | None, device: str) -> None:
        self.told = told
        self._revision, self._weights, self._device = revision, weights, device
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._process: MethodProcess | None = None
        self._problem: NoTraceError | None = None

    def trace(self, ref: SampleRef, observation: Observation, seed: int) -> Trace | None:
        """Made now, there; :class:`pytest_cpas.evaluation.RevisionError` as well."""
        folder, process = self._started()
        write_observations(folder / "observation.npz", [observation])
        told = process.ask(
            "trace", f"{folder / 'observation.npz'}", seed, f"{folder / 'trace.npz'}"
        )
        arrays = read_npz(folder / "trace.npz")
        return _trace(told, list(arrays.values()), observation)

    def close(self) -> None:
        """End the process, and remove the files."""
        if self._process is not None:
            self._process.close()
            self._process = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _started(self) -> tuple[Path, MethodProcess]:
        if self._problem is not None:  # it would be the same again
            raise self._problem
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="cpas-parity-")
        folder = Path(self._folder.name)
        if self._process is None:
            adapter = self._revision.extract(folder)
            try:
                self._process = MethodProcess(
                    self.told,
                    traced_worker.__file__,
                    adapter,
                    weights=self._weights,
                    device=self._device,
                    error=NoTraceError,
                )
            except NoTraceError as error:
                self._problem = error
                raise
        return folder, self._process


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
