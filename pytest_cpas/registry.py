"""Finding methods, data sets and metrics by name; only what is asked for is imported."""

from __future__ import annotations

import difflib
import functools
import importlib
import inspect
from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pytest_cpas.types import ContractError, ToldError, as_dataset, message_of, words_of
from pytest_cpas.types.datasets import remember_maker

if TYPE_CHECKING:
    from pytest_cpas.types import Dataset

Kind = Literal["method", "dataset", "metric", "protocol"]

#: What can be registered, in words.
KINDS: dict[Kind, str] = {
    "method": "method",
    "dataset": "data set",
    "metric": "metric implementation",
    "protocol": "protocol",
}

_OWN: dict[Kind, str] = {
    "method": "package.module:Class",
    "dataset": "package.module:Class",
    "metric": "package.module",
    "protocol": "a .toml file",
}


class RegistryError(ToldError):
    """A name that cannot be turned into what it names."""


def registered(kind: Kind) -> list[EntryPoint]:
    """The entry points of a kind, sorted by name; none of them is imported."""
    return sorted(entry_points(group=f"pytest_cpas.{kind}s"), key=lambda entry: entry.name)


def resolve(kind: Kind, name: str) -> Any:
    """What is registered as ``name``, or named as ``package.module:Class``.

    A registered data set named as ``NAME:DIR`` is looked for in ``DIR`` and nowhere else; one that
    is made without a folder says as ``in_folder`` what it is in one, ``package.module:Class``.

    Metric implementations are mappings ``METRICS``; ``package.module`` names one as well.

    Raises :class:`RegistryError` for an unknown name, an ambiguous one, or an import that fails;
    for a registered name it says which distribution is to blame.
    """
    if ":" in name:
        module, _, attribute = name.partition(":")
        if kind == "dataset" and module in {entry.name for entry in registered(kind)}:
            make = resolve(kind, module)
            if in_folder := getattr(make, "in_folder", None):
                make = resolve(kind, in_folder)
            return functools.wraps(make)(lambda data_dir: make(Path(attribute)))
        return _load(kind, name, module, attribute, "")
    if kind == "metric" and "." in name:
        return _load(kind, name, name, "METRICS", "")
    entries = [entry for entry in registered(kind) if entry.name == name]
    if not entries:
        known = [entry.name for entry in registered(kind)]
        close = difflib.get_close_matches(name, known, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise RegistryError(
            f"unknown {KINDS[kind]} {name!r}.{hint} Registered: {', '.join(known) or 'none'}"
            f" (pytest --cpas-list); one of your own is named {_OWN[kind]}"
        )
    if len({entry.value for entry in entries}) > 1:
        owners = ", ".join(f"{_owner(entry)} ({entry.value})" for entry in entries)
        raise RegistryError(
            f"{KINDS[kind]} {name!r} is registered by several distributions: {owners}."
            f" Uninstall one, or name your own as {_OWN[kind]}"
        )
    entry = entries[0]
    return _load(kind, name, entry.module, entry.attr, f", registered by {_owner(entry)}")


def open_datasets(names: Sequence[str], data_dir: Path | None) -> list[Dataset]:
    """Make the data sets that ``names`` name, as :func:`open_dataset` does.

    One that is several says as ``splits`` how each is called: ``NAME:DIR`` is all ``SPLIT:DIR``.
    """
    asked: list[str] = []
    for name in names:
        kind, _, folder = name.partition(":")
        folder = folder or str(data_dir or "")
        several = folder and kind in {entry.name for entry in registered("dataset")}
        splits = getattr(resolve("dataset", kind), "splits", ()) if several else ()
        asked += [f"{split}:{folder}" for split in splits] or [name]
    return [open_dataset(name, data_dir) for name in asked]


def open_dataset(name: str, data_dir: Path | None) -> Dataset:
    """Make the data set that ``name`` names for :func:`resolve`, in the folder ``data_dir``.

    Raises what :func:`resolve` raises, also for a data set that cannot be made for no reason of its
    own, :class:`pytest_cpas.types.DataError` for what is no data set, and the data set's own
    :class:`pytest_cpas.types.ContractError` and :class:`OSError`.
    """
    make = resolve("dataset", name)
    if not callable(make):
        raise RegistryError(
            f"data set {name!r}: {type(make).__name__} {make!r} cannot be called; expected a class"
            " that inherits from pytest_cpas.Dataset"
        )
    if inspect.isabstract(make):
        lacks = ", ".join(sorted(make.__abstractmethods__))
        raise RegistryError(f"data set {name!r}: the class {make.__name__} has no {lacks}")
    try:
        dataset = as_dataset(make(data_dir), name)
    except (ContractError, OSError, KeyboardInterrupt):
        raise
    except ImportError as error:  # which says what to install
        raise RegistryError(f"data set {name!r}: {error}") from error
    except BaseException as error:
        if not isinstance(error, Exception):  # no way out of a verdict either
            told = f"{type(error).__name__}({message_of(error)})"
            raise RegistryError(
                f"data set {name!r}: {told} was raised while it was made; what cannot be"
                " opened raises pytest_cpas.DataError that says why"
            ) from error
        folder = "no folder was given with --cpas-data" if data_dir is None else f"in {data_dir}"
        raise RegistryError(
            f"data set {name!r} cannot be opened, {folder} ({words_of(error)})"
        ) from error
    remember_maker(dataset, make)
    return dataset


def _owner(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown distribution"


def _load(kind: Kind, name: str, module: str, attribute: str, blame: str) -> Any:
    try:
        return getattr(importlib.import_module(module), attribute)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # importing foreign code can raise anything, and exit or skip
        raise RegistryError(
            f"{KINDS[kind]} {name!r}{blame}: {module}:{attribute} cannot be imported"
            f" ({words_of(error)})"
        ) from error
