"""What is done on a GPU without waiting for it: functions of tensors as CUDA graphs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

ResultT = TypeVar("ResultT")

#: Graphs that are kept of one function, each with the memory of its intermediate results.
MOST = 8


def queued(x: Tensor) -> bool:
    """Whether operators on ``x`` are only queued, as on a GPU: there each costs its launch however
    little it does, and a look at a value waits for all of them."""
    return x.is_cuda


def exponential_(x: Tensor) -> Tensor:
    """In place; on a CPU as numpy rounds it, with which choices were recorded that hang on it."""
    if queued(x):
        return x.exp_()
    np.exp(x.numpy(), out=x.numpy())
    return x


class _Captured(NamedTuple):
    replay: Callable[[], object]
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]


class Graphs:
    """A function of tensors whose launches are replayed, for inputs of kinds that come again.

    The function gives a tuple of tensors, looks at no value on the host, and does the same for all
    inputs of one kind (shapes and types). The first of a kind, and all when ``MOST`` kinds are
    kept, are computed the plain way: where every input is of a kind of its own nothing is captured.
    """

    def __init__(self, function: Callable[..., tuple[Tensor, ...]]) -> None:
        self._function = function
        self._captured: dict[tuple[Any, ...], _Captured | None] = {}

    def __call__(self, *given: Tensor) -> tuple[Tensor, ...]:
        """What the function gives."""
        # a graph keeps the numerics with which it was captured
        key = (*((x.shape, x.dtype) for x in given), *numerics())
        captured = self._captured.get(key)
        if captured is None:
            if key not in self._captured or self._full():
                self._captured[key] = None
                return tuple(self._function(*given))
            captured = self._captured[key] = self._capture(given)
        for kept, x in zip(captured.inputs, given, strict=True):
            kept.copy_(x)
        captured.replay()
        # the next replay writes where this one did
        return tuple(output.clone() for output in captured.outputs)

    def _full(self) -> bool:
        return sum(kept is not None for kept in self._captured.values()) >= MOST

    def _capture(self, given: tuple[Tensor, ...]) -> _Captured:
        inputs = tuple(x.clone() for x in given)
        replay, outputs = capture(lambda: tuple(self._function(*inputs)))
        return _Captured(replay, inputs, outputs)


def capture(function: Callable[[], ResultT]) -> tuple[Callable[[], object], ResultT]:
    """How to do again what a function of nothing does on the GPU, and what it gave: tensors that
    are written anew each time.

    It is called twice: what is made once, such as workspaces, is not to be made within the graph.
    """
    aside = torch.cuda.Stream()
    aside.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(aside):
        function()
    torch.cuda.current_stream().wait_stream(aside)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = function()
    return graph.replay, result


def numerics() -> tuple[object, ...]:
    """What a graph keeps of how torch was set when it was captured; convolutions are always of full
    precision."""
    matmul = torch.backends.cuda.matmul
    # torch from 2.9 on has both ways, and refuses to tell by the older what was set by the newer
    precision = getattr(matmul, "fp32_precision", None) or matmul.allow_tf32
    return torch.are_deterministic_algorithms_enabled(), precision
