"""An implementation under test: every call is guarded, converted and recorded."""

from __future__ import annotations

import contextlib
import io
import os
import random
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
from typing import Any

import numpy as np

from pytest_cpas.checks.metrics.adapter import KNOWN, Box, Offer, Sample, as_turns
from pytest_cpas.checks.outcome import Finding, Outcome
from pytest_cpas.types import Symmetry

__all__ = ["Subject", "time_limit"]


class _Timer:
    """The time limit of the property that is being checked."""

    seconds = 0.0
    expired = False
    calling = False

    @classmethod
    def finding(cls) -> Finding:
        return Finding(Outcome.HUNG, f"the property took more than {cls.seconds:g} s")

    @classmethod
    def on_alarm(cls, number: int, frame: FrameType | None) -> None:
        cls.expired = True
        if cls.calling:
            raise cls.finding()


@contextlib.contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """End calls of an implementation when ``seconds`` have passed, with :class:`Finding`.

    A call is interrupted where signals exist (POSIX, main thread), and again and again if it
    swallows that; elsewhere, and in compiled code, the limit is noticed when the call returns. A
    call that never does is for :mod:`pytest_cpas.evaluation.watchdog`, which ends the process.
    """
    _Timer.seconds, _Timer.expired = seconds, False
    if not hasattr(signal, "SIGALRM") or threading.current_thread() is not threading.main_thread():
        timer = threading.Timer(seconds, setattr, (_Timer, "expired", True))
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()
        return
    began = time.monotonic()
    before = signal.signal(signal.SIGALRM, _Timer.on_alarm)
    others, interval = signal.setitimer(signal.ITIMER_REAL, seconds, 0.05)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        if others:  # somebody else's limit goes on; if it has passed meanwhile, it is told now
            left = others - (time.monotonic() - began)
            signal.setitimer(signal.ITIMER_REAL, max(left, 1e-6), interval)


class Subject:
    """The metrics of one implementation, called in the conventions of this package.

    ``subject("box_iou", box_a, box_b)`` gives a float (None where the metric may be n/a, a tuple
    of numbers or points) in radians, metres or shares of 1, whatever the implementation uses. It
    raises :class:`Finding` when the implementation raises, takes too long or returns something
    else. What it prints goes nowhere, and it gets copies of the arguments: :meth:`conduct` is what
    looks at that.
    """

    def __init__(self, name: str, metrics: Mapping[str, Offer]) -> None:
        """Raise :class:`ContractError` if an offer's definition is impossible."""
        self.name = name
        self.offers = {metric: offer.completed(metric) for metric, offer in metrics.items()}
        self.calls: list[tuple[str, tuple[Any, ...], str]] = []

    def __call__(self, metric: str, *args: Any) -> Any:
        """Compute a metric."""
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            return self._call(metric, args)

    def defines(self, metric: str, key: str) -> Any:
        """What the implementation declares about a metric that it offers."""
        return self.offers[metric].definition[key]

    def refuses(self, metric: str, *args: Any) -> None:
        """The implementation must raise for these arguments, not return anything."""
        try:
            value = self(metric, *args)
        except Finding as finding:
            if finding.outcome is Outcome.RAISED:
                return
            if finding.outcome is not Outcome.WRONG_TYPE:
                raise
            raise Finding(Outcome.VIOLATED, f"{finding} for bad input, expected an error") from None
        raise Finding(Outcome.VIOLATED, f"returned {value!r} for bad input, expected an error")

    def conduct(self, metric: str, *args: Any) -> None:
        """The call must print nothing, leave its arguments and the global random state alone."""
        offer = self.offers[metric]
        mine = offer.arguments(as_turns(metric, args))
        before = _image(mine)
        state = _random_state()
        with _captured() as printed:
            self._guarded(offer.function, mine)
            text = printed()
        self.calls.append((metric, args, ""))
        if _image(mine) != before:
            raise Finding(Outcome.CHANGED_ARGUMENTS, "the arguments are not what they were")
        if _random_state() != state:
            raise Finding(
                Outcome.DREW_GLOBAL_RANDOM, "numpy's or Python's global random state has changed"
            )
        if text:
            raise Finding(Outcome.PRINTED, f"the call printed {text[:60]!r}")

    def _call(self, metric: str, args: tuple[Any, ...]) -> Any:
        offer = self.offers[metric]
        mine = offer.arguments(as_turns(metric, args))
        self.calls.append((metric, args, "no result"))
        try:
            value = self._guarded(offer.function, mine)
            gives = KNOWN[metric].gives
            result: Any
            if value is None and gives.endswith("or None"):
                result = None
            elif gives == "truth value":
                result = _as_truth(value)
            elif gives.startswith("numbers"):
                result = tuple(map(offer.result, _as_rows(value, 1)))
            elif gives == "points":
                result = tuple(map(tuple, _as_rows(value, 2)))
            else:
                result = offer.result(_as_number(value))
        except Finding as finding:
            self.calls[-1] = (metric, args, str(finding))
            raise
        self.calls[-1] = (metric, args, f"gives {result!r}")
        return result

    def _guarded(self, function: Callable[..., Any], args: list[Any]) -> Any:
        if _Timer.expired:
            raise _Timer.finding()
        _Timer.calling = True
        try:
            value = function(*args)
        except Finding:
            raise
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            words = " ".join(str(error).split())[:160]
            raise Finding(
                Outcome.RAISED,
                f"raised {type(error).__name__}: {words} (in {place.name}, line {place.lineno})",
            ) from error
        finally:
            _Timer.calling = False
        if _Timer.expired:
            raise _Timer.finding()
        return value

    def snippet(self, message: str) -> str:
        """The calls since ``calls`` was cleared, as code that can be pasted."""
        lines = [
            "from numpy import array, inf, nan",
            "from pytest_cpas.checks.metrics import Box, Sample, load_subject",
            "from pytest_cpas.types import Symmetry",
            f"subject = load_subject({self.name!r})",
        ]
        for metric, args, result in self.calls[-6:]:
            words = ", ".join([repr(metric), *map(source, args)])
            lines.append(f"subject({words})" + (f"  # {result}" if result else ""))
        return "\n".join([*lines, f"# {message}"])


def source(value: Any) -> str:
    """Python code for an argument."""
    if isinstance(value, np.ndarray):
        return f"array({value.tolist()!r})"
    if isinstance(value, Box):
        box = (value.rotation, value.translation, value.extents)
        return f"Box({', '.join(map(source, box))})"
    if isinstance(value, Sample):
        parts = (value.rotation, value.translation, value.extents, value.points)
        return f"Sample({', '.join(map(source, parts))})"
    if isinstance(value, Symmetry):
        if value.sphere:
            return "Symmetry.full()"
        axis = "" if value.axis is None else f", axis={source(value.axis)}"
        return f"Symmetry({source(value.rotations)}{axis})"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k!r}: {source(v)}" for k, v in value.items()) + "}"
    return repr(value)


def _as_number(value: Any) -> float:
    if isinstance(value, (str, bytes, bool, np.bool_, complex, np.complexfloating)) or (
        isinstance(value, np.ndarray) and value.shape != ()
    ):
        raise Finding(Outcome.WRONG_TYPE, f"returned {_kind(value)}, expected one real number")
    try:
        return float(value)
    except (TypeError, ValueError):
        raise Finding(
            Outcome.WRONG_TYPE, f"returned {_kind(value)}, expected one real number"
        ) from None


def _as_rows(value: Any, dimensions: int) -> list[Any]:
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros(())
    if array.ndim != dimensions or (dimensions == 2 and array.shape[1] != 3):
        expected = "a list of real numbers" if dimensions == 1 else "points (N, 3)"
        raise Finding(Outcome.WRONG_TYPE, f"returned {_kind(value)}, expected {expected}")
    rows: list[Any] = array.tolist()
    return rows


def _as_truth(value: Any) -> bool:
    if isinstance(value, (bool, np.bool_)) or (
        isinstance(value, (int, np.integer)) and value in (0, 1)
    ):
        return bool(value)
    raise Finding(Outcome.WRONG_TYPE, f"returned {_kind(value)}, expected True or False")


def _kind(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} and type {value.dtype}"
    return f"{value!r:.60} of type {type(value).__name__}"


def _image(value: Any) -> Any:
    """A value that is equal if and only if the arguments are."""
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if isinstance(value, (list, tuple)):
        return [_image(entry) for entry in value]
    if isinstance(value, dict):
        return [(key, _image(entry)) for key, entry in value.items()]
    if isinstance(value, Sample):
        return _image([value.rotation, value.translation, value.extents, value.points])
    if hasattr(value, "as_quat"):
        return value.as_quat().tobytes()
    return repr(value)


def _random_state() -> Any:
    return _image(list(np.random.get_state())), random.getstate()  # noqa: NPY002 - it is watched


@contextlib.contextmanager
def _captured() -> Iterator[Callable[[], str]]:
    """What is written to the standard streams, by Python code or compiled code."""
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as file:

        def text() -> str:
            file.flush()
            file.seek(0)
            return file.read()

        streams = sys.stdout, sys.stderr
        descriptors = os.dup(1), os.dup(2)
        sys.stdout = sys.stderr = file
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        try:
            yield text
        finally:
            sys.stdout, sys.stderr = streams
            for number, descriptor in enumerate(descriptors, start=1):
                os.dup2(descriptor, number)
                os.close(descriptor)
