"""How much two right codes may differ at each value: a method against itself.

The same prediction again with another number of threads, beside another observation in one batch,
from an observation that float noise has touched, and with networks in float64. What these change is
rounding alone.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from pytest_cpas.traces.comparing import relative_difference
from pytest_cpas.traces.recording import Trace, record
from pytest_cpas.traces.values import Array, Value
from pytest_cpas.types import Method, Observation, words_of

__all__ = ["with_spread"]

#: Relative noise of depth and colour: half a step of float32.
STEP = 2.0**-24


def with_spread(
    method: Method, observation: Observation, seed: int, trace: Trace
) -> tuple[Trace, Mapping[str, str]]:
    """The trace with the spread of each value, and what was measured: the largest relative
    difference under each condition, or why there is none."""
    conditions: Mapping[str, Callable[[], Trace]] = {
        "threads": lambda: _with_other_threads(method, observation, seed),
        "batch": lambda: record(method, [observation, observation], seed),
        "noise": lambda: record(method, [touched(observation, seed)], seed),
        "float64": lambda: record(method, [observation], seed, wide=True),
    }
    spread: dict[tuple[str, int], float] = {}
    told: dict[str, str] = {}
    for name, again in conditions.items():
        try:
            other = again()
            if name == "float64":
                check_wide(other)
        except Exception as error:
            told[name] = f"not possible: {words_of(error)}"
            continue
        found, changed = _spread(trace, other)
        told[name] = f"{max(found.values(), default=0.0):.1e}"
        if changed:
            told[name] += f" before {changed}, where another choice is made"
        for key, size in found.items():
            spread[key] = max(spread.get(key, 0.0), size)
        # of the very same inputs, in the very same arithmetic
        if changed and name in ("threads", "batch"):
            told[name] += ", so that nothing is compared from there on"
            spread |= dict.fromkeys(_from(trace, changed), math.inf)
    values = [
        value.replaced(spread=spread[value.key]) if value.key in spread else value
        for value in trace.values
    ]
    return replace(trace, values=values), told


def check_wide(trace: Trace) -> None:
    """Raise :class:`ValueError` unless a network has computed in float64."""
    if not trace.widened:
        raise ValueError("no network is tapped by TorchTaps")
    if problems := {name: why for name, why in trace.widened.items() if why}:
        raise ValueError(", ".join(f"{name}: {why}" for name, why in problems.items()))


def _spread(trace: Trace, other: Trace) -> tuple[dict[tuple[str, int], float], str]:
    """The relative difference of each real value that can be compared, not of what is drawn.

    Where float noise has changed an integer, a choice, what follows is about something else and is
    no noise: the value's name, and nothing from there on.
    """
    theirs, found = other.by_key(), dict[tuple[str, int], float]()
    for value in trace.values:
        again = theirs.get(value.key)
        if again is None or value.kind not in ("tap", "answer"):
            continue
        array = _first_of_batch(again, value)
        if array is None:
            continue
        if not value.is_real:
            if value.kept.dtype.kind in "iub" and not np.array_equal(array, value.kept):
                return found, value.told
            continue
        size = relative_difference(array, value.kept)
        if np.isfinite(size):
            found[value.key] = size
    return found, ""


def _from(trace: Trace, told: str) -> list[tuple[str, int]]:
    """The values of a trace from one on."""
    names = [value.told for value in trace.values]
    return [value.key for value in trace.values[names.index(told) :]]


def _first_of_batch(again: Value, value: Value) -> Array | None:
    """The part of the first observation."""
    if again.shape == value.shape:
        return again.kept
    shape = (2 * value.shape[0], *value.shape[1:]) if value.shape else ()
    return again.kept[: value.shape[0]] if again.shape == shape else None


def touched(observation: Observation, seed: int) -> Observation:
    """An observation whose depth and colours are changed by about a step of float32."""
    random = np.random.default_rng(seed)

    def noisy(array: Array) -> Array:
        factors = 1 + STEP * random.uniform(-2, 2, array.shape)
        return (array * factors).astype(np.float32)

    return replace(
        observation,
        depth=noisy(observation.depth),
        rgb=noisy(observation.rgb).clip(0, 1),
    )


def _with_other_threads(method: Method, observation: Observation, seed: int) -> Trace:
    with other_threads():
        return record(method, [observation], seed)


@contextmanager
def other_threads() -> Iterator[None]:
    """One thread for torch where there were several, and two where there was one."""
    torch = sys.modules.get("torch")
    if torch is None:
        raise RuntimeError("torch is not imported")
    before = torch.get_num_threads()
    torch.set_num_threads(1 if before > 1 else 2)
    try:
        yield
    finally:
        torch.set_num_threads(before)
