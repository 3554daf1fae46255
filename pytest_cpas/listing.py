"""What ``pytest --cpas-list`` prints."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from pytest_cpas.protocols import Protocol
from pytest_cpas.registry import KINDS, RegistryError, registered, resolve
from pytest_cpas.remote import Spec
from pytest_cpas.types import MethodInfo, assets_of, some_of


def listing(
    weights: Path | None, protocols: Iterable[Protocol], elsewhere: Mapping[str, Spec]
) -> Iterator[str]:
    """The lines. Methods are imported to be asked for their declaration, and their assets looked
    for below ``weights``; data sets and metrics are named alone. ``protocols`` are told with their
    columns; ``elsewhere``: the methods in other interpreters that the project names, of which none
    is started."""
    for kind, name in KINDS.items():
        if kind == "protocol":
            continue
        yield f"{name}s:"
        for entry in registered(kind):
            owner = f"{entry.dist.name} {entry.dist.version}" if entry.dist else "unknown"
            yield f"  {entry.name:24} {entry.value}  ({owner})"
            if kind == "method":
                yield from (f"      {line}" for line in _declared(entry.name, weights))
        for called, spec in sorted(elsewhere.items()) if kind == "method" else ():
            yield f"  {called:24} {spec.cls}  (in another interpreter)"
            yield f"      {shlex.join(spec.command)}; pytest-cpas worker-check {called} tries it"

    yield "protocols:"
    for protocol in protocols:
        yield f"  {protocol.name:24} version {protocol.version}: {protocol.title}"
        for column in protocol.columns:
            guard = "  (guard)" if column.guard else ""
            yield f"      {column.id:24} {column.label}{guard}"


def _declared(name: str, weights: Path | None) -> Iterator[str]:
    try:
        method = resolve("method", name)
    except RegistryError as error:
        yield f"cannot be used: {error}"
        return
    info = getattr(method, "info", None)
    if not isinstance(info, MethodInfo):
        yield "cannot be used: it has no attribute info of type MethodInfo"
        return
    yield f"licence {info.licence}"
    parts = ["pose", *sorted(info.gives)]
    yield f"needs {', '.join(sorted(info.needs))}; gives {', '.join(parts)}"
    try:
        paths = [asset.path for asset in assets_of(method, weights)]
    except (ValueError, OSError) as error:
        yield f"cannot be used: {error}"
        return
    if not paths:
        yield "weights: none needed"
    elif weights is None:
        yield f"weights: {some_of(paths)} (no --cpas-weights to look in)"
    else:
        lacking = [path for path in paths if not (weights / path).is_file()]
        missing = f", missing {some_of(lacking)}" if lacking else ""
        yield f"weights: {len(paths) - len(lacking)} of {len(paths)} found in {weights}{missing}"
