"""What the lines of a results file may hold: each value is of the kind, and in the range, that a
run writes, whatever the checksum says.

Every function raises :class:`ValueError` that says what was seen and what was expected.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, TypeVar

from pytest_cpas.evaluation.estimates import decode_estimates, decode_shape
from pytest_cpas.evaluation.rows import THRESHOLDS, Row
from pytest_cpas.metrics.precision import FAILED
from pytest_cpas.types import SampleRef

__all__ = ["contract", "header", "ref", "row", "text", "texts"]

_T = TypeVar("_T")

_REPEATS = re.compile(rf"(?:[01-]{{{len(THRESHOLDS)}}}(?: (?!$)|$))*")

#: The errors of a row: what a failed prediction has, and the largest.
_ERRORS = {
    "translation_error": (FAILED["position_m"], math.inf),
    "rotation_error": (FAILED["rotation_deg"], 180.0),
    "iou": (FAILED["iou"], 1.0),
    "fscore_1cm": (FAILED["fscore"], 1.0),
}
#: Those that may be n/a.
_OPTIONAL_ERRORS = ("iou", "fscore_1cm")

_ROW = {field.name for field in fields(Row)} - {"sample", "category"}

#: No two positions that are read are farther apart, metres.
LARGEST_ERROR = 1e31

#: Share of a limit by which rounding may exceed it.
_SLACK = 1e-9


def text(name: str, value: Any) -> str:
    """A text."""
    if not isinstance(value, str):
        raise ValueError(f"{name} is {_shown(value)}, expected a text")
    return value


def texts(name: str, value: Any) -> dict[str, str]:
    """A mapping from text to text."""
    return _mapping(name, value, text)


def ref(value: Any) -> SampleRef:
    """The sample that a line is about."""
    if not isinstance(value, list) or len(value) != 4:
        raise ValueError(f"ref is {_shown(value)}, expected id, category, scene and model")
    name, category, scene, model = (text("ref", part) for part in value)
    return SampleRef(id=name, category=category, scene=scene, model=model)


def row(sample: SampleRef, value: Any) -> Row:
    """The row of ``sample``."""
    if not isinstance(value, dict) or value.keys() != _ROW:
        raise ValueError(f"row is {_shown(value)}, expected {', '.join(sorted(_ROW))}")
    reason = value["failure"]
    if reason is not None:
        text("failure", reason)
    for name in _ERRORS:
        _check_error(name, value[name], failed=reason is not None)
    if value["estimate"] is not None:
        _decoded("estimate", value["estimate"], lambda told: decode_estimates([told]))
    if value["shape"] is not None:
        _decoded("shape", value["shape"], decode_shape)
    if not _REPEATS.fullmatch(text("repeats", value["repeats"])):
        raise ValueError(f"repeats is {_shown(value['repeats'])}, expected outcomes such as 11-0")
    return Row(sample=sample.id, category=sample.category, **value)


def header(value: Any) -> dict[str, Any]:
    """The fields of a header."""
    if not isinstance(value, dict) or value.keys() != _HEADER.keys():
        raise ValueError(f"header is {_shown(value)}, expected {', '.join(sorted(_HEADER))}")
    return {name: check(name, value[name]) for name, check in _HEADER.items()}


def contract(value: Any) -> dict[str, Any]:
    """What a check of the contract found."""
    if not isinstance(value, dict) or value.keys() != _CONTRACT.keys():
        raise ValueError(f"contract is {_shown(value)}, expected {', '.join(sorted(_CONTRACT))}")
    return {name: check(name, value[name]) for name, check in _CONTRACT.items()}


def _check_error(name: str, value: Any, *, failed: bool) -> None:
    if value is None and name in _OPTIONAL_ERRORS:
        return
    number = isinstance(value, int | float) and not isinstance(value, bool)
    of_failed, most = _ERRORS[name]
    largest = min(most * (1 + _SLACK), LARGEST_ERROR)
    if number and (value == of_failed if failed else 0 <= value <= largest):
        return
    expected = f"{of_failed} of a failed prediction" if failed else f"a number from 0 to {most:g}"
    raise ValueError(f"{name} is {_shown(value)}, expected {expected}")


def _decoded(name: str, value: Any, decode: Callable[[str], object]) -> None:
    try:
        decode(text(name, value))
    except ValueError as error:
        raise ValueError(f"{name} is {_shown(value)} ({error})") from error


def _shown(value: Any) -> str:
    seen = repr(value)  # what comes from JSON here is not nested deep
    return seen if len(seen) <= 80 else f"{seen[:77]}..."


def _mapping(name: str, value: Any, check: Callable[[str, Any], _T]) -> dict[str, _T]:
    if not isinstance(value, dict):
        raise ValueError(f"{name} is {_shown(value)}, expected a mapping")
    return {key: check(f"{name} of {key}", part) for key, part in value.items()}


def _list(name: str, value: Any) -> list[str]:
    if not isinstance(value, list):
        raise ValueError(f"{name} is {_shown(value)}, expected a list of texts")
    return [text(name, part) for part in value]


def _count(name: str, value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**62:
        raise ValueError(f"{name} is {_shown(value)}, expected a count")
    return value


def _counts(name: str, value: Any) -> Mapping[str, int]:
    return _mapping(name, value, _count)


def _seeds(name: str, value: Any) -> int:
    if _count(name, value) < 1:
        raise ValueError(f"{name} is {value}, expected at least 1")
    return int(value)


def _shard(name: str, value: Any) -> str:
    found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text(name, value))
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise ValueError(f"{name} is {_shown(value)}, expected i/n with 1 <= i <= n")
    return str(value)


def _flag(name: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{name} is {_shown(value)}, expected true or false")
    return value


_HEADER: Mapping[str, Callable[[str, Any], Any]] = {
    "method": text,
    "dataset": text,
    "shard": _shard,
    "selected": _count,
    "listed": _counts,
    "missing": _list,
    "damaged": _list,
    "identity": texts,
    "provenance": texts,
    "seeds": _seeds,
    "under_contract": _flag,
    "nonce": text,
}

#: As :class:`pytest_cpas.checks.contract.ContractResult` tells it.
_CONTRACT: Mapping[str, Callable[[str, Any], Any]] = {
    "check": text,
    "outcome": text,
    "demanded": _flag,
    "message": text,
    "known": _flag,
    "recorded": _flag,
}
