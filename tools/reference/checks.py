"""The checks: of methods, of data sets, of implementations of metrics."""

import itertools
from collections.abc import Callable

from pytest_cpas.checks.contract import CONTRACT
from pytest_cpas.checks.dataset import CHECKS, sanity
from pytest_cpas.checks.metrics import KNOWN, PROPERTIES
from pytest_cpas.types import EQUIVARIANCES, MethodInfo
from reference.code import doc_comments, first_line
from reference.markdown import code, codes, heading, table

#: What a method can declare, and what it reads like.
_DECLARATIONS: dict[str, Callable[[MethodInfo], bool]] = {
    "`deterministic`": lambda info: info.deterministic,
    "`needs` has `rgb`": lambda info: "rgb" in info.needs,
    "`needs` lacks `rgb`": lambda info: "rgb" not in info.needs,
    "`needs` has `depth`": lambda info: "depth" in info.needs,
    "`needs` lacks `depth`": lambda info: "depth" not in info.needs,
    "`gives` has `extents`": lambda info: "extents" in info.gives,
    "`gives` has `shape`": lambda info: "shape" in info.gives,
} | {
    f"`equivariances` has `{name}`": lambda info, name=name: name in info.equivariances
    for name in EQUIVARIANCES
}


def _subsets(names: tuple[str, ...]) -> list[frozenset[str]]:
    sizes = range(len(names) + 1)
    return [frozenset(c) for size in sizes for c in itertools.combinations(names, size)]


#: Every declaration that a check can look at.
_INFOS = [
    MethodInfo(
        name="any",
        categories=("mug",),
        needs=needs,
        gives=gives,
        licence="none",
        deterministic=deterministic,
        equivariances=claims,
    )
    for needs in _subsets(("rgb", "depth"))
    for gives in _subsets(("extents", "shape"))
    for deterministic in (False, True)
    for claims in _subsets(EQUIVARIANCES)
]


def condition(holds: Callable[[MethodInfo], bool]) -> str:
    """When a predicate of a declaration holds, in words, found by trying every declaration."""
    wanted = [holds(info) for info in _INFOS]
    if not any(wanted):
        return "never"
    for size in range(3):
        for names in itertools.combinations(_DECLARATIONS, size):
            if wanted == [all(_DECLARATIONS[n](info) for n in names) for info in _INFOS]:
                return f"if {' and '.join(names)}" if names else "always"
    raise ValueError(f"{holds}: no two declarations say when it holds; describe it here")


def contract() -> str:
    """The contract of methods."""
    return table(
        ["check", "smoke", "what holds", "made", "demanded"],
        (
            (
                f"[`{check.name}`](../method-contract.md#the-checks)",
                "yes" if check.smoke else "",
                check.statement,
                condition(check.applies),
                condition(check.demanded),
            )
            for check in CONTRACT.values()
        ),
    )


def dataset_checks() -> str:
    """The checks of data sets."""
    return table(
        ["check", "what holds"],
        ((code(name), first_line(check.__doc__)) for name, check in CHECKS.items()),
    )


def dataset_limits() -> str:
    """The constants that they compare with."""
    return table(
        ["constant", "value", "meaning"],
        (
            (code(name), f"{getattr(sanity, name):.4g}", told)
            for name, told in doc_comments(sanity).items()
            if name.isupper() and isinstance(getattr(sanity, name), (int, float))
        ),
    )


def offers() -> str:
    """The metrics that an implementation can offer."""
    return table(
        ["metric", "arguments", "gives", "declarations, the default first"],
        (
            (
                code(name),
                known.arguments,
                known.gives,
                "; ".join(f"`{key}`: {codes(map(_choice, c))}" for key, c in known.choices.items()),
            )
            for name, known in KNOWN.items()
        ),
    )


def _choice(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def properties() -> str:
    """The properties of implementations of metrics, one table per metric."""
    groups: dict[str, list[tuple[str, str, str]]] = {}
    for entry in PROPERTIES.values():
        metric, _, name = entry.name.partition(".")
        groups.setdefault(metric, []).append((code(name), entry.statement, entry.reason))
    parts = []
    for metric, rows in groups.items():
        parts.append(heading(3, code(metric), f"properties-{metric}"))
        parts.append(table(["property", "what holds", "why"], rows))
    return "\n\n".join(parts)
