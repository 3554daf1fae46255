"""Known faults of data sets, and what they mean for a run."""

from __future__ import annotations

import hashlib
import inspect
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pytest_cpas.checks.dataset import CHECKS
from pytest_cpas.checks.known import LEFT_OUT, KnownFailure, known_failures, read_known
from pytest_cpas.types import ContractError, Dataset, GroundTruth, Sample, SampleRef, WrappedDataset

__all__ = ["known_faults", "without_faults"]


def known_faults(dataset: Dataset, files: Sequence[Path]) -> list[KnownFailure]:
    """Those that stand beside the data set's module, and those in ``files``.

    Raises :class:`pytest_cpas.types.DeclarationError` for a damaged file.
    """
    folder = Path(inspect.getfile(type(dataset))).parent
    # of many data sets that one class makes, the same can be known
    name = getattr(dataset, "known_as", dataset.name)
    known = known_failures(folder, name, "dataset", CHECKS)
    for path in files:
        known += read_known(path, "dataset", CHECKS)
    return known


def without_faults(dataset: Dataset, files: Sequence[Path]) -> Dataset:
    """A data set as it is run: what is known to be wrong is left out, or has no shape.

    Raises as :func:`known_faults`.
    """
    faults = [fault for fault in known_faults(dataset, files) if fault.run]
    found = {ref.id: fault for ref in dataset.samples if (fault := _fault_of(ref, faults))}
    mended = _mended(dataset, found)
    found = {sample: fault for sample, fault in found.items() if fault not in mended}
    return _WithoutFaults(dataset, found) if found else dataset


def _mended(dataset: Dataset, found: Mapping[str, KnownFailure]) -> set[KnownFailure]:
    """The faults that say what reading fails with, and of whose first sample it does not."""
    first: dict[KnownFailure, SampleRef] = {}
    for ref in dataset.samples:
        fault = found.get(ref.id)
        if fault is not None and fault.check == "readable" and fault.message != "*":
            first.setdefault(fault, ref)
    mended = set()
    for fault, ref in first.items():
        try:
            dataset.truth(ref)
        except ContractError as error:
            if fault.says(str(error)):
                continue
        mended.add(fault)
    return mended


def _fault_of(ref: SampleRef, faults: Sequence[KnownFailure]) -> KnownFailure | None:
    """The first that names a sample; to leave it out goes before its shape."""
    for fault in sorted(faults, key=lambda fault: fault.run != LEFT_OUT):
        if fault.matches(sample=ref.id, model=ref.model, category=ref.category):
            return fault
    return None


class _WithoutFaults(WrappedDataset):
    def __init__(self, dataset: Dataset, faults: dict[str, KnownFailure]) -> None:
        super().__init__(dataset)
        left_out = {sample for sample, fault in faults.items() if fault.run == LEFT_OUT}
        self.samples = [ref for ref in dataset.samples if ref.id not in left_out]
        self.absent = [sample for sample in dataset.absent if sample not in left_out]
        self._shapeless = faults.keys() - left_out
        counts = Counter(faults.values())
        self.missing = [
            *dataset.missing,
            *(
                f"known fault ({fault}): {count} samples"
                f" {'' if fault.run == LEFT_OUT else 'judged '}{fault.run}. {fault.reason}"
                for fault, count in counts.items()
            ),
        ]
        # other samples, or other facts about them, are of another data set
        told = sorted((sample, fault.run) for sample, fault in faults.items())
        self.digest = hashlib.sha256(f"{dataset.digest} {told}".encode()).hexdigest()[:16]

    def load(self, ref: SampleRef) -> Sample:
        sample = self._dataset.load(ref)
        return replace(sample, truth=self._without_shape(ref, sample.truth))

    def truth(self, ref: SampleRef) -> GroundTruth:
        return self._without_shape(ref, self._dataset.truth(ref))

    def _without_shape(self, ref: SampleRef, truth: GroundTruth) -> GroundTruth:
        return replace(truth, surface=None) if ref.id in self._shapeless else truth
