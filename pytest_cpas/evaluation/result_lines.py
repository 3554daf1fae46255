"""What the lines of a results file may hold: each value is of the kind, and in the range, that a
run writes, whatever the checksum says.

Every function raises :class:`ValueError` that says what was seen and what was expected.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import fields
from typing import Any, TypeVar

from pytest_cpas.evaluation.estimates import decode_estimates, decode_shape
from pytest_cpas.evaluation.rows import Answer, Detection, Row
from pytest_cpas.facts import fact
from pytest_cpas.types import SampleRef, shown
from pytest_cpas.types._arrays import MAX

__all__ = [
    "check_row",
    "contract",
    "header",
    "line",
    "ref",
    "row",
    "several_texts",
    "text",
    "texts",
]

_T = TypeVar("_T")

_ROW = {field.name for field in fields(Row)} - {"sample", "category", "detections"}

_DETECTION = {field.name for field in fields(Detection)}

_ANSWER = {field.name for field in fields(Answer)}

#: Facts that every answer has.
_POSE = ("position_m", "rotation_deg")

#: No two positions that are read are farther apart, metres.
LARGEST_ERROR = 1e31

#: Characters of a text: more than a run keeps of a reason, an exception or a message, each of which
#: it shortens to thousands.
LONGEST_TEXT = 2**20

#: Detections that are ranked with a sample: no more are read of an image.
MOST_DETECTIONS = 300

_FIRST_LINE = ({"header", "format"},)
_OTHER_LINES = (
    {"row", "ref"},
    {"error", "ref"},
    {"contract"},
    {"changed"},
    {"opened"},
    {"program", "files"},
)

#: Share of a limit by which rounding may exceed it.
_SLACK = 1e-9


def line(value: Any, *, first: bool) -> dict[str, Any]:
    """A line, which has the keys of one of the kinds of lines; the ``first`` one has a header."""
    kinds = _FIRST_LINE if first else _OTHER_LINES
    if not isinstance(value, dict) or value.keys() not in kinds:
        expected = "; or ".join(" and ".join(sorted(keys)) for keys in kinds)
        raise ValueError(f"the line is {shown(value)}, expected {expected}")
    return value


def text(name: str, value: Any) -> str:
    """A text, of at most :data:`LONGEST_TEXT` characters."""
    if not isinstance(value, str):
        raise ValueError(f"{name} is {shown(value)}, expected a text")
    if len(value) > LONGEST_TEXT:
        raise ValueError(
            f"{name} is {shown(value)}, a text of {len(value)} characters, expected at most"
            f" {LONGEST_TEXT}"
        )
    return value


def texts(name: str, value: Any) -> dict[str, str]:
    """A mapping from text to text."""
    return _mapping(name, value, text)


def several_texts(name: str, value: Any) -> list[str]:
    """A list of texts."""
    if not isinstance(value, list):
        raise ValueError(f"{name} is {shown(value)}, expected a list of texts")
    return [text(name, part) for part in value]


def ref(value: Any) -> SampleRef:
    """The sample that a line is about."""
    if not isinstance(value, list) or len(value) != 4:
        raise ValueError(f"ref is {shown(value)}, expected id, category, scene and model")
    name, category, scene, model = (text("ref", part) for part in value)
    return SampleRef(id=name, category=category, scene=scene, model=model)


def row(sample: SampleRef, value: Any) -> Row:
    """The row of ``sample``."""
    if not isinstance(value, dict) or value.keys() - {"detections"} != _ROW:
        raise ValueError(f"row is {shown(value)}, expected {', '.join(sorted(_ROW))}")
    if value["shape"] is not None:
        _decoded("shape", value["shape"], decode_shape)
    if not isinstance(value["answers"], list) or not value["answers"]:
        raise ValueError(f"answers is {shown(value['answers'])}, expected one for each seed")
    answers = tuple(map(_answer, value["answers"]))
    found = value.get("detections", [])
    if not isinstance(found, list) or len(found) > MOST_DETECTIONS:
        raise ValueError(f"detections is {shown(found)}, expected at most {MOST_DETECTIONS}")
    return Row(
        sample=sample.id,
        category=sample.category,
        answers=answers,
        shape=value["shape"],
        detections=tuple(map(_detection, found)),
    )


def _detection(value: Any) -> Detection:
    if not isinstance(value, dict) or value.keys() != _DETECTION:
        raise ValueError(f"detection is {shown(value)}, expected {', '.join(sorted(_DETECTION))}")
    for name in ("name", "image", "category"):
        text(name, value[name])
    score = value["score"]
    if not isinstance(score, float) or not abs(score) <= MAX:
        raise ValueError(f"score is {shown(score)}, expected a finite number")
    if value["estimate"] is not None:
        _decoded("estimate", value["estimate"], lambda told: decode_estimates([told]))
    return Detection(**value)


def check_row(row: Row, first: Row, seeds: int, defined: Collection[str]) -> None:
    """That a row has an answer for each of the ``seeds``, and of the facts that are ``defined``
    those that the ``first`` row has."""
    if len(row.answers) != seeds:
        raise ValueError(f"{len(row.answers)} answers, expected one for each of {seeds} seeds")
    for answer in row.answers:
        if other := sorted(answer.facts.keys() ^ first.facts.keys()):
            raise ValueError(f"{shown(other)}: facts that only one of two answers has")
    if unknown := sorted(row.facts.keys() - set(defined)):
        raise ValueError(f"{shown(unknown)}: facts that the header does not define")


def _answer(value: Any) -> Answer:
    if not isinstance(value, dict) or value.keys() != _ANSWER:
        raise ValueError(f"answer is {shown(value)}, expected {', '.join(sorted(_ANSWER))}")
    if value["failure"] is not None:
        text("failure", value["failure"])
    if value["estimate"] is not None:
        _decoded("estimate", value["estimate"], lambda told: decode_estimates([told]))
    facts = _mapping("facts", value["facts"], lambda name, number: number)
    for name, number in facts.items():
        _check_fact(name, number, failed=value["failure"] is not None)
    return Answer(facts=facts, failure=value["failure"], estimate=value["estimate"])


def header(value: Any) -> dict[str, Any]:
    """The fields of a header."""
    if not isinstance(value, dict) or value.keys() != _HEADER.keys():
        raise ValueError(f"header is {shown(value)}, expected {', '.join(sorted(_HEADER))}")
    return {name: check(name, value[name]) for name, check in _HEADER.items()}


def contract(value: Any) -> dict[str, Any]:
    """What a check of the contract found."""
    if not isinstance(value, dict) or value.keys() != _CONTRACT.keys():
        raise ValueError(f"contract is {shown(value)}, expected {', '.join(sorted(_CONTRACT))}")
    return {name: check(name, value[name]) for name, check in _CONTRACT.items()}


def _check_fact(name: str, value: Any, *, failed: bool) -> None:
    made = fact(name)
    if value is None and name not in _POSE:
        return
    number = isinstance(value, int | float) and not isinstance(value, bool)
    most = min(made.most, LARGEST_ERROR if made.unit == "m" else MAX)
    if number and (value == made.failed if failed else 0 <= value <= most * (1 + _SLACK)):
        return
    expected = f"{made.failed} of a failed prediction" if failed else f"a number from 0 to {most:g}"
    raise ValueError(f"{name} is {shown(value)}, expected {expected}")


def _decoded(name: str, value: Any, decode: Callable[[str], object]) -> None:
    try:
        decode(text(name, value))
    except ValueError as error:
        raise ValueError(f"{name} is {shown(value)} ({error})") from error


def _mapping(name: str, value: Any, check: Callable[[str, Any], _T]) -> dict[str, _T]:
    if not isinstance(value, dict):
        raise ValueError(f"{name} is {shown(value)}, expected a mapping")
    return {key: check(f"{name} of {key}", part) for key, part in value.items()}


def _count(name: str, value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**62:
        raise ValueError(f"{name} is {shown(value)}, expected a count")
    return value


def _counts(name: str, value: Any) -> Mapping[str, int]:
    counts = _mapping(name, value, _count)
    for category in counts:
        SampleRef(id="any", category=category, scene="")  # checks what it is called
    return counts


def _seeds(name: str, value: Any) -> int:
    if _count(name, value) < 1:
        raise ValueError(f"{name} is {value}, expected at least 1")
    return int(value)


def _shard(name: str, value: Any) -> str:
    found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text(name, value))
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise ValueError(f"{name} is {shown(value)}, expected i/n with 1 <= i <= n")
    return str(value)


def _flag(name: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{name} is {shown(value)}, expected true or false")
    return value


_HEADER: Mapping[str, Callable[[str, Any], Any]] = {
    "method": text,
    "dataset": text,
    "shard": _shard,
    "selected": _count,
    "listed": _counts,
    "missing": several_texts,
    "derived": text,
    "damaged": several_texts,
    "identity": texts,
    "definitions": texts,
    "provenance": texts,
    "files": texts,
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
