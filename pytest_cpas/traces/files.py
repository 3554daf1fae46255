"""Traces in files: of each sample one of JSON lines, which says what there is, and one ``.npz``.

The first line is about the trace; each other line is about one value, in their order, and names its
array in the ``.npz``; values that are the same share one. Where there is no ``call`` it is the
first, without ``stride`` the array is whole; nothing is compared from an ``open`` value on. The
first line counts the others, and an array that is whole is that of its ``digest``, so that a torn
file, or that of another sample, is none. The file of lines is written last.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pytest_cpas._files import write_file
from pytest_cpas.reading.arrays import read_npz
from pytest_cpas.reading.files import read_bytes
from pytest_cpas.reading.paths import matching
from pytest_cpas.reading.schemas import check_schema
from pytest_cpas.reading.structured import json_value
from pytest_cpas.traces.recording import MOST_VALUES, Trace, answer_of
from pytest_cpas.traces.values import KINDS, Value, digest_of
from pytest_cpas.types import ContractError, DataError, message_of, shown

__all__ = ["DEFAULT_MOST", "LARGEST_MOST", "Header", "TracedSample", "read_sample", "write_sample"]

FORMAT = "pytest-cpas trace 1"

#: Bytes of the arrays of a sample, unless asked for otherwise, and at most: the reader's limit.
DEFAULT_MOST, LARGEST_MOST = 64 * 2**20, 200 * 2**20

#: Bytes of a file of lines, and of a line.
_LARGEST_LINES, _LONGEST_LINE = 2**24, 2**16

#: Numbers that are kept of an array, however small the limit.
_FEWEST = 8

_TEXTS = {"type": "object", "additionalProperties": {"type": "string"}}
_HEADER: Mapping[str, Any] = {
    "type": "object",
    "properties": {
        "format": {"const": FORMAT},
        **{name: {"type": "string"} for name in ("method", "dataset", "sample", "category")},
        "seed": {"type": "integer"},
        "values": {"type": "integer", "minimum": 0},
        "most": {"type": "integer", "minimum": 0},
        "reason": {"type": ["string", "null"]},
        **dict.fromkeys(("identity", "provenance", "spread_of"), _TEXTS),
    },
    "required": ["format", "method", "dataset", "sample", "category", "seed", "values", "reason"],
}
_VALUE: Mapping[str, Any] = {
    "type": "object",
    "properties": {
        "name": {"type": "string"},
        "call": {"type": "integer", "minimum": 1},
        "kind": {"enum": list(KINDS)},
        "stage": {"type": "string"},
        "shape": {"type": "array", "items": {"type": "integer", "minimum": 0, "maximum": 2**40}},
        "stride": {"type": "integer", "minimum": 1},
        "digest": {"type": "string"},
        "norm": {"type": ["number", "null"]},
        "spread": {"type": "number", "minimum": 0},
        "open": {"const": True},
        "array": {"type": "string"},
    },
    "required": ["name", "kind", "shape", "digest", "norm", "array"],
}


@dataclass(frozen=True, kw_only=True)
class Header:
    """What a trace is of. ``most``: bytes that were to be kept of a sample; ``identity`` of data
    and weights, ``provenance`` of code and machine; ``spread_of``: under which other conditions the
    spread was measured, with what was not possible."""

    method: str
    dataset: str
    sample: str
    category: str
    seed: int
    most: int = DEFAULT_MOST
    identity: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)
    spread_of: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, eq=False)
class TracedSample:
    """A recorded trace, and what it is of."""

    header: Header
    trace: Trace


def stem_of(sample: str) -> str:
    """The name of a sample's files, without suffix: readable, and another for each sample."""
    readable = re.sub(r"[^A-Za-z0-9.-]+", "_", sample)[-60:].strip("._-")
    return f"{readable}-{hashlib.sha256(sample.encode('utf-8', 'replace')).hexdigest()[:8]}"


def write_sample(folder: Path, header: Header, trace: Trace) -> int:
    """Write the files of a sample; the bytes that they have. What is over ``most`` is thinned, the
    largest values first. Raises OSError."""
    values = fitting(trace.values, header.most)
    head = {**vars(header), "values": len(values), "reason": trace.reason}
    lines: list[dict[str, Any]] = [{"format": FORMAT, **head}]
    arrays: dict[str, Any] = {}
    known: dict[tuple[str, int], str] = {}
    for value in values:
        # a block returns what its last part returned
        name = known.setdefault((value.digest, value.stride), f"{len(known):04d}")
        arrays.setdefault(name, value.kept)
        lines.append(
            {
                "name": value.name,
                **({"call": value.call} if value.call > 1 else {}),
                "kind": value.kind,
                **({"stage": value.stage} if value.stage else {}),
                "shape": list(value.shape),
                **({} if value.is_whole else {"stride": value.stride}),
                "digest": value.digest,
                "norm": value.norm,
                **({} if value.spread is None else _spread(value.spread)),
                "array": name,
            }
        )
    stem = stem_of(header.sample)
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)
    text = "".join(json.dumps(line, ensure_ascii=True) + "\n" for line in lines)
    listed = folder / f"{stem}.jsonl"
    # a file of lines beside other arrays would be of no trace
    listed.unlink(missing_ok=True)
    write_file(folder / f"{stem}.npz", packed.getvalue())
    write_file(listed, text)
    return len(packed.getvalue()) + len(text)


def _spread(spread: float) -> dict[str, Any]:
    return {"open": True} if spread == math.inf else {"spread": spread}


def fitting(values: Sequence[Value], most: int) -> list[Value]:
    """The values, thinned so that they have about ``most`` bytes together."""
    sizes = sorted(value.kept.nbytes for value in values)
    cap, left = float(most), float(most)
    for index, size in enumerate(sizes):
        cap = left / (len(sizes) - index)
        if size > cap:
            break
        left -= size
    else:
        return list(values)
    return [value.thinned(value.stride * _stride(value, cap)) for value in values]


def _stride(value: Value, cap: float) -> int:
    size, count = value.kept.nbytes, value.kept.size
    if size <= cap or count <= _FEWEST:
        return 1
    stride = max(1, min(-(-size // max(int(cap), 1)), count // _FEWEST))
    # no factor in common with an axis, or one channel alone would be kept
    while stride > 1 and any(math.gcd(stride, length) > 1 for length in value.shape if length > 1):
        stride += 1
    return stride


def read_sample(path: Path) -> TracedSample:
    """The trace in a file of lines and the ``.npz`` beside it; :class:`DataError` for any other
    file."""
    lines = read_bytes(path, _LARGEST_LINES).splitlines()
    if not 1 <= len(lines) <= MOST_VALUES + 1:
        raise DataError(f"{path}: {len(lines)} lines, expected one to {MOST_VALUES + 1}")
    told = [_line(f"{path}, line {n}", line, n > 1) for n, line in enumerate(lines, start=1)]
    head, *parts = told
    if head["values"] != len(parts):
        raise DataError(f"{path}: {len(parts)} values, expected {head['values']}; it is torn")
    arrays = read_npz(path.with_suffix(".npz"))
    values = [_value(f"{path}, line {n}", part, arrays) for n, part in enumerate(parts, start=2)]
    if len({value.key for value in values}) < len(values):
        raise DataError(f"{path}: a name is there twice with the same call")
    fields = {name: head[name] for name in Header.__dataclass_fields__ if name in head}
    trace = Trace(values=values, reason=head["reason"])
    try:
        answer_of(trace)
    except (ContractError, TypeError, ValueError) as error:
        raise DataError(f"{path}: its answer is none: {message_of(error)}") from error
    return TracedSample(header=Header(**fields), trace=trace)


def read_header(path: Path) -> Header:
    """What a file of lines says of its trace; :class:`DataError` for any other file."""
    first = read_bytes(path, _LARGEST_LINES).partition(b"\n")[0]
    head = _line(f"{path}, line 1", first, False)
    return Header(**{name: head[name] for name in Header.__dataclass_fields__ if name in head})


def samples_in(folder: Path) -> dict[str, Path]:
    """The files of lines in a folder, by sample; :class:`DataError` for one that is damaged."""
    found: dict[str, Path] = {}
    for path in matching(folder, "*.jsonl"):
        found[read_header(path).sample] = path
    return found


def _line(where: str, line: bytes, of_value: bool) -> dict[str, Any]:
    if len(line) > _LONGEST_LINE:
        raise DataError(f"{where}: {len(line)} bytes, at most {_LONGEST_LINE} are read")
    told = json_value(where, line, constants=False)
    if not of_value and isinstance(told, dict) and told.get("format") != FORMAT:
        raise DataError(
            f"{where}: format {told.get('format')!r}, expected {FORMAT!r}, which --cpas-trace"
            " writes"
        )
    check_schema(_VALUE if of_value else _HEADER, told, where)
    checked: dict[str, Any] = told
    return checked


def _value(where: str, told: Mapping[str, Any], arrays: Mapping[str, Any]) -> Value:
    kept = arrays.get(told["array"])
    if kept is None or kept.dtype.kind not in "biufU":
        raise DataError(f"{where}: the .npz has no array {told['array']!r} of numbers or texts")
    shape = tuple(told["shape"])
    size = 1
    for length in shape:
        size *= length
    stride = told.get("stride", 1)
    expected = shape if stride == 1 else (-(-size // stride),)
    if kept.shape != expected:
        raise DataError(f"{where}: {kept.shape} in the .npz, expected {expected}")
    if stride == 1 and digest_of(kept) != told["digest"]:
        raise DataError(f"{where}: the array of {shown(told['name'])} is another one in the .npz")
    return Value(
        **{name: told[name] for name in ("name", "kind", "digest", "norm")},
        call=told.get("call", 1),
        stage=told.get("stage", ""),
        kept=kept,
        shape=shape,
        stride=stride,
        spread=math.inf if told.get("open") else told.get("spread"),
    )
