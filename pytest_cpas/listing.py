"""What ``pytest --cpas-list`` prints."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from pytest_cpas.registry import KINDS, RegistryError, registered, resolve
from pytest_cpas.types import MethodInfo


def listing(weights: Path | None) -> Iterator[str]:
    """The lines. Methods are imported to be asked for their declaration, and their assets looked
    for below ``weights``; data sets and metrics are named alone."""
    for kind, words in KINDS.items():
        yield f"{words}s:"
        for entry in registered(kind):
            owner = f"{entry.dist.name} {entry.dist.version}" if entry.dist else "unknown"
            yield f"  {entry.name:24} {entry.value}  ({owner})"
            if kind == "method":
                yield from (f"      {line}" for line in _declared(entry.name, weights))


def _declared(name: str, weights: Path | None) -> Iterator[str]:
    try:
        info = getattr(resolve("method", name), "info", None)
    except RegistryError as error:
        yield f"cannot be used: {error}"
        return
    if not isinstance(info, MethodInfo):
        yield "cannot be used: it has no attribute info of type MethodInfo"
        return
    yield f"licence {info.licence}"
    parts = ["pose", *sorted(info.gives)]
    yield f"needs {', '.join(sorted(info.needs))}; gives {', '.join(parts)}"
    if not info.assets:
        yield "weights: none needed"
    elif weights is None:
        paths = [asset.path for asset in info.assets]
        yield f"weights: {', '.join(paths)} (no --cpas-weights to look in)"
    else:
        for asset in info.assets:
            found = (weights / asset.path).is_file()
            yield f"weights: {weights / asset.path} {'found' if found else 'not found'}"
