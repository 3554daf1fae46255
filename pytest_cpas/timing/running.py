"""The speed of one method on one data set: who competes, the rounds, the verdict, the document."""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pytest_cpas.documents import (
    IntervalDocument,
    MeasuredSpeedDocument,
    PublishedTimeDocument,
    ReferenceDocument,
    StageDocument,
)
from pytest_cpas.evaluation import Adapter, MethodRun, Revision, write_observations
from pytest_cpas.golden.published import PublishedTime, published_time
from pytest_cpas.remote import RemoteMethod
from pytest_cpas.timing.calibration import Calibration, kernel_for
from pytest_cpas.timing.comparison import Comparison, WithRecord, WithRival
from pytest_cpas.timing.contestant import Contestant, Examined
from pytest_cpas.timing.intervals import CONFIDENCE, LOOKS, Interval, median_interval
from pytest_cpas.timing.machine import machine
from pytest_cpas.timing.measuring import Rounds, time_rounds, timed_samples
from pytest_cpas.timing.records import (
    SpeedRecord,
    identity_of,
    provenance_of,
    record_path,
    write_record,
)
from pytest_cpas.timing.verdicts import SpeedWord
from pytest_cpas.timing.workers import TimingError, Worker
from pytest_cpas.types import MethodInfo, Observation, Verdict
from pytest_cpas.types.samples import ALL

#: A round has so many predictions that it takes at least as many seconds; the calibration kernel
#: is repeated until it takes as long as a round, up to the second number.
SHORTEST, LONGEST = 0.02, 0.25


@dataclass(frozen=True)
class Rival:
    """What a method competes with: ``method``, another one, or itself in a ``revision``.

    ``name`` as on the command line.
    """

    name: str
    method: type | None = None
    revision: str = ""

    def of(self, method: type) -> Adapter | Revision:
        """What competes with ``method``; :class:`pytest_cpas.evaluation.RevisionError` if that has
        no such revision."""
        return Adapter.of(self.method) if self.method else Revision.find(method, self.revision)

    def categories(self, info: MethodInfo) -> list[str]:
        """Those of a method that the rival knows as well."""
        known: MethodInfo = getattr(self.method, "info", info)
        return [category for category in info.categories if category in known.categories]


@dataclass(frozen=True)
class Plan:
    """What is asked for: without a ``rival`` it is the calibration kernel; without a ``limit``
    nothing is judged; ``update`` records the ratio below ``golden``."""

    golden: Path
    weights: Path | None
    device: str
    rival: Rival | None
    limit: float | None
    update: bool


class SpeedRun:
    """The timing of one run, once."""

    def __init__(self, run: MethodRun, plan: Plan) -> None:
        self.run, self.plan = run, plan
        self._rounds: Rounds | None = None

    def elapsed(self) -> float:
        """The clock for pytest-benchmark: the seconds that the method has taken in rounds."""
        return self._rounds.elapsed() if self._rounds else 0.0

    def measure(self, benchmark: Any) -> tuple[Verdict, MeasuredSpeedDocument]:
        """The verdict, and what the report holds below ``speed`` but for that.

        ``benchmark``: pytest-benchmark's fixture with :meth:`elapsed` for its timer. Raises what
        the method raises; :class:`pytest_cpas.evaluation.MethodError` if it cannot be loaded,
        :class:`pytest_cpas.types.ContractError` if no sample can be read,
        :class:`pytest_cpas.timing.workers.TimingError` for workers,
        :class:`pytest_cpas.evaluation.RevisionError` for revisions, and
        :class:`pytest_cpas.timing.records.RecordError` for what is recorded.
        """
        plan, info = self.plan, self.run.unloaded.info
        categories = plan.rival.categories(info) if plan.rival else info.categories
        samples = timed_samples(self.run, categories)
        names = [sample.ref.id for sample in samples]
        with ExitStack() as stack:
            observations = [sample.observation for sample in samples]
            candidate, reference = self._contestants(stack, observations)
            repetitions = _warm_up(candidate, reference, len(samples))
            examined, on = candidate.examine(), machine(candidate.facts())
            rounds = self._rounds = Rounds(candidate, reference, len(samples))
            identity = identity_of(self.run.identity, on, reference.name)
            path = record_path(plan.golden, self.run.method, self.run.dataset, on)
            if plan.update:
                # at least two quadruples per sample, and as many as there is time for
                looks = [look for look in LOOKS if look >= 2 * len(samples)]
                time_rounds(benchmark, rounds, looks, lambda _: True)
                record = SpeedRecord.of(names, rounds.by_sample(), identity, provenance_of(on))
                write_record(plan.golden, path, record)
                verdict, slowdown = Verdict(SpeedWord.RECORDED, ALL, str(path)), None
            else:
                comparison: Comparison = (
                    WithRival(reference.name, plan.limit)
                    if plan.rival
                    else WithRecord.of(path, identity, names, plan.limit)
                )
                time_rounds(benchmark, rounds, LOOKS, comparison.undecided)
                verdict, slowdown = comparison.verdict(rounds), comparison.slowdown(rounds)
        document: MeasuredSpeedDocument = {
            "seconds": _interval(rounds.candidate_seconds),
            "mean_seconds": statistics.fmean(rounds.candidate_seconds),
            "rounds": len(rounds.candidate_seconds),
            "samples": rounds.samples,
            "stages": _stages(examined),
            "memory": examined["memory"],
            "reference": self._reference(reference.name, rounds),
            "ratio": _interval([ratio for _, ratio in rounds.ratios]),
            "predictions_per_round": repetitions,
            "machine": on,
            "slowdown": None if slowdown is None else _interval_document(slowdown),
            "published": _published(published_time(self.run.method)),
        }
        if (transfer := examined.get("transfer")) is not None:
            document["transfer_seconds"] = transfer / examined["predictions"]
        return verdict, document

    def _reference(self, name: str, rounds: Rounds) -> ReferenceDocument:
        """What the method was timed in turns with."""
        rival = self.plan.rival
        if rival is None:
            kind: Literal["calibration", "method", "revision"] = "calibration"
        else:
            kind = "method" if rival.method else "revision"
        return {"kind": kind, "name": name, "seconds": _interval(rounds.reference_seconds)}

    def _contestants(
        self, stack: ExitStack, observations: list[Observation]
    ) -> tuple[Contestant | Worker, Calibration | Worker]:
        """The method and its reference; in workers of the same kind if both are methods."""
        run, plan = self.run, self.plan
        method = run.unloaded
        if isinstance(method, RemoteMethod) and not method.remote.is_here:
            raise TimingError(
                f"{run.method} answers on another machine than this one, where what it would be"
                " timed against runs; run pytest there, or leave out --cpas-benchmark"
            )
        if plan.rival is None:
            here = Contestant(run.loaded(), observations, run.seed, plan.device)
            stack.callback(here.close)
            return here, Calibration(kernel_for(plan.device), here.timed)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pytest-cpas-")))
        file = folder / "observations.npz"
        write_observations(file, observations)
        rival = plan.rival.of(type(method))
        if isinstance(rival, Revision):
            rival = rival.extract(folder)

        def start(name: str, adapter: Adapter) -> Worker:
            worker = Worker(
                name, adapter, file, weights=plan.weights, seed=run.seed, device=plan.device
            )
            stack.callback(worker.close)
            return worker

        return start(run.method, Adapter.of(type(method))), start(plan.rival.name, rival)


def _warm_up(candidate: Contestant | Worker, reference: Calibration | Worker, samples: int) -> int:
    """Each sample once: networks choose algorithms, priors are built, memory is taken.

    Then short predictions are repeated, so that a round is not over before the machine has done
    something else once; how often is returned.
    """
    seconds = statistics.median(candidate.run(index) for index in range(samples))
    rival = statistics.median(reference.run(index) for index in range(samples))
    repetitions = max(1, round(SHORTEST / max(seconds, 1e-6)))
    candidate.settle(repetitions)
    if isinstance(reference, Calibration):
        length = min(max(seconds, SHORTEST), LONGEST)
        reference.repeat(max(1, round(length / max(rival, 1e-6))))
    else:
        reference.settle(repetitions)
    return repetitions


def _stages(examined: Examined) -> list[StageDocument]:
    return [
        {
            "name": name,
            "seconds": seconds / examined["predictions"],
            "share": min(seconds / examined["total"], 1.0),
        }
        for name, seconds in examined["stages"].items()
    ]


def _interval(values: Sequence[float]) -> IntervalDocument:
    """The median of some values, and what it lies between."""
    return _interval_document(median_interval(values, CONFIDENCE))


def _interval_document(interval: Interval) -> IntervalDocument:
    return {
        "median": interval.median,
        "lower": interval.lower,
        "upper": interval.upper,
        "confidence": interval.confidence,
    }


def _published(time: PublishedTime | None) -> PublishedTimeDocument | None:
    if time is None:
        return None
    return {"dataset": time.dataset, "mean_seconds": time.mean_seconds, "machine": time.machine}
