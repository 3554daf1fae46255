"""Checking properties: searching for a counterexample, or replaying a recorded one."""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import time
import traceback
import warnings
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
from hypothesis import HealthCheck, Phase, Verbosity, given, settings
from hypothesis import strategies as st

from pytest_cpas.checks.metrics.adapter import Offer
from pytest_cpas.checks.metrics.properties import Property
from pytest_cpas.checks.metrics.subject import Subject, time_limit
from pytest_cpas.checks.outcome import Finding, Outcome
from pytest_cpas.reading.structured import parse_json
from pytest_cpas.registry import resolve
from pytest_cpas.types import DeclarationError

__all__ = ["DEFAULT_EXAMPLES", "DEFAULT_TIME_LIMIT", "Result", "check", "load_subject", "replay"]

#: Examples per property (of weight 1), and seconds per property.
DEFAULT_EXAMPLES = 40
DEFAULT_TIME_LIMIT = 60.0


@dataclass(frozen=True)
class Result:
    """What became of one property of one implementation.

    ``message``: what was seen and what was expected. ``case``: the counterexample's values as
    JSON, from which :func:`replay` makes it anew. ``snippet``: its calls, as code to paste.
    """

    subject: str
    property: str
    outcome: Outcome
    message: str = ""
    case: str = ""
    snippet: str = ""
    examples: int = 0
    seconds: float = 0.0


def load_subject(name: str) -> Subject:
    """The implementation registered as ``name``, or whose adapter is module ``package.module``.

    Raises :class:`RegistryError` or :class:`DeclarationError`.
    """
    return as_subject(name, resolve("metric", name))


def as_subject(name: str, metrics: object) -> Subject:
    """The subject of an adapter; :class:`DeclarationError` if it is none."""
    if not isinstance(metrics, Mapping) or not all(
        isinstance(entry, Offer) for entry in metrics.values()
    ):
        raise DeclarationError(
            f"metrics {name!r}: its adapter is {metrics!r:.80}, expected a mapping of metric names"
            " to offer(function, ...)"
        )
    return Subject(name, metrics)


def adapter_module(name: str) -> Any:
    """The module that holds the adapter of a loaded subject."""
    from pytest_cpas.registry import registered

    for entry in registered("metric"):
        if entry.name == name:
            return importlib.import_module(entry.module)
    return importlib.import_module(name.partition(":")[0])


def check(
    subject: Subject,
    prop: Property,
    *,
    seed: int = 0,
    examples: int = DEFAULT_EXAMPLES,
    limit: float = DEFAULT_TIME_LIMIT,
    shrink: bool = True,
) -> Result:
    """Search for a counterexample: the property's corners, then ``examples`` examples (times its
    weight).

    Deterministic in ``seed``. ``limit``: seconds. Without ``shrink`` the first counterexample is
    kept as it is.
    """
    if not prop.offered_by(subject):
        return Result(subject.name, prop.name, Outcome.NOT_OFFERED)
    found: list[tuple[Finding, str, str]] = []
    tried = 0

    def attempt(case: Mapping[str, Any]) -> None:
        nonlocal tried
        tried += 1
        try:
            _try(subject, prop, case)
        except Finding as finding:
            message = str(finding)
            found.append((finding, json.dumps(case), subject.snippet(message)))
            raise

    @hypothesis.seed(zlib.crc32(f"{prop.name} {seed}".encode()))
    @settings(
        max_examples=max(1, math.ceil(examples * prop.weight)),
        database=None,
        deadline=None,
        phases=(Phase.generate, Phase.shrink) if shrink else (Phase.generate,),
        suppress_health_check=list(HealthCheck),
        report_multiple_bugs=False,
        print_blob=False,
        verbosity=Verbosity.quiet,
    )
    @given(case=st.fixed_dictionaries(dict(prop.given)))
    def search(case: dict[str, Any]) -> None:
        attempt(case)

    start = time.perf_counter()
    broken = ""
    with time_limit(limit), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            # corners are small as they are: what they show is not made smaller
            with _seeded():
                for corner in prop.corners():
                    attempt(corner)
            search()
        except Finding:
            pass
        except Exception:
            # foreign code that is not deterministic confuses the search; what it found is real
            if not found:
                broken = traceback.format_exc()
    seconds = time.perf_counter() - start
    result = Result(subject.name, prop.name, Outcome.PASSED, examples=tried, seconds=seconds)
    if found:
        finding, case, snippet = _smallest(found)
        return replace(
            result, outcome=finding.outcome, message=str(finding), case=case, snippet=snippet
        )
    if broken:
        return replace(result, outcome=Outcome.HARNESS_ERROR, message=broken)
    return result


def _smallest(found: list[tuple[Finding, str, str]]) -> tuple[Finding, str, str]:
    """The last one, which the search ends with, unless time ran out on the way to it."""
    values = [entry for entry in found if entry[0].outcome is not Outcome.HUNG]
    return values[-1] if values else found[0]


def replay(subject: Subject, prop: Property, case: str, *, limit: float = 60.0) -> Result:
    """Try one recorded case again."""
    if not prop.offered_by(subject):
        return Result(subject.name, prop.name, Outcome.NOT_OFFERED)
    start = time.perf_counter()
    outcome, message, snippet = Outcome.PASSED, "", ""
    with time_limit(limit), warnings.catch_warnings(), _seeded():
        warnings.simplefilter("ignore")
        try:
            _try(subject, prop, parse_json(Path("the recorded case"), case.encode()))
        except Finding as finding:
            outcome, message = finding.outcome, str(finding)
            snippet = subject.snippet(message)
        except Exception:
            outcome, message = Outcome.HARNESS_ERROR, traceback.format_exc()
    seconds = time.perf_counter() - start
    return Result(subject.name, prop.name, outcome, message, case, snippet, 1, seconds)


@contextlib.contextmanager
def _seeded() -> Iterator[None]:
    """What foreign code draws from the global random state repeats, as in hypothesis' examples."""
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(0)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(state)  # noqa: NPY002


def _try(subject: Subject, prop: Property, case: Mapping[str, Any]) -> None:
    subject.calls.clear()
    prop.body(subject, **case)
