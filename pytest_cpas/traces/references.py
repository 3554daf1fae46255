"""What a method is compared with: a recorded trace, or another method that runs now."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path

from pytest_cpas.reading.paths import names
from pytest_cpas.traces.files import read_header, read_sample, samples_in
from pytest_cpas.traces.recording import Trace, record
from pytest_cpas.types import (
    DataError,
    Method,
    Observation,
    SampleRef,
    ToldError,
    message_of,
    some_of,
)

__all__ = ["MethodReference", "NoTraceError", "RecordedReference", "Reference"]


class NoTraceError(ToldError):
    """A reference gives no trace of a sample that it should have."""


class Reference(ABC):
    """What a method is compared with; ``told`` in words."""

    told: str

    @abstractmethod
    def trace(self, ref: SampleRef, observation: Observation, seed: int) -> Trace | None:
        """The trace of a sample; None if it has none of it.

        Raises :class:`NoTraceError` and :class:`pytest_cpas.types.DataError`.
        """

    def notes(self, identity: Mapping[str, str]) -> list[str]:
        """What is to be told of it beside a run of this identity."""
        return []

    def close(self) -> None:  # noqa: B027 - most hold nothing
        """Let go of what it holds."""


class RecordedReference(Reference):
    """A folder that ``--cpas-trace`` has written."""

    def __init__(self, folder: Path, method: str, dataset: str) -> None:
        """Look for the trace of a data set: of the method of this name, or of the only one.

        Raises :class:`pytest_cpas.types.DataError` if there is none, or several.
        """
        self.folder = trace_folder(folder, method, dataset)
        self._samples = samples_in(self.folder)
        if not self._samples:
            raise DataError(f"{self.folder}: no trace; --cpas-trace DIR records one")
        header = read_header(next(iter(self._samples.values())))
        self.header = header
        self.told = f"the trace of {header.method}"

    def notes(self, identity: Mapping[str, str]) -> list[str]:
        """Other weights, or another device, than those of the run."""
        there = self.header.identity
        return [
            f"{self.told} is of other {name}: {there[name]}, and here {identity[name]}"
            for name in ("weights", "device")
            if name in there and name in identity and there[name] != identity[name]
        ]

    def trace(self, ref: SampleRef, observation: Observation, seed: int) -> Trace | None:
        """As recorded; :class:`NoTraceError` if that was under another seed."""
        path = self._samples.get(ref.id)
        if path is None:
            return None
        read = read_sample(path)
        if read.header.seed != seed:
            raise NoTraceError(
                f"{path}: recorded under seed {read.header.seed}, and this run has {seed}; give"
                f" --cpas-seed={read.header.seed}"
            )
        return read.trace


def trace_folder(folder: Path, method: str, dataset: str) -> Path:
    """Where the trace of a data set is below a folder, or the folder itself.

    Raises :class:`pytest_cpas.types.DataError`.
    """
    if any(name.endswith(".jsonl") for name in names(folder)):
        return folder
    if names(folder / method / dataset):
        return folder / method / dataset
    if names(folder / dataset):
        return folder / dataset
    others = sorted(name for name in names(folder) if names(folder / name / dataset))
    if len(others) == 1:
        return folder / others[0] / dataset
    seen = f"traces of {some_of(others)}" if others else f"no trace of {dataset}"
    raise DataError(
        f"{folder}: {seen}, expected one of {method} on {dataset}; name the folder of one, such as"
        f" {folder / (others[0] if others else method)}"
    )


class MethodReference(Reference):
    """Another method, in this process; it is loaded when it is first asked."""

    def __init__(
        self, told: str, make: Callable[[], Method], weights: Path | None, device: str
    ) -> None:
        self.told = told
        self._make, self._weights, self._device = make, weights, device

    @functools.cached_property
    def _method(self) -> Method:
        method = self._make()
        method.load(self._weights, self._device)
        return method

    def trace(self, ref: SampleRef, observation: Observation, seed: int) -> Trace | None:
        """Made now."""
        try:
            method = self._method
            if ref.category not in method.info.categories:
                return None
            return record(method, [observation], seed)
        except Exception as error:
            raise NoTraceError(
                f"{self.told} on {ref.id}: {type(error).__name__}: {message_of(error)}"
            ) from error
