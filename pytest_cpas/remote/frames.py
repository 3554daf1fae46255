"""Frames as the harness reads and writes them: what comes is foreign bytes.

A frame is described in :mod:`pytest_cpas.remote.worker`. Nothing is unpickled; a header is JSON of
bounded size, arrays have one of few types and as many bytes as they are announced with.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.reading.structured import json_value
from pytest_cpas.remote.worker import LARGEST_BODY, LARGEST_HEADER, LENGTHS, MOST_ARRAYS
from pytest_cpas.types import DataError, ToldError, shown

__all__ = ["FrameError", "arrays_of", "encoded", "header_of", "sizes_of"]

#: Axes of an array at most.
_MOST_AXES = 8

#: Types of arrays, as numpy writes them: numbers, little-endian.
_TYPES = frozenset({"<f2", "<f4", "<f8", "|i1", "<i2", "<i4", "<i8", "|u1", "<u2", "<u4", "<u8"})


class FrameError(ToldError):
    """Bytes that are no answer of a worker."""


def encoded(token: bytes, header: Mapping[str, Any], arrays: Sequence[NDArray[Any]]) -> list[Any]:
    """A request as pieces to write one after the other; arrays are not copied."""
    arrays = [np.asarray(array, order="C") for array in arrays]
    told = {**header, "arrays": [[array.dtype.str, array.shape] for array in arrays]}
    text = json.dumps(told).encode("ascii")
    size = sum(array.nbytes for array in arrays)
    bodies = [array.data.cast("B") for array in arrays if array.size]
    return [token + LENGTHS.pack(len(text), size) + text, *bodies, token]


def sizes_of(lengths: bytes) -> tuple[int, int]:
    """Bytes of a header and of its arrays; :class:`FrameError` for more than is read."""
    header, body = LENGTHS.unpack(lengths)
    for size, most, what in ((header, LARGEST_HEADER, "header"), (body, LARGEST_BODY, "arrays")):
        if size > most:
            raise FrameError(f"an answer whose {what} takes {size} bytes, at most {most} are read")
    return header, body


def header_of(content: bytes) -> dict[str, Any]:
    """What a header says; :class:`FrameError` if that is nothing."""
    try:
        header = json_value("a header", content)
    except DataError as error:
        raise FrameError(f"an answer with {error}") from None
    if not isinstance(header, dict) or not isinstance(header.get("arrays"), list):
        raise FrameError(f"an answer whose header is {shown(header)}")
    return header


def arrays_of(header: Mapping[str, Any], body: bytearray) -> list[NDArray[Any]]:
    """The arrays that a header tells of; :class:`FrameError` if they are others."""
    told = header["arrays"]
    if len(told) > MOST_ARRAYS:
        raise FrameError(f"an answer of {len(told)} arrays, at most {MOST_ARRAYS} are read")
    arrays = []
    start = 0
    for each in told:
        dtype, shape = each if isinstance(each, list) and len(each) == 2 else ("", [-1])
        fits = isinstance(shape, list) and len(shape) <= _MOST_AXES
        known = isinstance(dtype, str) and dtype in _TYPES
        if not (known and fits and all(type(n) is int and n >= 0 for n in shape)):
            raise FrameError(f"an answer with an array that is {shown(each)}")
        count = 1
        for length in shape:
            count *= length
        end = start + count * np.dtype(dtype).itemsize
        if end > len(body):
            raise FrameError(f"an answer whose arrays take more than its {len(body)} bytes")
        arrays.append(np.frombuffer(body, dtype, count, start).reshape(shape))
        start = end
    if start != len(body):
        raise FrameError(f"an answer whose arrays take {start} of its {len(body)} bytes")
    return arrays
