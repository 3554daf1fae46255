"""One prediction of a method, with all that it says of its inside."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np

from pytest_cpas.evaluation import check_answers
from pytest_cpas.stages import hearing, listening
from pytest_cpas.traces.values import Array, Kind, Value, parts_of, plain_array
from pytest_cpas.types import (
    AnswerError,
    Hypothesis,
    Mesh,
    Method,
    Observation,
    Prediction,
)
from pytest_cpas.types.frames import standard_prediction

__all__ = ["Trace", "answer_of", "record"]

ValueT = TypeVar("ValueT")

#: Values of one prediction, and bytes that may be held of it while it runs.
MOST_VALUES = 9_000
MOST_HELD = 2**31


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Trace:
    """The values of one prediction in their order; ``reason``: why there is no answer, if there is
    none; ``widened``: the networks that computed in float64, each with "" or why it could not."""

    values: Sequence[Value]
    reason: str | None = None
    widened: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def by_key(self) -> dict[tuple[str, int], Value]:
        """The values by name and call."""
        return {value.key: value for value in self.values}


class Recorder:
    """Listens to stages and values. ``replay``: what is handed out in place of what is drawn, by
    name and call; ``wide``: see :class:`pytest_cpas.stages.Listener`."""

    def __init__(
        self, replay: Mapping[tuple[str, int], Array] | None = None, *, wide: bool = False
    ) -> None:
        self.values: list[Value] = []
        self.wide_parts: dict[str, str] = {}
        self.wide = wide
        self.replay: Mapping[tuple[str, int], Any] = dict(replay or {})
        self._stages: list[str] = []
        self._calls: Counter[str] = Counter()
        self._held = 0

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Enter a stage, and leave it."""
        self._stages.append(name)
        try:
            yield
        finally:
            self._stages.pop()

    def tapped(self, name: str, value: object) -> None:
        """Keep a copy."""
        self.keep(name, value, "tap")

    def drawn(self, name: str, value: ValueT) -> ValueT:
        """Keep a copy, and hand out what is to be replayed, as the same kind of thing."""
        call = self._calls[name] + 1
        self.keep(name, value, "draw")
        other = self.replay.get((name, call))
        return value if other is None else _like(name, value, other)

    def widened(self, name: str, problem: str) -> None:
        """Note it."""
        self.wide_parts[name] = problem

    def keep(self, name: str, value: object, kind: Kind) -> None:
        """Keep copies of the arrays in a value; raises :class:`AnswerError` where there are too
        many."""
        for part_name, part in parts_of(name, value):
            array = plain_array(part_name, part)
            self._held += array.nbytes
            if len(self.values) >= MOST_VALUES or self._held > MOST_HELD:
                raise AnswerError(
                    f"tap {part_name!r}: there are {len(self.values)} values of"
                    f" {self._held / 2**20:.0f} MiB before it, at most {MOST_VALUES} and"
                    f" {MOST_HELD / 2**20:.0f} MiB are recorded; name fewer, with exclude of"
                    " TorchTaps"
                )
            self._calls[part_name] += 1
            where = self._stages[-1] if self._stages else ""
            self.values.append(Value.of(part_name, self._calls[part_name], kind, where, array))


def record(
    method: Method,
    batch: Sequence[Observation],
    seed: int,
    replay: Mapping[tuple[str, int], Array] | None = None,
    *,
    wide: bool = False,
) -> Trace:
    """The trace of one prediction for the first observation of a batch.

    ``replay``: what is handed out in place of what is drawn; ``wide``: networks compute in float64
    where they can. Of a batch of several, all values are kept, and the answer for the first. The
    answer is in the standard frames. Raises what the method raises.
    """
    recorder = Recorder(replay, wide=wide)
    observed(recorder, batch[0])
    with hearing(recorder), listening(recorder):
        answers = method.predict([seen.copy() for seen in batch], seed)
    prediction = check_answers(answers[:1] if len(batch) > 1 else answers, method.info)
    prediction = standard_prediction(prediction, method.info)
    for name, part in answer_parts(prediction):
        recorder.keep(f"answer.{name}", part, "answer")
    return Trace(
        values=recorder.values,
        reason=None if prediction.hypotheses else prediction.reason,
        widened=recorder.wide_parts,
    )


def observed(recorder: Recorder, observation: Observation) -> None:
    """Keep the parts of an observation."""
    for name in ("rgb", "depth", "mask"):
        recorder.keep(f"observation.{name}", getattr(observation, name), "observation")
    camera = observation.camera
    intrinsics = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
    recorder.keep("observation.camera", np.array(intrinsics, float), "observation")


def answer_parts(prediction: Prediction) -> Iterator[tuple[str, Any]]:
    """The parts of all hypotheses by name; the best one's have no number."""
    for index, hypothesis in enumerate(prediction.hypotheses):
        number = "" if index == 0 else f"{index + 1}."
        for name in ("rotation", "translation", "extents", "points", "score"):
            if (part := getattr(hypothesis, name)) is not None:
                yield f"{number}{name}", part
        if hypothesis.mesh is not None:
            yield f"{number}vertices", hypothesis.mesh.vertices
            yield f"{number}triangles", hypothesis.mesh.triangles


def answer_of(trace: Trace) -> Hypothesis | None:
    """The best hypothesis of a trace, in the standard frames, as far as its parts were kept; None
    without any."""
    parts: dict[str, Any] = {
        value.name.removeprefix("answer."): value.kept
        for value in trace.values
        if value.kind == "answer" and value.is_whole
    }
    if not {"rotation", "translation"} <= parts.keys():
        return None
    mesh = None
    if {"vertices", "triangles"} <= parts.keys():
        mesh = Mesh(parts["vertices"], parts["triangles"])
    score = parts.get("score")
    return Hypothesis(
        rotation=parts["rotation"],
        translation=parts["translation"],
        extents=parts.get("extents"),
        points=parts.get("points"),
        mesh=mesh,
        score=None if score is None else float(score),
    )


def draws_of(trace: Trace, names: Collection[str] | None = None) -> dict[tuple[str, int], Array]:
    """What a trace has drawn and kept as a whole, by name and call: all, or that of ``names``."""
    return {
        value.key: value.kept
        for value in trace.values
        if value.kind == "draw" and value.is_whole and (names is None or value.name in names)
    }


def _like(name: str, value: ValueT, other: Array) -> ValueT:
    """``other`` as an array or tensor like ``value``; raises :class:`AnswerError` if it is none."""
    shape = tuple(getattr(value, "shape", ()))
    if shape != other.shape:
        raise AnswerError(
            f"draw {name!r}: {other.shape} were drawn by the reference, expected {shape} as here"
        )
    if hasattr(value, "new_tensor"):
        made: ValueT = value.new_tensor(other)
        return made
    replayed: Any = other.astype(np.asarray(value).dtype)
    return replayed if isinstance(value, np.ndarray) else type(value)(replayed.item())  # type: ignore[call-arg]
