"""A GPU's way of doing things, followed on a CPU: what is queued there is replayed from a record of
its operators, and a look at a value while it is recorded fails as it does there."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

#: Operators whose result, or its shape, is known on the host only when the device is done.
WAITED_FOR = {
    *("_local_scalar_dense", "item", "nonzero", "masked_select", "_unique2", "unique_dim"),
    *("unique_consecutive", "repeat_interleave.Tensor", "equal", "is_nonzero"),
}
#: What is copied from the host, which a graph must not be told to do.
FROM_HOST = {"lift_fresh"}


def name_of(function: Any) -> str:
    """Such as ``add.Tensor``; of a first overload, ``mm``."""
    return str(function).removeprefix("aten.").removesuffix(".default")


def tensors(values: object) -> list[Tensor]:
    return [x for x in tree_leaves(values) if isinstance(x, Tensor)]


def is_waited_for(function: Any, arguments: object) -> bool:
    """Whether the host waits for the device in an operator; an index of truth values asks how many
    are true."""
    name = name_of(function)
    if name.startswith(("index.", "index_put")):
        _, *others = tensors(arguments)
        return any(x.dtype in (torch.bool, torch.uint8) for x in others)
    return name in WAITED_FOR


class Operators(TorchDispatchMode):
    """Counts the operators that run, with the types of the tensors that they are given, and those
    that are waited for."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: dict[str, set[torch.dtype]] = {}
        self.waits = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.namespace != "aten":  # of torch's profiler
            return func(*args, **(kwargs or {}))
        given = tensors((args, kwargs))
        self.seen.setdefault(name_of(func), set()).update(x.dtype for x in given)
        self.waits += is_waited_for(func, args)
        return func(*args, **(kwargs or {}))


class _Record(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.done: list[tuple[Any, Any, Any, Any]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if is_waited_for(func, args) or name_of(func) in FROM_HOST:
            raise RuntimeError(f"{name_of(func)}: operation not permitted when stream is capturing")
        found = func(*args, **(kwargs or {}))
        self.done.append((func, args, kwargs or {}, found))
        return found


def capture(function: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
    """In place of :func:`method_adapters._networks.graphs.capture`: the operators of a call, which
    are done again with the same tensors."""
    function()
    with _Record() as record:
        result = function()

    @torch.no_grad()
    def replay() -> None:
        for func, args, kwargs, found in record.done:
            again = func(*args, **kwargs)
            for kept, new in zip(tensors(found), tensors(again), strict=True):
                if kept.data_ptr() != new.data_ptr():
                    kept.copy_(new)

    return replay, result


@contextmanager
def as_on_a_device(patch: Callable[..., None]) -> Iterator[None]:
    """With the ways that are taken on a GPU; ``patch``: setattr that is undone."""
    for name, module in list(sys.modules.items()):
        if name.startswith("method_adapters."):
            if hasattr(module, "queued"):
                patch(module, "queued", lambda x: True)
            if hasattr(module, "capture"):
                patch(module, "capture", capture)
    yield
