"""A value of a trace: an array, or what is kept of one that is too large.

Of a large one every ``stride``-th number is kept, in C order, with a digest and the norm of the
whole: two that are equal to the last bit are known to be, and two that are not are compared by
what was kept.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.reading.text import terminal_line
from pytest_cpas.types import AnswerError

Array = NDArray[Any]

#: What a value is: a part of the observation, tapped, drawn at random, or a part of the answer.
Kind = Literal["observation", "tap", "draw", "answer"]
KINDS: tuple[Kind, ...] = ("observation", "tap", "draw", "answer")


@dataclass(frozen=True, eq=False, kw_only=True)
class Value:
    """A named value of a prediction.

    ``call``: from 1, the how-manyth of that name; ``stage``: in which it was named, "" in none.
    ``kept``: the array, or with a ``stride`` above 1 every so-manyth of its numbers (N,).
    ``shape``, ``digest`` and ``norm`` are of the whole; the norm is None where it is no finite
    number. ``spread``: the largest relative difference that was measured between right answers of
    one code, None where it was not, infinite where float noise has made another choice before.
    """

    name: str
    call: int
    kind: Kind
    stage: str
    kept: Array
    shape: tuple[int, ...]
    digest: str
    norm: float | None
    stride: int = 1
    spread: float | None = None

    @classmethod
    def of(cls, name: str, call: int, kind: Kind, stage: str, array: Array) -> Value:
        """Of a whole array, which is not copied."""
        return cls(
            name=name,
            call=call,
            kind=kind,
            stage=stage,
            kept=array,
            shape=array.shape,
            digest=digest_of(array),
            norm=norm_of(array),
        )

    @property
    def key(self) -> tuple[str, int]:
        """Name and call."""
        return self.name, self.call

    @property
    def size(self) -> int:
        """Numbers in the whole."""
        return math.prod(self.shape)

    @property
    def is_whole(self) -> bool:
        """Whether all numbers are kept."""
        return self.stride == 1

    @property
    def is_open(self) -> bool:
        """Whether two right codes may differ in it by anything."""
        return self.spread == math.inf

    @property
    def is_real(self) -> bool:
        """Whether it holds real numbers, which float noise can change."""
        return self.kept.dtype.kind == "f"

    def thinned(self, stride: int) -> Value:
        """With every ``stride``-th of its numbers, or fewer if it is thinned already."""
        if stride <= self.stride:
            return self
        if stride % self.stride:
            stride += self.stride - stride % self.stride
        kept = np.ravel(self.kept)[:: stride // self.stride]
        return self.replaced(kept=kept, stride=stride)

    def replaced(self, **changes: Any) -> Value:
        """With other attributes."""
        return Value(**{**{name: getattr(self, name) for name in _NAMES}, **changes})

    @property
    def told(self) -> str:
        """Name and call, in words; a name is text from outside."""
        name = terminal_line(self.name)
        return name if self.call == 1 else f"{name}, call {self.call}"


_NAMES = tuple(Value.__dataclass_fields__)


def digest_of(array: Array) -> str:
    """Of kind, shape and numbers, whatever their order in memory: float32 is none of float64."""
    little = array.astype(array.dtype.newbyteorder("<"), copy=False)
    told = f"{little.dtype.str} {array.shape} ".encode()
    return hashlib.sha256(told + np.ascontiguousarray(little).tobytes()).hexdigest()[:16]


def norm_of(array: Array) -> float | None:
    """The Euclidean norm; None where that is no finite number."""
    if array.dtype.kind not in "fiub":
        return None
    norm = float(np.linalg.norm(np.ravel(array).astype(float)))
    return norm if math.isfinite(norm) else None


def plain_array(name: str, value: Any) -> Array:
    """A copy of an array, tensor or number as an array of numbers, truth values or texts.

    Complex numbers get an axis more, of real and imaginary parts. Raises
    :class:`pytest_cpas.types.AnswerError` for anything else.
    """
    if hasattr(value, "detach"):
        value = value.detach()
        if str(value.dtype) == "torch.bfloat16":  # which numpy does not have
            value = value.float()
        value = value.cpu().numpy()
    array = np.array(value)
    if array.dtype.kind == "c":
        array = np.stack([array.real, array.imag], axis=-1)
    if array.dtype.kind not in "biufU":
        raise AnswerError(
            f"tap {name!r}: {type(value).__name__} of {array.dtype}, expected numbers: an array, a"
            " tensor, or a tuple, list or dict of such"
        )
    if array.dtype.itemsize > 8 and array.dtype.kind == "f":
        array = array.astype(float)
    return array


def parts_of(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The arrays in a value, each with a name: of tuples, lists and dicts the parts."""
    if value is None:
        return
    fields: Sequence[str] | None = getattr(value, "_fields", None)
    if isinstance(value, Mapping):
        named = [(str(key), part) for key, part in value.items()]
    elif isinstance(value, tuple) and fields is not None:
        named = list(zip(fields, value, strict=True))
    elif isinstance(value, (tuple, list)) and not _is_numbers(value):
        named = [(str(index), part) for index, part in enumerate(value)]
    else:
        yield name, value
        return
    for part_name, part in named:
        yield from parts_of(f"{name}.{part_name}", part)


def _is_numbers(value: Sequence[Any]) -> bool:
    return all(isinstance(part, (bool, int, float)) for part in value)
