"""Methods in processes of their own: two of them, or two revisions, compete on equal terms."""

from __future__ import annotations

from pathlib import Path

from pytest_cpas.evaluation import Adapter, MethodProcess
from pytest_cpas.timing import contestant
from pytest_cpas.types import ToldError


class TimingError(ToldError):
    """Something cannot be timed: a worker died, a method raised."""


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
        :func:`pytest_cpas.evaluation.write_observations`.
        """
        self.name = name
        self._process = MethodProcess(
            name,
            contestant.__file__,
            adapter,
            weights=weights,
            device=device,
            error=TimingError,
            seed=seed,
            observations=str(observations),
        )

    def run(self, index: int) -> float:
        """Seconds of one prediction, taken in the worker."""
        return float(self._process.ask("run", index))

    def settle(self, repetitions: int) -> None:
        """As :meth:`Contestant.settle`."""
        self._process.ask("settle", repetitions)

    def examine(self) -> contestant.Examined:
        """As :meth:`Contestant.examine`."""
        examined: contestant.Examined = self._process.ask("examine")
        return examined

    def facts(self) -> contestant.ProcessFacts:
        """As :meth:`Contestant.facts`."""
        facts: contestant.ProcessFacts = self._process.ask("facts")
        return facts

    def close(self) -> None:
        """End the process."""
        self._process.close()
