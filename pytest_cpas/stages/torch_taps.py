"""Tapping what every part of a torch network returns. torch itself is not imported."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from contextlib import ExitStack
from fnmatch import fnmatchcase
from typing import Any

from pytest_cpas.stages.taps import Listener, heard_by


class TorchTaps:
    """``with TorchTaps(network):`` taps the output of every submodule that runs in the block.

    A submodule's tap is called ``NAME.PATH``, with its dotted path in ``module``; the module
    itself is called NAME. ``include`` and ``exclude``: patterns of paths with ``*``, such as
    ``encoder.*``; the module itself has the path "". A part whose ``forward`` is not called,
    because the code uses its weights otherwise, has no output to tap: name that by ``tap``.

    While nobody listens no hook is set.
    """

    def __init__(
        self,
        module: Any,
        name: str = "network",
        *,
        include: Sequence[str] = ("*",),
        exclude: Sequence[str] = (),
    ) -> None:
        """``module``: a ``torch.nn.Module``."""
        self._module, self._name = module, name
        self._include, self._exclude = include, exclude
        self._undo: ExitStack | None = None

    def __enter__(self) -> TorchTaps:
        listener = heard_by()
        if listener is not None:
            with ExitStack() as undo:
                if listener.wide:
                    _widen(self._module, self._name, listener, undo)
                for path, part in self._module.named_modules():
                    if self._is_named(path):
                        name = f"{self._name}.{path}" if path else self._name
                        hook = functools.partial(_hear, listener, name)
                        undo.callback(part.register_forward_hook(hook).remove)
                self._undo = undo.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        if self._undo is not None:
            self._undo.close()
            self._undo = None

    def _is_named(self, path: str) -> bool:
        def among(patterns: Sequence[str]) -> bool:
            return any(fnmatchcase(path, pattern) for pattern in patterns)

        return among(self._include) and not among(self._exclude)


def _hear(listener: Listener, name: str, _module: object, _inputs: object, output: object) -> None:
    listener.tapped(name, output)


def _widen(module: Any, name: str, listener: Listener, undo: ExitStack) -> None:
    """Have a network of float32 compute in float64 until ``undo``: its weights stay what they
    are."""
    parameters = [*module.parameters(), *module.buffers()]
    kinds = {str(part.dtype) for part in parameters if part.is_floating_point()}
    if kinds != {"torch.float32"}:
        seen = ", ".join(sorted(kinds)) or "no numbers"
        listener.widened(name, f"it holds {seen}, not torch.float32 alone")
        return
    listener.widened(name, "")
    undo.callback(module.float)
    module.double()
    handle = module.register_forward_pre_hook(_wide_inputs, with_kwargs=True)
    undo.callback(handle.remove)


def _wide_inputs(_module: object, args: Any, kwargs: Any) -> tuple[Any, Any]:
    def wide(value: Any) -> Any:
        return value.double() if getattr(value, "is_floating_point", bool)() else value

    return tuple(map(wide, args)), {key: wide(value) for key, value in kwargs.items()}
