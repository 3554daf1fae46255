"""What the options name: methods and data sets, the runs that they make, what goes with each run.

All of it before anything is collected, so that a mistake costs no time.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

from pytest_cpas import registry
from pytest_cpas.datasets.categories import CategorisedDataset, categories_file
from pytest_cpas.datasets.perturbed import perturbed
from pytest_cpas.documents import RunConditions, RunDocument
from pytest_cpas.evaluation import (
    DetectedRun,
    MergedRun,
    MethodRun,
    ResultsError,
    ResultsFile,
    Run,
    StoredRun,
    merge,
)
from pytest_cpas.remote import (
    RaisedThereError,
    WorkerError,
    named_methods,
    remote_method,
    spec_of,
)
from pytest_cpas.report.against import pairs
from pytest_cpas.report.stored import read_runs
from pytest_cpas.session.known_faults import without_faults
from pytest_cpas.session.options import RunOptions
from pytest_cpas.submissions import DetectedDataset
from pytest_cpas.types import (
    ContractError,
    Dataset,
    DeclarationError,
    Method,
    MethodInfo,
    assets_of,
    words_of,
)

__all__ = ["categorised", "make_method", "open_results", "read_others", "resolve_runs"]


def resolve_runs(options: RunOptions) -> list[Run]:
    """The runs, in the order in which they are judged and reported; nothing is loaded.

    Methods on data sets come first, then stored predictions, then merged results. Raises
    :class:`ValueError` for options that make no run, and what is wrong with a method, a data set or
    a file: :class:`pytest_cpas.registry.RegistryError`, :class:`pytest_cpas.types.ContractError`,
    :class:`pytest_cpas.evaluation.ResultsError`, :class:`OSError`.
    """
    _check_both_sides(options)
    methods = [(n, make_method(n, options.weights, options.root)) for n in options.methods]
    datasets = [
        categorised(without_faults(dataset, options.known_faults), options.categories)
        for dataset in registry.open_datasets(options.datasets, options.data)
    ]
    runs: list[Run] = []
    seen = _seen(datasets, options)
    for (name, make), dataset in itertools.product(methods, seen):
        runs += _method_runs(_made(name, make), make, dataset, options)
    asked: Sequence[Dataset | None] = datasets or [None]
    runs += [
        StoredRun(path, dataset=dataset, selection=options.selection, protocols=options.protocols)
        for path in options.predictions
        for dataset in asked
    ]
    runs += _merged_runs(options, datasets)
    judged = {run.dataset for run in runs}
    if options.only_for_pictures and not judged.issuperset(dataset.name for dataset in datasets):
        raise ResultsError(
            f"--cpas-dataset {', '.join(options.datasets)}: the results are of"
            f" {', '.join(sorted(judged))}"
        )
    _check_runs(runs, options.selection.categories)
    options.selection.check({category for run in runs for category in run.listed})
    return runs


def _seen(datasets: Sequence[Dataset], options: RunOptions) -> Sequence[Dataset]:
    """The data sets as methods see them: through the masks of a detector, if one is named."""
    if options.detections is None:
        return datasets
    if not options.methods or len(datasets) != 1:
        raise ValueError(
            f"--cpas-detections {options.detections}: {len(options.methods)} methods and"
            f" {len(datasets)} data sets are named, expected methods, to see objects through the"
            " masks, and the one data set whose images they are of: --cpas-method NAME"
            " --cpas-dataset NAME"
        )
    return [DetectedDataset(datasets[0], options.detections)]


def categorised(dataset: Dataset, categories: Path | None) -> Dataset:
    """A data set with its objects as instances of categories, if there is a map of them.

    Raises :class:`pytest_cpas.types.DataError` for a map that is none of the data set.
    """
    if categories is None:
        return dataset
    return CategorisedDataset(dataset, categories_file(categories))


def make_method(name: str, weights: Path | None, root: Path) -> Callable[[], Method]:
    """Check a method's class and its assets; nothing is loaded, but for the worker of a method in
    another interpreter, which is started. ``root``: the folder of the project, whose files may name
    such methods.

    Raises :class:`pytest_cpas.registry.RegistryError` for a name that means nothing,
    :class:`pytest_cpas.types.DeclarationError` for what is no method,
    :class:`FileNotFoundError` for assets that are not below ``weights``.
    """
    factory = _factory(name, root)
    info = _asked(name, "info", lambda: getattr(factory, "info", None))
    if not isinstance(info, MethodInfo):
        raise DeclarationError(
            f"method {name!r}: {factory!r} has no attribute info of type MethodInfo; a method is a"
            " class with info, load(assets, device) and predict(batch, seed)"
        )
    for asset in _asked(name, "assets", lambda: assets_of(factory, weights)):
        try:
            asset.locate(weights)
        except FileNotFoundError as error:
            _made(name, factory)  # what else it needs is told first: it is quicker to have
            raise FileNotFoundError(f"{info.name} needs {error}") from None
    make: Callable[[], Method] = factory
    return make


def _factory(name: str, root: Path) -> Any:
    """What makes the method: a class of this interpreter, or one that stands for a worker."""
    spec = spec_of(name, root)
    if spec is None:
        try:
            return registry.resolve("method", name)
        except registry.RegistryError as error:
            if ":" not in name and (named := named_methods(root)):
                raise registry.RegistryError(
                    f"{error}; methods of this project: {', '.join(named)}"
                ) from None
            raise
    if name in {entry.name for entry in registry.registered("method")}:
        raise registry.RegistryError(
            f"method {name!r} is registered, and named in a file of {root} as well; call that one"
            " otherwise"
        )
    try:
        return remote_method(spec)
    except (WorkerError, RaisedThereError) as error:
        raise registry.RegistryError(f"method {name!r}: {error}") from None


def _asked(name: str, part: str, ask: Callable[[], Any]) -> Any:
    """What a method's class says of itself, which may be code of its own."""
    try:
        return ask()
    except (ContractError, OSError):
        raise
    except Exception as error:
        raise DeclarationError(f"method {name!r}: its {part} raises {words_of(error)}") from error


def _made(name: str, factory: Callable[[], Method]) -> Method:
    """An instance; foreign code can raise anything while it is made, and exit or skip."""
    try:
        return factory()
    except (ContractError, OSError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise registry.RegistryError(
            f"method {name!r} cannot be made ({words_of(error)})"
        ) from error


def open_results(
    options: RunOptions,
    runs: Sequence[Run],
    *,
    writes: bool,
    opened: Callable[[], Collection[tuple[str, str]]],
) -> dict[Run, ResultsFile]:
    """The results file of each run, with the rows that it holds already; none without a folder.

    ``writes``: this process is the one that will; ``opened``: names and digests of the files that
    code has read up to now. Raises
    :class:`pytest_cpas.evaluation.ResultsError` for one that is damaged, another run's, or being
    written.
    """
    if options.results is None:
        return {}
    files = {
        run: ResultsFile(
            options.results,
            run,
            options.shard,
            reuse_any=options.reuse_any,
            opened=opened if isinstance(run, MethodRun) else tuple,
        )
        for run in runs
    }
    if writes:
        for file in files.values():
            file.check_free()
    return files


def read_others(options: RunOptions, runs: Sequence[Run]) -> list[RunDocument]:
    """The runs to compare with; that they fit ``runs`` is known before any of those is judged.

    Raises :class:`pytest_cpas.evaluation.ResultsError` and
    :class:`pytest_cpas.report.stored.StoredReportError`.
    """
    if not options.others:
        return []
    others = read_runs(options.others, options.protocols)
    conditions: list[RunConditions] = [
        {
            "method": run.method,
            "dataset": run.dataset,
            "identity": dict(run.identity),
            "definitions": dict(run.definitions),
        }
        for run in runs
    ]
    pairs(conditions, others)
    return others


def _check_both_sides(options: RunOptions) -> None:
    if bool(options.methods) == bool(options.datasets) or options.only_for_pictures:
        return
    if options.datasets and options.predictions:
        return
    given: registry.Kind = "method" if options.methods else "dataset"
    lacking: registry.Kind = "dataset" if options.methods else "method"
    known = ", ".join(entry.name for entry in registry.registered(lacking))
    raise ValueError(f"--cpas-{given} needs --cpas-{lacking} NAME as well; registered: {known}")


def _method_runs(
    method: Method, made_by: Callable[[], Method], dataset: Dataset, options: RunOptions
) -> list[MethodRun]:
    """The run of a method on a data set; with a profile, one for each part that this makes."""
    runs: list[MethodRun] = []
    for part in perturbed(dataset, method.info) if options.robustness else (dataset,):
        make = (
            functools.partial(DetectedRun, method, part)
            if isinstance(part, DetectedDataset)
            else functools.partial(MethodRun, method, part)
        )
        run = make(
            made_by=made_by,
            weights=options.weights,
            device=options.device,
            seed=options.seed,
            seeds=options.seeds,
            selection=options.selection,
            shared=runs[0] if runs else None,
            keeps_shapes=bool(options.report) and not options.robustness,
            protocols=options.protocols,
            batch=options.batch,
        )
        runs.append(run)
    return runs


def _merged_runs(options: RunOptions, datasets: Sequence[Dataset]) -> list[MergedRun]:
    """The runs in results files, each with its data set if that is at hand."""
    runs = merge(
        options.merge,
        allow_gaps=options.allow_gaps,
        any_program=options.reuse_any,
        protocols=options.protocols,
    )
    for run, dataset in itertools.product(runs, datasets):
        if dataset.name == run.dataset:
            run.take_images(dataset)
    return runs


def _check_runs(runs: Sequence[Run], categories: Sequence[str]) -> None:
    for run in runs:
        if not run.samples and not run.damaged:
            selected = f" of {', '.join(categories)}" if categories else ""
            raise ValueError(
                "\n".join([f"{run.method} on {run.dataset}: no samples{selected}", *run.missing])
            )
    names = [(run.method, run.dataset) for run in runs]
    if len(set(names)) < len(names):
        raise ValueError(f"the same method and data set twice: {names}")
