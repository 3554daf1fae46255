"""The contract of one run, before its samples: on which samples, what is known, what stops it."""

from __future__ import annotations

import functools
import inspect
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_cpas.checks.contract import (
    CONTRACT,
    ContractCheck,
    ContractResult,
    MethodSubject,
    check_contract,
)
from pytest_cpas.checks.known import gone, known_failures
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.diagnosis import diagnose_run
from pytest_cpas.evaluation import (
    MergedRun,
    MethodError,
    MethodRun,
    ResultsError,
    Run,
    SampleError,
    Selection,
)
from pytest_cpas.golden import RunTable
from pytest_cpas.remote import RemoteMethod
from pytest_cpas.types import ContractError, Sample, SampleRef, shown
from pytest_cpas.types.samples import evenly

__all__ = [
    "ContractStage",
    "Stage",
    "StoredStage",
    "contract_stages",
    "smoke_samples",
]

#: Samples that the checks look at.
SMOKE_SAMPLES = 4

#: Samples on which the usual mistakes are tried if the adapter is wrong.
EXPLAINED_SAMPLES = 12


def smoke_samples(run: MethodRun, count: int = SMOKE_SAMPLES) -> list[Sample]:
    """``count`` samples of a run, or fewer: of different categories and scenes where possible, each
    the one of three candidates that has the most depth in its mask. Damaged ones are left out.

    Of the six categories of the field: bottle, camera, can, mug.
    """
    by_category: dict[str, list[SampleRef]] = defaultdict(list)
    for ref in run.samples:
        by_category[ref.category].append(ref)
    categories = sorted(by_category)
    count = min(count, len(run.samples))
    chosen: dict[str, Sample] = {}
    for index in range(count):
        step = max(len(categories) / count, 1)
        refs = by_category[categories[int((index + 0.5) * step) % len(categories)]]
        starts = [int((index / count + part / (3 * count)) * len(refs)) for part in range(3)]
        candidates = _read(run, [refs[i % len(refs)] for i in dict.fromkeys(starts)], chosen)
        if candidates:
            best = max(candidates, key=_evidence)
            chosen[best.ref.id] = best
    return list(chosen.values())


def further_samples(run: MethodRun, chosen: Sequence[Sample]) -> list[Sample]:
    """One sample of each category of a run that ``chosen`` lack, as those were chosen."""
    lacking = {ref.category for ref in run.samples} - {sample.ref.category for sample in chosen}
    further = []
    for category in sorted(lacking):
        refs = [ref for ref in run.samples if ref.category == category]
        if candidates := _read(run, evenly(refs, 3), {}):
            further.append(max(candidates, key=_evidence))
    return further


def _read(run: MethodRun, refs: Sequence[SampleRef], known: dict[str, Sample]) -> list[Sample]:
    samples = []
    for ref in refs:
        if ref.id not in known:
            try:
                samples.append(run.read(ref))
            except ContractError:
                continue  # the sample's own item says what is damaged
    return samples


def _evidence(sample: Sample) -> int:
    return int(np.count_nonzero(sample.observation.mask & (sample.observation.depth > 0)))


class ContractStage:
    """The contract checks of a run in this process: each runs once, when it is first asked for."""

    def __init__(self, run: MethodRun) -> None:
        """Read what is known; :class:`DeclarationError` if that file is damaged."""
        self.run = run
        method = run.unloaded
        known_in = Path(inspect.getfile(type(method))).parent
        folder = method.remote.spec.folder if isinstance(method, RemoteMethod) else known_in
        known = known_failures(folder, method.info.name, "contract", CONTRACT)
        self.known = {failure.check: failure for failure in known}
        self._results: dict[str, ContractResult] = {}

    @functools.cached_property
    def _subject(self) -> MethodSubject:
        method, samples = self.run.limited(self.run.loaded()), smoke_samples(self.run)
        further = further_samples(self.run, samples)
        return MethodSubject(
            method,
            samples,
            further=further,
            seed=self.run.seed,
            fresh=lambda: self.run.limited(self.run.fresh()),
        )

    def result(self, check: ContractCheck) -> ContractResult:
        """What a check found; a known violation that does not happen is known all the same, of a
        complete run."""
        if check.name not in self._results:
            try:
                result = check_contract(self._subject, check)
            except MethodError as error:
                first = check.name == next(iter(CONTRACT))
                outcome = Outcome.RAISED if first else Outcome.NOT_OFFERED
                result = ContractResult(check.name, outcome, True, str(error))
            known = self.known.get(check.name)
            if known is not None and result.violated:
                message = f"{known.reason} {result.message}"
                result = replace(result, known=True, message=message)
            elif known is not None and gone([known], [], complete=is_complete(self.run)):
                result = replace(result, known=True)
            self._results[check.name] = replace(result, recorded=known is not None)
        return self._results[check.name]

    @property
    def wrong(self) -> str:
        """Why the samples need not be judged: the smoke checks that the method fails."""
        results = [self.result(check) for check in CONTRACT.values() if check.smoke]
        return "; ".join(
            f"{result.check}: {result.message}"
            for result in results
            if result.wrong and not result.known
        )

    @functools.cached_property
    def explanation(self) -> list[str]:
        """Which usual mistake explains it, tried on a few samples; empty if none does."""
        rows = []
        for ref in Selection(limit=EXPLAINED_SAMPLES).of(self.run.samples):
            try:
                rows.append(self.run.judge(ref))
            except SampleError:
                continue  # a check says what is wrong with such an answer
        findings = diagnose_run(self.run, rows, RunTable.of(self.run, rows), {})
        return [line for finding in findings for line in finding.lines()]


class StoredStage:
    """The same of merged shards: of each check, the worst that a shard has found."""

    #: As of :class:`ContractStage`; the shards have judged their samples, so nothing is stopped.
    wrong = ""

    def __init__(self, run: MergedRun) -> None:
        """From what each shard stored, by check; :class:`ResultsError` for what no check finds."""
        results = [
            _stored(path, result)
            for path, shard in zip(run.paths, run.contract, strict=True)
            for result in shard.values()
        ]
        results.sort(key=lambda result: (result.violated, not result.known))
        self._results = {result.check: result for result in results}
        if is_complete(run):
            # what no shard came across does not happen
            self._results |= {
                name: replace(result, known=True)
                for name, result in self._results.items()
                if result.recorded and not result.violated
            }

    def result(self, check: ContractCheck) -> ContractResult | None:
        """What the shards found; None if none of them ran the check."""
        return self._results.get(check.name)

    @property
    def explanation(self) -> list[str]:
        """Nothing: there is no method to ask."""
        return []


def _stored(path: Path, result: Mapping[str, Any]) -> ContractResult:
    if result["check"] not in CONTRACT:
        raise ResultsError(
            f"{path}: the contract has no check {shown(result['check'])}; its checks are"
            f" {', '.join(CONTRACT)}. Run again with this version"
        )
    if result["outcome"] not in [*Outcome]:
        raise ResultsError(
            f"{path}: check {result['check']} ended with {shown(result['outcome'])}, expected one"
            f" of {', '.join(Outcome)}"
        )
    return ContractResult(**result)


Stage = ContractStage | StoredStage


def is_complete(run: Run) -> bool:
    """Whether a run has all samples of its data set."""
    return len(run.samples) == sum(run.listed.values())


def contract_stages(runs: Sequence[Run]) -> dict[Run, Stage]:
    """The contract of each run that has one; :class:`DeclarationError` for a damaged file of what
    is known, :class:`ResultsError` for a results file with what no check finds."""
    return {
        run: StoredStage(run) if isinstance(run, MergedRun) else ContractStage(run)
        for run in runs
        if isinstance(run, MergedRun | MethodRun) and run.under_contract
    }
