"""The results files of a run's shards, put together and judged as one run."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pytest_cpas.datasets.perturbed import RobustnessPoint
from pytest_cpas.evaluation.opened import differences as opened_differences
from pytest_cpas.evaluation.results import (
    Results,
    ResultsError,
    Shard,
    header_differences,
    program_differences,
    read_results,
    together,
)
from pytest_cpas.evaluation.rows import Row
from pytest_cpas.evaluation.runs import Run, SampleError
from pytest_cpas.evaluation.surroundings import named
from pytest_cpas.protocols import Protocol
from pytest_cpas.types import DataError, Dataset, GroundTruth, SampleRef, raised_as

__all__ = ["MergedRun", "merge"]


class MergedRun(Run):
    """The results of all shards of a run, judged as one."""

    def __init__(
        self, parts: Sequence[Results], protocols: Sequence[Protocol] | None = None
    ) -> None:
        """Put results together that :func:`merge` has checked."""
        header = parts[0].header
        self._rows = {sample: row for part in parts for sample, row in part.rows.items()}
        self._errors = {sample: text for part in parts for sample, text in part.errors.items()}
        refs = [ref for part in parts for ref in part.refs.values()]
        samples = sorted(refs, key=lambda ref: ref.id)
        super().__init__(
            header.method,
            header.dataset,
            samples,
            missing=header.missing,
            derived=header.derived,
            damaged=header.damaged,
            identity=header.identity,
            protocols=protocols,
        )
        # of what the protocols need, the rows have what was measured then
        self.definitions = dict(header.definitions)
        self.listed = Counter(header.listed)
        self.provenance = functools.reduce(together, (part.header.provenance for part in parts))
        #: Whether more than one program computed the rows.
        self.several_programs = any(
            part.changed or program_differences(header, part.header) for part in parts
        )
        self.files = functools.reduce(together, (part.header.files for part in parts))
        self.seeds = header.seeds
        self.robustness_point = RobustnessPoint.named(header.dataset)
        self.under_contract = header.under_contract
        #: The files of the shards.
        self.paths = [part.path for part in parts]
        #: What the checks of the contract found, shard by shard.
        self.contract = [part.contract for part in parts]
        #: The data set that was judged, if it is at hand.
        self.images: Dataset | None = None

    def take_images(self, dataset: Dataset) -> None:
        """Have the samples themselves, for pictures; :class:`ResultsError` if the data differs."""
        if dataset.digest != self.identity.get("data"):
            raise ResultsError(
                f"{self.method} on {self.dataset} was judged on other data:"
                f" {self.identity.get('data')}, now {dataset.digest}; leave out --cpas-dataset"
            )
        self.images, self.quick_truth = dataset, dataset.quick_truth

    @raised_as(DataError)
    def truth(self, ref: SampleRef) -> GroundTruth | None:
        """The truth about one sample, if the data set is at hand."""
        return None if self.images is None else self.images.truth(ref)

    def judge(self, ref: SampleRef) -> Row:
        """The stored row; raises the stored error."""
        if ref.id in self._errors:
            raise SampleError(self._errors[ref.id])
        return self._rows[ref.id]


def merge(
    paths: Sequence[Path],
    *,
    allow_gaps: bool = False,
    any_program: bool = False,
    protocols: Sequence[Protocol] | None = None,
) -> list[MergedRun]:
    """The runs whose shards are in ``paths``, one per method and data set.

    They are judged under ``protocols``, where the rows have the facts for that.

    Raises :class:`ResultsError` for shards of different runs or conditions and, unless
    ``any_program``, of different programs, for samples that are in two files and, unless
    ``allow_gaps``, for shards or samples that are in none.
    """
    groups: dict[tuple[str, str], list[Results]] = {}
    for path in paths:
        results = read_results(path)
        groups.setdefault((results.header.method, results.header.dataset), []).append(results)
    for parts in groups.values():
        _check_shards(parts, allow_gaps, any_program)
    return [MergedRun(parts, protocols) for parts in groups.values()]


def _check_shards(parts: Sequence[Results], allow_gaps: bool, any_program: bool) -> None:
    first = parts[0]
    seen: dict[str, Path] = {}
    opened: dict[str, str] = {}
    shards: dict[int, Path] = {}
    for part in parts:
        shard, count = Shard.parse(part.header.shard), Shard.parse(first.header.shard).count
        same = replace(part.header, shard=first.header.shard, selected=first.header.selected)
        differences = header_differences(first.header, same)
        programs = [] if any_program else program_differences(first.header, same)
        programs += [] if any_program else opened_differences(opened, part.opened)
        opened |= part.opened
        if shard.count != count:
            differences.append(f"shards are {count}, now {shard.count}")
        if differences:
            raise ResultsError(
                f"{first.path} and {part.path} are of different runs: {'; '.join(differences)}"
            )
        if part.changed and not any_program:
            raise ResultsError(
                f"{part.path}: the program has changed while it computed these rows"
                f" ({named(part.changed)}), so they may be of two. Run the same command again, or"
                " pass --cpas-results-reuse=any"
            )
        if programs:
            raise ResultsError(
                f"{first.path} and {part.path} were computed by different programs:"
                f" {'; '.join(programs)}. --cpas-results-reuse=any judges them together"
            )
        if shard.index in shards:
            raise ResultsError(f"{shards[shard.index]} and {part.path} are both shard {shard}")
        shards[shard.index] = part.path
        for sample in (*part.rows, *part.errors):
            if sample in seen:
                raise ResultsError(f"sample {sample} is in {seen[sample]} and in {part.path}")
            seen[sample] = part.path
    gaps = [f"shard {i}/{count} is missing" for i in range(1, count + 1) if i not in shards]
    for part in parts:
        done = len(part.rows) + len(part.errors)
        if done < part.header.selected:
            gaps.append(f"{part.path} has {done} of its {part.header.selected} samples")
    if gaps and not allow_gaps:
        raise ResultsError(f"{'; '.join(gaps)}. Run what is missing, or pass --cpas-allow-gaps")
