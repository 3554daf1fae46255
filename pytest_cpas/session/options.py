"""What the command line asks for: read once, before collection, as plain values with types.

Nothing of pytest is needed here, and nothing is looked up: :mod:`pytest_cpas.session.resolution`
turns names into methods, data sets and runs.
"""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pytest_cpas.evaluation import Selection, Shard
from pytest_cpas.golden import ALARM
from pytest_cpas.protocols import Protocol
from pytest_cpas.types import Required

__all__ = ["DatasetOptions", "Granularity", "MetricsOptions", "RunOptions"]

#: How many samples one test item has: one, those of a scene, or all.
Granularity = Literal["sample", "scene", "dataset"]


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """What a run of methods, stored predictions or merged results is asked for.

    Paths are as they are opened. ``golden`` is the folder of golden tables; ``seeds`` counts the
    seeds that each sample is judged under, from ``seed`` on; ``alarm`` is the probability of a
    false alarm against a golden table of several seeds; ``protocols``: what is judged under, the
    paper's if None; ``timeout``: seconds that a prediction may take per sample, None for any;
    ``batch``: how many samples a method is asked about at once, None for as many as it declares;
    ``reuse_any``: whether rows in ``results`` serve that another program computed; ``save``: the
    file, or the folder, for all answers; ``trace``: the folder for traces, ``parity``: the one of
    the traces to compare with, if they are recorded ones; ``others`` are the files of the runs to
    compare with; ``root``: the folder of the project.
    """

    methods: Sequence[str] = ()
    datasets: Sequence[str] = ()
    predictions: Sequence[Path] = ()
    merge: Sequence[Path] = ()
    allow_gaps: bool = False
    data: Path | None = None
    categories: Path | None = None
    detections: Path | None = None
    weights: Path | None = None
    device: str = "cpu"
    seed: int = 0
    seeds: int = 1
    selection: Selection = field(default_factory=Selection)
    robustness: bool = False
    benchmark: bool = False
    batch: int | None = None
    granularity: Granularity = "sample"
    golden: Path
    update: bool = False
    require_golden: Required = False
    alarm: float = ALARM
    protocols: Sequence[Protocol] | None = None
    timeout: float | None = None
    results: Path | None = None
    reuse_any: bool = False
    save: Path | None = None
    trace: Path | None = None
    parity: Path | None = None
    report: Path | None = None
    others: Sequence[Path] = ()
    known_faults: Sequence[Path] = ()
    root: Path = Path()

    @classmethod
    def of(
        cls,
        options: Namespace,
        here: Path,
        *,
        golden: Path,
        root: Path = Path(),
        alarm: float = ALARM,
        protocols: Sequence[Protocol] | None = None,
        timeout: float | None = None,
    ) -> RunOptions:
        """From the options of :mod:`pytest_cpas.plugin` (and syrupy's ``--snapshot-update``).

        Relative paths are looked for in ``here``. Raises :class:`ValueError` that names an option
        whose value cannot be meant.
        """
        for name in ("limit", "jitter", "batch"):
            count = getattr(options, f"cpas_{name}")
            if count is not None and count < 1:
                raise ValueError(f"--cpas-{name} is {count}, expected at least 1")
        return cls(
            methods=tuple(options.cpas_method),
            datasets=tuple(options.cpas_dataset),
            predictions=_paths(here, options.cpas_predictions),
            merge=_paths(here, options.cpas_merge),
            allow_gaps=options.cpas_allow_gaps,
            data=_path(here, options.cpas_data),
            categories=_path(here, options.cpas_categories),
            detections=_path(here, options.cpas_detections),
            weights=_path(here, options.cpas_weights),
            device=options.cpas_device,
            seed=options.cpas_seed,
            seeds=options.cpas_jitter,
            selection=_selection(options),
            robustness=options.cpas_profile == "robustness",
            benchmark=options.cpas_benchmark,
            batch=options.cpas_batch,
            granularity=options.cpas_granularity,
            golden=golden,
            update=_update(options),
            require_golden=options.cpas_require_golden,
            alarm=alarm,
            protocols=protocols,
            timeout=timeout,
            results=_path(here, options.cpas_results),
            reuse_any=options.cpas_results_reuse == "any",
            save=_path(here, options.cpas_save_predictions),
            trace=_path(here, options.cpas_trace),
            parity=_folder(here, options.cpas_parity),
            report=_path(here, options.cpas_report),
            others=_paths(here, options.cpas_against),
            known_faults=_paths(here, options.cpas_known_faults),
            root=root,
        )

    @property
    def shard(self) -> Shard:
        """The part of the samples that is judged."""
        return Shard(self.selection.shard, self.selection.shards)

    @property
    def folders(self) -> list[Path]:
        """What is read or written and holds no code: data, weights, tables, results, answers and
        reports."""
        read = (self.data, self.detections, self.weights, self.golden, self.parity)
        named = (*read, self.results, self.save, self.trace, self.report)
        return [folder for folder in named if folder is not None]

    def check_written(self) -> None:
        """Raise :class:`ValueError` if one of the folders that are written cannot be."""
        named = {
            "--cpas-results": self.results,
            "--cpas-save-predictions": self._saved_into,
            "--cpas-trace": self.trace,
            "--cpas-report": self.report,
            "--cpas-golden": self.golden if self.update else None,
        }
        for option, folder in named.items():
            if folder is not None:
                _check_written(option, folder)

    @property
    def _saved_into(self) -> Path | None:
        return self.save.parent if self.save and not self.save.is_dir() else self.save

    @property
    def only_for_pictures(self) -> bool:
        """Whether the data sets are there for the report's pictures of merged results."""
        return bool(self.datasets and self.merge and self.report)


@dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """What checking data sets is asked for; ``known_faults``: files, ``pictures``: a folder."""

    datasets: Sequence[str]
    data: Path | None = None
    categories: Path | None = None
    selection: Selection = field(default_factory=Selection)
    granularity: Granularity = "sample"
    known_faults: Sequence[Path] = ()
    pictures: Path | None = None

    @classmethod
    def of(cls, options: Namespace, here: Path) -> DatasetOptions:
        """As :meth:`RunOptions.of`."""
        return cls(
            datasets=tuple(dict.fromkeys(options.cpas_check_dataset)),
            data=_path(here, options.cpas_data),
            categories=_path(here, options.cpas_categories),
            selection=_selection(options),
            granularity=options.cpas_granularity,
            known_faults=_paths(here, options.cpas_known_faults),
            pictures=_path(here, options.cpas_pictures),
        )

    def check_written(self) -> None:
        """As :meth:`RunOptions.check_written`."""
        if self.pictures is not None:
            _check_written("--cpas-pictures", self.pictures)


@dataclass(frozen=True, kw_only=True)
class MetricsOptions:
    """What checking implementations of metrics is asked for.

    ``examples`` per property, None for as many as is usual; ``shrink``: make counterexamples
    smaller; ``reports``: files to write.
    """

    metrics: Sequence[str]
    examples: int | None = None
    shrink: bool = True
    seed: int = 0
    update: bool = False
    reports: Sequence[Path] = ()

    @classmethod
    def of(cls, options: Namespace, here: Path) -> MetricsOptions:
        """As :meth:`RunOptions.of`."""
        if options.cpas_examples is not None and options.cpas_examples < 1:
            raise ValueError(f"--cpas-examples is {options.cpas_examples}, expected at least 1")
        reports = _paths(here, options.cpas_metrics_report)
        for path in reports:
            if path.suffix not in (".json", ".md"):
                raise ValueError(f"--cpas-metrics-report {path}: expected .json or .md")
            _check_written("--cpas-metrics-report", path.parent)
        return cls(
            metrics=tuple(dict.fromkeys(options.cpas_metrics)),
            examples=options.cpas_examples,
            shrink=not options.cpas_no_shrink,
            seed=options.cpas_seed,
            update=_update(options),
            reports=reports,
        )


def _check_written(option: str, folder: Path) -> None:
    """Raise :class:`ValueError` if no file could be written into what an option names, which need
    not be there yet: before a run of hours, not behind it."""
    place = next(place for place in (folder, *folder.parents) if os.path.lexists(place))
    if not place.is_dir():
        raise ValueError(f"{option}: {place} is a file, expected a folder; name another one")
    if not os.access(place, os.W_OK | os.X_OK):
        raise ValueError(f"{option}: nobody lets this user write into {place}; name another folder")


def _selection(options: Namespace) -> Selection:
    shard = Shard.parse(options.cpas_shard)
    return Selection(
        categories=tuple(options.cpas_category),
        limit=options.cpas_limit,
        shard=shard.index,
        shards=shard.count,
    )


def _update(options: Namespace) -> bool:
    """Whether ``--snapshot-update`` is given, which is syrupy's option."""
    return bool(getattr(options, "update_snapshots", False))


def _path(here: Path, name: str | None) -> Path | None:
    return here / name if name else None


def _folder(here: Path, name: str | None) -> Path | None:
    """The folder that a name is of, if there is one."""
    return here / name if name and (here / name).is_dir() else None


def _paths(here: Path, names: Sequence[str]) -> Sequence[Path]:
    return tuple(here / name for name in names)
